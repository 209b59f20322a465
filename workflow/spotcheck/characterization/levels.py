"""Levels of flats and darks: mean, temporal noise and fixed pattern of all frames with the same light and exposure.

Flats are frames of uniform light, darks are frames without light. The temporal noise comes from differences of two
frames, so that no fixed pattern counts as noise (EMVA 1288 Release 4.0 Linear, section 8.2). Frames are read one at a
time. Drift is the change of the mean reading from frame to frame, which is more than the noise of pixels explains.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from spotcheck.characterization.noise_curve import BlockNoise, measure_block_noise, measure_pair_correlation
from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import PHOTONS, Frame, parse_number
from spotcheck.errors import InputError
from spotcheck.io import progress
from spotcheck.sensor import SensorModel

# A level is saturated if at least this part of its pixels reads full scale.
SATURATED_PART = 0.5


class PatternVariances(NamedTuple):
    """Variances of the mean image without temporal noise [DN²] (EMVA 1288 Release 4.0 Linear, section 8.3)."""

    total: float  # variance of all pixels; the sum of the other three
    column: float  # variance from column to column
    row: float  # variance from row to row
    pixel: float  # variance of the pixels within columns and rows


@dataclass(frozen=True)
class Level:
    """Statistics of all frames with the same light and exposure."""

    kind: str  # "flat" or "dark"
    exposure_s: float  # exposure [s]; NaN if not given
    photons: float  # mean number of photons per pixel during the exposure; NaN if not given, 0 for darks
    frames: int  # number of frames
    mean: float  # mean reading [DN]
    mean_error: float  # standard error of the mean [DN]; from `measure_level` NaN with a single frame
    variance: float  # temporal variance of a pixel [DN²]; NaN with a single frame
    variance_error: float  # standard error of the temporal variance [DN²]; NaN with a single frame
    at_zero: float  # part of the pixels that read 0
    at_full: float  # part of the pixels that read full scale
    pattern: PatternVariances  # variances of the fixed pattern [DN²]; NaN with a single frame
    shape: tuple[int, int]  # rows and columns of a frame
    noise_range_px: int = 0  # distance over which pixels share noise in the first two frames [px]; 0: they do not
    block_noise: BlockNoise | None = None  # noise of means of pixels in the first two frames; None with a single one

    @property
    def is_saturated(self) -> bool:
        """Whether at least half of the pixels read full scale."""
        return self.at_full >= SATURATED_PART


def measure_levels(dataset: Dataset, full_scale_dn: float) -> list[Level]:
    """Return all levels of the flats and darks of a dataset, darks first, then by exposure and light.

    The list is empty if there are neither. The response curvature that the data sheet gives is corrected in all frames.

    Parameters
    ----------
    dataset : dataset whose frames are read.
    full_scale_dn : largest reading of the converter [DN].
    """
    groups = group_frames(dataset)
    # Unknown exposures and photons (NaN) come first.
    keys = sorted(groups, key=lambda key: (key[0] != "dark", *np.nan_to_num(key[1:], nan=-1.0)))
    sensor = make_linearizing_sensor(dataset, full_scale_dn)
    linear_full_scale_dn = sensor.without_curvature().full_scale_dn
    levels = []
    for key in progress.track(keys, "reading levels of flats and darks"):
        images = (sensor.linearize(frames.read_masked_image(dataset, frame)) for frame in groups[key])
        levels.append(measure_level(images, *key, linear_full_scale_dn))
    return add_common_drift(levels)


def group_frames(dataset: Dataset) -> dict[tuple[str, float, float], list[Frame]]:
    """Return the frames of each level of a dataset by (kind, exposure [s], photons per pixel).

    The kind is "flat" or "dark". Exposure and photons are NaN if not given; the photons of darks are 0.
    """
    groups: dict[tuple[str, float, float], list[Frame]] = {}
    for frame in dataset.frames:
        if frame.kind in ("flat", "dark"):
            # Keys with NaN agree because it is always the same object, `np.nan`.
            exposure_s = np.nan if frame.exposure_s is None else frame.exposure_s
            groups.setdefault((frame.kind, exposure_s, read_photons(frame)), []).append(frame)
    return groups


def make_linearizing_sensor(dataset: Dataset, full_scale_dn: float) -> SensorModel:
    """Return a sensor model whose `linearize` corrects the response curvature of the data sheet.

    The curvature applies above the black level [DN]: that of the data sheet, or the mean of the first dark frame if the
    sheet gives none, or else its default. Gain and read noise of the model are placeholders. `full_scale_dn` is the
    largest reading of the converter [DN].
    """
    black_dn, bend = dataset.instrument.sensor.black_level_dn, dataset.instrument.sensor.response_bend
    dark = next((frame for frame in dataset.frames if frame.kind == "dark"), None)
    if bend and dark is not None and "sensor.black_level_dn" not in dataset.instrument.given_keys:
        black_dn = float(np.nanmean(frames.read_masked_image(dataset, dark)))
    return SensorModel(
        gain_dn_per_e=1.0, read_noise_e=0.0, black_level_dn=black_dn, full_scale_dn=full_scale_dn, response_bend=bend
    )


def list_response_remarks(dataset: Dataset) -> list[str]:
    """Return a remark that the response curvature of the data sheet is corrected; empty if it gives none."""
    bend, source = dataset.instrument.sensor.response_bend, dataset.instrument.get_source("sensor.response_bend")
    return [f"all readings are corrected for the response curvature of {bend:g} ({source})"] if bend else []


def add_common_drift(levels: list[Level]) -> list[Level]:
    """Return levels, darks first, whose standard errors of the mean include the drift from frame to frame.

    The drift of a level cannot be determined from two frames. The variance of the drift is therefore averaged over all
    unsaturated levels of a kind: in DN² for darks, and for flats after division by the squared mean reading, as the
    drift of a lamp is proportional to its light. If no level of a kind has several frames, its drift counts as 0. The
    error of a level with a single frame is then 0, although it is unknown. `mean_error` of the given levels is that of
    `measure_level`.
    """
    updated_levels = []
    for kind in ("dark", "flat"):
        same_kind = [level for level in levels if level.kind == kind]
        # Variance of the mean of one frame over the square of the drift scale. A saturated level shows no drift.
        frame_variances = [
            (level.mean_error / _get_drift_scale(level)) ** 2 * level.frames
            for level in same_kind
            if level.frames > 1 and not level.is_saturated
        ]
        frame_variance = float(np.mean(frame_variances)) if frame_variances else 0.0
        for level in same_kind:
            noise_variance = np.nan_to_num(level.variance) / (level.frames * level.shape[0] * level.shape[1])
            drift_variance = 0.0 if level.is_saturated else frame_variance * _get_drift_scale(level) ** 2 / level.frames
            # The larger variance, not the sum: the scatter of frame means already contains the noise of pixels.
            updated_levels.append(replace(level, mean_error=float(np.sqrt(max(noise_variance, drift_variance)))))
    return updated_levels


def collect_field(levels: Sequence[Level], field: str) -> np.ndarray:
    """Return a numeric field of each level as an array [level], in the unit of the field."""
    return np.array([getattr(level, field) for level in levels], float)


def measure_light(flats: Sequence[Level]) -> np.ndarray:
    """Return a quantity that is proportional to the light of each flat [flat].

    It is the number of photons if all flats give one and not all are 0, otherwise the exposure [s].
    """
    photons = collect_field(flats, "photons")
    return photons if np.isfinite(photons).all() and photons.any() else collect_field(flats, "exposure_s")


def _get_drift_scale(level: Level) -> float:
    """Return the scale to which the drift of a level is proportional: the mean reading [DN] of a flat, 1 for a dark.

    The mean reading of a flat approximates its light; the dark offset that it includes is neglected.
    """
    return level.mean if level.kind == "flat" else 1.0


def read_photons(frame: Frame) -> float:
    """Return the mean photons per pixel that the manifest gives for a frame; NaN if it gives none, 0 for a dark.

    Raises
    ------
    InputError
        The cell is not a finite number of at least 0.
    """
    if frame.kind == "dark":
        return 0.0
    # `extra` has the texts of the additional columns of the manifest.
    text = (frame.extra.get(PHOTONS) or "").strip()
    if not text:
        return np.nan
    photons = parse_number(text)
    if photons is None or photons < 0:
        raise InputError(f"manifest.csv: {frame.label}: {PHOTONS} is {text!r}; it must be a number, 0 or more")
    return photons


def measure_level(
    images: Iterable[np.ndarray], kind: str, exposure_s: float, photons: float, full_scale_dn: float
) -> Level:
    """Return the statistics of the frames of one level, of which two are held in memory.

    Frames form consecutive pairs, from which noise and pattern are estimated. The last one of an odd number contributes
    to the mean only. The error of the mean is the scatter of the means of frames, see `add_common_drift`.

    Parameters
    ----------
    images : frames [rows, columns] in DN, at least one; NaN where a pixel is bad.
    kind, exposure_s, photons : the fields of `Level`.
    full_scale_dn : reading from which a pixel counts as saturated [DN].
    """
    means, row_variances, patterns = list[float](), list[np.ndarray](), list[PatternVariances]()
    pixels_at_zero = pixels_at_full = pixels = 0
    previous, noise_range_px, block_noise = np.zeros((0, 0)), 0, None
    for index, frame in enumerate(images):
        image = frame.astype(float)
        means.append(float(np.nanmean(image)))
        pixels_at_zero += int(np.count_nonzero(image <= 0))
        pixels_at_full += int(np.count_nonzero(image >= full_scale_dn))
        pixels += int(np.count_nonzero(~np.isnan(image)))
        if index % 2:
            row_variances.append(estimate_row_variances(previous, image))
            patterns.append(estimate_pattern_variances(previous, image))
        if index == 1:
            noise_range_px = measure_pair_correlation(previous, image).range_px
            block_noise = measure_block_noise(image - previous)
        previous = image
    variance = variance_error = mean_error = np.nan
    pattern = PatternVariances(*[np.nan] * len(PatternVariances._fields))
    if len(means) > 1:
        # Rows of all pairs give independent estimates, whose scatter gives the error.
        pooled = np.concatenate(row_variances)
        variance, variance_error = float(pooled.mean()), float(pooled.std(ddof=1) / np.sqrt(max(pooled.size, 2)))
        mean_error = float(np.std(means, ddof=1) / np.sqrt(len(means)))
        pattern = PatternVariances(*np.mean(patterns, axis=0).tolist())
    return Level(
        kind=kind,
        exposure_s=exposure_s,
        photons=photons,
        frames=len(means),
        mean=float(np.mean(means)),
        mean_error=mean_error,
        variance=variance,
        variance_error=variance_error,
        at_zero=pixels_at_zero / pixels,
        at_full=pixels_at_full / pixels,
        pattern=pattern,
        shape=(previous.shape[0], previous.shape[1]),
        noise_range_px=noise_range_px,
        block_noise=block_noise,
    )


def estimate_row_variances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the temporal variance [DN²] of each row [row] from two frames [rows, columns] of equal light.

    It is half of the variance of their difference. The mean difference is subtracted, since a lamp may drift between
    the frames. NaN pixels do not count, and rows without any other pixel are left out.
    """
    difference = first - second
    variances = frames.average_good_pixels((difference - np.nanmean(difference)) ** 2, axis=1) / 2
    return variances[~np.isnan(variances)]


