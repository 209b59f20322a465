"""What can rightly be named among freed frames, with errors; what p1 and p2 become; and what is left over.

Here p1 and p2 are a straight line through the widths of sites, not a law that every frame must obey: how sites differ
is part of their error.
"""

from collections.abc import Sequence
from itertools import compress
from typing import Any, NamedTuple

import numpy as np

from spotcheck.discrepancy.base import Base, base_of, spots_of
from spotcheck.discrepancy.cells import Setting
from spotcheck.discrepancy.detect import statistics
from spotcheck.discrepancy.explain import Account
from spotcheck.discrepancy.freed import (
    NO_GRAIN,
    SITES,
    Evidence,
    Grain,
    Stage,
    base_of_fit,
    candidates,
    closer,
    evidence_of,
    expectation,
    fitted,
    grain_of,
    grain_px,
    granular_noise,
    grown,
    is_granular,
    latent_of,
    settled,
    spread_sites,
    stage_of,
    widest_of,
    with_grain,
)
from spotcheck.discrepancy.look import Look, look_about
from spotcheck.discrepancy.modes import modes_of
from spotcheck.discrepancy.name import EARNS
from spotcheck.discrepancy.noise import block_correlation
from spotcheck.discrepancy.refit import Problem, Refit, refit
from spotcheck.discrepancy.shots import Design, Shot
from spotcheck.discrepancy.verify import Gap, rms_of
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import grain_contrast
from spotcheck.model.effect import Place, Present
from spotcheck.model.effects import vocabulary

# An effect is rightly named only if what is left where it acts is less than this part of what it closes, and if no
# other effect in its place closes more than this part of it.
LEFT, RIVAL = 0.1, 0.25
# Where hardly more than noise is left, a rival may close more: it is enough that it falls this far short in χ², and by
# this many times what is left.
SHORT, TIMES = 1000.0, 10.0
# Grain is rightly named only if exposures of a site share this part of it.
SHARED = 0.5


class Freed(NamedTuple):
    """Effects in the order in which they were added, standard error of each parameter; the evidence; the spot of every
    frame that chose the model (its law is None); contrast and grain [px] of what counts as granular noise, named or
    not; (value, standard error) of p1 and p2 [px], None where there are none."""

    present: tuple[Present, ...]
    errors: tuple[tuple[float | None, ...], ...]
    evidence: tuple[Evidence, ...]
    base: Base
    grain: tuple[float, float] | None
    p1: tuple[float, float | None] | None
    p2: tuple[float, float | None] | None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects, in order."""
        return tuple(own.effect.name for own in self.present)

    @property
    def whole(self) -> tuple[Present, ...]:
        """The effects, and what counts as granular noise."""
        if self.grain is None or any(map(is_granular, self.present)):
            return self.present
        return (*self.present, granular_noise(*self.grain))


class Left(NamedTuple):
    """A look at all conditions about freed frames, what is left there in the form of a fit, and its statistics."""

    look: Look
    refit: Refit
    statistics: dict[str, float]


def freed_of(shots: Sequence[Shot], design: Design, base: Base, setting: Setting) -> Freed | None:
    """What can rightly be named where each frame's brightness and width are its own; None if nothing."""
    widest = widest_of(shots, setting)
    chosen = np.flatnonzero(np.isin(design.site, spread_sites(design)))
    stage = stage_of([shots[int(k)] for k in chosen], design.take(chosen), part_of_base(base, chosen), setting, widest)
    effects = candidates(stage.look)
    stage, best = grown(stage, effects)
    if not best.model.present:
        return None
    stage, best = closer(stage, best)
    evidence = evidence_of(stage, best, effects)
    # One that another could replace may have bent the others: then no name is safe, and widths mean little.
    if not evidence or not all(rightly(own) for own in evidence):
        return None
    present = best.model.present
    errors = errors_of(stage, best)
    frames = spots(shots, design, base, setting, widest, present, stage.grain, stage.look.measured.side)
    p1, p2 = line_of(frames.sigma, design, setting.baseline)
    grain = next(((own.values[0], own.values[1]) for own in present if is_granular(own)), None)
    # What is anew in every exposure is no field of the site.
    named = grain_of(stage, best).shared > SHARED
    kept = [own.effect.name in vocabulary() and (named or not is_granular(own)) for own in present]
    errors, present = tuple(compress(errors, kept)), tuple(compress(present, kept))
    return Freed(present, errors, tuple(evidence), frames, grain, p1, p2)


