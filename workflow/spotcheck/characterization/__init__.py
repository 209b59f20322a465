"""Characterization of a camera sensor: EMVA 1288 from flats and darks, gain and noise from spots, maps of the pixels.

In: a `Dataset` and its crops. Out: transfer.nc (quantities of EMVA 1288), sensor.nc (gain [DN/e-], read noise [e-],
black level [DN] and other values in use, with standard errors and sources) and maps.nc (offset and gain of each pixel).
"""
