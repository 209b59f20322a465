"""Results for other programs: an instrument file with what was learned, and frames in electrons.

In: the results of a dataset, and its frames. Out: instrument.yaml, or a folder of corrected frames.
"""
