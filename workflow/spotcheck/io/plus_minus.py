"""Formatting of numbers for people: a value with its standard error, and a number in a sentence."""

import math

# Numbers with more decimals are written with a power of ten.
MAX_DECIMALS = 6
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def plus_minus(value: float, error: float, unit: str = "") -> str:
    """Return `value ± error unit`, rounded to two digits of the error.

    Parameters
    ----------
    value : float
        Value; NaN or infinite gives "none".
    error : float
        Standard error in the unit of the value; if NaN or not positive, only the value is written, to four digits.
    unit : str
        Unit, written last.

    Examples
    --------
    >>> plus_minus(0.28031, 0.0012, "DN/e-")
    '0.2803 ± 0.0012 DN/e-'
    >>> plus_minus(1.2344e-4, 1.2e-6, "m")
    '1.234e-04 ± 1.2e-06 m'
    """
    if not math.isfinite(value):
        return "none"
    suffix = f" {unit}" if unit else ""
    if math.isnan(error) or error <= 0:
        return f"{value:.4g}{suffix}"
    if math.isinf(error):
        return f"{value:.4g} ± inf{suffix}"
    decimals = max(0, 1 - math.floor(math.log10(error)))
    if decimals <= MAX_DECIMALS:
        return f"{value:.{decimals}f} ± {error:.{decimals}f}{suffix}"
    mantissa_decimals = max(0, decimals + math.floor(math.log10(abs(value)))) if value else 1
    return f"{value:.{mantissa_decimals}e} ± {error:.1e}{suffix}"


def two_digits(value: float) -> str:
    """Return a number with two significant digits for a sentence: `360`, `0.05`, `2.5 · 10⁻¹⁶`."""
    if value == 0 or 1e-2 <= abs(value) < 1e4:
        return f"{float(f'{value:.2g}'):g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa} · 10{str(int(exponent)).translate(SUPERSCRIPTS)}"
