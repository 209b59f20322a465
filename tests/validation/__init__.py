"""Validation: data sets of which the truth is known, or part of it, are judged, and the judgements scored.

These are programmes of measurement, not tests: `make validate`, `make validate-second`, `make validate-real`. One
protocol and one judge serve all:

protocol    what a generator of data sets is, and what a job is
generators  rig: the virtual rig's hidden effects; second: code of its own, for the same effects; real: real frames, as
            they are and with an effect put into their readings; light: light that is no Gaussian
judge       from a folder to its verdict by the command line, and from a job to its record
records     one line a job; the records that the published scores follow from
run         the command: as many jobs as the time allows, then the generator's report
outcome     what one record says, and whether it is right
score       from records to figures; figure, intervals: what they are made of
page, picture, table    how figures are written and drawn
times       how long the whole command takes
engine      what only the inside of the present verdict engine tells; all else knows of it no more than a user does

`benchmarks` measures speed and accuracy beside other packages: `make bench`.
"""
