"""A number as a person writes it: to the digits that its standard error leaves, or to two."""

import math

# Numbers with more decimals are written with a power of ten.
DECIMALS = 6


def plus_minus(value: float, error: float, unit: str = "") -> str:
    """Value ± error with two digits of the error: "0.2803 ± 0.0012 DN/e-", "1.234e-04 ± 1.2e-06 m".

    The value alone where there is no error; "none" where there is no value.
    """
    if not math.isfinite(value):
        return "none"
    tail = f" {unit}" if unit else ""
    if math.isnan(error) or error <= 0:
        return f"{value:.4g}{tail}"
    if math.isinf(error):
        return f"{value:.4g} ± inf{tail}"
    digits = max(0, 1 - math.floor(math.log10(error)))
    if digits <= DECIMALS:
        return f"{value:.{digits}f} ± {error:.{digits}f}{tail}"
    kept = max(0, digits + math.floor(math.log10(abs(value)))) if value else 1
    return f"{value:.{kept}e} ± {error:.1e}{tail}"


def two_digits(value: float) -> str:
    """A number in a sentence: `360`, `0.05`, `2.5 · 10⁻¹⁶`."""
    if value == 0 or 1e-2 <= abs(value) < 1e4:
        return f"{float(f'{value:.2g}'):g}"
    digits, exponent = f"{value:.1e}".split("e")
    return f"{digits} · 10{str(int(exponent)).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}"
