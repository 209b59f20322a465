"""Validation: data sets of which the truth is known, or part of it, are judged, and the judgements scored.

These are programmes of measurement, not tests: `make validate`, `make validate-real`.

protocol    what a generator of data sets is, and what a job is
generators  light: hidden effects on Gaussian light, real beams and real frames, by code that shares nothing with the
            library or the rig (`second`: its effects and camera); real: flats of a real sensor
judge       from a folder to its verdict by the command line, and from a job to its record
records     one line a job
run         the command: as many jobs as the time allows, then the generator's report
intervals, table    how figures are made and written

`benchmarks` measures speed and accuracy beside other packages: `make bench`.
"""
