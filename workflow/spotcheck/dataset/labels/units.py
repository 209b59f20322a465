"""Numbers with units as people and cameras write them."""

import re
from decimal import Decimal, InvalidOperation

# Factor to the unit of our columns, by what is measured. µ is two letters of Unicode: the micro sign and the Greek one.
_MICRO = ("u", "\u00b5", "\u03bc")
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
        **dict.fromkeys(("deg", "degs", "degree", "degrees", "\u00b0"), "1"),  # not grad, of which a circle has 400
        "rad": "57.29577951308232",
        "mrad": "0.05729577951308232",
    },
    "dn_per_e": {"dn/e": "1", "dn/e-": "1", "adu/e-": "1"},
}
# Any of them, as part of a pattern.
ANY = "|".join(sorted((re.escape(unit) for own in UNITS.values() for unit in own), key=len, reverse=True))
NUMBER = r"[-+]?(?:\d+(?:[.,]\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_VALUE = re.compile(rf"\s*({NUMBER})(?:\s*/\s*(\d+))?\s*[\[(]?([^\W\d_]*|°|DN/e-?|ADU/e-)[\])]?\s*")
# Characters in which a number with its unit ends.
_LONGEST = 60


def kind_of(unit: str) -> str | None:
    """What a unit measures: s, m, deg or dn_per_e; None for what is no unit."""
    return next((kind for kind, own in UNITS.items() if unit in own or unit.lower() in own), None)


def scaled(number: str, unit: str, kind: str) -> float | None:
    """A number in a unit, in the unit of `kind`; None where that does not measure it, or is no number.

    Decimal arithmetic: 100 µs are 1e-4 s, not the binary fraction next to it.
    """
    factor = UNITS[kind].get(unit) or UNITS[kind].get(unit.lower())
    try:
        value = float(Decimal(number.replace(",", ".")) * Decimal(factor)) if factor else None
    except (InvalidOperation, OverflowError, ValueError):
        return None
    return value if value is not None and abs(value) < 1e12 else None


def parted(text: str) -> tuple[str, str] | None:
    """Number and unit ("" for none) of a text that is nothing else, such as `1.5 ms`, `1/200 s` or `3`."""
    found = _VALUE.fullmatch(text) if len(text) <= _LONGEST else None
    if found is None:
        return None
    number, below, unit = found.groups()
    if below:
        if not int(below):
            return None
        number = repr(float(number.replace(",", ".")) / int(below))
    return number, unit
