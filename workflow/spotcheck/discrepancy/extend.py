"""The loop: detect, name, add to the model, and look again, until nothing disagrees or nothing explains."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.assess import BY_CHANCE, LIKELIEST, assessable, likeliest
from spotcheck.discrepancy.base import Base
from spotcheck.discrepancy.cells import Setting
from spotcheck.discrepancy.detect import Detection, Null, detect
from spotcheck.discrepancy.explain import Account, account, granular
from spotcheck.discrepancy.freed_named import Freed, Left, freed_of, left_of
from spotcheck.discrepancy.lasting import lasting
from spotcheck.discrepancy.look import Look, look_again, look_at
from spotcheck.discrepancy.name import CONSTANT, plainly, present_of, search
from spotcheck.discrepancy.refit import NO_WAVE
from spotcheck.discrepancy.shots import Design, Shot
from spotcheck.discrepancy.stripes import peak
from spotcheck.discrepancy.surround import LEFT, STATISTIC, Surround, surround_of
from spotcheck.model.effect import Place

# −log10 p from which on scatter, stripes or lines stand out clearly.
CLEAR = 4.0
# Where less than this many times the expected χ² is left, it may be an edge's that blocks do not resolve; and so often
# is looked again.
NEARLY, AGAIN = 3.0, 2
# Of the mean's excess χ² a tolerance forgives at most this part, where what is left is so many standard errors from
# nothing: else a tolerance would name whatever takes most of a faint disagreement.
FORGIVEN, CERTAINLY = 0.05, 5.0
# Period [px] of the finest stripes that pixels resolve, and a little.
FINEST = 2.05


class Tolerance(NamedTuple):
    """What is not worth an alarm: rms of the mean's residual as a part of the peak, the same as a part of a pixel's
    noise, and the excess of noise."""

    of_peak: float = 0.002
    of_noise: float = 0.02
    alpha: float = 0.01


class Size(NamedTuple):
    """How large a disagreement is in its worst condition, free of noise: rms of the mean's residual over the peak, and
    over a pixel's noise; excess of the noise's variance."""

    of_peak: float
    of_noise: float
    excess_variance: float


class Findings(NamedTuple):
    """The first look and account, detection and size of the disagreement; the explanations that hold, best first; the
    best account and what remains of it; every single effect's account; why others were not assessed; and for every
    single effect −2 ln L over the base model's, and χ². Where no set holds: what can be named, and what is left, with
    each frame's brightness and width its own (None: nothing); what lies beside the crops under the base model."""

    look: Look
    base: Account
    detection: Detection
    size: Size
    explanations: list[Account]
    best: tuple[Look, Account] | None
    rest: Detection
    rest_size: Size
    singles: dict[str, Account]
    not_assessed: dict[str, str]
    status: str
    evidence: dict[str, tuple[float, float]]
    freed: Freed | None = None
    left: Left | None = None
    around: Surround | None = None


