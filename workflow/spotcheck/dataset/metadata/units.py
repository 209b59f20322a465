"""Numbers with units as people and cameras write them."""

import re
from decimal import Decimal, InvalidOperation

# Factor from each unit to the unit of manifest columns, by dimension. Factors are decimal texts, for exact arithmetic.
# The micro sign has two code points in Unicode: the sign itself (\u00b5) and the Greek letter (\u03bc).
UNITS: dict[str, dict[str, str]] = {
    dimension: {unit: factor for factor, names in factors.items() for unit in names.split()}
    for dimension, factors in {
        "s": {
            "60": "min",
            "1": "s sec secs second seconds",
            "1e-3": "ms msec millisecond milliseconds",
            "1e-6": "us \u00b5s \u03bcs usec \u00b5sec \u03bcsec microsecond microseconds",
            "1e-9": "ns nsec nanosecond nanoseconds",
        },
        "m": {
            "1": "m meter metre",
            "1e-2": "cm",
            "1e-3": "mm",
            "1e-6": "um \u00b5m \u03bcm micron microns micrometer micrometre",
            "1e-9": "nm",
        },
        # Not grad: a circle has 400 of them.
        "deg": {"1": "deg degs degree degrees \u00b0", "57.29577951308232": "rad", "0.05729577951308232": "mrad"},
        "dn_per_e": {"1": "dn/e dn/e- adu/e-"},
    }.items()
}
# Regular expressions of any unit, with the longest alternatives first, and of any decimal number.
UNIT_PATTERN = "|".join(
    sorted((re.escape(unit) for factors in UNITS.values() for unit in factors), key=len, reverse=True)
)
NUMBER_PATTERN = r"[-+]?(?:\d+(?:[.,]\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
# Remark on the cells of a column whose commas may separate either thousands or decimals.
UNDECIDABLE_COMMA = "(comma: thousands or decimals?)"
# A comma before exactly three digits, which may separate either thousands or decimals.
_AMBIGUOUS_COMMA = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
# Numbers whose commas can only separate thousands, and those whose comma can only be a decimal one.
_THOUSANDS = re.compile(r"(?<![\d.,])[1-9]\d{0,2}(?:(?:,\d{3}){2,}(?![\d,])|(?:,\d{3})+\.\d)")
_DECIMAL_COMMA = re.compile(r"(?<![\d.,])(?:(?:0\d*|\d{4,}),\d+|\d+,(?:\d{1,2}|\d{4,}))(?![\d.,])")
# A number or fraction, perhaps with a unit, which may stand in brackets.
_QUANTITY = re.compile(rf"\s*({NUMBER_PATTERN})(?:\s*/\s*(\d+))?\s*[\[(]?([^\W\d_]*|°|DN/e-?|ADU/e-)[\])]?\s*")
# Longest text that is read as a number with a unit [characters], and size from which converted numbers are rejected as
# misread.
_LONGEST_QUANTITY, _LARGEST_VALUE = 60, 1e12


def get_dimension(unit: str) -> str | None:
    """Return the key of `UNITS` for a unit: s, m, deg or dn_per_e; None for an unknown unit."""
    return next((name for name, factors in UNITS.items() if unit in factors or unit.lower() in factors), None)


def convert_quantity(number: str, unit: str, dimension: str) -> float | None:
    """Return a number in the unit of manifest columns.

    Decimal arithmetic makes 100 µs exactly 1e-4 s, not the binary fraction next to it.

    Parameters
    ----------
    number : text of a decimal number, with a point or a comma.
    unit : unit of the number.
    dimension : key of `UNITS`, which is also the unit of the result.

    Returns
    -------
    float or None
        None if the unit does not belong to the dimension, if the text is not a number below 1e12, or if its comma may
        separate either thousands or decimals.
    """
    if _AMBIGUOUS_COMMA.fullmatch(number):
        return None
    factor = UNITS[dimension].get(unit) or UNITS[dimension].get(unit.lower())
    try:
        value = float(Decimal(number.replace(",", ".")) * Decimal(factor)) if factor else None
    except (InvalidOperation, OverflowError, ValueError):
        return None
    return value if value is not None and abs(value) < _LARGEST_VALUE else None


def ask_about_comma(number: str) -> str:
    """Return the question whether the comma of a number separates thousands or decimals; "" if it is clear."""
    if not _AMBIGUOUS_COMMA.fullmatch(number):
        return ""
    return f"{number.replace(',', '.')} or {number.replace(',', '')}?"


def parse_quantity(text: str) -> tuple[str, str] | None:
    """Return number and unit, as texts, of a text such as `1.5 ms`, `1/200 s` or `3`; None for any other text.

    The unit is "" if it is absent, and may be unknown.
    """
    match = _QUANTITY.fullmatch(text) if len(text) <= _LONGEST_QUANTITY else None
    if match is None:
        return None
    number, denominator, unit = match.groups()
    if denominator:
        if not int(denominator) or _AMBIGUOUS_COMMA.fullmatch(number):
            return None
        number = repr(float(number.replace(",", ".")) / int(denominator))
    return number, unit


def resolve_commas(cells: list[str]) -> list[str]:
    """Return the cells of a column, with numbers written without thousands separators and with decimal points.

    The meaning of a comma is taken from all cells: `1,000,000` or `1,000.5` show thousands separators, `1,5` or `0,125`
    a decimal comma. If they show neither or both, the commas are undecidable, and each cell gets `UNDECIDABLE_COMMA` at
    its end, so that no cell of the column is read as a number.
    """
    has_thousands = any(map(_THOUSANDS.search, cells))
    has_decimals = any(map(_DECIMAL_COMMA.search, cells))
    if has_thousands != has_decimals:
        return [re.sub(r"(?<=\d),(?=\d)", "" if has_thousands else ".", cell) for cell in cells]
    if has_thousands or any(map(_AMBIGUOUS_COMMA.search, cells)):
        return [cell and f"{cell} {UNDECIDABLE_COMMA}" for cell in cells]
    return cells
