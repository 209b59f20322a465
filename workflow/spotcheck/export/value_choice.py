"""Choose between the learned value of a key and that of the data sheet.

A key is "section.name" of instrument.yaml. The data sheet is what the dataset's own instrument.yaml states. A learned
value is adopted if the data sheet does not state the key, if the results contradict the sheet, or if the standard error
of the learned value is smaller. A value from spots alone never replaces a stated one, since the texture of the material
looks like noise. Files and bad pixels are always adopted.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spotcheck.dataset.instrument import SECTIONS, Instrument
from spotcheck.discrepancy.criteria import CLEAR_ERRORS
from spotcheck.export.learned_values import LearnedValue
from spotcheck.io.schema import find_violation


@dataclass(frozen=True)
class Choice:
    """Decision on one learned value."""

    learned: LearnedValue  # value that the results give
    stated: float | None  # value of the data sheet; None if it has none, and for files and bad pixels
    stated_stderr: float  # standard error of `stated`, in its unit; 0 if the sheet gives none
    is_adopted: bool  # whether the learned value is written
    reason: str  # why it is adopted or not, in words


def choose_values(learned: Sequence[LearnedValue], instrument: Instrument) -> list[Choice]:
    """Return the decision on each learned value, in the order of the sections of instrument.yaml.

    Parameters
    ----------
    learned : sequence of LearnedValue
        Learned values, at most one for each key.
    instrument : Instrument
        Data sheet of the dataset.
    """
    sections = list(SECTIONS)
    ordered = sorted(learned, key=lambda value: sections.index(value.key.partition(".")[0]))
    return [_choose(value, instrument) for value in ordered]


def _choose(learned: LearnedValue, instrument: Instrument) -> Choice:
    """Return the decision on a value: files and bad pixels are adopted always, numbers if `_compare` prefers them.

    A number that the schema of instrument.yaml does not allow is not adopted.
    """
    section, _, name = learned.key.partition(".")
    if not name or not isinstance(learned.value, int | float):
        return Choice(learned, None, 0.0, True, "learned beside what the sheet states")
    stated_section = getattr(instrument, section)
    stated = getattr(stated_section, name) if learned.key in instrument.given_keys else None
    stated_stderr = float(getattr(stated_section, f"{name}_stderr", 0.0)) if stated is not None else 0.0
    violation = find_violation({section: {name: learned.value}}, "instrument")
    is_adopted, reason = (False, violation) if violation else _compare(learned, stated, stated_stderr)
    return Choice(learned, stated, stated_stderr, is_adopted, reason)


def _compare(learned: LearnedValue, stated: float | None, stated_stderr: float) -> tuple[bool, str]:
    """Return whether a learned number replaces the stated one (None if there is none), and why.

    `stated_stderr` is 0 if the data sheet gives no error. Numbers contradict each other if they differ by more than
    `CLEAR_ERRORS` standard errors of the difference.
    """
    if stated is None:
        return True, "the sheet does not say"
    if learned.overrules:
        return True, "contradicts the sheet"
    if learned.is_from_spots:
        return False, "spots alone do not overrule a sheet"
    if not np.isfinite(learned.stderr):
        return False, "its error is not known"
    # In standard errors of the difference.
    difference = abs(learned.value - stated) / np.hypot(learned.stderr, stated_stderr)
    if difference > CLEAR_ERRORS:
        return True, f"contradicts the sheet by {difference:.1f} errors"
    if learned.stderr < stated_stderr:
        return True, "known better than the sheet states"
    return False, f"agrees with the sheet within {max(difference, 0.1):.1f} errors"
