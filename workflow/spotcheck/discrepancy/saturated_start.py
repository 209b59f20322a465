"""First fit of frames whose readings pile up below full scale: a clip that takes part from the start.

Brightness and width that know of no clip stall far from the truth, and hide the clip from every later test. If the
light is granular, its contrast and the scatter of the clip level are fitted as well: grains behind a clip bend the mean
as a soft clip does.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from spotcheck.discrepancy.criteria import MIN_GAIN, PARAMETER_PRICE
from spotcheck.discrepancy.frames import FrameParameters, FrameSet, select_pixels, thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.residuals import measure_residuals
from spotcheck.model.effect import AppliedEffect, Effect, EffectScales, RandomStep, keyword_names_of
from spotcheck.model.stage import Stage

# Range [highest reading] and bins of the histogram in which a pile-up is looked for.
HISTOGRAM_RANGE, BINS = (0.3, 1.1), 120
# Density at which a pile-up begins, in that of the readings below it, and ends, in that of its mode.
FOOT, TAIL = 2.0, 0.02
# Rank of the reading that counts as the highest: hot pixels do not.
TOP_RANK = 200
# Least density of a pile-up in that of the readings below it.
LEAST_RATIO = 4.0
# Smoothed readings [level] of the flank of a spot, the side of the smoothing [px], and the fewest of them.
FLANK, SMOOTHING_PX, FEWEST_FLANK = (0.05, 0.6), 5, 30
# Believable widths of a spot from its flank, in the width of a fit that knows of no clip.
FLANK_WIDTH = (0.2, 2.0)
# Light [level] at which grains are looked for, and the distance of pixels whose difference shows them [px].
GRAIN_LIGHT, GRAIN_LAG = (0.05, 0.4), 4
# Contrast of grains that bend the mean behind a clip.
COARSE_CONTRAST = 0.1
# Least relative scatter of a level, start of a fit.
LEAST_SCATTER = 0.005
# Iterations of the fits.
FIRST_ITERATIONS, ITERATIONS = 8, 40


@dataclass(frozen=True)
class PileUp:
    """Readings that pile up at one level below full scale."""

    level_dn: float  # their mean above black [DN]
    scatter: float  # their relative scatter beyond read noise and rounding


def find_pile_up(frames: FrameSet, black_dn: float, full_scale_dn: float, noise_dn: float) -> PileUp | None:
    """Return the pile-up at the upper end of the readings, or None.

    It is a mode of the histogram that rises `LEAST_RATIO` times above the density of the readings below it.
    """
    readings = frames.readings[np.isfinite(frames.readings)] - black_dn
    top = float(np.partition(readings, -TOP_RANK)[-TOP_RANK])
    counts, edges = np.histogram(readings, BINS, (HISTOGRAM_RANGE[0] * top, HISTOGRAM_RANGE[1] * top))
    third = BINS // 3
    mode = third + int(np.argmax(counts[third:]))
    floor = max(float(np.median(counts[: max(2 * mode // 3, 1)])), 1.0)
    if counts[mode] < LEAST_RATIO * floor or edges[mode + 1] > full_scale_dn - black_dn - 1:
        return None
    first = last = mode
    while first > 0 and counts[first - 1] > FOOT * floor:
        first -= 1
    while last < BINS - 1 and counts[last + 1] > TAIL * counts[mode]:
        last += 1
    pile = readings[(readings >= edges[first]) & (readings < edges[last + 1])]
    level = float(pile.mean())
    return PileUp(level, float(np.sqrt(max(pile.var() - noise_dn**2 - 1 / 12, 0.0))) / level)


def fit_saturated(declared: JointFit, frames: FrameSet, effects: Sequence[Effect], scales: EffectScales) -> JointFit:
    """Return the fit with a clip if readings pile up and it explains them far better, else the declared fit."""
    sensor = declared.model.forward.sensor
    noise = sensor.gain_dn_per_e * sensor.read_noise_e
    pile = find_pile_up(frames, sensor.black_level_dn, sensor.full_scale_dn, noise)
    if pile is None:
        return declared
    spots = fit_flanks(frames, declared.model.spots, pile.level_dn, sensor.black_level_dn)
    start = replace(declared.model, spots=spots)
    thin = thin_pixels(select_pixels(frames, spots))
    clips = [effect for effect in effects if effect.vanishes_at == np.inf]
    sharp, *others = starts_of_clip(clips, pile, is_random=False)
    best = fit_jointly(start.with_effect(sharp, scales), thin, tolerance=1.0, iterations=FIRST_ITERATIONS)
    contrast = estimate_contrast(best.model, frames, pile.level_dn)
    for clip in others if contrast <= COARSE_CONTRAST else ():
        model = start.with_effect(clip, scales)
        fit = fit_jointly(model, thin, tolerance=1.0, iterations=ITERATIONS, rival=best.deviance)
        price = PARAMETER_PRICE * (len(fit.model.free) - len(best.model.free))
        best = fit if fit.deviance < best.deviance - price - MIN_GAIN else best
    if contrast > COARSE_CONTRAST:
        grains = [applied for effect in effects for applied in granular_light(effect, contrast, scales)]
        for clip in starts_of_clip(clips, pile, is_random=True):
            for granular in grains:
                model = start.with_effect(clip, scales).with_effect(granular, scales)
                fit = fit_jointly(model, thin, tolerance=1.0, iterations=ITERATIONS)
                best = fit if fit.deviance < best.deviance - MIN_GAIN else best
    # The effects that are sought beside it move it further: it need not converge here.
    full = fit_jointly(best.model, select_pixels(frames, best.model.spots), tolerance=1.0, iterations=FIRST_ITERATIONS)
    without = fit_jointly(declared.model, full.pixels, iterations=FIRST_ITERATIONS)
    return full if without.deviance - full.deviance > MIN_GAIN else declared


def starts_of_clip(clips: Sequence[Effect], pile: PileUp, is_random: bool) -> list[AppliedEffect]:
    """Return clips at the level of a pile-up, with variants whose level scatters or with the others."""
    starts = []
    for effect in clips:
        values = dict(zip((p.name for p in effect.parameters), effect.starts(_no_scales())[0], strict=True))
        values[effect.parameters[0].name] = pile.level_dn
        for variant, steps in effect.variants.items():
            random = [step for step in steps if isinstance(step, RandomStep)]
            if bool(random) == is_random:
                for step in random:
                    for name in set(keyword_names_of(step.quadrature)) - {effect.parameters[0].name}:
                        values[name] = max(pile.scatter, LEAST_SCATTER)
                has = {p.name for p in effect.parameters_of(variant)}
                numbers = tuple(values[p.name] if p.name in has else np.nan for p in effect.parameters)
                starts.append(AppliedEffect(effect, variant, numbers))
    return starts


def _no_scales() -> EffectScales:
    return EffectScales(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 1.0)


def granular_light(effect: Effect, contrast: float, scales: EffectScales) -> list[AppliedEffect]:
    """Return an effect of granular light with a contrast, in its most general variant; nothing for other effects."""
    variants = [
        variant
        for variant, steps in effect.variants.items()
        if steps and all(isinstance(step, RandomStep) and step.stage is Stage.SPECKLE_FIELD for step in steps)
    ]
    if not variants:
        return []
    general = max(variants, key=lambda variant: len(effect.parameters_of(variant)))
    applied = AppliedEffect(effect, general, tuple(effect.starts(scales)[0]))
    return [applied.with_value(effect.parameters[0].name, min(contrast, 1.0))]


def fit_flanks(frames: FrameSet, spots: FrameParameters, level_dn: float, black_dn: float) -> FrameParameters:
    """Return spots from a parabola through ln of the smoothed readings well below a level; frames without such a flank
    keep theirs."""
    rows = spots.as_rows().T.copy()
    y_index, x_index = np.mgrid[: frames.readings.shape[1], : frames.readings.shape[2]]
    for f, image in enumerate(np.nan_to_num(frames.readings.astype(float), nan=black_dn)):
        smooth = ndimage.uniform_filter(image, SMOOTHING_PX) - black_dn
        label, count = ndimage.label(smooth > FLANK[0] * level_dn)
        if count == 0 or smooth.max() < FLANK[1] * level_dn:
            continue
        spot = label == 1 + np.argmax(np.bincount(label.ravel())[1:])
        flank = spot & (smooth < FLANK[1] * level_dn)
        if flank.sum() < FEWEST_FLANK:
            continue
        x = x_index[flank] + frames.left[f] - rows[f, 2]
        y = y_index[flank] + frames.top[f] - rows[f, 3]
        # An ellipse: a circle through a contour that is none makes the width far too large.
        terms = np.stack([np.ones(x.size), x, y, -x * x / 2, -x * y, -y * y / 2], 1)
        a, bx, by, cxx, cxy, cyy = np.linalg.lstsq(terms, np.log(smooth[flank]), rcond=None)[0]
        determinant = cxx * cyy - cxy * cxy
        if cxx <= 0 or determinant <= 0:
            continue
        dx, dy = (cyy * bx - cxy * by) / determinant, (cxx * by - cxy * bx) / determinant
        square = determinant**-0.5
        sigma = np.sqrt(max(square - (SMOOTHING_PX**2 - 1) / 12, 0.25 * square))
        if FLANK_WIDTH[0] < sigma / np.exp(rows[f, 1]) < FLANK_WIDTH[1]:
            rows[f] = a + (bx * dx + by * dy) / 2, np.log(sigma), rows[f, 2] + dx, rows[f, 3] + dy
    return FrameParameters(*rows.T)


def estimate_contrast(model: JointModel, frames: FrameSet, level_dn: float) -> float:
    """Return the contrast of granular light from differences of relative residuals `GRAIN_LAG` px apart.

    Only light well below the level takes part. A wrong shape changes little over so few pixels.
    """
    images = measure_residuals(model, frames)
    is_lit = (images.spot > GRAIN_LIGHT[0] * level_dn) & (images.spot < GRAIN_LIGHT[1] * level_dn) & (images.weight > 0)
    slope = np.where(is_lit, images.spot, 1.0)
    relative = images.residual / slope
    noise = np.where(is_lit, 1 / np.where(is_lit, images.weight, 1.0), 0.0) / slope**2
    numerator = denominator = 0.0
    for axis in (1, 2):
        is_pair = is_lit & np.roll(is_lit, GRAIN_LAG, axis)
        square = (relative - np.roll(relative, GRAIN_LAG, axis)) ** 2 - noise - np.roll(noise, GRAIN_LAG, axis)
        numerator += float(square[is_pair].sum()) / 2
        denominator += float(is_pair.sum())
    return float(np.sqrt(max(numerator / max(denominator, 1.0), 0.0)))
