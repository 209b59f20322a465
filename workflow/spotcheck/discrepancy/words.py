"""Numbers, measurements and lists in words, for sentences and tables that a person reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from spotcheck.model.effect import Effect

# Units as a person writes them, where files write them differently.
UNITS = {"1": "", "deg": "°", "degree": "°", "pixel": "px"}
# Units that take a prefix, since exposures and beams span powers of ten; and the prefixes by power of ten.
PREFIXED_UNITS = ("s", "m", "rad", "W")
PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: ""}
# A standard error is written with two digits if its digits form a number below this, such as 0.0354 (Particle Data
# Group, Review of Particle Physics, Introduction 5.3).
TWO_DIGITS = 3.55
# Smaller percentages are written as 0 [%].
LEAST_PERCENT = 0.001
# Smaller p-values are written as "below" this one.
LEAST_PROBABILITY = 1e-4
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def value_text(value: float | None, stderr: float | None, unit: str) -> str:
    """Return a value with its standard error and unit, rounded to the digits that the error leaves.

    Parameters
    ----------
    value : float or None
        The value; "no value" is written for None, NaN and infinity.
    stderr : float or None
        Standard error; without one that is finite and positive, the value has four digits.
    unit : str
        Unit as in files; "1" for none.

    Examples
    --------
    >>> value_text(0.02403, 0.00113, "1")
    '0.0240 ± 0.0011'
    >>> value_text(1.23e-5, 4.2e-7, "s")
    '12.3 ± 0.4 µs'
    """
    if value is None or not np.isfinite(value):
        return "no value"
    unit = UNITS.get(unit, unit)
    if unit in PREFIXED_UNITS and value:
        power = int(np.clip(3 * np.floor(np.log10(abs(value)) / 3), min(PREFIXES), max(PREFIXES)))
        value, stderr = value / 10.0**power, None if stderr is None else stderr / 10.0**power
        unit = PREFIXES[power] + unit
    if stderr is None or not np.isfinite(stderr) or stderr <= 0:
        text = f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    else:
        digits = digits_of(stderr)
        shown = max(digits, 0)
        text = f"{round(value, digits):.{shown}f} ± {round(stderr, digits):.{shown}f}"
    space = "" if unit in ("", "°") else " "
    return f"{text}{space}{unit}".replace("-", "−")


def digits_of(stderr: float) -> int:
    """Return the decimals of a value with this standard error; negative if tens are rounded."""
    power = int(np.floor(np.log10(stderr)))
    return int(np.clip((stderr < TWO_DIGITS * 10.0**power) - power, -9, 9))


def number_text(value: float | None, digits: int = 3) -> str:
    """Return a number without an error with so many digits, such as `1.00`, `5440`, `9.61 · 10⁵`; a dash if unknown."""
    if value is None or not np.isfinite(value):
        return "–"
    # Rounded before the power is taken: 9.996 becomes 10.0, not 10.00.
    value = float(f"{value:.{digits - 1}e}")
    power = int(np.floor(np.log10(abs(value)))) if value else 0
    if -4 <= power < 5:
        text = f"{value:.{max(digits - 1 - power, 0)}f}"
    else:
        text = f"{value / 10.0**power:.{digits - 1}f} · 10{str(power).translate(SUPERSCRIPTS)}"
    return text.replace("-", "−")


def over_noise_text(value: float | None) -> str:
    """Return a number in units of the noise; noise alone gives `1.00`."""
    return f"{value:.2f}" if value is not None and abs(value) < 1 else number_text(value)


def percent_text(part: float) -> str:
    """Return a part in per cent with two digits, three from 90 % on; 99.97 % is rounded down, since it is not all."""
    percent = 100 * part
    if 90 <= percent < 100:
        return f"{np.floor(10 * percent) / 10:.3g} %"
    if percent >= 100 or abs(percent) < LEAST_PERCENT:
        return f"{percent:.0f} %".replace("-0", "0")
    return f"{percent:.2g} %".replace("-", "−")


def probability_text(p: float) -> str:
    """Return a p-value with two digits, such as `p = 0.32`, or `p < 0.0001`."""
    return f"p = {p:.2g}" if p >= LEAST_PROBABILITY else "p < 0.0001"


def condition_text(condition: Mapping[str, Any]) -> str:
    """Return the conditions of a measurement, such as `an exposure of 1.8 ms and 45°`.

    `condition` holds values by the names of columns of the manifest; None if a condition is not set. `blocked` says
    whether the beam is blocked.
    """
    words = []
    for name, value in condition.items():
        if value is None or name == "blocked":
            continue
        if name == "exposure_s":
            words.append(f"an exposure of {value_text(value, None, 's')}")
        else:
            words.append(f"{value:.4g}°" if name == "angle_deg" else f"{name} {value:.4g}")
    return list_text(words) + (" with the beam blocked" if condition.get("blocked") else "")


def limit_text(value: float, unit: str, effect: Effect | None) -> str:
    """Return one end of the range of an effect's strength; a share is written in per cent.

    It has two digits of its distance from the strength at which the effect vanishes, since no limit is known better.
    """
    nothing = effect.vanishes_at if effect else 0.0
    if effect and effect.is_share:
        value, nothing, unit = 100 * value, 100 * nothing, "%"
    distance = abs(value - nothing)
    digits = 1 - int(np.floor(np.log10(distance))) if 0 < distance < np.inf else 15
    return value_text(round(value, digits), None, unit)


def size_text(effect: Effect, low: str, high: str) -> str:
    """Return the range of an effect's strength, such as `no clip below 930 DN`.

    `low` and `high` are texts of its ends; "" for an end without a limit.
    """
    noun = effect.noun or f"{effect.parameters[0].name} of {effect.name}"
    if np.isinf(effect.vanishes_at):
        return f"no {noun} below {low}" if low else ""
    if low and high:
        return f"{noun} from {low} to {high}"
    if low or high:
        return f"{noun} below {high}" if high else f"{noun} above {low}"
    return ""


def limits_text(document: Mapping[str, Any]) -> list[str]:
    """Return a line for each entry of `limits` of a verdict; those without a limit come last."""
    lines = []
    for limit in sorted(document["limits"], key=lambda limit: not limit["words"]):
        first = f"{limit['words']} (95 %)" if limit["words"] else limit["why"]
        second = f"{limit['frames']:,} more frames would halve that" if limit["frames"] else limit["more"]
        lines.append(f"{limit['effect']}: {'; '.join(filter(None, (first, second)))}")
    return lines


def list_text(words: Sequence[str], mark: str = "") -> str:
    """Return `a`, `a and b` or `a, b and c`; words are joined by `mark` if there is one."""
    if mark or len(words) < 2:
        return mark.join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"