def investigate(
    shots: Sequence[Shot], design: Design, base: Base, setting: Setting, null: Null, tolerance: Tolerance
) -> Findings:
    """All steps on the frames that may choose the model."""
    look = look_at(shots, design, base, setting)
    first = account(look, ())
    around = surround_of(shots, look, first)
    left = first.left | likeliest(look, first)
    detection = detect(null, left | told(around))
    size = size_of(look, first, left[LIKELIEST], around)
    effects, not_assessed = assessable(look)
    if consistent(detection, size, tolerance):
        return Findings(look, first, detection, size, [], None, detection, size, {}, not_assessed, "consistent", {},
                        around=around)  # fmt: skip
    if consistent(detect(null, left), size_of(look, first, left[LIKELIEST]), tolerance):
        # Effects are told by the crops, which agree.
        return Findings(look, first, detection, size, [], None, detection, size, {}, not_assessed | {"all": LEFT},
                        "unknown", {}, around=around)  # fmt: skip
    looks: dict[tuple, Look] = {}

    def near_to(leader: Account) -> Look:
        if leader.key not in looks:
            looks[leader.key] = about(shots, look, leader)
        return looks[leader.key]

    def closer(leader: Account, own: Account) -> tuple[Account, bool]:
        near = near_to(leader)
        exact = closer_account(near, own)
        good = fits(near, exact)
        if own.names == leader.names and detect(null, exact.left).p_value < tolerance.alpha:
            # At the first look blocks blur what tells forms of one effect apart, also within the tolerance.
            other, near = best_form(near, exact, near_to)
            if other.effects != exact.effects:
                near = near_to(other)
                exact = closer_account(near, other)
                looks[leader.key] = near
                good = fits(near, exact)
            for _ in range(AGAIN):
                if good or exact.refit.chi2 >= NEARLY * near.problem.used.sum() or "pixel" in own.component:
                    break
                # The first look may lead astray: once more, from what the closer one found.
                near = about(shots, near, exact)
                exact = closer_account(near, exact)
                looks[leader.key] = near
                good = fits(near, exact)
        elif not good and own.names != leader.names:
            # The form that a rival has from there may be the wrong one, and its edge needs a look of its own.
            exact, near = best_form(near, exact, near_to)
            good = fits(near, exact)
        return exact, good

    def fits(near: Look, exact: Account) -> bool:
        # A model gone astray may leave no block that could speak against it.
        if not near.problem.used.any() or not granular(near, exact) or not resolved(exact):
            return False
        more = likeliest(near, exact)
        rest = detect(null, exact.left | more)
        # Hot pixels alone settle outliers, whatever these are: then nothing odd may be left, however small.
        hot_alone = "pixel" in exact.component and not exact.component["pixel"]
        if hot_alone and rest.p_value < tolerance.alpha:
            return False
        good = consistent(rest, size_of(near, exact, more[LIKELIEST]), tolerance)
        good &= rest.p_value >= tolerance.alpha or not much_left(exact, near, first, look)
        # Last, for it opens every frame again.
        return good and ("pixel" not in exact.component or lasting(shots, look, _prnu(exact)))

    naming = search(look, effects, closer, near_to)
    evidence = {n: (own.score - first.score, own.refit.chi2) for n, own in naming.singles.items()}
    explanations = naming.holding
    status = ("named" if len(explanations) == 1 else "ambiguous") if explanations else "unknown"
    if not explanations:
        unknown = Findings(look, first, detection, size, [], None, detection, size, naming.singles, not_assessed,
                           status, evidence, around=around)  # fmt: skip
        if not unruly(detect(null, (naming.best or first).left)):
            return unknown
        freed = freed_of(shots, design, base, setting)
        return unknown if freed is None else with_freed(unknown, freed, shots, null)
    near = near_to(explanations[0])
    best = closer_account(near, explanations[0])
    beside, more = surround_of(shots, near, best), likeliest(near, best)
    rest = detect(null, best.left | more | told(beside))
    rest_size = size_of(near, best, more[LIKELIEST], beside)
    if beside is not None and not consistent(rest, rest_size, tolerance):
        status, not_assessed = "unknown", not_assessed | {"all": LEFT}
    return Findings(look, first, detection, size, explanations, (near, best), rest, rest_size, naming.singles,
                    not_assessed, status, evidence, around=around)  # fmt: skip


def resolved(own: Account) -> bool:
    """Whether stripes are coarser than two pixels and leave some light: else they are another thing's aliases. True
    where there are none."""
    for present in own.refit.model.present:
        if present.effect.spectral:
            depth, period = present.values[:2]
            return bool(depth <= 1 and period > FINEST)
    return True


def much_left(own: Account, near: Look, first: Account, look: Look) -> bool:
    """Whether an account leaves more of the first excess χ² of the means than a tolerance may forgive."""
    left, excess = (fit.refit.chi2 - float(seen.problem.used.sum()) for fit, seen in ((own, near), (first, look)))
    error = float(np.sqrt(2 * near.problem.used.sum() * own.together))
    return left > max(FORGIVEN * excess, CERTAINLY * error)


def told(around: Surround | None) -> dict[str, float]:
    """What surroundings add to the statistics."""
    return {} if around is None else {STATISTIC: around.statistic}


def unruly(detection: Detection) -> bool:
    """Whether brightness or width scatter from frame to frame, so that no law of them can hold."""
    return any(detection.by_statistic.get(f"frame: {name}", 0.0) > CLEAR for name in ("brightness", "width"))


def with_freed(found: Findings, freed: Freed, shots: Sequence[Shot], null: Null | None = None) -> Findings:
    """Findings with what was named among freed frames, and what is left there; without a null law the rest stays."""
    left = left_of(freed, shots, found.look)
    rest = found.rest if null is None else detect(null, left.statistics)
    return found._replace(freed=freed, left=left, rest=rest)


def about(shots: Sequence[Shot], look: Look, leader: Account) -> Look:
    """A closer look: about what an account expects of every pixel. Long stripes pull at the sites' centres: once they
    are taken off, the spots are placed anew."""
    prnu = _prnu(leader) if "pixel" in leader.component and look.measured.common else None
    model = leader.refit.model
    others = tuple(own for own in model.present if not own.effect.spectral)
    if len(others) < len(model.present):
        # Blocks do not resolve short stripes, and other effects turn their peak: it is sought where these are off.
        look = look_again(shots, look, model._replace(present=others, wave=NO_WAVE), leader.latent, prnu)
        found = peak(look.measured)
        values = (found.depth, found.period, found.direction, 0.0)
        present = tuple(own if own in others else own._replace(values=values) for own in model.present)
        model = model._replace(present=present, shift=0 * model.shift)
    near = look_again(shots, look, model, leader.latent, prnu)
    if near.measured.waves.any():
        near = look_again(shots, near, near.problem.start, leader.latent, prnu)
    return near


