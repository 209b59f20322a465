"""Which of what was learned takes the place of what the data sheet states.

A number goes in where the sheet does not say it, where the results contradict the sheet, or where they know it better
than the sheet's own error. What spots alone tell of a sensor never overrules a sheet: grain of a material looks like
noise.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from spotcheck.characterization.sensor_choice import SPOTS
from spotcheck.dataset.instrument import SECTIONS, Instrument
from spotcheck.discrepancy.criteria import CLEAR_ERRORS
from spotcheck.export.adoption.learned import Learned
from spotcheck.io.schema import find_violation


class Choice(NamedTuple):
    """What was learned of a key; what the sheet states of it (None: nothing) and with which error; whether the learned
    value is taken, and why or why not."""

    learned: Learned
    stated: Any
    stated_stderr: float
    taken: bool
    why: str


def choices_of(learned: Sequence[Learned], given: Instrument) -> list[Choice]:
    """A choice for each key, in the order of instrument.yaml."""
    order = list(SECTIONS)
    ready = sorted(learned, key=lambda own: order.index(own.key.partition(".")[0]))
    return [_choice(own, given) for own in ready]


def _choice(own: Learned, given: Instrument) -> Choice:
    section, _, name = own.key.partition(".")
    if not name or not isinstance(own.value, int | float):
        return Choice(own, None, 0.0, True, "learned beside what the sheet states")
    holder = getattr(given, section)
    stated = getattr(holder, name) if own.key in given.given_keys else None
    stated_stderr = float(getattr(holder, f"{name}_stderr", 0.0)) if stated is not None else 0.0
    if breach := find_violation({section: {name: own.value}}, "instrument"):
        return Choice(own, stated, stated_stderr, False, breach)
    return Choice(own, stated, stated_stderr, *_weighed(own, stated, stated_stderr))


def _weighed(own: Learned, stated: float | None, stated_stderr: float) -> tuple[bool, str]:
    """Whether a number is taken, and why."""
    if stated is None:
        return True, "the sheet does not say"
    if own.overrules:
        return True, "contradicts the sheet"
    if own.origin.startswith(SPOTS):
        return False, "spots alone do not overrule a sheet"
    if not np.isfinite(own.stderr):
        return False, "its error is not known"
    errors = abs(own.value - stated) / np.hypot(own.stderr, stated_stderr)
    if errors > CLEAR_ERRORS:
        return True, f"contradicts the sheet by {errors:.1f} errors"
    if own.stderr < stated_stderr:
        return True, "known better than the sheet states"
    return False, f"agrees with the sheet within {max(errors, 0.1):.1f} errors"
