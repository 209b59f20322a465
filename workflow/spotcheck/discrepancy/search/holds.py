"""Whether an effect holds everywhere it speaks: the consistency test.

The score of an effect's strength, beside all else that is fitted, is split into cells; where the effect is what its
name says, every cell asks for the same strength. Q = Σ U²/I − (Σ U)²/Σ I follows χ² of one less than cells. Searches
for gravitational waves live on this test (Allen, Phys. Rev. D 71, 062001); the allowance in proportion to the signal's
square is theirs too, for templates that are nearly right.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy import criteria
from spotcheck.discrepancy.evidence.patterns import gathered, patterns_of
from spotcheck.discrepancy.evidence.pixels import Ready, by_cell, screen
from spotcheck.discrepancy.nuisance.fit import Fitted, nudged
from spotcheck.discrepancy.observe.design import Design
from spotcheck.discrepancy.observe.pixels import Frame
from spotcheck.model.effect import Context, Present


class Holding(NamedTuple):
    """Q over its cells, the square of z beside all else, and the strength's standard error."""

    q: float
    cells: int
    z2: float
    error: float

    @property
    def excess(self) -> float:
        """What is missed beyond chance, as a part of z²."""
        return (self.q - (self.cells - 1)) / max(self.z2, 1e-300)

    @property
    def holds(self) -> bool:
        """Whether the effect speaks alike everywhere."""
        by_chance = criteria.CHANCE.value * np.sqrt(2 * max(self.cells - 1, 1))
        return self.q - (self.cells - 1) <= max(by_chance, criteria.ROUNDED.value * self.z2)


def pattern_of(
    frames: Sequence[Frame], design: Design, fitted: Fitted, own: Present, context: Context
) -> tuple[Present, float, Holding]:
    """A pattern as products of frames tell it, whatever their weights; what it gains, and whether all cells of the spot
    tell the same."""
    sites, rows = gathered(frames, design, Ready(frames, fitted, []))
    for found in patterns_of(sites, rows, [own.effect], context):
        if found.own.effect.excess(found.own.values[0], context) >= 1:
            told = found.told
            holding = Holding(told.q, told.cells, min(told.gain, (told.value / told.error) ** 2), found.error)
            return found.own, told.gain, holding
    return own, 0.0, Holding(0.0, 1, 0.0, np.inf)


def holding_of(frames: Sequence[Frame], groups: np.ndarray, fitted: Fitted, effect: int) -> Holding:
    """Test the effect of a number in a fitted model; `groups` [frame] parts frames, by exposure or by site. z² is
    infinite where the strength vanishes nowhere."""
    strength = next((own for own in fitted.free if own.effect == effect and own.parameter == 0), None)
    value = fitted.model.present[effect].values[0]
    if strength is None:
        # What no strength moves is moved by all of the effect.
        beside, moved, step = fitted, fitted.model.without(effect), value
    else:
        beside = _without(fitted, fitted.free.index(strength))
        moved, step = nudged(fitted.model, strength)
    (own,) = screen(frames, beside, [moved])
    score, information = by_cell(frames, beside, moved, own)
    parts, group = np.unique(groups, return_inverse=True)
    u, i = (np.zeros((len(parts), score.shape[1])) for _ in range(2))
    np.add.at(u, group, score)
    np.add.at(i, group, information)
    # A cell that tells next to nothing has no normal score.
    told = i > 1e-4 * i.max()
    q = float((u[told] ** 2 / i[told]).sum() - u[told].sum() ** 2 / i[told].sum())
    error = abs(step) / np.sqrt(max(own.information, 1e-300))
    neutral = fitted.model.present[effect].effect.neutral
    wald = ((value - neutral) / error) ** 2 if np.isfinite(neutral) else np.inf
    return Holding(q, int(told.sum()), float(wald), float(error))


def _without(fitted: Fitted, at: int) -> Fitted:
    """The same fit, with the parameter at a place held: its rows and columns leave the dense part."""
    others = fitted.free[:at] + fitted.free[at + 1 :]
    place = len(fitted.schur.left) - len(fitted.free) + at
    return fitted._replace(free=others, schur=fitted.schur.without(np.array([place])))