def rightly(own: Evidence) -> bool:
    """Whether an effect that is one of the best set may be called by its name."""
    if own.rise < EARNS or own.left > LEFT * own.rise:
        return False
    adequate = own.left < own.blocks
    return own.rival_rise > (max(SHORT, TIMES * own.left) if adequate else (1 - RIVAL) * own.rise)


def part_of_base(base: Base, frames: np.ndarray) -> Base:
    """The spots of some frames."""
    return base._replace(**{name: getattr(base, name)[frames] for name in ("amplitude", "sigma", "x0", "y0")})


def errors_of(stage: Stage, fit: Refit) -> tuple[tuple[float | None, ...], ...]:
    """Standard errors of all parameters, by leaving out one site at a time: sites differ by more than noise."""
    design = stage.look.measured.design
    problem = stage.look.problem
    values = []
    for site in range(design.sites):
        kept = design.site != site
        part = Problem(problem.cells, problem.setting, problem.start, problem.used & kept[:, None, None])
        part.context = problem.context
        own = stage._replace(look=stage.look._replace(problem=part))
        again = fitted(own, fit.model.present, fit.model.base, fit.model.shift)
        grain = grain_of(own, again, kept)
        present = with_grain(again.model.present, grain, stage.look.measured.side)
        by_name = {p.effect.name: p.values for p in present}
        values.append([by_name.get(p.effect.name, p.values) for p in fit.model.present])
    out: list[tuple[float | None, ...]] = []
    at = 0
    for k, own_effect in enumerate(fit.model.present):
        idle = own_effect.effect.idle.get(own_effect.form, ())
        errors: list[float | None] = []
        for j, parameter in enumerate(own_effect.effect.parameters):
            if parameter.name in idle:
                errors.append(None)
                continue
            table = np.array([row[k][j] for row in values])
            spread = np.sqrt((len(table) - 1) * table.var()) if len(table) > 2 else 0.0
            if not is_granular(own_effect):
                spread = max(spread, np.sqrt(max(fit.covariance[at, at], 0.0)))
                at += 1
            errors.append(float(spread) if spread > 0 else None)
        out.append(tuple(errors))
    return tuple(out)


