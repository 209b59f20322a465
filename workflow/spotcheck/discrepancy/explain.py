"""What a set of effects makes of a look: one joint fit of condition means and of noise, and what it leaves over."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares, minimize_scalar, nnls
from scipy.stats import gamma

from spotcheck.discrepancy.cells import pooled
from spotcheck.discrepancy.detect import statistics
from spotcheck.discrepancy.grain import REFINED, at_its_coarsest, grains_of, strays
from spotcheck.discrepancy.look import Look, course_of
from spotcheck.discrepancy.modes import modes_of
from spotcheck.discrepancy.noise import (
    COMPONENTS,
    FrameFits,
    Observable,
    block_correlation,
    crossed,
    deviations,
    frame_fits,
    grained,
    hottest,
    pointing_of,
    scatter_of,
)
from spotcheck.discrepancy.refit import Latent, Model, Refit, Told, moving, refit
from spotcheck.discrepancy.shots import Design
from spotcheck.model.chain import Moments
from spotcheck.model.effect import Effect, Place, Present
from spotcheck.model.sensor import ROUNDING_VARIANCE

# Relative components of variance never exceed this: light does not scatter by more than itself.
MOST_RELATIVE = {"pixel": 1.0, "grain": 1.0, "gain": 1.0}
# A predicted excess of noise is trusted to this part of itself: loads rest on block means and on the form of a field.
TRUST = 0.03
# The correlation of a granular field has no fixed form; what it does to anything but its own power is trusted less.
TRUST_GRAIN = 0.3
# Observables of what scatters from frame to frame and has a component of its own.
SCATTER = ("brightness", "centre")
# White noise and the means are fitted in turn, so often at most, until the noise moves by less than this part of its
# standard error.
ROUNDS, STILL = 8, 0.2
# From so many standard deviations on a quantity of the frames scatters clearly; and no granular field brings more than
# this part of that to the differences between exposures of a site (a tenth where widths differ by a third).
CLEARLY, APART = 10.0, 0.5
# So often is a grain found with the errors held that follow from it.
WEIGHED = 3
# Relative step to bend a cost by.
BEND = 3e-3
# Of some 30,000 places in a spectrum none is higher by chance, but once in a million sets.
RARE = 3e-11
# Shape of observables that no component explains; they speak only in what is left over.
MARKS = ("stripes", "spot", "hot", "outliers", "skewness")


class Account(NamedTuple):
    """Effects with their forms; the joint fit; variance components; standard errors of these, of the grain (`size`
    [px]) and of white noise (`read` [e-]); the grain [px]; −2 ln L of everything with 2 for each free number of an
    effect; statistics and observables of what is left; how many blocks scatter as one."""

    effects: tuple[tuple[Effect, str], ...]
    refit: Refit
    component: dict[str, float]
    component_error: dict[str, float]
    grain: float
    score: float
    left: dict[str, float]
    observables: list[Observable]
    latent: Latent
    together: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects, in order."""
        return tuple(effect.name for effect, _ in self.effects)

    @property
    def key(self) -> tuple[tuple[str, str], ...]:
        """Names and forms of the effects, in order."""
        return tuple((effect.name, form) for effect, form in self.effects)

    @property
    def refit_effects(self) -> tuple[tuple[Effect, str], ...]:
        """Effects that the joint fit holds: all but those that only scatter."""
        return tuple((p.effect, p.form) for p in self.refit.model.present)


def is_component(effect: Effect) -> bool:
    """Whether an effect is a component of variance rather than a change of the mean."""
    return effect.scatter is not None


