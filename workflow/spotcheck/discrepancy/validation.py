"""Validation on held-out frames: how well nested models predict repeats that no earlier step has used.

Brightness and width of a held-out frame come from the laws that were fitted to the other repeats. Only its centre, one
for each site, is fitted to it; where sites vary, brightness and width of a new site are fitted under that variation.

The gap is the mean over blocks of `BLOCK_PX` pixels near the spot of (Σ r)²/Σ v, with the variance v of the noise of
single pixels: noise alone gives 1. The score is −2 ln p of the frames, with all scatter of the model.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from spotcheck.discrepancy.evaluation import Evaluation, evaluate, map_batches
from spotcheck.discrepancy.fields import correlated_area
from spotcheck.discrepancy.frames import Design, FrameParameters, FrameSet, Pixels, select_pixels, thin_pixels
from spotcheck.discrepancy.joint_fit import JointModel
from spotcheck.discrepancy.laws import is_law, spot_conditions
from spotcheck.discrepancy.normal_equations import NormalEquations, assemble
from spotcheck.discrepancy.residuals import ResidualImages, place_on_sensor, whole_crops
from spotcheck.model.effect import AppliedEffect, RandomStep
from spotcheck.model.forward import ForwardModel
from spotcheck.model.stage import Stage

# Side of the blocks, and distance from the spot [σ] within which they count.
BLOCK_PX, GAP_RADIUS = 8, 3.5
# Most steps of the fit of sites, the largest step of ln peak and ln σ [1] and of the centre [px], and the drop of
# −2 ln L for each site at which it ends.
SITE_STEPS, LARGEST_STEPS, SITE_TOLERANCE = 30, (0.7, 0.3, 4.0, 4.0), 0.02
# Part of the diagonal of the information that is added where a step fails: at first, and from try to try.
FIRST_DAMPING, DAMPING_FACTOR = 1e-2, 8.0
# Steps of that fit on all pixels.
LAST_STEPS = 2
# Standard deviations of the gap beyond its floor up to which nothing is left open.
NOISE_Z = 2.0
# Parameters of a spot that scatter from frame to frame: ln peak, x and y.
SCATTERING = [0, 2, 3]


@dataclass(frozen=True)
class PixelGains:
    """Gains of pixels, estimated from residuals; arrays [row, column] of a part of the sensor."""

    mean: np.ndarray  # relative gain less 1
    variance: np.ndarray  # of that mean about the truth
    prior_variance: float  # of pixels that no frame shows
    top: int  # row of the sensor of row 0
    left: int  # column of the sensor of column 0

    def under_crop(self, top: int, left: int, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and variance [row, column] under a crop; 0 and that of the prior outside the known part."""
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
    """Scatter of readings about their mean beyond the distribution of a single reading."""

    field_variance: float = 0.0  # relative variance of granular light that is not in the distribution of a reading
    grain_px: float = 0.0  # standard deviation of the correlation of granular light [px]
    row_variance: float = 0.0  # variance common to a row of a frame [DN²]
    brightness_sd: float = 0.0  # of ln peak from frame to frame
    centre_sd: float = 0.0  # of the centre along an axis from frame to frame [px]
    site_sd: tuple[float, float] = (0.0, 0.0)  # of ln peak and ln σ from site to site
    gains: PixelGains | None = field(default=None, repr=False)

    @property
    def frame_sd(self) -> np.ndarray:
        """Standard deviations of ln peak, x and y from frame to frame."""
        return np.array([self.brightness_sd, self.centre_sd, self.centre_sd])


@dataclass(frozen=True)
class NestedModel:
    """One model of the chain from the declared to the extended one."""

    added: str  # effect by which it exceeds the model before it; "" for the declared model
    forward: ForwardModel  # with a law of peak and width
    scatter: FrameScatter = FrameScatter()


