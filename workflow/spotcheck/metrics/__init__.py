"""The paper's metrics of crops, and comparison of measured with simulated crops.

In: crops [row, column] in DN. Out: PSNR, speckle contrast, peak and sums; metrics.nc on the grid of spots.
"""
