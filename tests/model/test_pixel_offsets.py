"""Moments of pixels with offsets of their own, against a sensor whose black level is shifted by the same offset."""

from dataclasses import replace

import numpy as np
import pytest

from spotcheck.model.pixel_offsets import moments_with_offsets
from spotcheck.sensor import ReadingDistribution, SensorModel

LIGHT = np.array([0.0, 0.7, 3.0, 20.0, 90.0, 240.0])
# The mean oscillates with the rounding by 2e-5 DN under Gaussian noise of 0.7 DN; interpolation between tables adds
# 1e-4 DN at the smallest noise.
MEAN_TOLERANCE_DN = 3e-4


@pytest.mark.parametrize("read_noise_dn", [0.25, 0.5, 0.69, 1.5])
@pytest.mark.parametrize("gain", [0.03, 0.4, 1.0, 2.0])
@pytest.mark.parametrize("offset_dn", [-1.3, 0.37, 2.6])
def test_an_offset_acts_as_a_shifted_black_level(read_noise_dn, gain, offset_dn):
    """Rounding, both ends of the converter and shot noise in steps of one electron act as without tables of offsets."""
    sensor = SensorModel(
        gain_dn_per_e=gain, read_noise_e=read_noise_dn / gain, black_level_dn=2.0, full_scale_dn=255.0
    )  # fmt: skip
    moments = moments_with_offsets(ReadingDistribution(sensor), LIGHT, offset_dn=np.full(LIGHT.shape, offset_dn))
    exact = ReadingDistribution(replace(sensor, black_level_dn=2.0 + offset_dn)).cumulants(LIGHT)
    np.testing.assert_allclose(moments.mean, exact.mean, rtol=0, atol=MEAN_TOLERANCE_DN)
    # The variance of the reading differs by the square of such oscillations, and by those of the rounding error.
    np.testing.assert_allclose(moments.variance, exact.variance, rtol=2e-3, atol=1e-3)