def account(look: Look, present: Sequence[Present], start: Model | None = None, target: float = np.inf) -> Account:
    """Fit `present` (values are starts; those of variance components do not matter) beside the base, from `start`;
    `target` as for `refit`."""
    start = start or look.problem.start
    direct = tuple(own for own in present if own.effect.component in ("", "row"))
    active = [own.effect.component for own in present if is_component(own.effect)]
    effects = tuple((own.effect, own.form) for own in direct)
    start = start._replace(present=direct)
    noisy = any(own.effect.place is Place.NOISE for own in direct)
    if noisy:
        direct, _ = _with_noise(look, direct, start, active)
        start = start._replace(present=direct)
    at = look.problem.evaluate(start)
    component, error, grain = _components(look, active, expected_of(look, at, direct))
    latent = latent_of(look, component, grain, active)
    told, before = _told(look, direct), direct
    fit = refit(look.problem, effects, start._replace(present=_with_rows(direct, component)), latent, target, told=told)
    expected = expected_of(look, fit.moments, fit.model.present)
    for _ in range(ROUNDS if active or noisy else 0):
        # What the means were off by before looked like noise; and where black cuts noise, it raises the means.
        present_now, white = fit.model.present, {}
        if noisy:
            present_now, white["read"] = _with_noise(look, fit.model.present, fit.model, active)
            expected = expected_of(look, look.problem.evaluate(fit.model._replace(present=present_now)), present_now)
        component, error, grain = _components(look, active, expected)
        error |= white
        latent = latent_of(look, component, grain, active)
        model = fit.model._replace(present=_with_rows(present_now, component))
        fit = refit(look.problem, effects, model, latent, target, told=told)
        expected = expected_of(look, fit.moments, fit.model.present)
        if not noisy or abs(_total(present_now) - _total(before)) < STILL * white["read"]:
            break
        before = present_now
    if "centre" in active and (look.cells.frames <= 1).all():
        component["centre"], error["centre"] = _of_shifts(fit, look.cells.place)
    fresh = any(p.effect.spectral for p in present) and not any(p.effect.spectral for p in look.problem.start.present)
    striped = _striped(look, fit.model.present) if fresh else np.zeros(len(look.observables))
    seen, noise_score = _left_over(look, component, grain, expected, striped)
    numbers = sum(max(len(e.parameters) - len(e.idle.get(form, ())), 1) for e, form in effects)
    numbers += len(active) - ("row" in active) + ("grain" in active) + fit.model.wave.size
    # A law that takes the place of another has no use for its numbers.
    numbers -= sum(len(e.replaces) for e, _ in effects)
    score = fit.score + noise_score + 2 * numbers + _occam(look, fit, component)
    score += 0.0 if "pixel" in active else look.hot
    sites = look.measured.design.sites
    if component.get("grain"):
        hottest_left = hottest(look.measured, component["grain"])
        seen = [o._replace(value=hottest_left) if o.label == "hot" else o for o in seen]
    pattern = _by_pattern(look.observables, component.get("pixel", 0.0), sites)
    seen = [o for o in seen if not _settled(o, present, fresh, sites, pattern)]
    shared = _shared_variance(look, component, grain, fit)
    modes = modes_of(look.cells, look.setting, fit.residual, fit.variance, look.problem.used, shared)
    freedom = max(int(look.problem.used.sum()) - fit.freedom, 1)
    # Blocks that scatter together are fewer numbers than blocks.
    used = look.problem.used
    together = 1 + (float(np.mean((shared / fit.variance)[used])) if np.ndim(shared) else 0.0)
    left = statistics(modes, fit.chi2, freedom, seen, together)
    # In the order in which they were given.
    listed = tuple((p.effect, p.form) for p in present)
    return Account(listed, fit, component, error, grain, score, left, seen, latent, together)


def _total(direct: Sequence[Present]) -> float:
    """Read noise [e-] of the effect that says it."""
    return next(own.values[0] for own in direct if own.effect.place is Place.NOISE)


def _with_rows(direct: tuple[Present, ...], component: dict[str, float]) -> tuple[Present, ...]:
    """The effects with the row noise that the scatter of lines tells."""
    rms = float(np.sqrt(component.get("row", 0.0)))
    return tuple(own._replace(values=(rms,)) if own.effect.component == "row" else own for own in direct)


