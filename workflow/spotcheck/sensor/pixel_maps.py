"""Maps of the pixels of a sensor: the offset of each pixel above the black level, and its relative gain."""

from typing import NamedTuple

import numpy as np


class PixelMaps(NamedTuple):
    """Offset and relative gain of each pixel of a sensor, for fits of spots.

    The mean reading of a pixel is black level + offset_dn + K · gain · ν [DN]. K is the gain of the sensor [DN/e-], and
    ν is the mean number of electrons in a pixel of relative gain 1 under the same light.

    Parameters
    ----------
    offset_dn : ndarray
        Excess of each pixel over the common black level [rows, columns] in DN; NaN where it is unknown.
    gain : ndarray
        Electrons of each pixel relative to the average pixel under equal light [rows, columns]; NaN where unknown.
    offset_stderr_dn : float, optional
        Standard error of the offset of one pixel [DN]. A fit adds it to the noise of the readings.
    gain_stderr : float, optional
        Standard error of the relative gain of one pixel. A fit adds it to the noise of the readings.

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
        """Return the maps of a window of the sensor.

        Parameters
        ----------
        top, left : int
            Row and column of the sensor at which the window starts [px]. They may be negative.
        rows, columns : int
            Size of the window [px].

        Returns
        -------
        PixelMaps
            Maps [rows, columns] with the same standard errors; NaN where the window reaches beyond the sensor.
        """
        windows = []
        for sensor_map in (self.offset_dn, self.gain):
            window = np.full((rows, columns), np.nan)
            # First row and column of the window that are on the sensor.
            first_row, first_column = max(-top, 0), max(-left, 0)
            on_sensor = sensor_map[max(top, 0) : max(top + rows, 0), max(left, 0) : max(left + columns, 0)]
            height, width = on_sensor.shape
            window[first_row : first_row + height, first_column : first_column + width] = on_sensor
            windows.append(window)
        return self._replace(offset_dn=windows[0], gain=windows[1])
