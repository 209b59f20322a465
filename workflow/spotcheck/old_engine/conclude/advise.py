"""What to measure next where effects cannot be told apart: the feasible condition that needs the fewest frames.

If one effect is there and not its rival, a frame of a new condition reads what the one model expects; by how much the
other model, its brightness, width and centre free, falls behind there is what a frame is worth.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from spotcheck.old_engine import criteria
from spotcheck.old_engine.conclude.judgement import Advice
from spotcheck.old_engine.model.chain import Law, spot_state
from spotcheck.old_engine.model.effect import Context
from spotcheck.old_engine.nuisance.fit import fit
from spotcheck.old_engine.nuisance.numbers import expected_of
from spotcheck.old_engine.nuisance.parameters import free_of
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Expectation, Frame, Model, Numbers
from spotcheck.old_engine.search.forward import MOST_STEPS, Outcome

# More frames than this nobody takes for one question.
MOST_FRAMES = 200
# A frame whose brightest reading is above this part of full scale is not asked for.
USABLE = 0.97
# Peak of a spot whose beam is blocked [ln DN].
BLOCKED = -20.0

Condition = Mapping[str, float | bool]


def advise(outcome: Outcome, law: Law | None, design: Design, context: Context) -> tuple[Advice, ...]:
    """For each effect of pixels that has a rival: how many frames of which condition tell it from the nearest one."""
    out, present = [], outcome.after.model.present
    for one in outcome.found:
        place = next((k for k, own in enumerate(present) if own.effect.name == one.own.effect.name), None)
        if place is None or not one.instead:
            continue
        model = outcome.after.model.without(place).with_effect(one.instead[0])
        other = fit(outcome.frames, model, outcome.after.penalty, free_of(model, context), steps=MOST_STEPS).model
        pair = (one.own.effect.name, one.instead[0].effect.name)
        best = cheapest(outcome.frames, design, outcome.after.model, other, law)
        if best is not None:
            out.append(Advice(best[0], pair, best[1]))
    return tuple(out)


def cheapest(
    frames: Sequence[Frame], design: Design, first: Model, other: Model, law: Law | None
) -> tuple[Condition, int] | None:
    """The condition that tells two models apart whichever is true, and how many frames of it; None where none does."""
    tried = []
    for condition in feasible(design):
        worth = min(worth_of(frames, *pair, condition, law) for pair in ((first, other), (other, first)))
        if worth > 0:
            tried.append((int(np.ceil(criteria.GAIN.value / worth)), condition))
    least = min(tried, key=lambda own: own[0], default=None)
    return (least[1], least[0]) if least is not None and least[0] <= MOST_FRAMES else None


def feasible(design: Design) -> Iterator[Condition]:
    """Exposures from a quarter of the shortest to four times the longest, and those between; angles between those that
    occur and two beyond, at the longest exposure; that exposure with the beam blocked."""
    exposures, angles = design.exposures, np.unique(design.angle_deg[np.isfinite(design.angle_deg)])
    if not exposures.size:
        return
    longest = {"exposure_s": float(exposures[-1])}
    for t in (exposures[0] / 4, exposures[0] / 2, *np.sqrt(exposures[:-1] * exposures[1:]), 2 * exposures[-1],
              4 * exposures[-1]):  # fmt: skip
        yield {"exposure_s": float(t)}
    if angles.size:
        for angle in (*((angles[:-1] + angles[1:]) / 2), angles[-1] + 22.5, angles[-1] + 45):
            yield longest | {"angle_deg": float(angle)}
    yield longest | {"blocked": True}


def worth_of(frames: Sequence[Frame], first: Model, other: Model, condition: Condition, law: Law | None) -> float:
    """−2 ln L by which the other model falls behind with one frame of a condition, where the first is true."""
    times = np.array([float(frame.view.exposure_s.ravel()[0]) for frame in frames])
    exposure = float(condition["exposure_s"])
    k = int(np.argmin(np.abs(np.log(times / exposure))))
    view = frames[k].view._replace(exposure_s=np.full((1, 1, 1), exposure))
    if "angle_deg" in condition:
        view = view._replace(angle=np.full((1, 1, 1), np.deg2rad(float(condition["angle_deg"]))))
    numbers = first.take(np.array([k])).numbers
    log_peak, log_width = numbers.log_peak + np.log(exposure / times[k]), numbers.log_width
    if law is not None:
        at, before = (spot_state(v, first.baseline, law, ()) for v in (view, frames[k].view))
        log_peak, log_width = (n + float(np.log(a / b).ravel()[0]) for n, a, b in
                               zip((numbers.log_peak, numbers.log_width), at, before, strict=True))  # fmt: skip
    if condition.get("blocked"):
        log_peak = np.full(1, BLOCKED)
    moved = Numbers(log_peak, log_width, numbers.x, numbers.y)
    blank = Frame(np.zeros_like(frames[k].pixels), view)
    seen = Expectation([blank], first._replace(numbers=moved)).of(blank, 0)
    if not np.isfinite(seen.mean).all() or seen.mean.max() > USABLE * first.sensor.full_scale_dn:
        return 0.0
    wanted = Frame(seen.mean, view)
    then = other._replace(numbers=moved)
    rest = (
        Expectation([wanted], then).of(wanted, 0) if condition.get("blocked") else expected_of([wanted], then)[0]
    ).mean
    return float(((seen.mean - rest) ** 2 / seen.variance).sum())