def estimate_pattern_variances(first: np.ndarray, second: np.ndarray) -> PatternVariances:
    """Return the variances of the fixed pattern from the covariance of two frames [rows, columns] of equal light.

    The covariance contains no temporal noise, not even noise of whole rows. Means of columns and rows contain part of
    the pixel pattern. The variances of columns, rows and pixels are therefore solved for with
    s² = s²_column + s²_row + s²_pixel (EMVA 1288 Release 4.0 Linear, section 8.3). NaN pixels do not count. For frames
    of a single row or column, and of 2 × 2 pixels, all but the total are NaN.
    """
    first, second = first - np.nanmean(first), second - np.nanmean(second)
    rows, columns = first.shape
    total = float(np.nanmean(first * second))
    # Covariances of the means of columns (over axis 0) and of rows.
    column_covariance, row_covariance = (
        float(np.nanmean(frames.average_good_pixels(first, axis) * frames.average_good_pixels(second, axis)))
        for axis in (0, 1)
    )
    pixels = rows * columns
    # The determinant of the linear equations of the three variances, apart from a factor.
    scale = pixels - rows - columns
    if scale <= 0:
        return PatternVariances(total, np.nan, np.nan, np.nan)
    column = (pixels - rows) / scale * column_covariance - columns / scale * (total - row_covariance)
    row = (pixels - columns) / scale * row_covariance - rows / scale * (total - column_covariance)
    pixel = pixels / scale * (total - column_covariance - row_covariance)
    return PatternVariances(total, column, row, pixel)
