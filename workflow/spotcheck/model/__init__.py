"""The forward model of a frame: law of the exposure → light of the spot → pixels → sensor.

In: an instrument, effects with their parameters, and the conditions of a frame. Out: mean and variance of its readings,
their derivatives, and random frames.
"""
