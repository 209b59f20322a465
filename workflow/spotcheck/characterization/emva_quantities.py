"""Quantities of EMVA 1288: symbols, units and meanings, and the values of one sensor with their standard errors.

A quantity without a value has the reason why it is unknown. The functions of `derived_quantities` that compute them
cite the sections of the standard.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from spotcheck.io.number_text import quantity_text

# Name → (symbol of the standard, unit, meaning), in the order in which they are listed.
QUANTITIES = {
    "gain": ("K", "DN/e-", "overall gain"),
    "dark_offset": ("μ_y.dark", "DN", "dark offset, without exposure if darks have three"),
    "dark_noise_dn": ("σ_y.dark", "DN", "noise without light, with rounding"),
    "dark_noise": ("σ_d", "e-", "noise without light"),
    "dark_current": ("μ_I", "e-/s", "dark current, by the mean"),
    "dark_current_by_variance": ("μ_I.var", "e-/s", "dark current, by the noise"),
    "responsivity": ("R", "DN/p", "responsivity"),
    "quantum_efficiency": ("η", "1", "quantum efficiency"),
    "saturation_dn": ("μ_y.sat", "DN", "reading at saturation"),
    "saturation_photons": ("μ_p.sat", "p", "photons at saturation"),
    "full_well": ("μ_e.sat", "e-", "saturation capacity (full well)"),
    "snr_max": ("SNR_max", "1", "largest signal-to-noise ratio"),
    "threshold_photons": ("μ_p.min", "p", "absolute sensitivity threshold, photons"),
    "threshold": ("μ_e.min", "e-", "absolute sensitivity threshold"),
    "dynamic_range": ("DR", "1", "dynamic range"),
    "linearity_error": ("LE", "%", "linearity error, mean"),
    "linearity_lowest": ("LE_min", "%", "linearity error, lowest"),
    "linearity_highest": ("LE_max", "%", "linearity error, highest"),
    "dsnu": ("DSNU", "e-", "dark signal non-uniformity"),
    "dsnu_column": ("DSNU_col", "e-", "dark signal non-uniformity of columns"),
    "dsnu_row": ("DSNU_row", "e-", "dark signal non-uniformity of rows"),
    "dsnu_pixel": ("DSNU_pix", "e-", "dark signal non-uniformity of pixels"),
    "prnu": ("PRNU", "%", "photo response non-uniformity"),
    "prnu_column": ("PRNU_col", "%", "photo response non-uniformity of columns"),
    "prnu_row": ("PRNU_row", "%", "photo response non-uniformity of rows"),
    "prnu_pixel": ("PRNU_pix", "%", "photo response non-uniformity of pixels"),
}


@dataclass(frozen=True)
class Quantity:
    """A measured quantity of EMVA 1288."""

    name: str  # key of `QUANTITIES`
    symbol: str  # symbol of the standard
    value: float  # value [unit]; NaN if unknown
    stderr: float  # standard error of the value [unit]; NaN if unknown
    unit: str  # "1" if dimensionless
    why: str = ""  # reason why the value is unknown; "" if it is known

    def __str__(self) -> str:
        """Return symbol, value, error and unit as text, or the reason why the value is unknown."""
        if not np.isfinite(self.value):
            return f"{self.symbol} is unknown: {self.why}"
        return f"{self.symbol} = {quantity_text(self.value, self.stderr, self.unit)}"


class QuantityTable(dict[str, Quantity]):
    """Quantities by name. A later entry of the same name replaces an earlier one."""

    def set(self, name: str, value: float, stderr: float, why: str = "") -> None:
        """Enter a value and its standard error, both in the unit that `QUANTITIES` gives for the name."""
        symbol, unit, _ = QUANTITIES[name]
        self[name] = Quantity(name, symbol, float(value), float(stderr), unit, why)

    def set_unknown(self, names: Iterable[str], reason: str) -> None:
        """Mark the named quantities as unknown, with the reason as a phrase; earlier values are replaced."""
        for name in names:
            self.set(name, np.nan, np.nan, reason)

    def fill_unknown(self, reason: str) -> None:
        """Mark all quantities that have no entry yet as unknown, with the reason as a phrase."""
        self.set_unknown([name for name in QUANTITIES if name not in self], reason)


def divide(numerator: Quantity, denominator: Quantity) -> tuple[float, float]:
    """Return the quotient of two independent quantities and its standard error.

    Both are NaN if a quantity is unknown. The denominator must not be 0.
    """
    ratio = numerator.value / denominator.value
    error = np.hypot(numerator.stderr / denominator.value, ratio * denominator.stderr / denominator.value)
    return ratio, float(error)
