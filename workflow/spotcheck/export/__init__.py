"""Export results for other programs and datasets: an instrument file, and frames in electrons.

In: the results of a dataset, and its frames. Out: instrument.yaml with learned values, or a folder of corrected frames.
"""
