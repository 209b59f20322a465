"""The sensor by measurement: EMVA 1288 from flats and darks, gain and noise from spots, maps of the pixels.

In: a `Dataset` and its crops. Out: transfer.nc, sensor.nc and maps.nc: gain [DN/e-], read noise [e-], black level [DN]
with standard errors, and where each value comes from.
"""
