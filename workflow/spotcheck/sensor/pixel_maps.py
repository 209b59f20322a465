"""Maps of a sensor's pixels: how far each reads above the common black level, and how much of the light it turns into
electrons."""

from typing import NamedTuple

import numpy as np


class PixelMaps(NamedTuple):
    """How the pixels of a sensor differ, for fits of spots.

    A reading's mean is black level + offset + K gain ν, where a pixel that is like all has a mean of ν electrons.

    Parameters
    ----------
    offset_dn : how far each pixel reads above the common black level [DN], [rows, columns]; NaN where it is not known.
    gain : how much of the light it turns into electrons, 1 on average, of the same shape.
    offset_stderr_dn, gain_stderr : standard errors of one pixel's offset [DN] and gain [1]: noise to a fit.

    Examples
    --------
    >>> import numpy as np, spotcheck
    >>> sensor = spotcheck.SensorModel(gain_dn_per_e=0.5, read_noise_e=5, black_level_dn=20, full_scale_dn=1023)
    >>> rng = np.random.default_rng(1)
    >>> maps = spotcheck.PixelMaps(rng.normal(0, 3, (48, 64)), rng.normal(1, 0.02, (48, 64)))
    >>> y, x = np.mgrid[:48, :64]
    >>> image = sensor.draw(maps.gain * 900 * np.exp(-((x - 31) ** 2 + (y - 23) ** 2) / 50), rng) + maps.offset_dn
    >>> without, with_maps = spotcheck.fit_spots(image, sensor), spotcheck.fit_spots(image, sensor, maps=maps)
    >>> print(f"χ² {without.chi2_reduced:.2f} → {with_maps.chi2_reduced:.2f}")
    χ² 2.18 → 1.02
    """

    offset_dn: np.ndarray
    gain: np.ndarray
    offset_stderr_dn: float = 0.0
    gain_stderr: float = 0.0

    def cut(self, top: int, left: int, rows: int, columns: int) -> "PixelMaps":
        """The maps of a part of the sensor, NaN beyond it."""
        inside = []
        for values in (self.offset_dn, self.gain):
            part = np.full((rows, columns), np.nan)
            y, x = max(-top, 0), max(-left, 0)
            known = values[max(top, 0) : max(top + rows, 0), max(left, 0) : max(left + columns, 0)]
            part[y : y + known.shape[0], x : x + known.shape[1]] = known
            inside.append(part)
        return self._replace(offset_dn=inside[0], gain=inside[1])
