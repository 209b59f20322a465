"""Flats and darks, level by level: mean, noise and pattern of all frames that saw the same light for the same time.

Noise in time comes from differences of two frames, so that no pattern of the sensor or the light counts as noise
(EMVA 1288 Release 4.0 Linear, section 8.2). Frames are read one pair at a time.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import PHOTONS, Frame
from spotcheck.errors import InputError
from spotcheck.io import progress
from spotcheck.sensor import SensorModel

# A level of which this part of the pixels reads full scale is saturated.
FULL = 0.5


class Spatial(NamedTuple):
    """Variances of the mean image [DN²], noise in time taken off: of all pixels, and split into columns, rows and
    single pixels (EMVA 1288 Release 4.0 Linear, section 8.3)."""

    total: float
    column: float
    row: float
    pixel: float


class Level(NamedTuple):
    """One light and one exposure: kind (`flat`, `dark`), exposure [s], photons per pixel (NaN: not given), number of
    frames; mean [DN] and variance in time [DN²] with standard errors (variance NaN with a single frame); parts of the
    pixels that read 0 and full scale; variances of the pattern; rows and columns."""

    kind: str
    exposure_s: float
    photons: float
    frames: int
    mean: float
    mean_error: float
    variance: float
    variance_error: float
    at_zero: float
    at_full: float
    spatial: Spatial
    shape: tuple[int, int]


def levels_of(dataset: Dataset, full_scale_dn: float) -> list[Level]:
    """All levels of a dataset, darks first, by exposure and light; readings end at `full_scale_dn`. What the data sheet
    says of the response is turned round."""
    groups: dict[tuple[str, float, float], list[Frame]] = {}
    for frame in dataset.frames:
        if frame.kind in ("flat", "dark"):
            exposure = np.nan if frame.exposure_s is None else frame.exposure_s
            groups.setdefault((frame.kind, exposure, photons_of(frame)), []).append(frame)
    ordered = sorted(groups, key=lambda key: tuple(-1.0 if k != k else k for k in key[1:]))
    ordered.sort(key=lambda key: key[0] != "dark")
    sensor = straightening(dataset, full_scale_dn)
    read = {key: (sensor.linearize(frames.read_masked_image(dataset, own)) for own in groups[key]) for key in ordered}
    levels = progress.track(list(read.items()), "reading levels of flats and darks")
    return with_common_drift(
        [level_of(images, *key, sensor.without_curvature().full_scale_dn) for key, images in levels]
    )


def straightening(dataset: Dataset, full_scale_dn: float) -> SensorModel:
    """A sensor that turns round what the data sheet says of the response. It bends what lies above black, which a dark
    frame shows where the sheet does not say it."""
    own = dataset.instrument.sensor
    black, dark = own.black_level_dn, next((frame for frame in dataset.frames if frame.kind == "dark"), None)
    if own.response_bend and dark is not None and "sensor.black_level_dn" not in dataset.instrument.given_keys:
        black = float(np.nanmean(frames.read_masked_image(dataset, dark)))
    return SensorModel(1.0, 0.0, black_level_dn=black, full_scale_dn=full_scale_dn, response_bend=own.response_bend)


def on_response(dataset: Dataset) -> list[str]:
    """A remark on a response that the data sheet says to bend."""
    bend, source = dataset.instrument.sensor.response_bend, dataset.instrument.get_source("sensor.response_bend")
    return [f"the bend of the response, {bend:g} by {source}, is turned round before anything else"] if bend else []


def with_common_drift(levels: list[Level]) -> list[Level]:
    """Standard errors of the means with what lamp and offset drift from frame to frame: two frames hardly tell it, so
    all levels of a kind do together, flats as a part of their light."""
    out = []
    for kind in ("dark", "flat"):
        own = [level for level in levels if level.kind == kind]
        size = np.array([level.mean if kind == "flat" else 1.0 for level in own])
        # Where all pixels are at the end of the converter, nothing drifts.
        told = [k for k, level in enumerate(own) if level.frames > 1 and level.at_full < FULL]
        common = float(np.mean([(own[k].mean_error / size[k]) ** 2 * own[k].frames for k in told])) if told else 0.0
        for level, scale in zip(own, size, strict=True):
            noise = np.nan_to_num(level.variance) / (level.frames * level.shape[0] * level.shape[1])
            drift = common * scale**2 / level.frames if level.at_full < FULL else 0.0
            out.append(level._replace(mean_error=float(np.sqrt(max(noise, drift)))))
    return out


def photons_of(frame: Frame) -> float:
    """Photons per pixel of a flat; NaN where they are not given, 0 for a dark."""
    if frame.kind == "dark":
        return 0.0
    text = (frame.extra.get(PHOTONS) or "").strip()
    if not text:
        return np.nan
    try:
        photons = float(text)
    except ValueError:
        photons = -1.0
    if not (np.isfinite(photons) and photons >= 0):
        raise InputError(f"manifest.csv: {frame.label}: {PHOTONS} is {text!r}; it must be a number, 0 or more")
    return photons


def level_of(images: Iterable[np.ndarray], kind: str, exposure_s: float, photons: float, full_scale_dn: float) -> Level:
    """Statistics of the images of one level, two at a time; of an odd number the last one counts for the mean alone."""
    before: np.ndarray | None = None
    rows_of_squares: list[np.ndarray] = []
    patterns: list[Spatial] = []
    means: list[float] = []
    zeros = full = pixels = 0
    shape = (0, 0)
    for number, frame in enumerate(images):
        image = frame.astype(float)
        shape = (image.shape[0], image.shape[1])
        means.append(float(np.nanmean(image)))
        zeros += int(np.count_nonzero(image <= 0))
        full += int(np.count_nonzero(image >= full_scale_dn))
        pixels += int(np.count_nonzero(~np.isnan(image)))
        if number % 2 and before is not None:
            rows_of_squares.append(variance_by_row(before, image))
            patterns.append(pattern_of(before, image))
        before = image
    variance = error = np.nan
    if rows_of_squares:
        rows = np.concatenate(rows_of_squares)
        variance, error = float(rows.mean()), float(rows.std(ddof=1) / np.sqrt(max(rows.size, 2)))
    mean_error = float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else np.nan
    pattern = Spatial(*np.mean(patterns, axis=0).tolist()) if patterns else Spatial(*[np.nan] * 4)
    return Level(kind, exposure_s, photons, len(means), float(np.mean(means)), mean_error, variance, error,
                 zeros / pixels, full / pixels, pattern, shape)  # fmt: skip


def variance_by_row(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Variance in time [DN²] by row of two frames of equal light: half of that of their difference, without what a
    lamp drifts between them. Pixels that are NaN do not count, nor do rows of nothing else."""
    difference = first - second
    rows = frames.average_good_pixels((difference - np.nanmean(difference)) ** 2, axis=1) / 2
    return rows[~np.isnan(rows)]


def pattern_of(first: np.ndarray, second: np.ndarray) -> Spatial:
    """Variances of what two frames share: their covariance holds no noise in time, not even that of whole rows.

    Column and row means hold part of the pixels' own pattern; the three are solved for, s² = s²_col + s²_row + s²_pix.
    Pixels that are NaN do not count.
    """
    a, b = first - np.nanmean(first), second - np.nanmean(second)
    rows, columns = a.shape
    total = float(np.nanmean(a * b))
    of_columns, of_rows = (
        float(np.nanmean(frames.average_good_pixels(a, k) * frames.average_good_pixels(b, k))) for k in (0, 1)
    )
    rest = rows * columns - rows - columns
    if rest <= 0:
        return Spatial(total, np.nan, np.nan, np.nan)
    column = (rows * columns - rows) / rest * of_columns - columns / rest * (total - of_rows)
    row = (rows * columns - columns) / rest * of_rows - rows / rest * (total - of_columns)
    pixel = rows * columns / rest * (total - of_columns - of_rows)
    return Spatial(total, column, row, pixel)
