"""Maps of a sensor's pixels: offset of each above the common black level, and its gain relative to the others."""

from typing import NamedTuple

import numpy as np


class PixelMaps(NamedTuple):
    """Offset and gain of each pixel of a sensor, for fits of spots.

    The mean reading of a pixel is black level + offset + K gain ν, where ν are the mean electrons of a pixel with the
    gain 1 under the same light, and K is the gain of the sensor [DN/e-].

    Parameters
    ----------
    offset_dn : excess of each pixel over the common black level [rows, columns] in DN; NaN where it is unknown.
    gain : electrons of each pixel relative to the average pixel under equal light [rows, columns]; NaN where unknown.
    offset_stderr_dn, gain_stderr : standard errors of one pixel's offset [DN] and gain [1]; they are noise to a fit.

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
        """Return the maps of a window of the sensor [rows, columns], NaN where it reaches beyond the sensor.

        `top` and `left` are the row and the column of its first pixel on the sensor [px]; they may be negative.
        """
        windows = []
        for values in (self.offset_dn, self.gain):
            window = np.full((rows, columns), np.nan)
            # First row and column of the window that are on the sensor.
            y, x = max(-top, 0), max(-left, 0)
            known = values[max(top, 0) : max(top + rows, 0), max(left, 0) : max(left + columns, 0)]
            window[y : y + known.shape[0], x : x + known.shape[1]] = known
            windows.append(window)
        return self._replace(offset_dn=windows[0], gain=windows[1])
