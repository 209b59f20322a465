"""Validation on held-out frames: how well nested models predict repeats that no earlier step has used.

A site is the set of frames with the same angle, declared conditions and repeat, at several exposures. Brightness and
width of a held-out frame come from laws across frames, which follow the conditions of a frame, such as its exposure.
These were fitted to the other repeats. Only the centre is fitted, one for each site; if brightness and width vary from
site to site, those of each site are fitted as well, with their variation as a prior.

The gap is the mean over blocks of `BLOCK_PX` pixels near the spot of (Σ r)²/Σ v, with the residual r of a pixel and the
variance v of its noise: noise alone gives 1. The score is −2 ln p of the frames, with all scatter of the model. The
spot parameters of a frame are ln peak, ln σ, x and y.

An `Evaluation` of a model has, for each pixel of a frame, the `residual` [DN] and its `weight`, 1/variance. `slopes`
are the derivatives of the light by the spot parameters, `moments.mean_slope` is that of the mean reading by the light.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from spotcheck.discrepancy.evaluation import Evaluation, evaluate, map_batches
from spotcheck.discrepancy.fields import correlated_area
from spotcheck.discrepancy.frames import (
    SPOT_PARAMETERS,
    Design,
    FrameParameters,
    FrameSet,
    Pixels,
    select_pixels,
    thin_pixels,
)
from spotcheck.discrepancy.joint_fit import JointModel
from spotcheck.discrepancy.laws import is_law, predict_spots, spot_conditions
from spotcheck.discrepancy.normal_equations import NormalEquations, assemble
from spotcheck.discrepancy.residuals import ResidualImages, place_on_sensor, select_all_pixels, sum_over_blocks
from spotcheck.discrepancy.site_draws import improve_draws, start_draws
from spotcheck.model.effect import AppliedEffect, RandomStep
from spotcheck.model.forward import ForwardModel
from spotcheck.model.stage import Stage

# Side of the blocks [px], and distance from the spot [σ] within which their pixels count.
BLOCK_PX, GAP_RADIUS = 8, 3.5
# Most steps of the fit of sites, to thinned and then to all pixels; largest steps of ln peak, ln σ [1], x and y [px];
# and the drop of −2 ln L for each site at which the fit ends.
SITE_STEPS, LAST_STEPS, LARGEST_STEPS, SITE_TOLERANCE = 30, 2, (0.7, 0.3, 4.0, 4.0), 0.02
# Damping of a step [diagonal of the information]: at first, and the factor by which it grows with each step that fails.
FIRST_DAMPING, DAMPING_FACTOR = 1e-2, 8.0
# Excess of the gap over its floor, in standard deviations, above which it is significant.
NOISE_Z = 2.0
# Indices of the spot parameters that may scatter from frame to frame: ln peak, x and y.
SCATTERING = [0, 2, 3]
# Singular values [largest one] that are taken for 0 in the step of a site.
NULL_STEP = 1e-12


@dataclass(frozen=True)
class PixelGains:
    """Gains of pixels, estimated from residuals; arrays [row, column] of the part of the sensor that crops cover."""

    mean: np.ndarray  # estimate of the relative gain less 1
    variance: np.ndarray  # variance of the true gain about this estimate
    prior_variance: float  # variance of the gain of a pixel that no frame shows
    top: int  # row of the sensor of row 0
    left: int  # column of the sensor of column 0

    def under_crop(self, top: int, left: int, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and variance of the gains under a crop [row, column]; 0 and `prior_variance` outside the arrays.

        `top` and `left` are row and column of the sensor under pixel (0, 0) of the crop, `shape` its rows and columns.
        """
        mean, variance = np.zeros(shape), np.full(shape, self.prior_variance)
        rows, columns = (np.arange(size) + corner for size, corner in zip(shape, (top, left), strict=True))
        row_index, column_index = rows - self.top, columns - self.left
        has_row = (row_index >= 0) & (row_index < self.mean.shape[0])
        has_column = (column_index >= 0) & (column_index < self.mean.shape[1])
        crop, known = np.ix_(has_row, has_column), np.ix_(row_index[has_row], column_index[has_column])
        mean[crop], variance[crop] = self.mean[known], self.variance[known]
        return mean, variance