def _prnu(own: Account) -> float:
    """Rms of the pixels' gains."""
    return float(np.sqrt(own.component["pixel"]))


def best_form(near: Look, own: Account, near_to: Callable[[Account], Look]) -> tuple[Account, Look]:
    """The best account over all forms of each effect, one after the other, from the values at hand; and its look.

    Where a form has an edge, nothing but its own expectation of every pixel says how good it is.
    """
    edged = any(e.place is Place.WELL for e, _ in own.effects) and own.refit.chi2 < NEARLY * near.problem.used.sum()
    for k, (effect, _) in enumerate(own.effects):
        for form in effect.forms:
            if form == own.effects[k][1] or effect.spectral:
                continue
            present = list(present_of(own))
            # Where a form has parameters of its own, the values at hand may mean another thing in it.
            afresh = effect.idle.get(form) != effect.idle.get(own.effects[k][1])
            starts = [present[k].values, *(effect.starts(near.problem.context) if afresh else ())]
            tried = []
            for values in starts:
                present[k] = present[k]._replace(form=form, values=values)
                tried.append(account(near, present, own.refit.model, own.refit.score + CONSTANT))
            other, look = min(tried, key=plainly), near
            if edged and effect.place is Place.WELL and other.refit.chi2 < NEARLY * near.problem.used.sum():
                look = near_to(other)
                other = closer_account(look, other)
            if plainly(other) < plainly(own) - 1:
                own, near = other, look
    return own, near


def closer_account(near: Look, own: Account) -> Account:
    """An account fitted again at a closer look. That takes each frame's own brightness and centre off where they
    scatter; how much they do is what was seen before."""
    found = {p.effect.name: p.values for p in near.problem.start.present if p.effect.spectral}
    present = [p._replace(values=found.get(p.effect.name, p.values)) for p in present_of(own)]
    exact = account(near, present, own.refit.model._replace(shift=near.problem.start.shift))
    kept = {name: own.component[name] for name in ("gain", "centre") if name in own.component}
    errors = {name: own.component_error[name] for name in kept}
    return exact._replace(component=exact.component | kept, component_error=exact.component_error | errors)


def consistent(detection: Detection, size: Size, tolerance: Tolerance) -> bool:
    """Whether nothing disagrees, or too little to matter.

    The tolerances are of the mean and of the noise; scatter, stripes and lines that stand out clearly always matter.
    """
    small = size.of_peak < tolerance.of_peak and size.of_noise < tolerance.of_noise
    small &= abs(size.excess_variance) < 2 * tolerance.of_noise
    other = max(v for k, v in detection.by_statistic.items() if not k.startswith(("mean", "variance", "surround")))
    return detection.p_value >= tolerance.alpha or (small and other < CLEAR)


def size_of(look: Look, own: Account, likeliest_z: float, around: Surround | None = None) -> Size:
    """Size of what is left of an account, in the worst condition or as the likeliest effect (its z) over all; of the
    mean also beside the crops."""
    fit, cells = own.refit, look.cells
    used = look.problem.used
    top = float(np.max(look.light))
    pixels = float(cells.pixels[used].sum())
    peak, noise = 0.0, np.sqrt(max(likeliest_z**2 - BY_CHANCE**2, 0.0) / max(pixels, 1.0))
    for c in range(len(cells.place)):
        at = used[c]
        if not at.any():
            continue
        excess = np.mean((fit.residual[c][at]) ** 2 - fit.variance[c][at])
        count = at.sum() / own.together
        error = np.sqrt(2 * np.mean(fit.variance[c][at] ** 2) / count)
        # Less a standard error, since the worst of many conditions is a large one by chance.
        peak = max(peak, np.sqrt(max(excess - error, 0.0)) / top)
        z = fit.residual[c][at] ** 2 / fit.variance[c][at] - 1
        over = np.mean(z) - np.sqrt(2 / count)
        noise = max(noise, np.sqrt(max(over, 0.0) / np.mean(cells.pixels[c][at])))
    levels = [o for o in own.observables if o.block == "variance"]
    weight = np.array([o.error**-2 for o in levels])
    excess = float((weight * [o.value for o in levels]).sum() / weight.sum()) if levels else 0.0
    if around is not None:
        peak = max(peak, around.off() / top)
    return Size(float(peak), float(noise), excess)