@dataclass(frozen=True)
class Prediction:
    """Held-out frames under one model."""

    gap: float  # mean over blocks of the squared sum of residuals over its variance; 1 is noise alone
    floor: float  # its expectation under the model
    deviation: float  # standard deviation of gap − floor under the model
    rms_dn: float  # rms of block means beyond noise [DN]
    score: float  # −2 ln p of all frames but for a constant
    spots: FrameParameters  # predicted spots

    @property
    def left_open(self) -> float:
        """What the model leaves of the gap; 0 if that is within `NOISE_Z` standard deviations."""
        return self.gap - self.floor if self.open_z > NOISE_Z else 0.0

    @property
    def open_z(self) -> float:
        """Gap beyond its floor in standard deviations."""
        return (self.gap - self.floor) / self.deviation


def estimate_gains(images: ResidualImages, variance: float) -> PixelGains:
    """Return the posterior of each pixel's gain under a prior variance, from residuals of frames."""
    spot = images.spot.astype(float)
    factors = (images.residual * spot * images.weight, spot**2 * images.weight)
    score, information = (place_on_sensor(factor, images.left, images.top).sum(axis=0) for factor in factors)
    posterior = 1 / (information + 1 / variance)
    return PixelGains(score * posterior, posterior, variance, int(images.top.min()), int(images.left.min()))


def predict_frames(nested: NestedModel, frames: FrameSet, start: FrameParameters) -> Prediction:
    """Compare held-out frames with a model.

    Parameters
    ----------
    nested : NestedModel
        The model.
    frames : FrameSet
        Held-out frames.
    start : FrameParameters
        Centres from which their fit starts, one mean for each site; peak and width are not used.
    """
    spots = _from_law(nested.forward, frames.design, _site_means(frames.design, start))
    effects = tuple(applied for applied in nested.forward.effects if not is_law(applied.effect))
    model = JointModel(replace(nested.forward, law=None, effects=effects), spots, frames.design)
    near = select_pixels(frames, spots)
    for pixels in (thin_pixels(near), near):
        model = _fit_sites(model, pixels, nested.scatter.site_sd, SITE_STEPS if pixels is not near else LAST_STEPS)
    return _measure(model, nested.scatter, frames)


def _site_means(design: Design, spots: FrameParameters) -> FrameParameters:
    """Return the spots with the mean centre of each site."""
    site = np.unique(design.site, return_inverse=True)[1]
    count = np.bincount(site)
    x, y = (np.bincount(site, axis)[site] / count[site] for axis in (spots.x, spots.y))
    return replace(spots, x=x, y=y)


def _from_law(model: ForwardModel, design: Design, spots: FrameParameters) -> FrameParameters:
    """Return the spots with peak and width of the law."""
    spot = model.spot(spot_conditions(design))
    shape = (len(spots.x), 1, 1)
    peak, sigma = (np.broadcast_to(part, shape).ravel() for part in (spot.peak_dn, spot.sigma_px))
    return replace(spots, log_peak=np.log(peak), log_sigma=np.log(sigma))


def _fit_sites(model: JointModel, pixels: Pixels, site_sd: tuple[float, float], steps: int) -> JointModel:
    """Return the model with one centre for each site and, where sites vary, with one brightness and width.

    Steps of Fisher scoring are damped until −2 ln L, with the normal prior of brightness and width, does not rise.
    """
    site = np.unique(model.design.site, return_inverse=True)[1]
    is_free = np.array([site_sd[0] > 0, site_sd[1] > 0, True, True])
    precision = np.array([1 / site_sd[k] ** 2 if site_sd[k] > 0 else 0.0 for k in (0, 1)] + [0.0, 0.0])
    moved, start = np.zeros((site.max() + 1, 4)), model.spots.as_rows()
    equations, damping = assemble(model, pixels), 0.0
    for _ in range(steps):
        gradient, information = _sum_by_site(equations, site)
        gradient = gradient - precision * moved
        information = information + np.diag(precision)
        step = np.zeros_like(gradient)
        for number in range(len(step)):
            free = information[number][np.ix_(is_free, is_free)]
            damped = free + damping * np.diag(np.diag(free))
            step[number, is_free] = np.linalg.lstsq(damped, gradient[number, is_free], rcond=1e-12)[0]
        step = np.clip(step, -np.array(LARGEST_STEPS), LARGEST_STEPS)
        trial = replace(model, spots=FrameParameters(*(start + (moved + step)[site].T)))
        new = assemble(trial, pixels)
        rise = new.deviance - equations.deviance + float(np.sum(precision * ((moved + step) ** 2 - moved**2)))
        if not rise <= 0:
            damping = max(DAMPING_FACTOR * damping, FIRST_DAMPING)
            continue
        model, equations, moved, damping = trial, new, moved + step, damping / DAMPING_FACTOR
        if -rise < SITE_TOLERANCE * len(step):
            break
    return model


