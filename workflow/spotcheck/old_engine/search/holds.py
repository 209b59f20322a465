"""Whether an effect holds everywhere it speaks: the consistency test.

The score of an effect's strength, beside all else that is fitted, is split into cells; where the effect is what its
name says, every cell asks for the same strength. Q = Σ U²/I − (Σ U)²/Σ I follows χ² of one less than cells. Searches
for gravitational waves live on this test (Allen, Phys. Rev. D 71, 062001); the allowance in proportion to the signal's
square is theirs too, for templates that are nearly right.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence.grain import neighbours
from spotcheck.old_engine.evidence.patterns import gathered, patterns_of
from spotcheck.old_engine.evidence.pixels import ByCell, Field, Ready, by_cell, screen
from spotcheck.old_engine.model.effect import Context, Present
from spotcheck.old_engine.nuisance.fit import Fitted
from spotcheck.old_engine.nuisance.parameters import nudged
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Frame, Model, scatters


class Holding(NamedTuple):
    """Q over its cells, the square of z beside all else, and the strength's standard error; and by which factor errors
    are larger than the likelihood of single pixels says, as fields make neighbours alike."""

    q: float
    cells: int
    z2: float
    error: float
    wider: float = 1.0

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


def groups_of(design: Design) -> np.ndarray:
    """What parts frames that must agree about an effect: their exposure, or where all have one their pose."""
    return design.exposure_s if design.exposures.size > 1 else design.pose


def fields_of(model: Model, step: int) -> list[Field]:
    """Fields of a model of which neighbours, so many pixels apart, share grains."""
    grains = [own for own in model.present if scatters(own.effect, "field") and own.effect.component == "grain"]
    return [
        Field(own.values[0], *(neighbours(root * own.values[1] / step) for root in (2**0.5, 1.0))) for own in grains
    ]


def holding_of(frames: Sequence[Frame], design: Design, fitted: Fitted, effect: int) -> Holding:
    """Test the effect of a number in a fitted model. z² is infinite where the strength vanishes nowhere."""
    strength = next((own for own in fitted.free if own.effect == effect and own.parameter == 0), None)
    value = fitted.model.present[effect].values[0]
    if strength is None:
        # What no strength moves is moved by all of the effect.
        beside, moved, step = fitted, fitted.model.without(effect), value
    else:
        beside = _without(fitted, fitted.free.index(strength))
        moved, step = nudged(fitted.model, strength)
    (own,) = screen(frames, beside, [moved])
    (cells,) = by_cell(frames, beside, [moved], [own], fields_of(fitted.model, frames[0].step))
    told = agreement_of(cells, design)
    error = told.wider * abs(step) / np.sqrt(max(own.information, 1e-300))
    neutral = fitted.model.present[effect].effect.neutral
    wald = ((value - neutral) / error) ** 2 if np.isfinite(neutral) else np.inf
    return Holding(told.q, told.cells, float(wald), float(error), told.wider)


class Agreement(NamedTuple):
    """Q of a change over so many cells, and by which factor errors are larger than pixels alone say."""

    q: float
    cells: int
    wider: float


def agreement_of(cells: ByCell, design: Design) -> Agreement:
    """Whether cells ask for the same size of a change: those of the frames of a group are summed."""
    score, information, alone, together = cells
    parts, group = np.unique(groups_of(design), return_inverse=True)
    u, i, v = (np.zeros((len(parts), score.shape[1])) for _ in range(3))
    for to, of in ((u, score), (i, information), (v, alone + together)):
        np.add.at(to, group, of)
    # A cell that tells next to nothing has no normal score.
    told = i > 1e-4 * i.max()
    u, i, v = u[told], i[told], v[told]
    strength_of_all = (i * u / v).sum() / (i * i / v).sum()
    q = float(((u - strength_of_all * i) ** 2 / v).sum())
    # All exposures of a site have the same field.
    sites = [np.sqrt(together[design.site == site].sum(axis=1)).sum() ** 2 for site in np.unique(design.site)]
    wider = float(np.sqrt((alone.sum() + np.sum(sites)) / information.sum()))
    return Agreement(q, int(told.sum()), wider)


def _without(fitted: Fitted, at: int) -> Fitted:
    """The same fit, with the parameter at a place held: its rows and columns leave the dense part."""
    others = fitted.free[:at] + fitted.free[at + 1 :]
    place = len(fitted.schur.left) - len(fitted.free) + at
    return fitted._replace(free=others, schur=fitted.schur.without(np.array([place])))