@dataclass(frozen=True)
class FrameScatter:
    """Scatter of readings about their mean that the model's distribution of a single reading does not contain."""

    field_variance: float = 0.0  # relative variance of granular light (speckle)
    grain_px: float = 0.0  # standard deviation of the Gaussian correlation of granular light [px]; 0 for none
    row_variance: float = 0.0  # variance of an offset that a row of a frame shares [DN²]
    brightness_sd: float = 0.0  # standard deviation of ln peak from frame to frame
    centre_sd: float = 0.0  # standard deviation of x and of y from frame to frame [px]
    site_sd: tuple[float, float] = (0.0, 0.0)  # standard deviations of ln peak and ln σ from site to site
    gains: PixelGains | None = field(default=None, repr=False)  # None: pixels have equal gains

    @property
    def frame_sd(self) -> np.ndarray:
        """Standard deviations of ln peak, x and y from frame to frame [3], in the order of `SCATTERING`."""
        return np.array([self.brightness_sd, self.centre_sd, self.centre_sd])


@dataclass(frozen=True)
class NestedModel:
    """One model of the chain from the declared to the extended one."""

    added: str  # effect by which it exceeds the model before it; "" for the declared model
    forward: ForwardModel  # model of the mean image, with a law of peak and width
    scatter: FrameScatter = FrameScatter()  # scatter beyond the forward model


@dataclass(frozen=True)
class Prediction:
    """Comparison of held-out frames with one model."""

    gap: float  # see the module docstring
    floor: float  # expectation of the gap if the model is right, 1 without scatter beyond single readings
    deviation: float  # standard deviation of the gap if the model is right
    rms_dn: float  # rms over blocks of the mean residual beyond noise [DN]
    score: float  # −2 ln p of all frames, up to a constant
    spots: FrameParameters  # predicted spots, with the fitted centres

    @property
    def left_open(self) -> float:
        """Excess of the gap over its floor; 0 if it is not significant (`NOISE_Z`)."""
        return self.gap - self.floor if self.open_z > NOISE_Z else 0.0

    @property
    def open_z(self) -> float:
        """Excess of the gap over its floor in standard deviations."""
        return (self.gap - self.floor) / self.deviation


def estimate_gains(images: ResidualImages, variance: float) -> PixelGains:
    """Return the posterior mean and variance of each pixel's gain, by residuals of frames that were not held out.

    Parameters
    ----------
    images : ResidualImages
        Residuals of a fit.
    variance : float
        Prior variance of the relative gain.
    """
    spot = images.spot.astype(float)
    factors = (images.residual * spot * images.weight, spot**2 * images.weight)
    score, information = (place_on_sensor(factor, images.left, images.top).sum(axis=0) for factor in factors)
    posterior = 1 / (information + 1 / variance)
    return PixelGains(score * posterior, posterior, variance, int(images.top.min()), int(images.left.min()))


def predict_frames(nested: NestedModel, frames: FrameSet, start: FrameParameters) -> Prediction:
    """Return the comparison of held-out frames with a model.

    Parameters
    ----------
    nested : NestedModel
        The model.
    frames : FrameSet
        Held-out frames.
    start : FrameParameters
        Spots of the frames. Their fit starts from the mean centre of each site; peak and width are not used.
    """
    spots = _start_spots(nested.forward, frames.design, start)
    effects = tuple(applied for applied in nested.forward.effects if not is_law(applied.effect))
    model = JointModel(replace(nested.forward, law=None, effects=effects), spots, frames.design)
    pixels = select_pixels(frames, spots)
    thin = thin_pixels(pixels)
    model = start_draws(_fit_sites(model, thin, nested.scatter.site_sd, SITE_STEPS), thin)
    model = improve_draws(_fit_sites(model, pixels, nested.scatter.site_sd, LAST_STEPS), pixels)
    return _compare_frames(model, nested.scatter, frames)


