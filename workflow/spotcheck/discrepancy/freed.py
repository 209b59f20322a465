"""The same frames with each frame's brightness and width its own: what can still be named where no law of them holds.

A law that fails in brightness or width leaves so much over that nothing else can be judged beside it. Here every frame
is a condition of its own, on a cut around the spot, so that an effect of shape or sensor is told by the frames' shape
alone. What the law itself says (`angle_reflectance`, `photon_budget`, …) cannot be assessed so.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from spotcheck.discrepancy.assess import assessable
from spotcheck.discrepancy.base import Base
from spotcheck.discrepancy.cells import Setting, pooled
from spotcheck.discrepancy.look import Look, look_again, look_at
from spotcheck.discrepancy.measure import BLOCKS
from spotcheck.discrepancy.name import EARNS, MOST
from spotcheck.discrepancy.noise import block_correlation
from spotcheck.discrepancy.pixels import Scene
from spotcheck.discrepancy.refit import NOTHING, Latent, Refit, basis, refit, screened
from spotcheck.discrepancy.shots import Design, Shot
from spotcheck.model.chain import COARSE, Free, Law, View, grain_contrast, granular_variance, light, readings
from spotcheck.model.effect import Effect, Place, Present
from spotcheck.model.effects import built_in, vocabulary

# Sites among which effects are sought, spread over the angles; the others only say how wide and bright they are.
SITES = 8
# Half of the cut around the spots, in widths of the widest.
REACH = 4.5
# Levels, as parts of the highest readings, between which the area of a spot tells its width, and the quantile and part
# of it above which readings count as the highest.
LOW, HIGH = 0.1, 0.5
TOP, NEAR_TOP = 99.5, 0.7
# Where light keeps this part of its effect on the reading, grain shows as it is.
FREE_TO_SHOW = 0.5
# Readings this many times over the noise show grain.
LIT = 5.0
LEAST_PIXELS = 400
# An effect must bring this part of all that −2 ln L falls.
LARGE = 0.05
# Pixels of a block scatter far more than foretold from this many times on.
FAR_MORE = 4.0
# Times that the weights of a fit are taken anew.
WEIGHED = 2
# The blocks that tell an effect have this part of what it changes.
TELLING = 0.9
# Another form must bring this part more of what the first one does.
FORM = 0.01
# How many effects are tried beside those that stop the signal, whose first order says little.
BESIDE = 4
# Places in the chain where an effect changes the shape of the mean spot or of the reading.
SHAPES = (Place.METRIC, Place.PROFILE, Place.BLUR, Place.ADDED, Place.PEDESTAL, Place.CHARGE, Place.WELL,
          Place.RESPONSE, Place.DIGITAL)  # fmt: skip


class Grain(NamedTuple):
    """A granular field: contrast [1], the part of a pixel's variance that the mean of a block keeps, and the part that
    exposures of a site share (NaN: no site shows grain in two)."""

    contrast: float
    together: float
    shared: float = np.nan


NO_GRAIN = Grain(0.0, 0.3)


class Stage(NamedTuple):
    """A look at freed frames, the flanks' own (peak [DN], σ_g [px]) of every frame, the grain, and the variance [DN²]
    of every block that all fits are weighed and compared with, whatever their model says of it: grain scatters so much
    that a wrong model could excuse itself with it."""

    shots: list[Shot]
    look: Look
    flanks: Free
    grain: Grain
    variance: np.ndarray


def freed_design(design: Design) -> Design:
    """Every frame a condition of its own; a site's exposures share its centre."""
    own = np.arange(len(design.condition))
    return design._replace(
        condition=own,
        angle_deg=design.angle_deg[design.condition],
        exposure_s=design.exposure_s[design.condition],
        place=design.site,
    )


def spread_sites(design: Design) -> np.ndarray:
    """Up to `SITES` sites, in turn from every place (angle)."""
    place = [int(design.place[design.condition[design.site == s][0]]) for s in range(design.sites)]
    turn = [place[:s].count(own) for s, own in enumerate(place)]
    return np.sort(np.lexsort((place, turn))[:SITES])