def _with_noise(
    look: Look, direct: tuple[Present, ...], start: Model, active: Sequence[str]
) -> tuple[tuple[Present, ...], float]:
    """The effects with the read noise that the scatter within frames, beside active components, and the means where
    black cuts it, tell; and its standard error [e-]."""
    sensor = look.setting.sensor
    problem = look.problem
    at_start = problem.evaluate(start)
    # Fixed weights: means that are off for another reason are no noise.
    weight = 1 / problem.variance(at_start, Latent())[problem.used]
    grain = _components(look, active, expected_of(look, at_start, direct))[2]
    # A frame's own brightness, once it is strong, leaves more in the frames' numbers than white noise does.
    within = _plain(look) & np.array([o.block != "frame" for o in look.observables])

    def model(total: float) -> Model:
        present = tuple(own._replace(values=(total,)) if own.effect.place is Place.NOISE else own for own in direct)
        return start._replace(present=present)

    def cost(log_total: float) -> float:
        own = model(float(np.exp(log_total)))
        at = problem.evaluate(own)
        means = float(weight @ problem.residual(at)[problem.used] ** 2)
        return means + _solve(look, active, expected_of(look, at, own.present), grain, within)[2]

    least = np.log(max(sensor.read_noise_e, 0.1))
    # The cost is flat far from its minimum: first a coarse grid, then inwards.
    grid = least + np.linspace(0, 3, 7)
    costs = [cost(v) for v in grid]
    k = int(np.argmin(costs))
    best = minimize_scalar(cost, bounds=(grid[max(k - 1, 0)], grid[min(k + 1, 6)]), method="bounded",
                           options={"xatol": 1e-4})  # fmt: skip
    total = float(np.exp(best.x))
    return model(total).present, total * _spread(cost, best.x)


def _spread(cost: Callable[[float], float], best: float) -> float:
    """Standard error of the logarithm that makes a cost (−2 ln L) least; NaN where the cost has no bottom there."""
    bend = (cost(best - BEND) - 2 * cost(best) + cost(best + BEND)) / BEND**2
    return float(np.sqrt(2 / bend)) if bend > 0 else float("nan")


def expected_of(look: Look, at: Moments, present: Sequence[Present]) -> np.ndarray:
    """Change of each observable that the model's own mean and noise bring: of the noise level by level, and of the
    brightness from frame to frame where it runs with the order."""
    problem, cells = look.problem, look.cells
    ratio = pooled(at.variance) / problem.variance_start - 1
    change = pooled(at.mean) - problem.mean_start
    # What bends within a block is no noise: curvature leaves more than a plane takes.
    side = look.measured.side
    dy, dx = np.gradient(change, side, axis=(1, 2))
    dyy, dxx, dxy = np.gradient(dy, side, axis=1), np.gradient(dx, side, axis=2), np.gradient(dx, side, axis=1)
    bent = (dxx**2 + dyy**2) * side**4 / 720 + dxy**2 * (side**2 / 12) ** 2
    ratio = ratio + bent / problem.variance_start
    course = any("order" in own.effect.needs for own in (*problem.start.present, *present))
    out = np.zeros(len(look.observables))
    for k, o in enumerate(look.observables):
        if o.block == "variance":
            own = cells.level[o.condition] == int(o.label.split()[1])
            own &= cells.pixels[o.condition] > 0
            out[k] = float(np.mean(ratio[o.condition][own])) if own.any() else 0.0
        elif o.label == "brightness" and course:
            out[k] = _scatter_beside(look, look.problem.start.present) - _scatter_beside(look, present)
    if (present or problem.start.present) and problem.used.any():
        # Whatever makes pixels noisier, read noise or the shot noise of a pedestal, as lines and bands weigh them.
        weight = np.where(problem.used, problem.variance_start, np.inf) ** -2
        more = float((weight * (pooled(at.variance) - problem.variance_start)).sum() / weight.sum())
        white = np.array([o.load[COMPONENTS.index("read")] * (o.block != "variance") for o in look.observables])
        out += more * white
    return out


def _scatter_beside(look: Look, present: Sequence[Present]) -> float:
    """Scatter of brightness beside what runs with the order of acquisition, over what is due to noise."""
    chi2, freedom = _scatter(look, present)
    return chi2 / max(freedom, 1) - 1


def _scatter(look: Look, present: Sequence[Present]) -> tuple[float, int]:
    """χ² of the brightness of frames within their conditions beside what runs with the order of acquisition, and its
    degrees of freedom."""
    return scatter_of(_beside_course(look, present), look.measured.design.condition)[:2]


