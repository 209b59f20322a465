"""Readings of a camera: mean, variance and random draws against the exact law."""

import numpy as np
import pytest

from spotcheck.model.sensor import ROUNDING_VARIANCE, SensorModel
from tests.library.shelf import CAMERA
from tests.reference.exact_law import moments, reading_law

SENSORS = [
    SensorModel(0.11, 13.0, full_scale_dn=1023.0),
    SensorModel(0.5, 5.0, black_level_dn=20.0, full_scale_dn=1023.0),
    SensorModel(1.0, 0.0, full_scale_dn=255.0),
    SensorModel(0.02, 8.0, black_level_dn=2.0, full_scale_dn=255.0),
    SensorModel(0.3, 9.0, full_well_e=400.0, black_level_dn=30.0, full_scale_dn=4095.0),
]


@pytest.mark.parametrize("sensor", SENSORS)
def test_moments_of_a_reading(sensor):
    """Against the law summed over electrons. Of the noise without clips the mean is off by less than 0.5 %, the
    variance by less than 2 %: what skew brings at the clips where light counts as normal; faint light is exact but for
    interpolation."""
    electrons = np.array([0, 0.01, 0.3, 1, 3.3, 7, 20, 31, 33, 50, 77.3, 100, 150, 250, 395, 420, 800, 2000])
    want = np.array([moments(reading_law(own, sensor))[:2] for own in electrons])
    noise = sensor.gain_dn_per_e**2 * (electrons + sensor.read_noise_e**2) + ROUNDING_VARIANCE
    half = sensor._replace(quantum_efficiency=0.5)
    assert np.max(np.abs(half.mean(2 * electrons) - want[:, 0]) / np.sqrt(noise)) < 0.005
    assert np.max(np.abs(half.variance(2 * electrons) - want[:, 1]) / noise) < 0.02


@pytest.mark.parametrize("sensor", SENSORS)
def test_draws_have_these_moments(sensor):
    """200 000 readings at four levels: within 4.5 standard errors (false alarm 7e-6 a number, 40 of them) and what the
    moments may be off; dark current counts with its exposure."""
    warm, count = sensor._replace(dark_current_e_per_s=2e4), 200_000
    for photons in (0.0, 5.0, 60.0, 380.0):
        drawn = warm.draw(np.full((2, count // 2), photons), 7, exposure_s=1e-3).astype(float)
        mean, variance = warm.mean(photons, exposure_s=1e-3), warm.variance(photons, exposure_s=1e-3)
        fourth = np.mean((drawn - drawn.mean()) ** 4) - drawn.var() ** 2
        noise = sensor.gain_dn_per_e**2 * (photons + 20 + sensor.read_noise_e**2) + ROUNDING_VARIANCE
        assert abs(drawn.mean() - mean) < 4.5 * np.sqrt(variance / count) + 0.005 * np.sqrt(noise)
        assert abs(drawn.var() - variance) < 4.5 * np.sqrt(fourth / count) + 0.02 * noise


def test_draws_follow_their_generator():
    """Equal seeds, equal readings, in the shape of the light; a generator goes on."""
    photons = np.full((3, 4, 5), 700.0)
    first = CAMERA.draw(photons, 3)
    assert first.shape == (3, 4, 5) and first.dtype == np.uint16
    assert np.array_equal(first, CAMERA.draw(photons, np.random.default_rng(3)))
    rng = np.random.default_rng(3)
    assert not np.array_equal(CAMERA.draw(photons, rng), CAMERA.draw(photons, rng))
    assert CAMERA.draw(700.0, 1).shape == () and CAMERA.mean(700.0).shape == ()


@pytest.mark.parametrize("photons", [-1.0, [3.0, np.nan]])
def test_light_is_not_negative(photons):
    for call in (CAMERA.mean, CAMERA.variance, lambda light: CAMERA.draw(light, 1)):
        with pytest.raises(ValueError, match="photons: holds a number that is not 0 or above"):
            call(photons)
    with pytest.raises(ValueError, match="sensor: gain_dn_per_e is -1"):
        CAMERA._replace(gain_dn_per_e=-1).mean(3.0)
