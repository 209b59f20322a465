"""Disagreement of simulation and measurement, and the physical effects that the model lacks.

In: crops of spot frames, or levels of flats and darks, with the instrument's model. Out: a verdict: the effects that
were added to the model with values and errors, and how far that closes the gap on held-out frames.
"""
