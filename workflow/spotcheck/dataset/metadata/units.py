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
# Remark on the cells of a column whose commas or points may separate either thousands or decimals.
UNDECIDABLE_SEPARATOR = "(thousands or decimals?)"
# A comma before exactly three digits, which may separate either thousands or decimals.
_AMBIGUOUS_COMMA = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
# Numbers, as templates, whose separator S can only separate thousands (O is the other separator), those whose S can
# only be a decimal one, and those in which it may be either.
_THOUSANDS = r"(?<![\d.,])[1-9]\d{0,2}(?:(?:S\d{3}){2,}(?![\dS])|(?:S\d{3})+O\d)"
_DECIMALS = r"(?<![\d.,])(?:(?:0\d*|\d{4,})S\d+|\d+S(?:\d{1,2}|\d{4,})|\d+S\d+(?=[eE][-+]?\d))(?![\d.,])"
_EITHER = r"(?<![\d.,])[1-9]\d{0,2}S\d{3}(?![\d.,])"
# Apostrophes and spaces between groups of three digits, which separate nothing but thousands.
_DIGIT_GROUPS = re.compile(r"(?<![\d.,])[1-9]\d{0,2}(?:['’ \u00a0\u2009\u202f]\d{3})+(?!\d)")
# A number without a point or comma at the start of a cell.
_WHOLE_NUMBER = re.compile(r"\s*[-+]?\d+(?![\d.,])")
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
    match = _QUANTITY.fullmatch(join_digit_groups(text)) if len(text) <= _LONGEST_QUANTITY else None
    if match is None:
        return None
    number, denominator, unit = match.groups()
    if denominator:
        if not int(denominator) or _AMBIGUOUS_COMMA.fullmatch(number):
            return None
        number = repr(float(number.replace(",", ".")) / int(denominator))
    return number, unit


def join_digit_groups(text: str) -> str:
    """Return a text with numbers such as `1'000` and `1 000` written without separators of thousands."""
    return _DIGIT_GROUPS.sub(lambda match: re.sub(r"\D", "", match[0]), text)


def resolve_separators(cells: list[str], cell_separator: str) -> list[str]:
    """Return the cells of a column, with numbers written without thousands separators and with decimal points.

    The meaning of commas and points is taken from all cells: `1,000,000`, `1,000.5` or `2.5` show that commas separate
    thousands; `1,5`, `0,125`, `1.000.000` or `1.000,5` that they are decimal. If the cells show neither or both, the
    separators are undecidable, and each cell gets `UNDECIDABLE_SEPARATOR` at its end, so that no cell of the column is
    read as a number.

    Parameters
    ----------
    cells : cells of the column.
    cell_separator : separator of the cells in a row. Points are decimal in tables that are separated by commas. With
        semicolons, which are usual where commas are decimal, a column such as `1.000`, `2.000` is undecidable; with
        tabs only if it has whole numbers as well.
    """
    cells = [join_digit_groups(cell) for cell in cells]
    has_decimal_points = _has_number(_THOUSANDS, ",", cells) or _has_number(_DECIMALS, ".", cells)
    has_decimal_commas = _has_number(_THOUSANDS, ".", cells) or _has_number(_DECIMALS, ",", cells)
    if has_decimal_points != has_decimal_commas:
        thousands, decimal = (",", ".") if has_decimal_points else (".", ",")
        whole = [re.sub(rf"(?<=\d){re.escape(thousands)}(?=\d)", "", cell) for cell in cells]
        return [re.sub(rf"(?<=\d){re.escape(decimal)}(?=\d)", ".", cell) for cell in whole]
    may_be_thousands = cell_separator == ";" or (cell_separator == "\t" and any(map(_WHOLE_NUMBER.match, cells)))
    if has_decimal_points:
        # Points and commas are both decimal, which matters only beside numbers with thousands.
        is_open = any(_has_number(form, separator, cells) for form in (_THOUSANDS, _EITHER) for separator in ",.")
    else:
        is_open = _has_number(_EITHER, ",", cells) or (may_be_thousands and _has_number(_EITHER, ".", cells))
    if is_open:
        return [cell and f"{cell} {UNDECIDABLE_SEPARATOR}" for cell in cells]
    return cells


def _has_number(template: str, separator: str, cells: list[str]) -> bool:
    """Return whether a cell has a number of the form of a template for this separator, a comma or a point."""
    other = "." if separator == "," else ","
    pattern = re.compile(template.replace("S", re.escape(separator)).replace("O", re.escape(other)))
    return any(map(pattern.search, cells))