def _start_spots(forward: ForwardModel, design: Design, spots: FrameParameters) -> FrameParameters:
    """Return spots with peak and width by the law of a model, and the mean centre of `spots` of their site."""
    site = np.unique(design.site, return_inverse=True)[1]
    x, y = (np.bincount(site, values)[site] / np.bincount(site)[site] for values in (spots.x, spots.y))
    log_peak, log_sigma = predict_spots(forward, spot_conditions(design))
    return FrameParameters(log_peak, log_sigma, x, y)


def _fit_sites(model: JointModel, pixels: Pixels, site_sd: tuple[float, float], steps: int) -> JointModel:
    """Return the model with the spot parameters of each site fitted to its frames, the rest kept.

    The frames of a site share the shift of their centres and, where `site_sd` (of ln peak and ln σ) is above 0, those
    of ln peak and ln σ. Steps of Fisher scoring are damped until −2 ln L, with the normal prior of ln peak and ln σ,
    does not rise.
    """
    site = np.unique(model.design.site, return_inverse=True)[1]
    is_free = np.array([site_sd[0] > 0, site_sd[1] > 0, True, True])
    precision = np.array([1 / sd**2 if sd > 0 else 0.0 for sd in site_sd] + [0.0, 0.0])
    # Shifts of the spot parameters from their start [site, parameter].
    shift, start = np.zeros((site.max() + 1, SPOT_PARAMETERS)), model.spots.as_rows()
    equations, damping = assemble(model, pixels), 0.0
    for _ in range(steps):
        gradient, information = _sum_by_site(equations, site)
        gradient = gradient - precision * shift
        information = information + np.diag(precision)
        step = np.zeros_like(gradient)
        for number in range(len(step)):
            free = information[number][np.ix_(is_free, is_free)]
            damped = free + damping * np.diag(np.diag(free))
            step[number, is_free] = np.linalg.lstsq(damped, gradient[number, is_free], rcond=NULL_STEP)[0]
        step = np.clip(step, -np.array(LARGEST_STEPS), LARGEST_STEPS)
        trial = replace(model, spots=FrameParameters(*(start + (shift + step)[site].T)))
        trial_equations = assemble(trial, pixels)
        prior_rise = float(np.sum(precision * ((shift + step) ** 2 - shift**2)))
        rise = trial_equations.deviance - equations.deviance + prior_rise
        # NaN counts as a rise.
        if not rise <= 0:
            damping = max(DAMPING_FACTOR * damping, FIRST_DAMPING)
            continue
        model, equations, shift, damping = trial, trial_equations, shift + step, damping / DAMPING_FACTOR
        if -rise < SITE_TOLERANCE * len(step):
            break
    return model


