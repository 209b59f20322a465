"""Noise of dark pixels: variance beyond the model's, and covariances of rows, columns and neighbours.

Products of residuals that share no noise estimate a covariance. A reading is cut at 0, so that it shows only a part of
the noise before the cut: its mean follows that noise with a slope below 1. Covariances of residuals are divided by
those of the slopes, which gives covariances of the signal before rounding and the cut.

`ResidualImages` has images [frame, row, column]: the `residual` [DN], its `weight`, 1/variance, the `slope` of the mean
reading by the light, and which pixels are dark (`is_dark`, beyond 5 σ of the spot). A line is a row or a column.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.evaluation import LEAST_VARIANCE
from spotcheck.discrepancy.joint_fit import JointModel
from spotcheck.discrepancy.residuals import ResidualImages
from spotcheck.model.forward import ForwardModel

# Fewest dark pixels from which their noise is estimated.
FEWEST_DARK = 5000
# Length of the blocks into which a row or column of pixels is divided [px]. Products of blocks that touch are left out,
# so that light or noise that neighbouring pixels share does not count as common to the row.
BLOCK_PX = 8
# Frames from which on only the scatter over frames gives errors; with fewer frames the scatter over rows or columns
# counts as well.
MANY_FRAMES = 10
# Step of differences of dark readings, by their noise and by light, relative to the read noise.
NOISE_STEP = 0.01


@dataclass(frozen=True)
class Moment:
    """A variance or covariance of dark signals."""

    value: float  # [DN²]
    stderr: float  # standard error [DN²]; NaN if unknown


@dataclass(frozen=True)
class DarkSlopes:
    """Derivatives of mean and variance of a dark reading by the variance of the read noise [DN²] and by light [DN].

    The mean follows the noise because readings are cut at 0.
    """

    variance_by_noise: float  # [1]; 0 if readings do not show the noise
    mean_by_noise: float  # [1/DN]
    variance_by_light: float  # [DN]
    mean_by_light: float  # [1]

    @property
    def variance_by_mean(self) -> float:
        """Increase of the variance with light that raises the mean by 1 DN [DN]."""
        return self.variance_by_light / self.mean_by_light

    @property
    def excess_by_noise(self) -> float:
        """Increase of the variance with the noise, beyond that with light that raises the mean as much [1]."""
        return self.variance_by_noise - self.variance_by_mean * self.mean_by_noise


@dataclass(frozen=True)
class DarkNoise:
    """Noise of the signal of dark pixels, before rounding and the cut at 0."""

    white: Moment  # variance of single pixels beyond the model's, without what rows, columns and smooth light share
    row: Moment  # variance of an offset that a row of a frame shares
    column: Moment  # variance of an offset that a column of a frame shares
    next_row: Moment  # covariance of the offsets of neighbouring rows of a frame
    same_row: Moment  # covariance of the offsets of the same row in different frames; its error is not known
    neighbour: Moment  # covariance of neighbours in a row


def measure_dark_noise(images: ResidualImages, slopes: DarkSlopes) -> DarkNoise | None:
    """Return the noise of dark pixels; None if there are too few, or if their readings do not depend on their noise.

    Parameters
    ----------
    images : ResidualImages
        Residuals of a fit.
    slopes : DarkSlopes
        Derivatives of dark readings under the model of the fit.
    """
    dark = images.is_dark
    if dark.sum() < FEWEST_DARK or slopes.variance_by_noise == 0:
        return None
    # Covariance of readings = covariance of signals × product of slopes.
    readings, visible = _multiply_lines(images.residual, dark), _multiply_lines(images.slope, dark)
    same_row, same_row_visible = (
        float((sums.sum(axis=0) ** 2 - (sums**2).sum(axis=0)).sum()) for sums in (readings.row_sums, visible.row_sums)
    )
    moments = {name: ratio_moment(getattr(readings, name), getattr(visible, name))
               for name in ("row", "column", "next_row", "neighbour")}  # fmt: skip
    same = Moment(same_row / max(same_row_visible, 1e-300), np.nan)
    return DarkNoise(white=_white_moment(images, slopes), same_row=same, **moments)


def measure_dark_slopes(forward: ForwardModel) -> DarkSlopes:
    """Return the derivatives of mean and variance of dark readings by the read noise's variance and by the light.

    All are 0 if the variance of a dark reading is below the floor of the fit, `LEAST_VARIANCE`.
    """
    sensor, distribution = forward.sensor, forward.distribution()
    if distribution.variance(0.0) < LEAST_VARIANCE:
        return DarkSlopes(0.0, 0.0, 0.0, 0.0)
    noises = [sensor.read_noise_e * (1 + shift) for shift in (-NOISE_STEP, NOISE_STEP)]
    low, high = (replace(forward, sensor=replace(sensor, read_noise_e=noise)).distribution() for noise in noises)
    noise_step = sensor.gain_dn_per_e**2 * (noises[1] ** 2 - noises[0] ** 2)
    light_step = NOISE_STEP * distribution.noise_dn
    return DarkSlopes(
        variance_by_noise=float(high.variance(0.0) - low.variance(0.0)) / noise_step,
        mean_by_noise=float(high.mean(0.0) - low.mean(0.0)) / noise_step,
        variance_by_light=float(distribution.variance(light_step) - distribution.variance(0.0)) / light_step,
        mean_by_light=float(distribution.mean(light_step) - distribution.mean(0.0)) / light_step,
    )


def propagate_to_noise(model: JointModel, covariance: np.ndarray) -> float:
    """Return the variance that errors of fitted parameters cause in the white noise of dark pixels [DN⁴].

    A clip at black, for example, hides a part of the noise, which depends on its threshold. The read noise itself is
    no such parameter: its value in the model cancels in the noise that is found.

    Parameters
    ----------
    model : JointModel
        Model of the fit.
    covariance : array [fitted, fitted]
        Covariance of its fitted parameters of sensor and effects.
    """
    slopes = measure_dark_slopes(model.forward)
    if slopes.variance_by_noise == 0:
        return 0.0
    stderr = np.sqrt(np.diag(covariance))
    changes = np.zeros(len(stderr))  # change of the noise's variance by one standard error of each parameter [DN²]
    for k, parameter in enumerate(model.free):
        # Readings do not depend on a parameter whose error is infinite.
        if parameter.name == "read_noise_e" or not np.isfinite(stderr[k]):
            continue
        value = model.value_of(parameter)
        low, high = (model.with_value(parameter, value + sign * stderr[k]).forward.distribution() for sign in (-1, 1))
        excess = [float(side.variance(0.0) - slopes.variance_by_mean * side.mean(0.0)) for side in (low, high)]
        changes[k] = (excess[1] - excess[0]) / 2 / slopes.excess_by_noise
    used = changes != 0
    correlation = covariance[np.ix_(used, used)] / np.outer(stderr[used], stderr[used])
    return float(changes[used] @ correlation @ changes[used])


class LineProducts(NamedTuple):
    """Sums of products of dark pixels in each row or column of each frame."""

    row: np.ndarray  # of blocks of a row that do not touch [frame, row]
    column: np.ndarray  # of blocks of a column that do not touch [frame, column]
    next_row: np.ndarray  # of the sums of a row and the next one [frame, row − 1]
    neighbour: np.ndarray  # of neighbours in a row [frame, row]
    row_sums: np.ndarray  # sums over a row, without products [frame, row]


def _multiply_lines(values: np.ndarray, is_dark: np.ndarray) -> LineProducts:
    """Return sums of products of the dark pixels of images [frame, row, column]."""
    frames = []
    # Frame by frame, to save memory.
    for image, dark in zip(values, is_dark, strict=True):
        image = image * dark
        rows = _block_sums(image)
        row_sums = rows.sum(axis=1)
        neighbours = (image[:, 1:].astype(float) * image[:, :-1]).sum(axis=1)
        columns = _far_products(_block_sums(image.T))
        frames.append((_far_products(rows), columns, row_sums[1:] * row_sums[:-1], neighbours, row_sums))
    return LineProducts(*map(np.array, zip(*frames, strict=True)))


def _white_moment(images: ResidualImages, slopes: DarkSlopes) -> Moment:
    """Return the variance of single pixels beyond the model's, from second differences of 2 × 2 neighbours.

    These share no rows, no columns and no slope of the mean image. Light that the model lacks adds variance as well.
    The mean residual shows that light and is used to subtract its variance; the noise that is sought also shifts the
    mean, which the divisor takes into account.
    """
    rows_of_frames = []
    for residual, weight, dark in zip(images.residual, images.weight, images.is_dark, strict=True):
        # Even rows and the odd rows below them.
        upper, lower = np.s_[: len(dark) // 2 * 2 : 2], np.s_[1::2]
        variance = 1 / np.where(dark, weight, 1.0).astype(float) + slopes.variance_by_mean * residual
        differences, variances = residual[upper].astype(float) - residual[lower], variance[upper] + variance[lower]
        both_dark = dark[upper] & dark[lower]
        used = both_dark[:, 1:] & both_dark[:, :-1]
        second_differences = differences[:, 1:] - differences[:, :-1]
        excess = np.where(used, second_differences**2 - variances[:, 1:] - variances[:, :-1], 0.0)
        rows_of_frames.append((excess.sum(axis=1), used.sum(axis=1)))
    excess, count = (np.array(rows) for rows in zip(*rows_of_frames, strict=True))
    # Four pixels contribute their variance to each second difference.
    return ratio_moment(excess, 4 * slopes.excess_by_noise * count)


def ratio_moment(products: np.ndarray, visible: np.ndarray) -> Moment:
    """Return Σ products / Σ visible with its standard error.

    Parameters
    ----------
    products : array [frame, line]
        Sums of products of residuals in each line of pixels [DN²].
    visible : array [frame, line]
        Part of the moment that readings show, times the number of products [1]: for covariances, the same sums of
        products with slopes in place of residuals.

    Returns
    -------
    Moment
        Its error comes from the scatter over frames; with few frames it is at least that from the scatter over lines.
        The value has no meaning if Σ visible is 0.
    """
    total = max(float(visible.sum()), 1e-300)
    value = float(products.sum()) / total
    influence = (products - value * visible) / total
    frames = len(influence)
    frame_influence = influence.sum(axis=1)
    over_frames = np.sqrt(np.sum(frame_influence**2) * frames / max(frames - 1, 1)) if frames > 1 else 0.0
    over_lines = 0.0 if frames >= MANY_FRAMES else np.sqrt(np.sum(influence**2))
    return Moment(value, float(max(over_frames, over_lines)))


def _block_sums(lines: np.ndarray) -> np.ndarray:
    """Return sums [line, block] over blocks of `BLOCK_PX` pixels of lines [line, pixel]; a remainder is left out."""
    blocks = lines.shape[1] // BLOCK_PX
    return lines[:, : blocks * BLOCK_PX].reshape(len(lines), blocks, BLOCK_PX).sum(axis=2, dtype=float)


def _far_products(sums: np.ndarray) -> np.ndarray:
    """Return twice the sum of products of blocks that do not touch [line], from the sums of blocks [line, block]."""
    touching = (sums[:, 1:] * sums[:, :-1]).sum(axis=1)
    return sums.sum(axis=1) ** 2 - (sums**2).sum(axis=1) - 2 * touching
