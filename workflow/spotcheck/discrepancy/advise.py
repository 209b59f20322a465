"""Which next measurement would tell tied explanations apart, and how many frames of it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.cells import Cells, pooled
from spotcheck.discrepancy.explain import Account, account, is_component
from spotcheck.discrepancy.look import Look
from spotcheck.discrepancy.name import present_of
from spotcheck.discrepancy.refit import Model, Problem, refit
from spotcheck.model.effect import Effect, Place
from spotcheck.model.sensor import reading

# −2 ln L by which an explanation must fall behind to be told apart: five standard deviations.
APART = 25.0
MOST_FRAMES = 200
# Frames by which the worth of one is reckoned: nearest to what is asked for, as a rival bends at first.
FEW = 8


class Condition(NamedTuple):
    """A feasible measurement, at a site of its own: exposure [s], fibre angle [deg], and whether the beam is blocked
    while the room stays as it is."""

    exposure_s: float
    angle_deg: float
    blocked: bool = False


class Advice(NamedTuple):
    """The condition that separates two explanations best, how many frames of it, and which two (by number)."""

    condition: Condition
    pair: tuple[int, int]
    frames: int
    gain_a_frame: float


def advise(look: Look, tied: Sequence[Account]) -> list[Advice]:
    """One piece of advice for the best explanation against each other, as far as any feasible condition tells them
    apart with a number of frames that one takes."""
    out = []
    for k, rival in enumerate(tied[1:], start=1):
        found = [own for own in conditions_for(look, tied[0], rival) if own[1] <= MOST_FRAMES]
        if found:
            condition, frames, gain = min(found, key=lambda own: own[1])
            out.append(Advice(condition, (0, k), int(np.ceil(frames)), gain))
    return out


def conditions_for(look: Look, first: Account, rival: Account) -> list[tuple[Condition, float, float]]:
    """Every feasible condition with the frames of it that tell two explanations apart whichever is true (a part of one
    where one is more than enough; inf: none do), and −2 ln L by which the false one falls behind with each.

    One may mimic whatever the other does, as a broad enough halo does a pedestal: then they are told apart if it is the
    true one, or not at all, and the frames are those for that.
    """
    ways = ((first, rival), (rival, first))
    scatter = _scatter(first, rival)
    before = [0.0 if scatter else separations(look, *way, None)[0] for way in ways]
    out = []
    for condition in feasible(look):
        tried = []
        for way, already in zip(ways, before, strict=True):
            if condition.blocked:
                gain = _of_pedestal(look, *way, condition)
            else:
                gain = _of_fields(look, *way) if scatter else separation(look, *way, condition, already)
            tried.append((float(max(APART - already, 1.0) / gain) if gain > 0 else np.inf, gain))
        out.append((condition, *max([own for own in tried if own[0] <= MOST_FRAMES] or tried)))
    return out


def feasible(look: Look) -> list[Condition]:
    """Exposures from a quarter of the shortest to four times the longest, and those between, at the first angle; the
    angles, those between, and two beyond, at the longest exposure; that exposure with the beam blocked."""
    view = look.cells.view
    exposures = np.unique(view.exposure_s[view.exposure_s > 0])
    angles = np.rad2deg(np.unique(view.angle))
    if not exposures.size:
        return []
    longer = [exposures[0] / 4, exposures[0] / 2, *exposures, *np.sqrt(exposures[:-1] * exposures[1:]),
              2 * exposures[-1], 4 * exposures[-1]]  # fmt: skip
    between = [*angles, *((angles[:-1] + angles[1:]) / 2), angles[-1] + 22.5, angles[-1] + 45]
    out = [Condition(float(t), float(angles[0])) for t in longer]
    out += [Condition(float(exposures[-1]), float(a)) for a in between[1:]]
    return [*out, Condition(float(exposures[-1]), float(angles[0]), blocked=True)]


def separation(look: Look, first: Account, rival: Account, condition: Condition, without: float) -> float:
    """−2 ln L by which a rival falls behind with every frame of a condition, if the first explanation is true; it is so
    much behind `without` any."""
    with_it, dark = separations(look, first, rival, condition, FEW)
    return 0.0 if dark else max(with_it - without, 0.0) / FEW


def _scatter(first: Account, rival: Account) -> bool:
    """Whether effects of which only one of two explanations knows are components of variance, so that no mean tells
    them apart."""
    return any(map(is_component, _apart(first, rival)))


def _apart(first: Account, rival: Account) -> list[Effect]:
    """Effects of which only one of two explanations knows."""
    return [e for own in (first, rival) for e, _ in own.effects if (e.name in first.names) != (e.name in rival.names)]


def pedestal_of(own: Account) -> float:
    """The uniform level [DN] that an explanation has beside black, 0 without one."""
    return sum(p.values[0] for p in own.refit.model.present if p.effect.uniform)


def _of_pedestal(look: Look, first: Account, rival: Account, condition: Condition) -> float:
    """−2 ln L by which one frame with the beam blocked tells a pedestal from what comes with the light; 0 where both
    have one, or neither, and where a slope of the background lets the level be anything.

    A false pedestal may shrink, which costs what had asked for it.
    """
    pedestals = [[e for e, _ in own.effects if e.place is Place.PEDESTAL] for own in (first, rival)]
    level, other = (any(e.uniform for e in own) for own in pedestals)
    if level == other or any(not e.uniform for own in pedestals for e in own):
        return 0.0
    own = first if level else rival
    dark, lit = (reading(dn, condition.exposure_s, look.setting.sensor) for dn in (0.0, pedestal_of(own)))
    pixels = float(look.cells.pixels.sum() / look.cells.frames.sum())
    frames = FEW * pixels * float((lit.mean - dark.mean) ** 2 / lit.variance)
    if own is rival:
        kept = [p for p in present_of(rival) if not p.effect.uniform]
        held = max(account(look, kept, rival.refit.model).score - rival.score, 0.0)
        frames *= held / (held + frames)
    return frames / FEW


def _of_fields(look: Look, first: Account, rival: Account) -> float:
    """−2 ln L by which one frame at a new site tells a pattern of the pixels from grain of the sample; 0 for other
    components.

    The first stays where it is, the second does not: two frames share r of their variance or nothing, which is worth
    −ln(1 − r²) for each grain in view.
    """
    if sorted(effect.component for effect in _apart(first, rival)) != ["grain", "pixel"]:
        return 0.0
    own = first if "pixel" in first.component or "grain" in first.component else rival
    relative = own.component.get("pixel", 0.0) + own.component.get("grain", 0.0)
    light = pooled(own.refit.moments.mean) - look.setting.sensor.black_level_dn
    field = relative * np.maximum(light, 0.0) ** 2
    shared = field / (field + pooled(own.refit.moments.variance))
    near = int(np.argmax(look.cells.view.exposure_s))
    pixels = look.cells.pixels[near] / max(look.cells.frames[near], 1)
    grains = pixels / max(2 * np.pi * own.grain**2 if "grain" in own.component else 1.0, 1.0)
    return float(-(grains * np.log1p(-(np.minimum(shared[near], 0.999) ** 2))).sum())


def separations(
    look: Look, first: Account, rival: Account, condition: Condition | None, frames: int = 1
) -> tuple[float, bool]:
    """−2 ln L of the rival's best fit to what the first explanation expects, over its own; and whether the condition is
    of no use (too bright, or too short for one of them)."""
    problem = look.problem
    view, cells = problem.cells.view, problem.cells
    if condition is not None:
        # The new frames lie as those of the nearest exposure do.
        near = int(np.argmin(np.abs(view.exposure_s.ravel() - condition.exposure_s)))
        own = {name: getattr(view, name)[near : near + 1] for name in view._fields[:9]}
        own["exposure_s"] = np.full((1, 1, 1), condition.exposure_s)
        own["angle"] = np.full((1, 1, 1), np.deg2rad(condition.angle_deg))
        view = view._replace(**{name: np.concatenate([getattr(view, name), own[name]]) for name in own})  # type: ignore[arg-type]
        each = float(cells.pixels.max() / max(cells.frames.max(), 1))
        more = np.where(cells.pixels[near : near + 1] > 0, each * frames, 0.0)
        cells = cells._replace(
            view=view,
            place=np.append(cells.place, cells.place.max() + 1),
            frames=np.append(cells.frames, frames),
            pixels=np.concatenate([cells.pixels, more]),
        )
    truth, other = (_over(own.refit.model, cells) for own in (first, rival))
    blank = cells._replace(residual=np.zeros(cells.pixels.shape), variance=np.ones(cells.pixels.shape))
    with np.errstate(invalid="ignore"):
        at, rivals = (Problem(blank, look.setting, own).at_start for own in (truth, other))
    # A shutter that is late by more than the exposure leaves no frame (NaN).
    if not np.isfinite((at.mean, rivals.mean)).all() or np.max(at.mean) > 0.97 * look.setting.sensor.full_scale_dn:
        return 0.0, True
    variance = np.where(cells.pixels > 0, pooled(at.variance) / np.maximum(cells.pixels, 1), np.inf)
    asimov = Problem(blank._replace(variance=variance), look.setting, truth, scatter=variance)
    return refit(asimov, rival.refit_effects, other).chi2, False


def _over(model: Model, cells: Cells) -> Model:
    """The model over the conditions and places of other cells; a new place has no shift and no stripes."""
    shift, wave = np.zeros((2, int(cells.place.max()) + 1, 2))
    shift[: len(model.shift)] = model.shift[: len(shift)]
    wave[: len(model.wave)] = model.wave
    return model._replace(shift=shift, gain=np.ones(len(cells.place)), wave=wave if len(model.wave) else model.wave)
