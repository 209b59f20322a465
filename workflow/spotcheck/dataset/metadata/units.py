"""Numbers with units as people and cameras write them."""

import re
from decimal import Decimal, InvalidOperation

# The micro sign has two code points in Unicode: the sign itself and the Greek letter.
_MICRO = ("u", "\u00b5", "\u03bc")
# Factor from each unit to the unit of our columns, by dimension.
UNITS: dict[str, dict[str, str]] = {
    "s": {
        **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "1"),
        **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), "1e-3"),
        **dict.fromkeys((*(f"{u}{s}" for u in _MICRO for s in ("s", "sec")), "microsecond", "microseconds"), "1e-6"),
        **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), "1e-9"),
        "min": "60",
    },
    "m": {
        **dict.fromkeys(("m", "meter", "metre"), "1"),
        "cm": "1e-2",
        "mm": "1e-3",
        **dict.fromkeys((*(f"{u}m" for u in _MICRO), "micron", "microns", "micrometer", "micrometre"), "1e-6"),
        "nm": "1e-9",
    },
    "deg": {
        **dict.fromkeys(("deg", "degs", "degree", "degrees", "\u00b0"), "1"),  # not grad: a circle has 400 of them
        "rad": "57.29577951308232",
        "mrad": "0.05729577951308232",
    },
    "dn_per_e": {"dn/e": "1", "dn/e-": "1", "adu/e-": "1"},
}
# Alternatives of regular expressions: any unit, the longest first, and any decimal number.
UNIT_PATTERN = "|".join(
    sorted((re.escape(unit) for factors in UNITS.values() for unit in factors), key=len, reverse=True)
)
NUMBER_PATTERN = r"[-+]?(?:\d+(?:[.,]\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_QUANTITY = re.compile(rf"\s*({NUMBER_PATTERN})(?:\s*/\s*(\d+))?\s*[\[(]?([^\W\d_]*|°|DN/e-?|ADU/e-)[\])]?\s*")
# Longest text that is read as a number with a unit [characters].
_LONGEST = 60
# Converted numbers of this size or more are rejected as misread.
_LARGEST = 1e12


def get_dimension(unit: str) -> str | None:
    """Return the key of `UNITS` for a unit: s, m, deg or dn_per_e; None for an unknown unit."""
    return next((name for name, factors in UNITS.items() if unit in factors or unit.lower() in factors), None)


def convert_quantity(number: str, unit: str, dimension: str) -> float | None:
    """Return a number in the unit of our columns.

    Decimal arithmetic makes 100 µs exactly 1e-4 s, not the binary fraction next to it.

    Parameters
    ----------
    number : decimal number, with a point or a comma.
    unit : unit of the number.
    dimension : key of `UNITS`, which is also the unit of the result.

    Returns
    -------
    float or None
        None if the unit does not belong to the dimension, or the text is not a number below 1e12.
    """
    factor = UNITS[dimension].get(unit) or UNITS[dimension].get(unit.lower())
    try:
        value = float(Decimal(number.replace(",", ".")) * Decimal(factor)) if factor else None
    except (InvalidOperation, OverflowError, ValueError):
        return None
    return value if value is not None and abs(value) < _LARGEST else None


def parse_quantity(text: str) -> tuple[str, str] | None:
    """Return number and unit ("" if absent) of a text such as `1.5 ms`, `1/200 s` or `3`; None for any other text."""
    match = _QUANTITY.fullmatch(text) if len(text) <= _LONGEST else None
    if match is None:
        return None
    number, denominator, unit = match.groups()
    if denominator:
        if not int(denominator):
            return None
        number = repr(float(number.replace(",", ".")) / int(denominator))
    return number, unit
