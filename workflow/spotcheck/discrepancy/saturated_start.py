"""First fit of frames whose readings pile up below full scale: a clip takes part from the start.

A clip is a sensor stage that limits readings to a level. Brightness and width that are fitted without it stall far from
the truth, and hide the clip from every later test. If the light is granular (speckle), its contrast and the scatter of
the clip level are fitted as well: grains in front of a clip bend the mean as a soft clip does. The first parameter of
an effect is its strength; that of a clip is its level above the black level [DN], and the effect vanishes at infinity.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from spotcheck.discrepancy.criteria import MIN_GAIN, PARAMETER_PRICE
from spotcheck.discrepancy.frames import FrameParameters, FrameSet, select_pixels, thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.residuals import measure_residuals
from spotcheck.discrepancy.validation import is_field
from spotcheck.model.effect import AppliedEffect, Effect, EffectScales, RandomStep, keyword_names_of

# Range [highest reading] and number of bins of the histogram of readings.
HISTOGRAM_RANGE, BINS = (0.3, 1.1), 120
# Rank of the reading that counts as the highest one: hot pixels lie above it.
TOP_RANK = 200
# Least count of a pile-up's highest bin [median count of the bins below it].
LEAST_RATIO = 4.0
# Counts below which the bins of a pile-up end: downwards [median count of the bins below it], upwards [its highest
# bin].
FOOT, TAIL = 2.0, 0.02
# Range of smoothed readings that are the flank of a spot [clip level], side of the smoothing [px], and fewest pixels.
FLANK, SMOOTHING_PX, FEWEST_FLANK = (0.05, 0.6), 5, 30
# Variance of a uniform distribution over one px or DN.
UNIFORM_VARIANCE = 1 / 12
# Least part of the variance of a smoothed spot that is left after that of the smoothing is taken off.
LEAST_VARIANCE_SHARE = 0.25
# Range of credible widths of a spot from its flank [width of a fit without the clip].
FLANK_WIDTH = (0.2, 2.0)
# Range of light in which grains are sought [clip level], and distance of the pixels whose difference shows them [px].
GRAIN_LIGHT, GRAIN_LAG = (0.05, 0.4), 4
# Contrast above which grains bend the mean in front of a clip.
COARSE_CONTRAST = 0.1
# Least relative scatter of a clip level from which a fit starts.
LEAST_SCATTER = 0.005
# Decrement of −2 ln L at which these fits end, and most iterations of a first and of a later fit.
TOLERANCE, FIRST_ITERATIONS, ITERATIONS = 1.0, 8, 40
# Scales with which starts of a clip are listed: all but the level, which a pile-up gives, are fractions.
UNIT_SCALES = EffectScales(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 1.0)


@dataclass(frozen=True)
class PileUp:
    """Readings that pile up at one level below full scale."""

    level_dn: float  # their mean above the black level [DN]
    scatter: float  # their standard deviation beyond read noise and rounding, over their mean


def find_pile_up(frames: FrameSet, black_dn: float, full_scale_dn: float, noise_dn: float) -> PileUp | None:
    """Return the pile-up at the upper end of the readings, or None.

    It is a mode of the histogram of all readings that rises far above the counts below it.

    Parameters
    ----------
    frames : FrameSet
        Frames of a dataset.
    black_dn, full_scale_dn : float
        Black level and largest reading of the sensor [DN].
    noise_dn : float
        Standard deviation of the read noise [DN].
    """
    readings = frames.readings[np.isfinite(frames.readings)] - black_dn
    highest = float(np.partition(readings, -TOP_RANK)[-TOP_RANK])
    counts, edges = np.histogram(readings, BINS, (HISTOGRAM_RANGE[0] * highest, HISTOGRAM_RANGE[1] * highest))
    lower_third = BINS // 3
    mode = lower_third + int(np.argmax(counts[lower_third:]))
    background = max(float(np.median(counts[: max(2 * mode // 3, 1)])), 1.0)
    # Saturation at full scale is part of every sensor model.
    if counts[mode] < LEAST_RATIO * background or edges[mode + 1] > full_scale_dn - black_dn - 1:
        return None
    first = last = mode
    while first > 0 and counts[first - 1] > FOOT * background:
        first -= 1
    while last < BINS - 1 and counts[last + 1] > TAIL * counts[mode]:
        last += 1
    pile = readings[(readings >= edges[first]) & (readings < edges[last + 1])]
    level = float(pile.mean())
    return PileUp(level, float(np.sqrt(max(pile.var() - noise_dn**2 - UNIFORM_VARIANCE, 0.0))) / level)


def fit_saturated(declared: JointFit, frames: FrameSet, effects: Sequence[Effect], scales: EffectScales) -> JointFit:
    """Return the fit with a clip if readings pile up and it explains them far better, else the declared fit.

    Parameters
    ----------
    declared : JointFit
        Fit of the declared model.
    frames : FrameSet
        Its frames.
    effects : sequence of Effect
        Effects of the mean image, from which clips and granular light are taken.
    scales : EffectScales
        Typical sizes of the dataset, from which effects derive starting values and bounds.
    """
    sensor = declared.model.forward.sensor
    noise = sensor.gain_dn_per_e * sensor.read_noise_e
    pile = find_pile_up(frames, sensor.black_level_dn, sensor.full_scale_dn, noise)
    if pile is None:
        return declared
    spots = fit_flanks(frames, declared.model.spots, pile.level_dn, sensor.black_level_dn)
    start = replace(declared.model, spots=spots)
    thin = thin_pixels(select_pixels(frames, spots))
    clips = [effect for effect in effects if effect.vanishes_at == np.inf]
    # The first variant of a clip is the sharp one.
    sharp, *others = starts_of_clip(clips, pile, is_random=False)
    best = fit_jointly(start.with_effect(sharp, scales), thin, tolerance=TOLERANCE, iterations=FIRST_ITERATIONS)
    contrast = estimate_contrast(best.model, frames, pile.level_dn)
    for clip in others if contrast <= COARSE_CONTRAST else ():
        # Softer clips have more parameters, which must pay for themselves.
        model = start.with_effect(clip, scales)
        fit = fit_jointly(model, thin, tolerance=TOLERANCE, iterations=ITERATIONS, rival=best.deviance)
        price = PARAMETER_PRICE * (len(fit.model.free) - len(best.model.free))
        best = fit if fit.deviance < best.deviance - price - MIN_GAIN else best
    if contrast > COARSE_CONTRAST:
        grains = [applied for effect in effects for applied in list_granular(effect, contrast, scales)]
        for clip in starts_of_clip(clips, pile, is_random=True):
            for granular in grains:
                model = start.with_effect(clip, scales).with_effect(granular, scales)
                fit = fit_jointly(model, thin, tolerance=TOLERANCE, iterations=ITERATIONS)
                best = fit if fit.deviance < best.deviance - MIN_GAIN else best
    # This fit need not converge: effects that are sought later move the clip further.
    pixels = select_pixels(frames, best.model.spots)
    full = fit_jointly(best.model, pixels, tolerance=TOLERANCE, iterations=FIRST_ITERATIONS)
    without = fit_jointly(declared.model, pixels, iterations=FIRST_ITERATIONS)
    return full if without.deviance - full.deviance > MIN_GAIN else declared


def starts_of_clip(clips: Sequence[Effect], pile: PileUp, is_random: bool) -> list[AppliedEffect]:
    """Return a start of each variant of clips, with the level of a pile-up.

    `is_random` selects the variants whose level scatters from pixel to pixel, with the scatter of the pile-up; else
    those whose level is the same in all pixels are returned.
    """
    starts = []
    for effect in clips:
        names = [parameter.name for parameter in effect.parameters]
        values = dict(zip(names, effect.starts(UNIT_SCALES)[0], strict=True))
        values[names[0]] = pile.level_dn
        for variant, steps in effect.variants.items():
            random_steps = [step for step in steps if isinstance(step, RandomStep)]
            if bool(random_steps) == is_random:
                for step in random_steps:
                    # A quadrature takes means over the draw; its parameters other than the level are the scatter.
                    for name in set(keyword_names_of(step.quadrature)) - {names[0]}:
                        values[name] = max(pile.scatter, LEAST_SCATTER)
                used = {parameter.name for parameter in effect.parameters_of(variant)}
                variant_values = tuple(values[name] if name in used else np.nan for name in names)
                starts.append(AppliedEffect(effect, variant, variant_values))
    return starts


def list_granular(effect: Effect, contrast: float, scales: EffectScales) -> list[AppliedEffect]:
    """Return an effect of granular light with a contrast, in its variant with most parameters; [] for other effects.

    Granular light is a random field that multiplies the light; `contrast` is its relative standard deviation.
    """
    variants = [variant for variant in effect.variants if is_field(AppliedEffect(effect, variant, ()))]
    if not variants:
        return []
    general = max(variants, key=lambda variant: len(effect.parameters_of(variant)))
    applied = AppliedEffect(effect, general, tuple(effect.starts(scales)[0]))
    return [applied.with_value(effect.parameters[0].name, min(contrast, 1.0))]


def fit_flanks(frames: FrameSet, spots: FrameParameters, level_dn: float, black_dn: float) -> FrameParameters:
    """Return the spot of each frame by the flank of its readings, where a clip does not act.

    The logarithm of a Gaussian is a parabola. It is fitted to ln of the smoothed readings well below the clip level.
    Frames without such a flank, or with a width that is not credible, keep their spot.

    Parameters
    ----------
    frames : FrameSet
        Frames of a dataset.
    spots : FrameParameters
        Spots of a fit without the clip.
    level_dn : float
        Level of the clip above the black level [DN].
    black_dn : float
        Black level [DN].
    """
    # Rows [frame]: ln peak, ln σ, x, y.
    rows = spots.as_rows().T.copy()
    y_index, x_index = np.mgrid[: frames.readings.shape[1], : frames.readings.shape[2]]
    for frame, image in enumerate(np.nan_to_num(frames.readings.astype(float), nan=black_dn)):
        smooth = ndimage.uniform_filter(image, SMOOTHING_PX) - black_dn
        label, count = ndimage.label(smooth > FLANK[0] * level_dn)
        if count == 0 or smooth.max() < FLANK[1] * level_dn:
            continue
        # The largest connected region is the spot.
        spot = label == 1 + np.argmax(np.bincount(label.ravel())[1:])
        flank = spot & (smooth < FLANK[1] * level_dn)
        if flank.sum() < FEWEST_FLANK:
            continue
        _, log_sigma, x0, y0 = rows[frame]
        x, y = x_index[flank] + frames.left[frame] - x0, y_index[flank] + frames.top[frame] - y0
        # ln reading = a + b·r − r'Cr/2. An ellipse: a circle that is fitted to an elliptic contour is far too wide.
        terms = np.stack([np.ones(x.size), x, y, -x * x / 2, -x * y, -y * y / 2], 1)
        a, bx, by, cxx, cxy, cyy = np.linalg.lstsq(terms, np.log(smooth[flank]), rcond=None)[0]
        determinant = cxx * cyy - cxy * cxy
        if cxx <= 0 or determinant <= 0:
            continue
        # The maximum lies at C⁻¹b; σ² is the geometric mean of the variances along both axes, less the smoothing's.
        dx, dy = (cyy * bx - cxy * by) / determinant, (cxx * by - cxy * bx) / determinant
        variance = determinant**-0.5
        sigma = np.sqrt(max(variance - (SMOOTHING_PX**2 - 1) / 12, LEAST_VARIANCE_SHARE * variance))
        if FLANK_WIDTH[0] < sigma / np.exp(log_sigma) < FLANK_WIDTH[1]:
            rows[frame] = a + (bx * dx + by * dy) / 2, np.log(sigma), x0 + dx, y0 + dy
    return FrameParameters(*rows.T)


def estimate_contrast(model: JointModel, frames: FrameSet, level_dn: float) -> float:
    """Return the contrast of granular light: the relative standard deviation of its brightness.

    It follows from differences of relative residuals between pixels `GRAIN_LAG` px apart, less their noise. A wrong
    light shape changes little over so few pixels. Only light well below the clip level takes part.

    Parameters
    ----------
    model : JointModel
        Fitted model of the frames.
    frames : FrameSet
        The frames.
    level_dn : float
        Level of the clip above the black level [DN].
    """
    images = measure_residuals(model, frames)
    is_lit = (images.spot > GRAIN_LIGHT[0] * level_dn) & (images.spot < GRAIN_LIGHT[1] * level_dn) & (images.weight > 0)
    light = np.where(is_lit, images.spot, 1.0)
    relative = images.residual / light
    noise = np.where(is_lit, 1 / np.where(is_lit, images.weight, 1.0), 0.0) / light**2
    variance_sum = pairs = 0.0
    # Rolled images wrap around, but the edges of a crop are dark.
    for axis in (1, 2):
        is_pair = is_lit & np.roll(is_lit, GRAIN_LAG, axis)
        excess = (relative - np.roll(relative, GRAIN_LAG, axis)) ** 2 - noise - np.roll(noise, GRAIN_LAG, axis)
        variance_sum += float(excess[is_pair].sum()) / 2
        pairs += float(is_pair.sum())
    return float(np.sqrt(max(variance_sum / max(pairs, 1.0), 0.0)))
