"""From light to readings: mean signal, and order of the chain."""

import numpy as np
import pytest

from spotcheck.sensor import ReadingDistribution, SensorModel
from spotcheck.sensor.model import dark_signal, mean_signal, photo_electrons


def test_electrons_of_photons():
    """Eq. 15: electrons over photons is the quantum efficiency."""
    assert photo_electrons(1000.0, 0.38) / 1000.0 == pytest.approx(0.38, rel=1e-14)


def test_mean_signal_of_the_linear_sensor():
    """Eqs. 16, 24, 25 and 29: 5000 photons, 7 dark electrons."""
    got = mean_signal(5000.0, 7.0, 0.11, 0.38)
    assert dark_signal(7.0, 0.11) == pytest.approx(0.77, rel=1e-12)
    assert got == pytest.approx(0.11 * (0.38 * 5000 + 7), rel=1e-12)


ORDER = {
    "the well stops electrons before the offset": (SensorModel(0.5, 0, 0, 100.0, 30.0, 1023.0), 500.0, 0.5 * 100 + 30),
    "the converter stops after the offset": (SensorModel(0.5, 0, 0, np.inf, 30.0, 255.0), 500.0, 255),
    "no light reads the black level": (SensorModel(0.5, 0, 0, np.inf, 30.0, 255.0), 0.0, 30),
    "rounded once, to nearest": (SensorModel(0.11, 0, 0, 70.0, 0.2, 1023.0), 500.0, 8),  # 7.7 + 0.2
    "a 16 bit container ends at 65535": (SensorModel(100.0, 0, 0, np.inf, 0.0, 1e9), 1e7, 65535),
}


@pytest.mark.parametrize(("s", "light", "value"), ORDER.values(), ids=ORDER)
def test_order_of_the_chain(s, light, value):
    """Without noise, and with light that fills the well or none, every reading is one known number."""
    got = ReadingDistribution(s).sample(np.full(500, light), np.random.default_rng(0))
    assert got.dtype == np.uint16 and set(got.tolist()) == {value}
