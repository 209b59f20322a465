"""Where the spots lie before anything is known of an effect."""

import numpy as np
import pytest

from spotcheck.discrepancy.base import spots_of
from spotcheck.discrepancy.shots import Shot
from spotcheck.estimate.spotfit import fit_spots
from spotcheck.model.sensor import SensorModel
from tests.reference.numpy_chain import draw

STATED = SensorModel(0.0969, 10.07, 45.1, 13500.0, 13.0, 1023.0)


def test_a_spot_is_found_under_noise_far_above_the_stated():
    """The likelihood of readings that scatter 2.4 times as widely as it says may have no root; the spot is there."""
    y, x = np.mgrid[:120, :120].astype(float)
    light = 900 * np.minimum(np.exp(-((x - 60.2) ** 2 + (y - 58.7) ** 2) / (2 * 9.0**2)), np.exp(-0.25))
    image = draw(light, 1e-3, STATED._replace(read_noise_e=24.0), np.random.default_rng(0)).astype(float)
    assert fit_spots(image, STATED, top_hat=True, circular=True).status != "ok"
    ((peak, x0, y0, sigma, trusted),) = spots_of([Shot(None, None, 0, 0, (), 0, 0, lambda: image)], STATED, True)
    # Five standard errors of a spot of 500 bright pixels at a signal-to-noise ratio of 50 each.
    assert trusted and (x0, y0) == pytest.approx((60.2, 58.7), abs=0.05)
    assert peak == pytest.approx(900, abs=10) and sigma == pytest.approx(9.0, abs=0.1)


def test_a_frame_without_a_spot_is_not_trusted():
    image = np.full((60, 60), 13.0)
    assert spots_of([Shot(None, None, 0, 0, (), 0, 0, lambda: image)], STATED, True)[0, 4] == 0