def _beside_course(look: Look, present: Sequence[Present]) -> FrameFits:
    """Brightness of every frame beside what runs with the order of acquisition."""
    condition, fits = look.measured.design.condition, look.brightness
    course = course_of(look, present) - course_of(look, look.problem.start.present)
    # A course is relative to its condition's mean, a frame's brightness to the base.
    mean = np.bincount(condition, fits.value[:, 0]) / np.bincount(condition)
    course = course * (1 + mean[condition])
    return fits._replace(value=fits.value - course[:, None])


def _told(look: Look, present: Sequence[Present]) -> list[Told]:
    """What the brightness of the frames of a condition tells of an effect that acts frame by frame: means of conditions
    lose it. And where the look's own model stops noise and all, that pixels repeat one number, for which they are left
    out, tells the level to rounding."""
    condition, out = look.measured.design.condition, []
    about = {(p.effect.name, p.form): p.values for p in look.problem.start.present}
    for k, own in enumerate(present):
        if own.form in own.effect.rounded and len(moving(own.effect, own.form)) == 1:
            if level := about.get((own.effect.name, own.form)):
                out.append(Told(k, np.array(level[:1]), np.array([[1 / ROUNDING_VARIANCE]])))
        if "order" not in own.effect.needs:
            continue
        free = moving(own.effect, own.form)

        def rest(values: np.ndarray, k: int = k, own: Present = own, free: list[int] = free) -> np.ndarray:
            all_values = np.array(own.values)
            all_values[free] = values
            tried = own._replace(values=tuple(map(float, all_values)))
            return deviations(_beside_course(look, [*present[:k], tried, *present[k + 1 :]]), condition)

        _, freedom = _scatter(look, present)
        low, high = own.effect.bounds(look.problem.context)[free].T
        begin = np.clip(np.array(own.values)[free], low, high)
        best = least_squares(rest, begin, bounds=(low, high), x_scale="jac", xtol=1e-9)
        # Where brightness scatters besides, frames tell less.
        if freedom:
            out.append(Told(k, best.x, best.jac.T @ best.jac / max(2 * best.cost / freedom, 1.0)))
    return out


def _plain(look: Look) -> np.ndarray:
    """Observables that a component of variance may move."""
    return np.array([o.label not in MARKS and not o.label.startswith("code") for o in look.observables])


def _components(look: Look, active: Sequence[str], expected: np.ndarray):
    """Active components by weighted least squares, none below 0, with standard errors, and the grain."""
    if not active:
        return {}, {}, 1.0
    if "grain" not in active:
        value, error, _ = _solve(look, active, expected, 1.0)
        return dict(zip(active, value, strict=True)), dict(zip(active, error, strict=True)), 1.0

    def cost(log_grain: float, held: np.ndarray | None = None) -> float:
        return _solve(look, active, expected, float(np.exp(log_grain)), held=held)[2]

    first = min(np.log(grains_of(look.problem.context.sigma_px)), key=cost)
    bounds, held = first + np.log(REFINED), None
    for _ in range(WEIGHED):
        # Errors are wider than chance alone makes them, for what the loads are trusted, and grow with the field: were
        # they free here, a field that scatters less would seem likelier. Held, they draw to neither side.
        at = partial(cost, held=held)
        best = float(minimize_scalar(at, bounds=bounds, method="bounded", options={"xatol": 2e-3}).x)
        grain = float(np.exp(best))
        found, spread, _ = _solve(look, active, expected, grain, held=held)
        held = _errors(look, active, expected, grain, found)
    errors = dict(zip(active, spread, strict=True)) | {"size": grain * _spread(at, best)}
    return dict(zip(active, found, strict=True)), errors, grain