def _sum_by_site(equations: NormalEquations, site: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return score [site, 4] and Fisher information [site, 4, 4] of spot parameters that the frames of a site share.

    `site` [frame] are numbers from 0 on.
    """
    sites, frames = site.max() + 1, np.arange(len(site))
    gradient, information = np.zeros((sites, SPOT_PARAMETERS)), np.zeros((sites, SPOT_PARAMETERS, SPOT_PARAMETERS))
    np.add.at(gradient, site, equations.gradient.reshape(-1, SPOT_PARAMETERS))
    blocks = equations.information.reshape(len(site), SPOT_PARAMETERS, len(site), SPOT_PARAMETERS)
    np.add.at(information, site, blocks[frames, :, frames])
    return gradient, information


def _compare_frames(model: JointModel, scatter: FrameScatter, frames: FrameSet) -> Prediction:
    """Return the comparison of frames with a model whose spots are final."""
    pixels = select_all_pixels(frames)

    def compare_batch(batch: slice) -> tuple[np.ndarray, float]:
        """Return the blocks and the score of a batch of frames."""
        return _compare_batch(model, scatter, frames, pixels, batch)

    results = map_batches(compare_batch, pixels)
    residual, noise, other_variance, count, frame = np.concatenate([blocks for blocks, _ in results], axis=1)
    squares, relative = residual**2 / noise, other_variance / noise
    # The square of a normal number has the variance 2 times its squared mean.
    variance = 2 * np.sum((1 + relative) ** 2)
    if scatter.frame_sd.any():
        # A deviation of a frame's spot moves all its blocks together: their scatter adds up before it is squared.
        variance = 2 * np.sum(np.bincount(frame.astype(int), relative) ** 2) + 2 * len(relative)
    excess = (residual**2 - noise) / count**2
    return Prediction(
        gap=float(squares.mean()),
        floor=float(1 + relative.mean()),
        deviation=float(np.sqrt(variance) / len(relative)),
        rms_dn=float(np.sqrt(max(excess.mean(), 0.0))),
        score=float(sum(score for _, score in results)),
        spots=model.spots,
    )


def _compare_batch(
    model: JointModel, scatter: FrameScatter, frames: FrameSet, pixels: Pixels, batch: slice
) -> tuple[np.ndarray, float]:
    """Return sums over the blocks near the spots of a batch of frames [5, block], and the score of the frames.

    `pixels` are all pixels of `frames`, of which `batch` selects some. The sums are, for each block, that of the
    residuals [DN], its variance by the noise of single pixels and by all other scatter [DN²], and the number of pixels.
    The number of the frame follows.
    """
    evaluation = evaluate(model, pixels, batch)
    used = evaluation.weight > 0
    variance = np.where(used, 1 / np.where(used, evaluation.weight, 1.0), 0.0)
    # Derivatives of the mean reading by the scattering spot parameters; that by ln peak is the one by a relative gain.
    slopes = evaluation.slopes[SCATTERING] * evaluation.moments.mean_slope * used
    light_square = slopes[0] ** 2
    grain_variance = np.where(used, _variance_by_grains(model, pixels, batch, variance), 0.0)
    residual = evaluation.residual
    gain_variance = np.zeros_like(variance)
    if scatter.gains is not None:
        corners = zip(frames.top[batch], frames.left[batch], strict=True)
        known = [scatter.gains.under_crop(int(top), int(left), frames.readings.shape[1:]) for top, left in corners]
        gain, gain_error = (np.stack(arrays) for arrays in zip(*known, strict=True))
        residual, gain_variance = residual - gain * slopes[0], gain_error * light_square
    total = variance + scatter.field_variance * light_square + gain_variance
    weight = np.where(used, 1 / np.where(used, total, 1.0), 0.0)
    score = _score_frames(scatter, residual, weight, slopes, evaluation.moments.mean_slope * used)
    is_near = used & _is_near(evaluation)

    def sum_blocks(values: np.ndarray) -> np.ndarray:
        """Return sums over the pixels near the spot [frame, block row, block column]."""
        return sum_over_blocks(values * is_near, BLOCK_PX)

    # Neighbours share grains, so that the variance of a block is larger by the area that a grain correlates.
    area = correlated_area(scatter.grain_px, BLOCK_PX)
    others = area * sum_blocks(grain_variance + scatter.field_variance * light_square) + sum_blocks(gain_variance)
    # All pixels of a block follow ln peak of the frame, and those of a row its offset.
    others += (scatter.brightness_sd * sum_blocks(slopes[0])) ** 2
    others += scatter.row_variance * BLOCK_PX * sum_blocks(evaluation.moments.mean_slope**2)
    if scatter.centre_sd:
        # The centre of a site was fitted to these frames, which takes off a part of the scatter.
        share = 1 - 1 / np.bincount(model.design.site).max()
        others += share * scatter.centre_sd**2 * (sum_blocks(slopes[1]) ** 2 + sum_blocks(slopes[2]) ** 2)
    count = sum_blocks(np.ones(used.shape))
    is_used_block = count > BLOCK_PX**2 / 2
    frame = np.broadcast_to(np.arange(batch.start, batch.stop)[:, None, None], count.shape)
    arrays = (sum_blocks(residual), sum_blocks(variance - grain_variance), others, count, frame)
    return np.array([values[is_used_block] for values in arrays]), score


def _score_frames(
    scatter: FrameScatter, residual: np.ndarray, weight: np.ndarray, slopes: np.ndarray, row_slope: np.ndarray
) -> float:
    """Return −2 ln p of frames, up to a constant.

    Offsets of rows, and deviations of a frame's spot, are integrated out, each as if the other were absent. Arrays are
    [frame, row, column]: residual [DN], 1/variance of a reading by itself [1/DN²], 0 for pixels that are not used, and
    the derivative of the mean reading by an offset of its row. `slopes` are those by the scattering spot parameters,
    with an axis of these before the others.
    """
    log_weight = np.log(weight, where=weight > 0, out=np.zeros(weight.shape))
    score = float(np.sum(residual**2 * weight) - np.sum(log_weight))
    # With a covariance V + S S', −2 ln p changes by ln |1 + S'V⁻¹S| − (S'V⁻¹r)'(1 + S'V⁻¹S)⁻¹(S'V⁻¹r) (Woodbury).
    if scatter.row_variance:
        gradient = (row_slope * residual * weight).sum(axis=2)
        information = scatter.row_variance * (row_slope**2 * weight).sum(axis=2)
        score += float(np.sum(np.log1p(information) - scatter.row_variance * gradient**2 / (1 + information)))
    if scatter.frame_sd.any():
        scaled = slopes * scatter.frame_sd[:, None, None, None]
        gradient = np.einsum("afhw,fhw->fa", scaled, residual * weight)
        information = np.einsum("afhw,bfhw,fhw->fab", scaled, scaled, weight) + np.eye(len(SCATTERING))
        score += float(np.sum(np.linalg.slogdet(information)[1]))
        score -= float(np.sum(gradient * np.linalg.solve(information, gradient[:, :, None])[:, :, 0]))
    return score


def _variance_by_grains(model: JointModel, pixels: Pixels, batch: slice, variance: np.ndarray) -> np.ndarray | float:
    """Return the part [DN²] of the variance of a reading that granular light of the model causes; 0 if it has none."""
    effects = tuple(applied for applied in model.forward.effects if not is_field(applied))
    if len(effects) == len(model.forward.effects):
        return 0.0
    without = replace(model, forward=replace(model.forward, effects=effects))
    evaluation = evaluate(without, pixels, batch, with_slopes=False)
    return np.maximum(variance - 1 / np.where(evaluation.weight > 0, evaluation.weight, np.inf), 0.0)


def has_field(model: JointModel) -> bool:
    """Return whether the effects of a model contain granular light."""
    return any(is_field(applied) for applied in model.forward.effects)


def is_field(applied: AppliedEffect) -> bool:
    """Return whether an effect is granular light and nothing else: a random field that multiplies the light."""
    steps = applied.effect.variants[applied.variant]
    return bool(steps) and all(isinstance(step, RandomStep) and step.stage is Stage.SPECKLE_FIELD for step in steps)


def _is_near(evaluation: Evaluation) -> np.ndarray:
    """Return which pixels lie within `GAP_RADIUS` of their spot [frame, row, column]."""
    conditions = evaluation.conditions
    distance = np.hypot(conditions.pixels.x - conditions.x0, conditions.pixels.y - conditions.y0)
    return distance < GAP_RADIUS * conditions.sigma_px
