"""The spot in a frame: where it is, its crop, and frames that are unlike their siblings.

In: the frames of a `Dataset`. Out: frames.nc and crops.nc on the grid of spots, each cell with its status flags.
"""
