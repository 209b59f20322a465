"""The search among laws of exposure, angle and order, and scatter from frame to frame: on the frames' numbers."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence.accounts import Account
from spotcheck.old_engine.evidence.influence import as_cells_agree, influence_of, numbers_of
from spotcheck.old_engine.evidence.laws import Laws, agreement, errors_of, laws_of
from spotcheck.old_engine.evidence.scatter import Trial
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.effect import Context, Effect
from spotcheck.old_engine.nuisance.fit import Fitted
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Frame
from spotcheck.old_engine.search.forward import Found, held
from spotcheck.old_engine.search.holds import Holding


class Lawful(NamedTuple):
    """Effects that were found on the frames' numbers, what these say beside them, and standard errors of the parameters
    of laws, by the effect's name."""

    found: tuple[Found, ...]
    told: Laws
    errors: dict[str, tuple[float, ...]]


def search_laws(
    frames: Sequence[Frame],
    design: Design,
    fitted: Fitted,
    baseline: Baseline,
    crop_px: float,
    effects: Sequence[Effect],
    context: Context,
) -> Lawful:
    """Effects that act on brightness, width and place of whole frames, from a fit in which these are free; `baseline`
    has the laws that are declared."""
    numbers = as_cells_agree(numbers_of(fitted, influence_of(frames, fitted)), design.condition)
    found: list[Found] = []
    while True:
        present = tuple(own.own for own in found)
        told = laws_of(numbers, design, baseline, fitted.model.sensor, crop_px, present, effects)
        known = {own.present.effect.name for own in told.trials}
        of_centre = [own for own in told.scatters if own.present.effect.name not in known]
        trials = [own for own in (*told.trials, *of_centre) if _counts(own, context)]
        if not trials or len(found) == criteria.MOST.value:
            break
        best = min(trials, key=lambda own: (np.isnan(own.alone), own.alone, -own.gain))
        near = {own.present.effect.name: float(own.alone - best.alone) for own in trials
                if own is not best and own.alone - best.alone < criteria.RIVAL.value}  # fmt: skip
        holding = Holding(0.0, 1, float(best.z**2), best.error)
        found.append(Found(best.present, float(best.gain), holding, near))

    def told_of(some: list[Found]) -> Laws:
        present = tuple(own.own for own in some)
        return laws_of(numbers, design, baseline, fitted.model.sensor, crop_px, present, effects)

    last, _ = held(found, lambda some: _holding(some, told_of(some).base), lambda some, k: some[:k] + some[k + 1 :])
    return _lawful(last, told if len(last) == len(found) else told_of(last))


def _holding(found: Sequence[Found], base: Account | None) -> list[Found]:
    """Found effects, each with how groups of frames agree about it beside all others: where two laws leave nothing that
    could speak against them, the later one is not known to be there."""
    names = {} if base is None else {own.effect.name: k for k, own in enumerate(base.present)}
    out, untold = [], 0
    for one in found:
        k = names.get(one.own.effect.name)
        if base is not None and k is not None:
            q, freedom = agreement(base, k)
            untold += not freedom
            q = np.inf if untold > 1 and not freedom else q
            one = one._replace(holding=one.holding._replace(q=q, cells=freedom + 1))
        out.append(one)
    return out


def _lawful(found: Sequence[Found], told: Laws) -> Lawful:
    """What was found, with values and errors beside all that was found after it."""
    errors = errors_of(told.base) if told.base else {}
    last = {own.effect.name: own for own in (told.base.present if told.base else ())}
    out = [one._replace(own=last.get(one.own.effect.name, one.own)) for one in found]
    return Lawful(tuple(out), told, errors)


def _counts(own: Trial, context: Context) -> bool:
    """Whether an effect gains, is told, and is more than nothing."""
    gain = min(own.gain, own.z**2) >= criteria.GAIN.value
    return gain and own.present.effect.excess(own.value, context) >= 1