def _solve(
    look: Look,
    active: Sequence[str],
    expected: np.ndarray,
    grain: float,
    among: np.ndarray | None = None,
    held: np.ndarray | None = None,
):
    """Active components, their standard errors, and −2 ln L, from the observables `among` (all that components may
    move); with `held` [observable] in place of the errors that follow from the components."""
    seen = look.observables
    own = _plain(look) if among is None else among
    loads = grained(seen, grain, look.measured.side)[:, [COMPONENTS.index(name) for name in active]]
    value = np.array([o.value for o in seen]) - expected
    basic = np.array([o.error for o in seen])
    found = np.zeros(len(active))
    for _ in range(4 if active and held is None else 1):
        error = _errors(look, active, expected, grain, found, loads) if held is None else held
        scale = 1 / error[own]
        size = np.maximum(np.linalg.norm(loads[own] * scale[:, None], axis=0), 1e-300)
        if active:
            found, _ = nnls(loads[own] * scale[:, None] / size, value[own] * scale)
            found = np.minimum(found / size, [MOST_RELATIVE.get(name, np.inf) for name in active])
    rest = (value - loads @ found)[own] * scale
    score = float((rest**2).sum() + 2 * np.log(error[own] / basic[own]).sum())
    return found, 1 / size, score


def _errors(
    look: Look,
    active: Sequence[str],
    expected: np.ndarray,
    grain: float,
    found: np.ndarray,
    loads: np.ndarray | None = None,
) -> np.ndarray:
    """Standard error of each observable beside active components of the sizes `found`, which move it by `loads`
    [observable, component] each."""
    seen = look.observables
    if loads is None:
        loads = grained(seen, grain, look.measured.side)[:, [COMPONENTS.index(name) for name in active]]
    brought = dict(zip(active, (loads * found).T, strict=True))
    excess = (loads * found).sum(axis=1)
    floor = np.array([o.floor for o in seen])
    error = np.array([o.error for o in seen]) * (1 + np.maximum(excess + expected, 0) / floor) + TRUST * np.abs(excess)
    if "grain" in brought:
        form = np.array([0.0 if o.label == "site" else TRUST_GRAIN for o in seen])
        variance = float(found[list(active).index("grain")])
        error = error + form * brought["grain"] + _by_grain(seen, variance, grain)
    if "pixel" in brought:
        error = error + _one_draw(look) * brought["pixel"]
    return error


def _shared_variance(look: Look, component: dict[str, float], grain: float, fit: Refit) -> np.ndarray | float:
    """Variance [DN²] that sums over many blocks have on top of that of each: neighbours in a granular field,
    exposures of a site, and frames of a sensor scatter together."""
    if not any(component.get(name) for name in ("grain", "pixel", "row")):
        return 0.0
    frames = np.maximum(look.cells.frames, 1)[:, None, None]
    side = look.measured.side
    places = np.bincount(look.cells.place)[look.cells.place][:, None, None]
    light = pooled(fit.moments.mean) - look.setting.sensor.black_level_dn
    relative = component.get("grain", 0.0) * max(2 * np.pi * grain**2, 1.0) / side**2 / frames * places
    relative = relative + component.get("pixel", 0.0) / side**2 * len(look.cells.place)
    rows = component.get("row", 0.0) * look.response**2 / side / frames * light.shape[2]
    return relative * light**2 + rows


def _striped(look: Look, present: Sequence[Present]) -> np.ndarray:
    """What stripes bring to each observable until a closer look takes each site's own phase off; good to a factor 2."""
    depth, period = next(p.values[:2] for p in present if p.effect.spectral)
    rows = look.measured.sums.pull.shape[1]
    power = depth**2 / 2
    out = np.zeros(len(look.observables))
    for k, o in enumerate(look.observables):
        if o.label == "band" and o.low / 1.6 <= period <= o.high * 1.6:
            area = np.pi * (o.low**-2.0 - o.high**-2.0)
            out[k] = power / area
        elif o.label == "site":
            out[k] = power
        elif o.block in ("variance", "line"):
            out[k] = power * o.load[COMPONENTS.index("pixel")] * min((look.measured.side / period) ** 2, 1.0)
            out[k] *= rows if o.block == "line" else 1.0
    return out