def _sum_by_site(equations: NormalEquations, site: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return gradient [site, 4] and information [site, 4, 4] of spots that frames of a site share."""
    gradient, information = np.zeros((site.max() + 1, 4)), np.zeros((site.max() + 1, 4, 4))
    for frame, number in enumerate(site):
        rows = slice(4 * frame, 4 * frame + 4)
        gradient[number] += equations.gradient[rows]
        information[number] += equations.information[rows, rows]
    return gradient, information


@dataclass(frozen=True)
class _BlockSums:
    """Sums over the blocks of all frames; arrays [block]."""

    residual: np.ndarray  # residuals [DN]
    noise: np.ndarray  # variance of the noise of pixels [DN²]
    scatter: np.ndarray  # variance of the sum of residuals by all other scatter [DN²]
    count: np.ndarray  # pixels
    frame: np.ndarray  # frame of the block


def _measure(model: JointModel, scatter: FrameScatter, frames: FrameSet) -> Prediction:
    """Return the comparison of frames with a model."""
    pixels = whole_crops(frames)

    def of_batch(part: slice) -> tuple[_BlockSums, float]:
        return _compare(model, scatter, frames, pixels, part)

    parts = map_batches(of_batch, pixels)
    blocks = _BlockSums(
        *(np.concatenate([getattr(sums, name) for sums, _ in parts]) for name in _BlockSums.__dataclass_fields__)
    )
    squares, relative = blocks.residual**2 / blocks.noise, blocks.scatter / blocks.noise
    variance = 2 * np.sum((1 + relative) ** 2)
    if scatter.frame_sd.any():
        # One draw moves all blocks of a frame.
        variance = 2 * np.sum(np.bincount(blocks.frame, relative) ** 2) + 2 * len(relative)
    excess = (blocks.residual**2 - blocks.noise) / blocks.count**2
    return Prediction(
        gap=float(squares.mean()),
        floor=float(1 + relative.mean()),
        deviation=float(np.sqrt(variance) / len(relative)),
        rms_dn=float(np.sqrt(max(excess.mean(), 0.0))),
        score=float(sum(score for _, score in parts)),
        spots=model.spots,
    )


def _compare(
    model: JointModel, scatter: FrameScatter, frames: FrameSet, pixels: Pixels, part: slice
) -> tuple[_BlockSums, float]:
    """Return the sums over blocks near the spots of a batch of frames, and their score."""
    at = evaluate(model, pixels, part)
    used = at.weight > 0
    variance = np.where(used, 1 / np.where(used, at.weight, 1.0), 0.0)
    slopes = at.slopes[SCATTERING] * at.moments.mean_slope * used
    light_square = slopes[0] ** 2
    of_grains = np.where(used, _variance_of_grains(model, pixels, part, variance), 0.0)
    residual = at.residual
    of_gains = np.zeros_like(variance)
    if scatter.gains is not None:
        crops = zip(frames.top[part], frames.left[part], strict=True)
        known = [scatter.gains.under_crop(int(top), int(left), frames.readings.shape[1:]) for top, left in crops]
        gain, gain_variance = (np.stack([pair[k] for pair in known]) for k in (0, 1))
        residual, of_gains = residual - gain * slopes[0], gain_variance * light_square
    total = variance + scatter.field_variance * light_square + of_gains
    score = _score(scatter, residual, total, slopes, at, used)
    is_near = used & _is_near(at)
    area = correlated_area(scatter.grain_px, BLOCK_PX)

    def sum_blocks(values: np.ndarray) -> np.ndarray:
        return _block_sums(values * is_near)

    field_part = of_grains + scatter.field_variance * light_square
    others = area * sum_blocks(field_part) + sum_blocks(of_gains)
    others += (scatter.brightness_sd * sum_blocks(slopes[0])) ** 2
    others += scatter.row_variance * BLOCK_PX * sum_blocks(at.moments.mean_slope**2)
    if scatter.centre_sd:
        share = 1 - 1 / np.bincount(model.design.site).max()  # the centre of the site was fitted to these frames
        others += share * scatter.centre_sd**2 * (sum_blocks(slopes[1]) ** 2 + sum_blocks(slopes[2]) ** 2)
    count = sum_blocks(np.ones(used.shape))
    is_full = count > BLOCK_PX**2 / 2
    frame = np.broadcast_to(np.arange(part.start, part.stop)[:, None, None], count.shape)
    noise = sum_blocks(variance - of_grains)
    arrays = (sum_blocks(residual), noise, others, count, frame)
    return _BlockSums(*(values[is_full] for values in arrays)), score


def _score(
    scatter: FrameScatter,
    residual: np.ndarray,
    variance: np.ndarray,
    slopes: np.ndarray,
    at: Evaluation,
    used: np.ndarray,
) -> float:
    """Return −2 ln p of frames. Rows and deviations of a frame's spot are integrated out, each for itself."""
    weight = np.where(used, 1 / np.where(used, variance, 1.0), 0.0)
    score = float(np.sum(residual**2 * weight) - np.sum(np.log(weight, where=used, out=np.zeros(used.shape))))
    if scatter.row_variance:
        slope = at.moments.mean_slope * used
        gradient = (slope * residual * weight).sum(axis=2)
        information = scatter.row_variance * (slope**2 * weight).sum(axis=2)
        score += float(np.sum(np.log1p(information) - scatter.row_variance * gradient**2 / (1 + information)))
    sd = scatter.frame_sd
    if sd.any():
        # Woodbury: with the deviations d = S e of a frame, e of variance 1.
        scaled = slopes * sd[:, None, None, None]
        gradient = np.einsum("afhw,fhw->fa", scaled, residual * weight)
        information = np.einsum("afhw,bfhw,fhw->fab", scaled, scaled, weight) + np.eye(3)
        score += float(np.sum(np.linalg.slogdet(information)[1]))
        score -= float(np.sum(gradient * np.linalg.solve(information, gradient[:, :, None])[:, :, 0]))
    return score


def _variance_of_grains(model: JointModel, pixels: Pixels, part: slice, variance: np.ndarray) -> np.ndarray | float:
    """Return the part of the variance that fields of the light bring into the distribution of a reading."""
    kept = tuple(applied for applied in model.forward.effects if not is_field(applied))
    if len(kept) == len(model.forward.effects):
        return 0.0
    alone = replace(model, forward=replace(model.forward, effects=kept))
    at = evaluate(alone, pixels, part, with_slopes=False)
    return np.maximum(variance - 1 / np.where(at.weight > 0, at.weight, np.inf), 0.0)


def has_field(model: JointModel) -> bool:
    """Return whether granular light is in the mean image of a model."""
    return any(is_field(applied) for applied in model.forward.effects)


def is_field(applied: AppliedEffect) -> bool:
    """Return whether an effect is granular light alone."""
    steps = applied.effect.variants[applied.variant]
    return bool(steps) and all(isinstance(step, RandomStep) and step.stage is Stage.SPECKLE_FIELD for step in steps)


def _is_near(at: Evaluation) -> np.ndarray:
    """Return which pixels lie within `GAP_RADIUS` of their spot."""
    conditions = at.conditions
    distance = np.hypot(conditions.pixels.x - conditions.x0, conditions.pixels.y - conditions.y0)
    return distance < GAP_RADIUS * conditions.sigma_px


def _block_sums(values: np.ndarray) -> np.ndarray:
    """Return sums over blocks of the crops [frame, block row, block column]."""
    frames, rows, columns = (values.shape[0], *(size // BLOCK_PX for size in values.shape[1:]))
    cut = values[:, : rows * BLOCK_PX, : columns * BLOCK_PX]
    return cut.reshape(frames, rows, BLOCK_PX, columns, BLOCK_PX).sum(axis=(2, 4))
