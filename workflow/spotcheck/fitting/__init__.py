"""Fit spots in crops, calibrate the law of their width, fit the caustic, and compute Fisher information and bounds.

In: crops [row, column] in DN and a sensor model. Out: fits.nc, calibration.nc, caustic.nc, bounds.nc and precision.nc,
each value with its standard error.
"""
