"""The sensor's chain in plain numpy, line by line as the dataset contract states it: what compiled draws must match."""

import numpy as np

from spotcheck.sensor import SensorModel


def draw(light_dn, exposure_s: float, sensor: SensorModel, rng: np.random.Generator) -> np.ndarray:
    """Random readings [DN, uint16] under `light_dn`, the whole chain (Eq. 23: H = S + B + W)."""
    electrons = rng.poisson(light_dn / sensor.gain_dn_per_e + sensor.dark_current_e_per_s * exposure_s)
    signal = np.minimum(electrons, sensor.full_well_e) + rng.normal(0.0, sensor.read_noise_e, np.shape(light_dn))
    dn = np.rint(sensor.gain_dn_per_e * signal + sensor.black_level_dn)
    return np.clip(dn, 0, min(sensor.full_scale_dn, 65535)).astype(np.uint16)
