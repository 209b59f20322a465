"""Ingest frames, find the spot in each, cut crops, and flag outlier frames.

In: the frames of a `Dataset`. Out: frames.nc, one row per frame, and crops.nc on the grid of spots, where each cell has
status flags.
"""
