"""One thing that a file says of its frames, and which of them agree."""

import math
from collections.abc import Iterable
from typing import NamedTuple

# Numbers that differ by less than this part are one: names round what tags hold to more digits.
ROUNDED_PART = 0.01


class Label(NamedTuple):
    """One thing that a file says of its frames.

    `column` is a column of manifest.csv (`kind`, `angle_deg`, `exposure_s`, `repeat`, `z_m`, `date`, `photons_per_px`),
    a key of instrument.yaml (`sensor.pixel_pitch_m`, …), `number` for the number that a name ends in, or None for what
    is not understood. `value` is in the unit of that name, or a word; None where a number has no unit. `text` is what
    was read, `where` names its source, and `page` the page of a stack that it speaks of, None for all of them.
    """

    column: str | None
    value: float | int | str | None
    text: str
    where: str
    page: int | None = None


def settled(labels: Iterable[Label], page: int = 0) -> tuple[dict[str, Label], list[str]]:
    """What the labels of a page agree on, by column, and a sentence for each contradiction.

    Of labels that agree the first is taken, so the most exact sources come first. A column that two labels contradict
    each other in has no value.
    """
    by_column: dict[str, list[Label]] = {}
    for label in labels:
        if label.column and label.value is not None and label.page in (None, page):
            by_column.setdefault(label.column, []).append(label)
    taken, said = {}, []
    for column, own in by_column.items():
        other = next((label for label in own if not agree(own[0], label)), None)
        if other is None:
            taken[column] = own[0]
        else:
            said.append(f"{column}: {shown(own[0])}, but {shown(other)}")
    return taken, said


def agree(one: Label, other: Label) -> bool:
    """Whether two labels of a column say the same: numbers within what names round, dates by their day."""
    a, b = one.value, other.value
    if one.column == "date":
        return str(a)[:10] == str(b)[:10]
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=ROUNDED_PART)
    return a == b


def shown(label: Label) -> str:
    """Where a label comes from, and what it says there."""
    return f"{label.where} says {label.text!r}"