def _one_draw(look: Look) -> np.ndarray:
    """By what part of itself the power that a pattern of the sensor brings to each observable scatters more than its
    error says: sites that see the same pixels are one draw of it, not many."""
    sites = look.measured.design.sites if look.measured.common else 1
    return np.array([
        (np.sqrt(sites) - 1) * o.error / o.floor if o.block == "spectrum" and o.label in ("band", "site") else 0.0
        for o in look.observables
    ])  # fmt: skip


def _by_grain(seen: Sequence[Observable], variance: float, grain: float) -> np.ndarray:
    """By how much what the sensor's pixels share is less certain beside a granular field of that relative variance and
    grain [px]: where two sites' fields are alike, they are so by chance."""
    out = np.zeros(len(seen))
    site = next((o for o in seen if o.label == "site"), None)
    if site is None or not variance:
        return out
    for k, o in enumerate(seen):
        if o.label == "sensor":
            out[k] = o.error * (crossed(grain, variance / site.floor) - 1)
    return out


def relief(look: Look, own: Account, effect: Effect) -> float:
    """By how much −2 ln L of the noise may fall if a component of variance, or white noise, is added to an account,
    means unchanged; gains and centres of the conditions are not counted."""
    name = effect.component or "read"
    active = [*own.component, name]
    expected = expected_of(look, own.refit.moments, own.refit.model.present)
    before = _solve(look, list(own.component), expected, own.grain)[2]
    if name in ("gain", "centre", "grain") and own.refit.chi2 > 1.05 * look.problem.used.sum():
        # They also move the condition means, in ways that only the fit can tell.
        return np.inf
    hot = look.hot if name == "pixel" else 0.0
    return before - _solve(look, active, expected, own.grain)[2] + hot


def granular(look: Look, own: Account) -> bool:
    """Whether what an account calls a granular field may be one; true where it has none."""
    variance = own.component.get("grain", 0.0)
    if not variance:
        return True
    if at_its_coarsest(own.grain, look.problem.context.sigma_px) or strays(look.measured, float(np.sqrt(variance))):
        return False
    quantities = [frame_fits(look.measured, "width")]
    if "gain" not in own.component:
        quantities.append(_beside_course(look, own.refit.model.present))
    return all(by_site(fits, look.measured.design) for fits in quantities)


def by_site(fits: FrameFits, design: Design) -> bool:
    """Whether a quantity of the frames scatters as a field of each site has it: alike at all exposures, but for what
    spots of other widths see of it; true where it scatters too little to say."""
    (total, sites, _), (apart, rest, _) = scatter_of(fits, design.condition), pointing_of(fits, design)
    if not rest or total < sites + CLEARLY * np.sqrt(2 * sites):
        return True
    return bool(apart / rest - 1 < APART * (total / sites - 1))


def latent_of(look: Look, component: dict[str, float], grain: float, active: Sequence[str]) -> Latent:
    """What components of variance bring to a condition's mean."""
    frames = np.maximum(look.cells.frames, 1)[:, None, None]
    side = look.measured.side
    relative = component.get("pixel", 0.0) / side**2
    relative = relative + component.get("grain", 0.0) * block_correlation(grain, side) / frames
    # Where black cuts readings an offset of a row moves them by less than itself.
    absolute = component.get("row", 0.0) * look.response**2 / side / frames
    # With one frame a condition nothing but the gains themselves says how much they scatter.
    scatter = component.get("gain", 0.0) / frames[:, 0, 0] if (frames > 1).any() else 0.0
    scatter = np.where(scatter > 0, scatter, np.inf)
    return Latent("gain" in active, "centre" in active, scatter, relative, absolute)


def _occam(look: Look, fit: Refit, component: dict[str, float]) -> float:
    """What free gains and centres of the conditions cost: their law is normal with the component's variance."""
    cost = 0.0
    frames = np.maximum(look.cells.frames, 1)
    if "gain" in component and len(fit.model.gain) > 1:
        own = fit.model.gain / fit.model.gain.mean() - 1
        # With one frame a condition nothing but the gains themselves says how much they scatter.
        variance = max(component["gain"], 1e-12) / frames
        if component["gain"] <= 0 or (frames == 1).all():
            variance = np.maximum(variance, np.mean(own**2))
        error = _gain_error(look)
        cost += float((own**2 / (variance + error)).sum() + np.log1p(variance / error).sum())
    if "centre" in component:
        place = look.cells.place
        shift = fit.model.shift
        variance = max(component["centre"], 1e-9) / frames
        for p in np.unique(place):
            own = shift[place == p] - shift[place == p].mean(axis=0)
            cost += float((own**2 / variance[place == p, None]).sum())
        cost += float(np.log1p(variance / 1e-5).sum())
    return cost