def flanks_of(shots: Sequence[Shot], black_dn: float) -> tuple[np.ndarray, np.ndarray]:
    """Peak [DN] and σ_g [px] of every frame by the areas where it reads over two levels.

    A Gaussian reads over f in an area of 2πσ² ln(A/f): the difference of two areas tells σ, whatever happens to the
    peak, and whatever grain does, which moves both areas alike.
    """
    images = [shot.pixels() - black_dn for shot in shots]
    tops = []
    for image in images:
        known = image[np.isfinite(image)]
        tops.append(np.median(known[known >= NEAR_TOP * np.percentile(known, TOP)]))
    highest = max(tops)
    out = []
    for image, top in zip(images, tops, strict=True):
        own = min(top, highest)
        low, high = (np.count_nonzero(image > part * own) for part in (LOW, HIGH))
        sigma = np.sqrt(max(low - high, 4) / (2 * np.pi * np.log(HIGH / LOW)))
        out.append((HIGH * own * np.exp(min(high / (2 * np.pi * sigma**2), 6.0)), sigma))
    amplitude, sigma = np.array(out).T
    return amplitude, sigma


def widest_of(shots: Sequence[Shot], setting: Setting) -> float:
    """σ_g [px] of the widest spot, by its flanks."""
    return float(flanks_of(shots, setting.sensor.black_level_dn)[1].max())


