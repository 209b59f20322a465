"""Formatting of numbers for people: a value with its standard error and unit, and numbers in sentences and tables."""

import math

from uncertainties import ufloat
from uncertainties.formatting import PDG_precision

# Units as a person writes them, by unit as in files; other units are the same.
UNITS = {"1": "", "deg": "°", "degree": "°", "pixel": "px"}
# Units that take a prefix, because exposures and beams span powers of ten; and the prefixes by power of ten.
PREFIXED_UNITS = ("s", "m", "rad", "W")
PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: ""}
# Values with an error and more decimals than this are written with a power of ten.
MAX_DECIMALS = 6
# Numbers without an error: value from which `quantity_text` writes no decimals; powers of ten that `number_text` writes
# out, and range of values that `two_digits` writes out, while others have a power of ten.
WHOLE_FROM, PLAIN_POWERS, PLAIN_RANGE = 1000, range(-4, 5), (1e-2, 1e4)
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def quantity_text(value: float | None, stderr: float | None, unit: str = "1") -> str:
    """Return a value with its standard error and unit, rounded to the digits that the error leaves.

    The error has one or two digits, by the rule of the Particle Data Group (Review of Particle Physics, Introduction
    5.3); the package `uncertainties` applies it.

    Parameters
    ----------
    value : float or None
        The value; "no value" is written for None, NaN and infinity.
    stderr : float or None
        Standard error in the unit of the value. If it is None, NaN or not positive, only the value is written, to four
        digits. An infinite error is written as ∞.
    unit : str
        Unit as in files; "1" for none. Seconds, metres, radians and watts get a prefix.

    Examples
    --------
    >>> quantity_text(0.02403, 0.00113)
    '0.0240 ± 0.0011'
    >>> quantity_text(1.23e-5, 4.2e-7, "s")
    '12.3 ± 0.4 µs'
    >>> quantity_text(-3.2e-8, 1.1e-9)
    '(−3.20 ± 0.11)×10⁻⁸'
    """
    if value is None or not math.isfinite(value):
        return "no value"
    unit = UNITS.get(unit, unit)
    if unit in PREFIXED_UNITS and value:
        power = min(max(3 * math.floor(math.log10(abs(value)) / 3), min(PREFIXES)), max(PREFIXES))
        value, stderr = value / 10.0**power, None if stderr is None else stderr / 10.0**power
        unit = PREFIXES[power] + unit
    space = "" if unit in ("", "°") else " "
    return f"{_number_with_error(value, stderr)}{space}{unit}"


def rounded_text(value: float, stderr: float) -> str:
    """Return a value without its error, with the decimals that `quantity_text` gives it; `stderr` is above 0."""
    return f"{value:.{max(count_decimals(stderr), 0)}f}".replace("-", "−")


def count_decimals(stderr: float) -> int:
    """Return the decimals of a value with a standard error above 0; −1 if the value is rounded to tens.

    The number of digits of the error follows the rule of the Particle Data Group.
    """
    # Number of significant digits of the error, and the error rounded to them.
    digits, rounded_stderr = PDG_precision(stderr)
    return digits - 1 - math.floor(math.log10(rounded_stderr))


def number_text(value: float | None, digits: int = 3) -> str:
    """Return a number without an error to `digits` significant digits: `1.00`, `5440`, `9.61 · 10⁵`.

    None, NaN and infinity give a dash.
    """
    if value is None or not math.isfinite(value):
        return "–"
    # Rounded before the power is taken: 9.996 becomes 10.0, not 10.00.
    value = float(f"{value:.{digits - 1}e}")
    power = math.floor(math.log10(abs(value))) if value else 0
    if power in PLAIN_POWERS:
        text = f"{value:.{max(digits - 1 - power, 0)}f}"
    else:
        text = f"{value / 10.0**power:.{digits - 1}f} · 10{str(power).translate(SUPERSCRIPTS)}"
    return text.replace("-", "−")


def two_digits(value: float) -> str:
    """Return a finite number to two significant digits for a sentence: `360`, `0.05`, `2.5 · 10⁻¹⁶`."""
    if value == 0 or PLAIN_RANGE[0] <= abs(value) < PLAIN_RANGE[1]:
        return f"{float(f'{value:.2g}'):g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa} · 10{str(int(exponent)).translate(SUPERSCRIPTS)}"


def _number_with_error(value: float, stderr: float | None) -> str:
    """Return a finite value as `value ± stderr`, or alone if its error is None, NaN or not positive.

    Both are in the same unit, which is not written.
    """
    if stderr is None or math.isnan(stderr) or stderr <= 0:
        text = f"{value:.0f}" if abs(value) >= WHOLE_FROM else f"{value:.4g}"
    elif math.isinf(stderr):
        text = f"{value:.4g} ± ∞"
    else:
        decimals = count_decimals(stderr)
        # The format rounds decimals, but no tens.
        if decimals < 0:
            value, stderr = round(value, decimals), round(stderr, decimals)
        # Formats of `uncertainties`: e has a power of ten, f has none, and P gives "±" and "×10⁻⁸" as characters.
        text = format(ufloat(value, stderr), "eP" if decimals > MAX_DECIMALS else "fP").replace("±", " ± ")
    return text.replace("-", "−")


def count_text(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is one: "1 frame", "2 frames"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
