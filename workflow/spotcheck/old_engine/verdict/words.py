"""Numbers, measurements and lists as a person says them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spotcheck.old_engine.model.effect import Effect

UNITS = {"1": "", "deg": "°", "degree": "°", "pixel": "px"}
# Units that are told with a prefix, as exposures and beams span powers of ten.
WITH_PREFIX = ("s", "m", "rad", "W")
PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: ""}
# An error that begins with less than this has two digits.
TWO_DIGITS = 3.55
# Less than this counts as 0 [%].
LEAST_PERCENT = 0.001
# Smaller p-values are not read as numbers.
SMALL_P = 1e-4
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def value_text(value: float | None, stderr: float | None, unit: str) -> str:
    """Value ± standard error and the unit, with two digits of an error that begins with 1 to 3, else one (after the
    Particle Data Group, Review of Particle Physics, Introduction 5.3): `0.0240 ± 0.0011`, `−3.1 ± 0.4 µs`."""
    if value is None or not np.isfinite(value):
        return "no value"
    unit = UNITS.get(unit, unit)
    if unit in WITH_PREFIX and value:
        power = int(np.clip(3 * np.floor(np.log10(abs(value)) / 3), -9, 0))
        value, stderr = value / 10.0**power, None if stderr is None else stderr / 10.0**power
        unit = PREFIXES[power] + unit
    tail = unit if unit in ("", "°") else f" {unit}"
    if stderr is None or not np.isfinite(stderr) or stderr <= 0:
        text = f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    else:
        digits = digits_of(stderr)
        shown = max(digits, 0)
        text = f"{round(value, digits):.{shown}f} ± {round(stderr, digits):.{shown}f}"
    return f"{text}{tail}".replace("-", "−")


def digits_of(stderr: float) -> int:
    """Decimals to which a number with an error is told."""
    power = int(np.floor(np.log10(stderr)))
    return int(np.clip((stderr < TWO_DIGITS * 10.0**power) - power, -9, 9))


def condition_text(condition: Mapping[str, Any]) -> str:
    """A measurement in words: `an exposure of 1.8 ms and 45°`."""
    words = []
    for name, value in condition.items():
        if name == "exposure_s":
            words.append(f"an exposure of {value_text(value, None, 's')}")
        elif name == "angle_deg" and value is not None:
            words.append(f"{value:.4g}°")
        elif name != "blocked" and value is not None:
            words.append(f"{name} {value:.4g}")
    return list_text(words) + (" with the beam blocked" if condition.get("blocked") else "")


def number_text(value: float | None, digits: int = 3) -> str:
    """A number without an error, with so many digits: `1.00`, `5440`, `9.61 · 10⁵`; a dash where it is not known."""
    if value is None or not np.isfinite(value):
        return "–"
    # Rounded first: 9.996 has one digit more before its point than after it was cut.
    value = float(f"{value:.{digits - 1}e}")
    power = int(np.floor(np.log10(abs(value)))) if value else 0
    if -4 <= power < 5:
        text = f"{value:.{max(digits - 1 - power, 0)}f}"
    else:
        text = f"{value / 10.0**power:.{digits - 1}f} · 10{str(power).translate(RAISED)}"
    return text.replace("-", "−")


def over_noise_text(value: float | None) -> str:
    """A number in units of the noise, which is 1.00 where noise alone is left."""
    return f"{value:.2f}" if value is not None and abs(value) < 1 else number_text(value)


def percent_text(part: float) -> str:
    """A part in percent with two digits, three from 90 % on; what is not quite all is never called all."""
    percent = 100 * part
    if 90 <= percent < 100:
        # 99.97 % is 99.9 %: rounded down.
        return f"{np.floor(10 * percent) / 10:.3g} %"
    if percent >= 100 or abs(percent) < LEAST_PERCENT:
        return f"{percent:.0f} %".replace("-0", "0")
    return f"{percent:.2g} %".replace("-", "−")


def probability_text(p: float) -> str:
    """A p-value, as far as one reads it."""
    return f"p = {p:.2g}" if p >= SMALL_P else "p < 0.0001"


def limit_text(value: float, unit: str, effect: Effect | None) -> str:
    """An end of what a strength may still be, to two digits of its distance from where the effect vanishes: no limit is
    known better. Where it vanishes nowhere or at infinity, as it is. A part is said in per cent."""
    neutral = effect.neutral if effect else 0.0
    if effect and effect.part:
        value, neutral, unit = 100 * value, 100 * neutral, "%"
    away = abs(value - neutral)
    digits = 1 - int(np.floor(np.log10(away))) if 0 < away < np.inf else 15
    return value_text(round(value, digits), None, unit)


def limits_text(document: Mapping[str, Any]) -> list[str]:
    """A line of a verdict for each effect that it does not name: how large it could still be, and the frames that would
    halve that; those that have no limit last."""
    lines = []
    for own in sorted(document["limits"], key=lambda own: not own["words"]):
        first = f"{own['words']} (95 %)" if own["words"] else own["why"]
        frames = f"{own['frames']:,} more frames would halve that" if own["frames"] else own["more"]
        lines.append(f"{own['effect']}: {'; '.join(filter(None, (first, frames)))}")
    return lines


def list_text(words: Sequence[str], mark: str = "") -> str:
    """`a`, `a and b`, `a, b and c`; with a mark joined by it."""
    if mark or len(words) < 2:
        return mark.join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"
