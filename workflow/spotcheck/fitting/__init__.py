"""Spots fitted to crops: centre, widths, amplitude; calibration p1 and p2; caustic; Fisher information and bounds.

In: crops [row, column] in DN and a sensor model. Out: fits.nc, calibration.nc, caustic.nc, bounds.nc and precision.nc,
each value with its standard error.
"""
