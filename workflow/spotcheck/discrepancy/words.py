"""Texts of numbers, conditions, limits and lists, for sentences and tables that a person reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from spotcheck.io.number_text import number_text, quantity_text

if TYPE_CHECKING:
    from spotcheck.model.effect import Effect

# Smaller percentages are written as 0 [%].
LEAST_PERCENT = 0.001
# Percentages from this one to 100 have three digits and are rounded down [%].
NEARLY_ALL = 90
# Smaller p-values are written as "p < 0.0001".
LEAST_SHOWN_P = 1e-4
# Digits of a number that is kept as it is: all that a float has.
ALL_DIGITS = 15


def over_noise_text(value: float | None) -> str:
    """Return the text of a number in units of the noise, such as a gap; noise alone gives `1.00`.

    None is written as `number_text` writes it.
    """
    return f"{value:.2f}" if value is not None and abs(value) < 1 else number_text(value)


def percent_text(part: float) -> str:
    """Return a part, such as 0.12, in per cent: two digits, or three from 90 % on.

    From 90 % to 100 % it is rounded down, so that 99.97 % is not written as all.
    """
    percent = 100 * part
    if NEARLY_ALL <= percent < 100:
        return f"{np.floor(10 * percent) / 10:.3g} %"
    if percent >= 100 or abs(percent) < LEAST_PERCENT:
        return f"{percent:.0f} %".replace("-0", "0")
    return f"{percent:.2g} %".replace("-", "−")


def probability_text(p: float) -> str:
    """Return the text of a p-value with two digits, such as `p = 0.32`, or `p < 0.0001`."""
    return f"p = {p:.2g}" if p >= LEAST_SHOWN_P else "p < 0.0001"


def condition_text(condition: Mapping[str, Any]) -> str:
    """Return the text of the conditions of a measurement, such as `an exposure of 1.8 ms and 45°`.

    Parameters
    ----------
    condition : mapping
        Values by the names of columns of the manifest, such as exposure_s and angle_deg; None for a condition that is
        not set. `blocked` is True if the beam is blocked.
    """
    words = []
    for name, value in condition.items():
        if value is None or name == "blocked":
            continue
        if name == "exposure_s":
            words.append(f"an exposure of {quantity_text(value, None, 's')}")
        else:
            words.append(f"{value:.4g}°" if name == "angle_deg" else f"{name} {value:.4g}")
    return list_text(words) + (" with the beam blocked" if condition.get("blocked") else "")


def limit_text(value: float, unit: str, effect: Effect | None) -> str:
    """Return the text of one end of the range of an effect's strength; a share is written in per cent.

    Its distance from the strength at which the effect vanishes has two digits, since no limit is known better. `unit`
    is that of the value. Without an effect (None) the distance is that from 0.
    """
    zero = effect.vanishes_at if effect else 0.0
    if effect and effect.is_share:
        value, zero, unit = 100 * value, 100 * zero, "%"
    distance = abs(value - zero)
    digits = 1 - int(np.floor(np.log10(distance))) if 0 < distance < np.inf else ALL_DIGITS
    return quantity_text(round(value, digits), None, unit)


def size_text(effect: Effect, low: str, high: str) -> str:
    """Return the text of the range of an effect's strength, such as `no clip below 930 DN`; "" without limits.

    `low` and `high` are texts of its ends by `limit_text`; "" for an end without a limit.
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
    """Return a line for each row of `limits` of a verdict; rows without a limit come last.

    `document` is the content of verdict.json.
    """
    lines = []
    for limit in sorted(document["limits"], key=lambda limit: not limit["words"]):
        size = f"{limit['words']} (95 %)" if limit["words"] else limit["why"]
        outlook = f"{limit['frames']:,} more frames would halve that" if limit["frames"] else limit["more"]
        lines.append(f"{limit['effect']}: {'; '.join(filter(None, (size, outlook)))}")
    return lines


def list_text(words: Sequence[str], mark: str = "") -> str:
    """Return words as `a`, `a and b` or `a, b and c`; with a `mark`, such as "; ", they are joined by it instead."""
    if mark or len(words) < 2:
        return mark.join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"