def spots(
    shots: Sequence[Shot],
    design: Design,
    base: Base,
    setting: Setting,
    widest: float,
    present: Sequence[Present],
    grain: Grain,
    side: int,
) -> Base:
    """Each frame's own spot beside effects that keep their values, a few sites at a time."""
    zero = np.zeros(len(shots))
    out = Base(zero, zero.copy(), zero.copy(), zero.copy(), None)
    for first in range(0, design.sites, SITES):
        frames = np.flatnonzero((design.site >= first) & (design.site < first + SITES))
        own = part_of_base(base, frames)
        stage = stage_of([shots[int(k)] for k in frames], design.take(frames), own, setting, widest)
        at = shots[int(frames[0])].pixels().shape[0] - stage.shots[0].pixels().shape[0]
        stage = stage._replace(grain=regrained(grain, side, stage.look.measured.side))
        stage, fit = closer(*settled(*with_best_spots(stage, present), fixed=True), fixed=True)
        moved = base_of_fit(stage, fit)
        for name in ("amplitude", "sigma", "x0", "y0"):
            getattr(out, name)[frames] = getattr(moved, name) + (max(at // 2, 0) if name in ("x0", "y0") else 0)
    return out


def with_best_spots(stage: Stage, present: Sequence[Present]) -> tuple[Stage, Refit]:
    """A stage with each frame's own spot beside effects that keep their values."""
    fit = fitted(stage, present, fixed=True)
    if any(own.effect.place is Place.WELL for own in present):
        fit = min(fit, fitted(stage, present, stage.flanks, fixed=True), key=lambda own: own.score)
    return stage, fit


def regrained(grain: Grain, side: int, other: int) -> Grain:
    """The same grain for blocks of another side [px]."""
    return grain if side == other else grain._replace(together=block_correlation(grain_px(grain, side), other))


def line_of(sigma: np.ndarray, design: Design, baseline: Baseline) -> tuple[Any, Any]:
    """p1 and p2 [px] with standard errors: a common slope over ln t within sites, and the mean over sites, each site
    being one draw."""
    exposure = design.exposure_s[design.condition]
    if not np.isfinite(exposure).all():
        return None, None
    x, y = np.log(exposure), sigma - baseline.laser_px
    sites = range(design.sites)
    own_x, own_y, slope, weight = np.zeros((4, design.sites))
    for s in sites:
        at = design.site == s
        own_x[s], own_y[s] = x[at].mean(), y[at].mean()
        weight[s] = ((x[at] - own_x[s]) ** 2).sum()
        slope[s] = ((x[at] - own_x[s]) * (y[at] - own_y[s])).sum() / weight[s] if weight[s] > 0 else 0.0
    p1, error = 0.0, 0.0
    if weight.sum() > 0:
        part = weight / weight.sum()
        p1 = float(part @ slope)
        known = np.count_nonzero(weight)
        error = float(np.sqrt((part**2 @ (slope - p1) ** 2) * known / (known - 1))) if known > 1 else np.nan
    at_one_second = own_y - p1 * own_x
    p2 = float(at_one_second.mean())
    scatter = at_one_second.var(ddof=1) / design.sites if design.sites > 1 else np.nan
    error2 = float(np.sqrt(scatter + (own_x.mean() * error) ** 2))
    return (p1, _finite(error)) if weight.sum() > 0 else None, (p2, _finite(error2))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def left_of(freed: Freed, shots: Sequence[Shot], first: Look) -> Left:
    """All conditions of a `first` look about each frame's own spot with the effects."""
    setting, design = first.setting, first.measured.design
    expect = expectation(shots, design, freed.base, freed.whole, setting)
    look = look_about(shots, first, expect)
    side, contrast = look.measured.side, grain_contrast(freed.whole)
    variance = look.cells.variance.copy()
    shared: np.ndarray | float = 0.0
    if contrast:
        assert freed.grain is not None
        grain = freed.grain[1]
        granular = np.zeros(variance.shape)
        for k in range(len(shots)):
            lit = contrast * expect(k).light
            rows, columns = variance.shape[1:]
            squares = (lit[: rows * side, : columns * side] ** 2).reshape(rows, side, columns, side).mean(axis=(1, 3))
            granular[design.condition[k]] += squares / look.cells.frames[design.condition[k]] ** 2
        variance += granular * block_correlation(grain, side)
        places = np.bincount(look.cells.place)[look.cells.place][:, None, None]
        shared = granular * max(2 * np.pi * grain**2, 1.0) / side**2 * places
    used, residual = look.problem.used, look.cells.residual
    chi2 = float((residual**2 / variance)[used].sum())
    fit = Refit(look.problem.start, np.nan, chi2, np.zeros((0, 0)), residual, variance, look.problem.at_start, 0)
    modes = modes_of(look.cells, setting, residual, variance, used, shared)
    return Left(look, fit, statistics(modes, chi2, int(used.sum()), []))


def gap_of_freed(freed: Freed, first: Account, look: Look, unseen: Sequence[Shot], design: Design | None) -> Gap | None:
    """Unseen frames under the law, and with each frame's brightness and width its own: without effects, with one, with
    two, … Effects keep their values. None where no frames were kept unseen."""
    if not unseen or design is None:
        return None
    base, widest = _base_of_unseen(unseen, design, look.setting), widest_of(unseen, look.setting)
    stage = stage_of(unseen, design, base, look.setting, widest)
    problem = stage.look.problem
    # All are measured by what the whole model leaves to chance.
    stage = stage._replace(grain=_grain(freed, stage.look.measured.side))
    stage, whole = settled(*with_best_spots(stage, freed.whole), fixed=True)
    law = problem.start._replace(base=first.refit.model.base, present=())
    fits = [refit(problem, (), law, latent_of(stage), fixed=True)]
    for count in range(len(freed.present)):
        present = freed.present[:count]
        bare = stage if any(map(is_granular, present)) else stage._replace(grain=NO_GRAIN)
        fits.append(with_best_spots(bare, present)[1])
    fits.append(whole)
    used = problem.used
    total = int(used.sum())
    chi2 = np.array([fit.chi2 for fit in fits]) / total
    floor = 1 - fits[-1].freedom / total
    width = chi2[0] - floor
    closed = (chi2[0] - chi2) / width if width > 0 else np.full(len(chi2), np.nan)
    maps = {name: np.where(used, fits[k].residual, np.nan) for name, k in (("before", 0), ("after", -1))}
    before, after = (rms_of([(problem, fits[k])]) for k in (0, -1))
    return Gap(float(chi2[0]), float(chi2[-1]), float(floor), float(closed[-1]), before, after, "unseen repeats",
               tuple(np.diff(closed)[1:].tolist()), maps)  # fmt: skip


def spots_of_unseen(freed: Freed, look: Look, unseen: Sequence[Shot], design: Design) -> Base:
    """The spot of each frame that was kept unseen, beside the effects with their values."""
    base, widest = _base_of_unseen(unseen, design, look.setting), widest_of(unseen, look.setting)
    side = look.measured.side
    return spots(unseen, design, base, look.setting, widest, freed.whole, _grain(freed, side), side)


def _base_of_unseen(unseen: Sequence[Shot], design: Design, setting: Setting) -> Base:
    corners = np.array([(s.left, s.top) for s in unseen], float)
    found = spots_of(unseen, setting.sensor, setting.baseline.top_hat)
    base = base_of(found, corners, design, setting.baseline, min(unseen[0].pixels().shape))
    assert base is not None  # the discovery frames of the same set had a base
    return base


def _grain(freed: Freed, side: int) -> Grain:
    """The granular noise of the model, for blocks of a side [px]."""
    if freed.grain is None:
        return NO_GRAIN
    return Grain(freed.grain[0], block_correlation(freed.grain[1], side))


def saved_effect(present: Present) -> dict[str, Any]:
    """Name, form and values of an effect."""
    return {"name": present.effect.name, "form": present.form, "values": [float(v) for v in present.values]}


def recalled_effect(saved: dict[str, Any]) -> Present:
    """An effect from its name, form and values."""
    return Present(vocabulary()[saved["name"]], saved["form"], tuple(saved["values"]))


def saved_of_freed(freed: Freed) -> dict[str, Any]:
    """As numbers and texts."""
    return {
        "effects": [
            saved_effect(p) | {"errors": list(errors)} for p, errors in zip(freed.present, freed.errors, strict=True)
        ],
        "evidence": [own._asdict() for own in freed.evidence],
        "base": {name: np.asarray(values).tolist() for name, values in zip(Base._fields[:4], freed.base, strict=False)},
        "grain": freed.grain,
        "p1": freed.p1,
        "p2": freed.p2,
    }


def recalled_freed(saved: dict[str, Any]) -> Freed:
    """From its numbers and texts."""
    present = tuple(map(recalled_effect, saved["effects"]))
    errors = tuple(tuple(p["errors"]) for p in saved["effects"])
    base = Base(**{name: np.array(own) for name, own in saved["base"].items()}, law=None)
    evidence = tuple(Evidence(**own) for own in saved["evidence"])
    grain, p1, p2 = (None if saved[name] is None else tuple(saved[name]) for name in ("grain", "p1", "p2"))
    return Freed(present, errors, evidence, base, grain, p1, p2)
