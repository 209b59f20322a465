"""Maps of offset and gain of a sensor's pixels from its darks and flats, with their standard errors.

Flats are frames of uniform light, darks are frames without light. A level is all flats or darks of one light and one
exposure. The frames of each level are assigned alternately to two halves. The halves share the pattern of the sensor
but no noise, so their covariance is the variance of the pattern, and their difference is the noise. Each pixel is then
shrunk towards the mean of all pixels by the part of its variance that is noise (Wiener filter): maps from few frames
add no noise if the pixels are alike.

# ASSUME: offsets are linear in exposure (dark current), and the noise is the same in all pixels. The unevenness of the
light of flats is a polynomial of the fourth degree over the frame; finer structure is that of the sensor.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.polynomial import legendre

from spotcheck.characterization.derived_quantities import MAX_PART_AT_ZERO
from spotcheck.characterization.levels import group_frames
from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame
from spotcheck.sensor.pixel_maps import PixelMaps

# Flats are used if this quantile of their readings is below this part of full scale: brighter ones may be nonlinear or
# clipped.
FLAT_QUANTILE, MAX_FLAT_LEVEL = 0.999, 0.7
# Least sum of squares of exposures [s²] in a divisor.
MIN_SQUARE_S2 = 1e-300
# A pixel that deviates from the mean by this number of standard deviations, as hot ones do, is not shrunk. A standard
# deviation is this multiple of the median absolute deviation, as in a normal distribution.
OUTLIER_SD, MAD_TO_SIGMA = 6.0, 1.4826
# Degree of the polynomial for the unevenness of light, and number of blocks along the shorter side to which it is
# fitted.
DEGREE, BLOCKS = 4, 32
# True for the terms of the polynomial [degree in y, degree in x], whose degrees sum to at most `DEGREE`.
IS_TERM = np.add.outer(np.arange(DEGREE + 1), np.arange(DEGREE + 1)) <= DEGREE

# Map → (unit, meaning).
MAPS = {
    "offset": ("DN", "how far each pixel reads above all on average, at the mean exposure of the darks"),
    "slope": ("DN/s", "by how much that grows with exposure"),
    "gain": ("1", "how much more of the light than the average each pixel turns into electrons"),
}


class MapEstimate(NamedTuple):
    """A map of deviations of the pixels from their mean, in the unit that `MAPS` gives for the map."""

    values: np.ndarray  # deviation of each pixel [rows, columns]; NaN if unknown
    stderr: float  # standard error of the deviation of one pixel
    rms: float  # standard deviation of the pixels, without noise


@dataclass(frozen=True)
class SensorMaps:
    """Maps of the pixels of a sensor."""

    offset: MapEstimate  # offset of each pixel from the mean of all, at `exposure_s` [DN]
    slope: MapEstimate | None  # derivative of the offset by exposure [DN/s]; None without different exposures
    exposure_s: float  # mean exposure of the darks [s]; NaN if unknown
    gain: MapEstimate | None  # relative gain less 1; None without usable flats
    darks: int  # number of darks used
    flats: int  # number of flats used

    def at(self, exposure_s: float | None) -> PixelMaps:
        """Return offsets [DN] and relative gains of the pixels at an exposure [s]; None means that of the darks."""
        offset, variance = self.offset.values, self.offset.stderr**2
        longer_s = 0.0 if exposure_s is None else exposure_s - self.exposure_s
        if self.slope is not None and np.isfinite(longer_s):
            offset = offset + longer_s * self.slope.values
            variance = variance + (longer_s * self.slope.stderr) ** 2
        stderr = float(np.sqrt(variance))
        if self.gain is None:
            # All pixels are alike; a pixel without an offset stays unknown.
            return PixelMaps(offset, gain=np.where(np.isnan(offset), np.nan, 1.0), offset_stderr_dn=stderr)
        return PixelMaps(offset, 1 + self.gain.values, offset_stderr_dn=stderr, gain_stderr=self.gain.stderr)


def measure_maps(dataset: Dataset, full_scale_dn: float) -> SensorMaps | str:
    """Return the maps from darks and flats of a dataset, or the reason why there are none, as a clause.

    Frames are read one at a time. `full_scale_dn` is the largest reading of the converter [DN].
    """
    # Each half is a list of frames.
    halves = _split_in_halves(dataset, "dark")
    if not halves[0]:
        return "there are no two darks of one exposure"
    # Both halves have the same exposures. The slope of a pixel's line over exposure is the sum of its readings times
    # `slope_weights` [1/s], all 0 without different exposures.
    exposures_s = np.array([np.nan if frame.exposure_s is None else frame.exposure_s for frame in halves[0]])
    deviations_s = exposures_s - exposures_s.mean() if np.isfinite(exposures_s).all() else np.zeros(len(exposures_s))
    slope_weights = deviations_s / max(float(deviations_s @ deviations_s), MIN_SQUARE_S2)
    # Mean image and image of slopes of each half, and counts of pixels over all frames.
    means, slopes, pixels_at_zero, pixels = [], [], 0, 0
    for half in halves:
        mean = slope = np.zeros(1)
        for frame, weight in zip(half, slope_weights, strict=True):
            image = frames.read_masked_image(dataset, frame).astype(float)
            pixels_at_zero += int(np.count_nonzero(image <= 0))
            pixels += int(np.isfinite(image).sum())
            mean, slope = mean + image / len(half), slope + weight * image
        means.append(mean)
        slopes.append(slope)
    if pixels_at_zero > MAX_PART_AT_ZERO * pixels:
        return f"{100 * pixels_at_zero / pixels:.1f} % of the darks' pixels read 0, so that their offsets are not known"
    maps = SensorMaps(
        offset=shrink_to_mean(*(mean - np.nanmean(mean) for mean in means)),
        slope=shrink_to_mean(*(slope - np.nanmean(slope) for slope in slopes)) if deviations_s.any() else None,
        exposure_s=float(exposures_s.mean()),
        gain=None,
        darks=2 * len(halves[0]),
        flats=0,
    )
    return _add_gain(maps, dataset, full_scale_dn, float(np.nanmean(means)), float(np.nanmean(slopes)))


def _split_in_halves(dataset: Dataset, kind: str) -> tuple[list[Frame], list[Frame]]:
    """Return the frames of a kind ("dark" or "flat") in two halves, whose frames agree pairwise in light and exposure.

    The last frame of an odd number in a level is left out.
    """
    levels = [level_frames for (level_kind, *_), level_frames in group_frames(dataset).items() if level_kind == kind]
    pairs = [pair for level_frames in levels for pair in zip(level_frames[::2], level_frames[1::2], strict=False)]
    return [first for first, _ in pairs], [second for _, second in pairs]


def _add_gain(
    maps: SensorMaps, dataset: Dataset, full_scale_dn: float, dark_level_dn: float, dark_slope_dn_per_s: float
) -> SensorMaps:
    """Return maps with the gain from the flats of a dataset; unchanged if no flats are usable.

    The mean over all pixels of a dark is `dark_level_dn` at the exposure of the maps, and grows by
    `dark_slope_dn_per_s` [DN/s]. `full_scale_dn` is the largest reading of the converter [DN].
    """

    def subtract_dark(image: np.ndarray, exposure_s: float | None) -> np.ndarray:
        """Return an image [rows, columns] of an exposure [s] (None: that of the darks) without its dark level [DN]."""
        longer_s = 0.0 if exposure_s is None or maps.slope is None else exposure_s - maps.exposure_s
        return image - (maps.at(exposure_s).offset_dn + dark_level_dn + longer_s * dark_slope_dn_per_s)

    # Sums of the usable flats of both halves.
    totals, flat_count = [np.zeros(1), np.zeros(1)], 0
    for pair in zip(*_split_in_halves(dataset, "flat"), strict=True):
        images = [frames.read_masked_image(dataset, frame).astype(float) for frame in pair]
        highest_dn = max(float(np.nanquantile(image, FLAT_QUANTILE)) for image in images)
        if highest_dn < MAX_FLAT_LEVEL * full_scale_dn:
            flat_count += 2
            totals = [
                total + subtract_dark(image, frame.exposure_s)
                for total, image, frame in zip(totals, images, pair, strict=True)
            ]
    if not flat_count:
        return maps
    # The light that both sums share. A polynomial that is 0 or negative somewhere cannot divide them.
    light = fit_light(totals[0] + totals[1]) / 2
    if not (light > 0).all():
        return maps
    ratios = [total / light for total in totals]
    gain = shrink_to_mean(*(ratio / np.nanmean(ratio) - 1 for ratio in ratios))
    return replace(maps, gain=gain, flats=flat_count)


def shrink_to_mean(first: np.ndarray, second: np.ndarray) -> MapEstimate:
    """Return the map that two halves share, shrunk towards 0 by a Wiener filter.

    Let s² be the variance of the pattern (covariance of the halves) and v that of the noise of the mean of the halves.
    The mean of the halves is multiplied by w = s²/(s² + v); the result has the standard error √(w v). Outliers beyond
    `OUTLIER_SD` are kept as they are.

    Parameters
    ----------
    first, second : maps of the two halves [rows, columns], with the mean 0; NaN where a pixel is unknown.
    """
    mean, half_difference = (first + second) / 2, (first - second) / 2
    scatter = MAD_TO_SIGMA * float(np.nanmedian(np.abs(mean)))
    is_outlier = np.abs(mean) > OUTLIER_SD * scatter if scatter > 0 else np.zeros(mean.shape, bool)
    is_inlier = np.isfinite(mean) & ~is_outlier
    noise_variance = float(np.mean(half_difference[is_inlier] ** 2))
    pattern_variance = max(float(np.mean((first * second)[is_inlier])), 0.0)
    factor = pattern_variance / (pattern_variance + noise_variance) if pattern_variance > 0 else 0.0
    values = np.where(is_outlier, mean, factor * mean)
    return MapEstimate(values, float(np.sqrt(factor * noise_variance)), float(np.sqrt(pattern_variance)))


def fit_light(image: np.ndarray) -> np.ndarray:
    """Return the least-squares polynomial of degree `DEGREE` through an image [rows, columns], at all of its pixels.

    It is fitted to the means of blocks. NaN pixels do not count.
    """
    side = max(1, min(image.shape) // BLOCKS)
    blocks = frames.average_blocks(image, side)
    is_known = np.isfinite(blocks)
    # Centres of the blocks and of the pixels along y and x; each side of the frame is scaled to −1 … 1.
    block_y, block_x = (side * (2 * np.arange(count) + 1) / length - 1
                        for count, length in zip(blocks.shape, image.shape, strict=True))  # fmt: skip
    y, x = ((2 * np.arange(length) + 1) / length - 1 for length in image.shape)
    down, right = np.meshgrid(block_y, block_x, indexing="ij")
    design = legendre.legvander2d(down, right, [DEGREE, DEGREE])[is_known]
    coefficients = np.zeros(IS_TERM.shape)
    coefficients[IS_TERM] = np.linalg.lstsq(design[:, IS_TERM.ravel()], blocks[is_known])[0]
    return legendre.leggrid2d(y, x, coefficients)


def build_maps_dataset(maps: SensorMaps | str, title: str, name: str) -> xr.Dataset:
    """Return the content of maps.nc, with title and folder name of the dataset.

    If `maps` is the reason why there are none, it is stored in the attribute `skipped`.
    """
    ds = xr.Dataset(attrs={"title": title, "dataset": name})
    if isinstance(maps, str):
        return ds.assign_attrs(skipped=maps)
    for key, (units, long_name) in MAPS.items():
        estimate: MapEstimate | None = getattr(maps, key)
        if estimate is None:
            continue
        ds[key] = (("row", "column"), estimate.values.astype("f4"), {"units": units, "long_name": long_name})
        for suffix, phrase in (("stderr", "standard error of a pixel of"), ("rms", "how far pixels differ in")):
            attributes = {"units": units, "long_name": f"{phrase} the map {key}"}
            ds[f"{key}_{suffix}"] = ((), getattr(estimate, suffix), attributes)
    for key, units, long_name in (
        ("exposure_s", "s", "mean exposure of the darks"),
        ("darks", "1", "number of darks"),
        ("flats", "1", "number of flats"),
    ):
        ds[key] = ((), getattr(maps, key), {"units": units, "long_name": long_name})
    return ds


def read_maps(ds: xr.Dataset) -> SensorMaps | None:
    """Return the maps in the content of maps.nc; None if it has none."""
    if "skipped" in ds.attrs:
        return None
    estimates = {
        key: MapEstimate(ds[key].values.astype(float), float(ds[f"{key}_stderr"]), float(ds[f"{key}_rms"]))
        for key in MAPS
        if key in ds
    }
    return SensorMaps(
        offset=estimates["offset"],
        slope=estimates.get("slope"),
        exposure_s=float(ds["exposure_s"]),
        gain=estimates.get("gain"),
        darks=int(ds["darks"]),
        flats=int(ds["flats"]),
    )