def _of_shifts(fit: Refit, place: np.ndarray) -> tuple[float, float]:
    """Variance [px²] of a frame's centre along an axis, and its standard error, where every condition is one frame:
    then nothing but the conditions' own centres tells it."""
    about = np.array([fit.model.shift[place == p].mean(axis=0) for p in place])
    freedom = 2 * (len(place) - len(np.unique(place)))
    variance = float(((fit.model.shift - about) ** 2).sum()) / max(freedom, 1)
    return variance, variance * float(np.sqrt(2 / max(freedom, 1)))


def _gain_error(look: Look) -> np.ndarray:
    """Variance of each condition's own brightness."""
    weight = np.where(look.problem.used, look.light**2 / look.cells.variance, 0.0).sum(axis=(1, 2))
    return 1 / np.maximum(weight, 1e-300)


def _left_over(look: Look, component: dict[str, float], grain: float, expected: np.ndarray, striped: np.ndarray):
    """Observables less all that is accounted for, and −2 ln L of those that components may move."""
    seen = look.observables
    loads = grained(seen, grain, look.measured.side)
    value = np.array([component.get(name, 0.0) for name in COMPONENTS])
    excess = loads @ value
    out, score = [], 0.0
    granular = loads[:, COMPONENTS.index("grain")] * component.get("grain", 0.0)
    pattern = loads[:, COMPONENTS.index("pixel")] * component.get("pixel", 0.0) * _one_draw(look)
    crossing = _by_grain(seen, component.get("grain", 0.0), grain)
    for o, own, change, plain, field, again, stripes in zip(
        seen, excess, expected, _plain(look), granular, pattern + crossing, striped, strict=True
    ):
        error = o.error * (1 + max(own + change, 0.0) / o.floor) + TRUST * (abs(own) + abs(change))
        error += (0.0 if o.label == "site" else TRUST_GRAIN) * field + again + stripes
        rest = o.value - own - change - stripes
        out.append(o._replace(value=rest, error=error) if plain else o)
        if o.label in SCATTER:
            # Its own likelihood: squares of `freedom` normal numbers of variance 1 + own.
            freedom, ratio = 2 / o.error**2, 1 + max(own, 0.0)
            score += freedom * ((1 + o.value - change) / ratio + np.log(ratio) - 1)
        elif plain:
            score += float((rest / error) ** 2 + 2 * np.log(error / o.error))
    return out, score


def _by_pattern(seen: Sequence[Observable], variance: float, sites: int) -> float:
    """How high a peak of the sites' common spectrum a pattern of the pixels' gains may bring, over its surroundings:
    power that is noise's is a mean over the sites, what all sites share is one draw."""
    site = next((o for o in seen if o.label == "site"), None)
    part = variance * site.load[COMPONENTS.index("pixel")] if site else 0.0
    alike = part / (part + site.floor) if site and part else 0.0
    return float((1 - alike) * gamma.isf(RARE, sites) / sites + alike * gamma.isf(RARE, 1))


def _settled(o: Observable, present: Sequence[Present], fresh: bool, sites: int, by_pattern: float) -> bool:
    """Marks that an effect in the model leaves by its nature at so many sites; `fresh` stripes are not taken off."""
    components = {own.effect.component for own in present}
    if o.label == "stripes" and "row" not in components and o.value > by_pattern:
        return fresh
    marks = {mark for own in present for mark in own.effect.marks}
    if sites == 1 and "grain" in components:
        # A granular field is then the same in all frames, as a pixel's offset is.
        marks.add("hot")
    mark = "code" if o.label.startswith("code") else o.label
    return mark in marks or (fresh and mark in ("stripes", "spot", "outliers", "skewness"))