def stage_of(shots: Sequence[Shot], design: Design, base: Base, setting: Setting, widest: float) -> Stage:
    """A first look at some frames, each its own, on cuts that hold spots of σ_g up to `widest` [px]."""
    crop = min(shots[0].pixels().shape)
    side = int(np.clip(round(2 * REACH * widest / BLOCKS), 2, max(crop // BLOCKS, 2))) * BLOCKS
    at = max((crop - side) // 2, 0)
    cut = [s._replace(left=s.left + at, top=s.top + at, pixels=partial(_cut, s, at, side)) for s in shots]
    amplitude, sigma = flanks_of(cut, setting.sensor.black_level_dn)
    own = base._replace(x0=base.x0 - at, y0=base.y0 - at, law=None)
    look = look_at(cut, freed_design(design), own, setting)
    # Where light may be far above what is read, the readings say where a level is to be sought.
    brightest = float(np.max((pooled(look.problem.at_start.mean) + look.cells.residual)[look.problem.used]))
    look.problem.context = look.problem.context._replace(
        peak_dn=brightest - setting.sensor.black_level_dn, sigma_px=float(np.median(sigma))
    )
    grain = NO_GRAIN._replace(contrast=_first_contrast(look))
    return Stage(cut, look, Free(amplitude[:, None, None], sigma[:, None, None]), grain, _seen_variance(look, grain))


def _cut(shot: Shot, at: int, side: int) -> np.ndarray:
    return shot.pixels()[at : at + side, at : at + side]


def _first_contrast(look: Look) -> float:
    """Contrast of what scatters within blocks about a plane, where readings lie between noise and half of the highest:
    before any model of the mean is at hand, so rather too small."""
    sums, sensor = look.measured.sums, look.setting.sensor
    reading = pooled(look.problem.at_start.mean) + sums.residual - sensor.black_level_dn
    noise = sensor.gain_dn_per_e * np.maximum(reading, 0.0) + (sensor.gain_dn_per_e * sensor.read_noise_e) ** 2
    lit = (reading > 2 * LIT * np.sqrt(noise)) & (reading < HIGH * np.max(reading)) & (sums.rough_dof > 0)
    if np.count_nonzero(lit) < 50:
        return 0.0
    within = sums.rough[lit] / sums.rough_dof[lit] * sums.variance[lit] - noise[lit]
    return float(np.sqrt(max(np.median(within / reading[lit] ** 2), 0.0)))


def _seen_variance(look: Look, grain: Grain) -> np.ndarray:
    """Variance [DN²] of the mean of every block by what its own pixels, and its neighbours', scatter about a plane:
    before any model is at hand."""
    variance = look.cells.variance
    if grain.contrast < COARSE:
        return variance
    return np.maximum(variance, grain.together / (1 - grain.together) * _scatter_within(look))


def _scatter_within(look: Look) -> np.ndarray:
    """Variance [DN²] of pixels about a plane in every block and its neighbours."""
    sums = look.measured.sums
    own = sums.rough / np.maximum(sums.rough_dof, 1) * sums.variance
    return ndimage.uniform_filter(own, (0, 3, 3), mode="nearest")


def with_grain(present: Sequence[Present], grain: Grain, side: int) -> tuple[Present, ...]:
    """Effects with the granular field as the last one, where it is coarse."""
    kept = tuple(own for own in present if not is_granular(own))
    if grain.contrast < COARSE:
        return kept
    return (*kept, granular_noise(grain.contrast, grain_px(grain, side)))


def is_granular(own: Present) -> bool:
    """Whether an effect is a granular field of the sites."""
    return own.effect.component == "grain"


def granular_noise(contrast: float, grain: float) -> Present:
    """A granular field of a contrast [1] and grain [px]: where the vocabulary has none it is noise without a name."""
    known = (*vocabulary().values(), *built_in().values())
    return Present(next(own for own in known if own.component == "grain"), "", (contrast, grain))


def grain_px(grain: Grain, side: int) -> float:
    """Grain [px] of which the means of blocks keep that part."""
    sizes = np.geomspace(0.2, 4 * side, 400)
    return float(np.interp(grain.together, [block_correlation(g, side) for g in sizes], sizes))


def fitted(
    stage: Stage,
    present: Sequence[Present],
    base: Law | Free | None = None,
    shift: np.ndarray | None = None,
    target: float = np.inf,
    fixed: bool = False,
) -> Refit:
    """Frames' own brightness, width and centre beside effects, from their values and a base (else the look's own)."""
    problem = stage.look.problem
    present = with_grain(present, stage.grain, stage.look.measured.side)
    start = problem.start._replace(present=present)
    start = start if base is None else start._replace(base=base)
    start = start if shift is None else start._replace(shift=shift)
    return refit(problem, [(own.effect, own.form) for own in present], start, latent_of(stage), target, fixed)


def latent_of(stage: Stage) -> Latent:
    """The variance that all fits of a stage share."""
    return Latent(known=stage.variance)


def weighed(stage: Stage, fit: Refit) -> Stage:
    """With the variance of blocks that a fit and the grain foretell; and where pixels of a block scatter far more than
    that, as where each stops at a level of its own, with what they show."""
    problem, grain = stage.look.problem, stage.grain
    model = fit.model._replace(present=with_grain(fit.model.present, grain, stage.look.measured.side))
    at = problem.evaluate(model)
    variance = problem.variance(at, NOTHING)
    if grain.contrast >= COARSE:
        granular = problem.granular(model)
        foretold = pooled(at.variance) + (1 - grain.together) * granular
        variance = variance + grain.together * granular
        seen = _scatter_within(stage.look)
        more = grain.together / (1 - grain.together) * (seen - foretold)
        variance = np.where(seen > FAR_MORE * foretold, variance + more, variance)
    return stage._replace(variance=variance)


def settled(stage: Stage, fit: Refit, fixed: bool = False) -> tuple[Stage, Refit]:
    """A fit with the weights that it foretells itself; with `fixed` effects and grain stay.

    Weights follow the means, and nothing is learnt from the variance: quasi-likelihood (Wedderburn 1974,
    doi:10.1093/biomet/61.3.439).
    """
    for _ in range(WEIGHED):
        if not fixed:
            stage = stage._replace(grain=grain_of(stage, fit))
        stage = weighed(stage, fit)
        fit = fitted(stage, fit.model.present, fit.model.base, fit.model.shift, fixed=fixed)
    return stage, fit


def expectation(
    shots: Sequence[Shot], design: Design, base: Base, present: Sequence[Present], setting: Setting
) -> Callable[[int], Scene]:
    """What effects and each frame's own spot expect of every pixel of a frame."""
    rows, columns = shots[0].pixels().shape
    exposures = np.nan_to_num(design.exposure_s, nan=1.0)
    known = design.exposure_s[np.isfinite(design.exposure_s)]
    reference = float(np.exp(np.mean(np.log(np.unique(known))))) if known.size else 1.0

    def single(value: float) -> np.ndarray:
        return np.full((1, 1, 1), float(value))

    def expect(k: int) -> Scene:
        left, top, c = shots[k].left, shots[k].top, design.condition[k]
        view = View(
            (left + np.arange(columns, dtype=float))[None, None, :],
            (top + np.arange(rows, dtype=float))[None, :, None],
            single(left + base.x0[k]),
            single(top + base.y0[k]),
            single(exposures[c]),
            single(np.deg2rad(np.nan_to_num(design.angle_deg[c]))),
            single(np.nan_to_num(design.order[k], nan=0.5)),
            single(0.0),
            single(0.0),
            float(exposures.max()),
            reference,
            *setting.frame_centre,
            setting.frame_rows,
            1.0,
        )
        own = Free(single(base.amplitude[k]), single(base.sigma[k]))
        lit, beside = light(view, setting.baseline, own, present)
        at = readings(view, lit, beside, present, setting.sensor)
        if grain_contrast(present) >= COARSE:
            # Of a granular field a reading shows what gets through whatever bends.
            granular = granular_variance(view, setting.baseline, own, present, setting.sensor)
            lit = np.sqrt(granular) / grain_contrast(present)
        whole = (np.ascontiguousarray(np.broadcast_to(v, (1, rows, columns))[0]) for v in (*at, lit, lit))
        return Scene(*whole)

    return expect


def base_of_fit(stage: Stage, fit: Refit) -> Base:
    """Each frame's own spot as a fit has it, on the cut."""
    base, free = stage.look.measured.base, fit.model.base
    assert isinstance(free, Free)
    shift = fit.model.shift[stage.look.measured.design.place]
    return base._replace(amplitude=free.amplitude.ravel(), sigma=free.sigma.ravel(), x0=base.x0 + shift[:, 0],
                         y0=base.y0 + shift[:, 1])  # fmt: skip


def grain_of(stage: Stage, fit: Refit, frames: np.ndarray | None = None) -> Grain:
    """Contrast and correlation of what the pixels of lit flanks scatter about a fit, as a part of their light; of some
    `frames` [frame, bool] only."""
    look = stage.look
    side, black = look.measured.side, look.setting.sensor.black_level_dn
    present = with_grain(fit.model.present, stage.grain._replace(contrast=max(stage.grain.contrast, 2 * COARSE)), side)
    expect = expectation(stage.shots, look.measured.design, base_of_fit(stage, fit), present, look.setting)
    squares, noise, means, mean_noise, pixels, blocks = np.zeros(6)
    site, seen = look.measured.design.site, []
    for k, shot in enumerate(stage.shots):
        if frames is not None and not frames[k]:
            continue
        scene = expect(k)
        shown = scene.light > FREE_TO_SHOW * (scene.mean - black)
        shown &= scene.light > LIT * np.sqrt(scene.variance)
        lit = np.where(shown, scene.light, 1.0)
        own = np.where(shown, (shot.pixels() - scene.mean) / lit, 0.0)
        white = np.where(shown, scene.variance / lit**2, 0.0)
        squares, noise, pixels = squares + (own**2).sum(), noise + white.sum(), pixels + shown.sum()
        full = _blocks(shown, side).all(axis=(1, 3))
        means += (_blocks(own, side).mean(axis=(1, 3))[full] ** 2).sum()
        mean_noise += _blocks(white, side).sum(axis=(1, 3))[full].sum() / side**4
        blocks += full.sum()
        seen.append((site[k], shot.left, shot.top, own, shown, white))
    if pixels < LEAST_PIXELS or blocks < LEAST_PIXELS / side**2:
        return NO_GRAIN
    whole, of_means = (squares - noise) / pixels, (means - mean_noise) / blocks
    # What is as smooth as a block is no grain: only a part within blocks counts.
    if whole - max(of_means, 0.0) < COARSE**2:
        return NO_GRAIN
    together = float(np.clip(of_means / whole, 1 / side**2, 1.0))
    return Grain(float(np.sqrt(min(whole, 1.0))), together, _shared(seen))


def _shared(seen: Sequence[tuple]) -> float:
    """Part of the variance of what is `seen` (site, left, top, relative residual, where, variance of the noise) that
    two frames of a site have in common."""
    common = own = 0.0
    for (site, left, top, a, lit_a, white_a), (other, left_b, top_b, b, lit_b, white_b) in combinations(seen, 2):
        dx, dy = left_b - left, top_b - top
        rows, columns = a.shape
        if site != other or abs(dx) >= columns or abs(dy) >= rows:
            continue
        first = slice(max(dy, 0), rows + min(dy, 0)), slice(max(dx, 0), columns + min(dx, 0))
        second = slice(max(-dy, 0), rows + min(-dy, 0)), slice(max(-dx, 0), columns + min(-dx, 0))
        both = lit_a[first] & lit_b[second]
        if np.count_nonzero(both) < LEAST_PIXELS / 4:
            continue
        u, v = a[first][both], b[second][both]
        common += float(u @ v)
        own += float(np.sqrt(max(u @ u - white_a[first][both].sum(), 0) * max(v @ v - white_b[second][both].sum(), 0)))
    return common / own if own > 0 else np.nan


def _blocks(values: np.ndarray, side: int) -> np.ndarray:
    """An image as [row of blocks, row, column of blocks, column]."""
    rows, columns = (n // side for n in values.shape)
    return values[: rows * side, : columns * side].reshape(rows, side, columns, side)


class Evidence(NamedTuple):
    """What speaks for an effect among freed frames: the rise of χ² without it; the best other effect in its place, and
    the rise that is left with that one; the excess of χ² that the best fit leaves where the effect acts, and in how
    many blocks that is."""

    name: str
    rise: float
    rival: str
    rival_rise: float
    left: float
    blocks: int


def candidates(look: Look) -> list[Effect]:
    """Effects that the shape of freed frames can show."""
    return [own for own in assessable(look)[0] if own.place in SHAPES]


def tried(stage: Stage, before: Refit, effect: Effect, target: float = np.inf) -> Refit | None:
    """The best fit of an effect added to a fit; only the start that promises most of each form."""
    problem = stage.look.problem
    effects = [(own.effect, own.form) for own in before.model.present]
    if any(set(effect.replaces) & set(own.replaces) for own, _ in effects):
        return None
    span = basis(problem, before, effects, latent_of(stage))
    best: Refit | None = None
    # Forms that clip read noise as well differ by too little to matter here.
    several = effect.place in (Place.METRIC, Place.WELL)
    forms = [form for form in effect.forms if not form.endswith("with noise")] if several else effect.forms[:1]
    for form in forms:
        _, values = screened(problem, before, span, effect, form)[0]
        start = before
        if best is not None and effect.place is Place.WELL:
            start = best
            values = next(own.values for own in best.model.present if own.effect.name == effect.name)
        present = (*before.model.present, Present(effect, form, values))
        own = fitted(stage, present, start.model.base, start.model.shift, target)
        if effect.place is Place.WELL and best is None:
            # Light may be far above where the signal stops: the flanks know.
            other = fitted(stage, present, stage.flanks, before.model.shift, target)
            own = min(own, other, key=lambda fit: fit.score)
        # A softer knee must be worth it.
        worth = FORM * max(before.score - best.score, 0.0) if best is not None and effect.place is Place.WELL else 0.0
        best = own if best is None or own.score < best.score - worth else best
    return best


def promising(stage: Stage, before: Refit, effects: Sequence[Effect]) -> list[Effect]:
    """The effects that to first order promise most beside a fit, and those whose first order says little."""
    problem = stage.look.problem
    names = {own.effect.name for own in before.model.present}
    span = basis(problem, before, [(own.effect, own.form) for own in before.model.present], latent_of(stage))
    others = [own for own in effects if own.name not in names]
    promise = {own.name: screened(problem, before, span, own, own.forms[0])[0][0] for own in others}
    ranked = sorted(others, key=lambda own: -promise[own.name])
    return [own for k, own in enumerate(ranked) if k < BESIDE or own.place is Place.WELL]


def best_added(stage: Stage, before: Refit, effects: Sequence[Effect], target: float = np.inf) -> Refit | None:
    """The best fit of one effect more."""
    best: Refit | None = None
    for effect in promising(stage, before, effects):
        own = tried(stage, before, effect, min(target, best.score if best else np.inf))
        if own is not None and (best is None or own.score < best.score):
            best = own
    return best


def grown(stage: Stage, effects: Sequence[Effect]) -> tuple[Stage, Refit]:
    """Effects added one after the other, each that which explains most, as long as each is worth it."""
    best = fitted(stage, ())
    total = 0.0
    for _ in range(MOST):
        ahead = best_added(stage, best, effects)
        gain = best.score - ahead.score if ahead is not None else 0.0
        total += gain
        if ahead is None or gain < max(EARNS, LARGE * total):
            break
        best = ahead
    return settled(stage, best) if best.model.present else (stage, best)


def closer(stage: Stage, fit: Refit, fixed: bool = False) -> tuple[Stage, Refit]:
    """A look about what a fit expects of every pixel, with the fit there; with `fixed` effects and grain stay."""
    look = look_again(stage.shots, stage.look, fit.model, latent_of(stage))
    look.problem.context = stage.look.problem.context
    moved = fit._replace(model=fit.model._replace(shift=0 * fit.model.shift))
    return settled(stage._replace(look=look), moved, fixed)


def _left_where_it_acts(best: Refit, without: Refit, stage: Stage) -> tuple[float, int]:
    """Excess of χ² of a fit in the blocks that tell one effect, those with most of what it changes; how many."""
    used = stage.look.problem.used
    changed = ((best.residual - without.residual) ** 2 / stage.variance)[used]
    squares = (best.residual**2 / stage.variance)[used]
    order = np.argsort(-changed)
    telling = order[: int(np.searchsorted(np.cumsum(changed[order]), TELLING * changed.sum())) + 1]
    return float(max((squares[telling] - 1).sum(), 0.0)), len(telling)


def evidence_of(stage: Stage, best: Refit, effects: Sequence[Effect]) -> list[Evidence]:
    """Of every effect of shape in a fit: what is lost without it, and what the best other effect wins back."""
    out = []
    for own in best.model.present:
        if is_granular(own):
            continue
        present = tuple(p for p in best.model.present if p is not own)
        without = fitted(stage, present, best.model.base, best.model.shift)
        if own.effect.place is Place.WELL:
            # Light far above where the signal stops was only found with it.
            other = fitted(stage, present, stage.look.measured.base.of_condition(stage.look.measured.design))
            without = min(without, other, key=lambda fit: fit.score)
        others = [e for e in effects if e.name != own.effect.name]
        rival = best_added(stage, without, others, best.score)
        added = [p for p in rival.model.present if not is_granular(p)] if rival else []
        name = added[-1].effect.name if added else ""
        lost = rival.score if rival is not None and rival.score < without.score else without.score
        left, blocks = _left_where_it_acts(best, without, stage)
        out.append(Evidence(own.effect.name, without.score - best.score, name, lost - best.score, left, blocks))
    return out
