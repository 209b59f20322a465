"""Comparison of measured frames with the model of the instrument, and search for physical effects that the model lacks.

In: crops of spot frames, or levels of flats and darks, and the model of the instrument. Out: a verdict with the effects
that were added to the model, their values and errors, and the part of the residual on held-out frames they explain.
"""
