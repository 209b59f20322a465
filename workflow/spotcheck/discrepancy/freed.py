"""The same frames with each frame's brightness and width its own: what can still be named where no law of them holds.

A law that fails in brightness or width leaves so much over that nothing else can be judged beside it. Here every frame
is a condition of its own, on a cut around the spot, so that an effect of shape or sensor is told by the frames' shape
alone. What the law itself says (`angle_reflectance`, `photon_budget`, …) cannot be assessed so.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.base import Base
from spotcheck.discrepancy.cells import Setting, pooled
from spotcheck.discrepancy.look import Look, look_at, scenes
from spotcheck.discrepancy.measure import BLOCKS
from spotcheck.discrepancy.noise import block_correlation
from spotcheck.discrepancy.refit import NOTHING, Latent, Model, Refit, refit
from spotcheck.discrepancy.shots import Design, Shot
from spotcheck.model.chain import COARSE, Free
from spotcheck.model.effect import Effect, Place, Present
from spotcheck.model.effects import vocabulary

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
# Places in the chain where an effect changes the shape of the mean spot or of the reading.
SHAPES = (Place.METRIC, Place.PROFILE, Place.BLUR, Place.ADDED, Place.PEDESTAL, Place.CHARGE, Place.WELL,
          Place.RESPONSE, Place.DIGITAL)  # fmt: skip


class Grain(NamedTuple):
    """A granular field: contrast [1], and the part of a pixel's variance that the mean of a block keeps."""

    contrast: float
    together: float


class Stage(NamedTuple):
    """A look at freed frames, the flanks' own (peak [DN], σ_g [px]) of every frame, and the grain."""

    shots: list[Shot]
    look: Look
    flanks: Free
    grain: Grain


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
    look.problem.context = look.problem.context._replace(peak_dn=brightest - setting.sensor.black_level_dn)
    grain = Grain(_first_contrast(look), 0.3)
    return Stage(cut, look, Free(amplitude[:, None, None], sigma[:, None, None]), grain)


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


def with_grain(present: Sequence[Present], grain: Grain, side: int) -> tuple[Present, ...]:
    """Effects with the granular field as the last one, where it is coarse."""
    kept = tuple(own for own in present if own.effect.name != "speckle")
    if grain.contrast < COARSE:
        return kept
    return (*kept, Present(vocabulary()["speckle"], "", (grain.contrast, grain_px(grain, side))))


def grain_px(grain: Grain, side: int) -> float:
    """Grain [px] of which the means of blocks keep that part."""
    sizes = np.geomspace(0.2, 4 * side, 400)
    return float(np.interp(grain.together, [block_correlation(g, side) for g in sizes], sizes))


def fitted(stage: Stage, present: Sequence[Present], base: Free | None = None, shift: np.ndarray | None = None) -> Refit:
    """Frames' own brightness, width and centre beside effects, from their values and a base (the look's own without)."""
    problem = stage.look.problem
    present = with_grain(present, stage.grain, stage.look.measured.side)
    start = problem.start._replace(present=present)
    start = start if base is None else start._replace(base=base)
    start = start if shift is None else start._replace(shift=shift)
    return refit(problem, [(own.effect, own.form) for own in present], start, latent_of(stage))


def latent_of(stage: Stage) -> Latent:
    """What grain brings to a block's mean."""
    return Latent(together=stage.grain.together) if stage.grain.contrast >= COARSE else NOTHING


def grain_of(stage: Stage, model: Model) -> Grain:
    """Contrast and correlation of what the pixels of lit flanks scatter about a model, as a part of their light."""
    side, black = stage.look.measured.side, stage.look.setting.sensor.black_level_dn
    present = with_grain(model.present, stage.grain._replace(contrast=max(stage.grain.contrast, 2 * COARSE)), side)
    _, expect = scenes(stage.shots, stage.look, model._replace(present=present), latent_of(stage))
    squares, noise, means, mean_noise, pixels, blocks = np.zeros(6)
    for k, shot in enumerate(stage.shots):
        scene = expect(k)
        shown = scene.light > FREE_TO_SHOW * (scene.mean - black)
        shown &= scene.light > LIT * np.sqrt(scene.variance)
        light = np.where(shown, scene.light, 1.0)
        own = np.where(shown, (shot.pixels() - scene.mean) / light, 0.0)
        white = np.where(shown, scene.variance / light**2, 0.0)
        squares, noise, pixels = squares + (own**2).sum(), noise + white.sum(), pixels + shown.sum()
        full = _blocks(shown, side).all(axis=(1, 3))
        means += (_blocks(own, side).mean(axis=(1, 3))[full] ** 2).sum()
        mean_noise += _blocks(white, side).sum(axis=(1, 3))[full].sum() / side**4
        blocks += full.sum()
    if pixels < LEAST_PIXELS or blocks < LEAST_PIXELS / side**2:
        return Grain(0.0, 0.3)
    whole, of_means = (squares - noise) / pixels, (means - mean_noise) / blocks
    # What is as smooth as a block is no grain: only a part within blocks counts.
    if whole - max(of_means, 0.0) < COARSE**2:
        return Grain(0.0, 0.3)
    return Grain(float(np.sqrt(min(whole, 1.0))), float(np.clip(of_means / whole, 1 / side**2, 1.0)))


def _blocks(values: np.ndarray, side: int) -> np.ndarray:
    """An image as [row of blocks, row, column of blocks, column]."""
    rows, columns = (n // side for n in values.shape)
    return values[: rows * side, : columns * side].reshape(rows, side, columns, side)
