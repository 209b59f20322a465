"""Maps of offset and gain of a sensor's pixels from its darks and flats, with their standard errors.

The frames of each level are assigned alternately to two halves. The halves share the pattern of the sensor but no
noise, so their covariance is the variance of the pattern, and their difference is the noise. Each pixel is then shrunk
towards the mean of all pixels by the part of its variance that is noise (Wiener filter): maps from few frames add no
noise if the pixels are alike.

# ASSUME: offsets are linear in exposure (dark current), and all have the same noise. The unevenness of the light of
flats is a polynomial of the fourth degree over the frame; finer structure is of the sensor.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.characterization.derived_quantities import MAX_PART_AT_ZERO
from spotcheck.characterization.levels import group_frames
from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame
from spotcheck.sensor.pixel_maps import PixelMaps

# Flats that exceed this part of full scale may be nonlinear or clipped.
MAX_FLAT_LEVEL = 0.7
# A pixel that deviates from the mean by this number of standard deviations, as hot ones do, is not shrunk.
OUTLIER_SD = 6.0
# Degree of the polynomial for the unevenness of light, and number of blocks per side to which it is fitted.
DEGREE, BLOCKS = 4, 32
# Degrees (j, k) in y and x of its terms.
TERMS = [(j, k) for j in range(DEGREE + 1) for k in range(DEGREE + 1 - j)]

# Map → (unit, meaning).
MAPS = {
    "offset": ("DN", "how far each pixel reads above all on average, at the mean exposure of the darks"),
    "slope": ("DN/s", "by how much that grows with exposure"),
    "gain": ("1", "how much more of the light than the average each pixel turns into electrons"),
}


class MapEstimate(NamedTuple):
    """A map of deviations of the pixels from their mean."""

    values: np.ndarray  # deviation of each pixel [rows, columns]; NaN if unknown
    stderr: float  # standard error of the deviation of one pixel
    rms: float  # standard deviation of the pixels, without noise


@dataclass(frozen=True)
class SensorMaps:
    """Maps of the pixels of a sensor."""

    offset: MapEstimate  # offset at `exposure_s` [DN]
    slope: MapEstimate | None  # derivative of the offset by exposure [DN/s]; None without different exposures
    exposure_s: float  # mean exposure of the darks [s]; NaN if unknown
    gain: MapEstimate | None  # relative gain less 1; None without usable flats
    darks: int  # number of darks used
    flats: int  # number of flats used

    def at(self, exposure_s: float | None) -> PixelMaps:
        """Return the maps at an exposure [s]; at that of the darks if it is None."""
        offset, variance = self.offset.values, self.offset.stderr**2
        difference_s = 0.0 if exposure_s is None else exposure_s - self.exposure_s
        if self.slope is not None and np.isfinite(difference_s):
            offset = offset + difference_s * self.slope.values
            variance = variance + (difference_s * self.slope.stderr) ** 2
        stderr = float(np.sqrt(variance))
        if self.gain is None:
            return PixelMaps(offset, np.where(np.isnan(offset), np.nan, 1.0), stderr)
        return PixelMaps(offset, 1 + self.gain.values, stderr, self.gain.stderr)


def measure_maps(dataset: Dataset, full_scale_dn: float) -> SensorMaps | str:
    """Return the maps from darks and flats of a dataset, or the reason why there are none.

    Frames are read one at a time. `full_scale_dn` is the largest reading of the converter [DN].
    """
    halves = _split_in_halves(dataset, "dark")
    if not halves[0]:
        return "there are no two darks of one exposure"
    exposures = np.array([np.nan if frame.exposure_s is None else frame.exposure_s for frame in halves[0]])
    deviations = exposures - exposures.mean() if np.isfinite(exposures).all() else np.zeros(len(exposures))
    slope_weights = deviations / max(float(deviations @ deviations), 1e-300)
    means, slopes, pixels_at_zero, pixels = [], [], 0, 0
    for half in halves:
        mean = slope = np.zeros(1)
        for frame, weight in zip(half, slope_weights, strict=True):
            image = frames.read_masked_image(dataset, frame).astype(float)
            pixels_at_zero, pixels = pixels_at_zero + int(np.count_nonzero(image <= 0)), pixels + image.size
            mean, slope = mean + image / len(half), slope + weight * image
        means.append(mean)
        slopes.append(slope)
    if pixels_at_zero > MAX_PART_AT_ZERO * pixels:
        return f"{100 * pixels_at_zero / pixels:.1f} % of the darks' pixels read 0, so that their offsets are not known"
    maps = SensorMaps(
        offset=shrink_to_mean(*(mean - np.nanmean(mean) for mean in means)),
        slope=shrink_to_mean(*(slope - np.nanmean(slope) for slope in slopes)) if deviations.any() else None,
        exposure_s=float(exposures.mean()),
        gain=None,
        darks=2 * len(halves[0]),
        flats=0,
    )
    return _add_gain(maps, dataset, full_scale_dn, float(np.nanmean(means)), float(np.nanmean(slopes)))


def _split_in_halves(dataset: Dataset, kind: str) -> tuple[list[Frame], list[Frame]]:
    """Return the frames of a kind in two halves with equal levels, without the last one of an odd number in a level."""
    levels = [level for (level_kind, *_), level in group_frames(dataset).items() if level_kind == kind]
    pairs = [level[k : k + 2] for level in levels for k in range(0, len(level) - 1, 2)]
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]


def _add_gain(
    maps: SensorMaps, dataset: Dataset, full_scale_dn: float, dark_level_dn: float, dark_slope_dn_per_s: float
) -> SensorMaps:
    """Return maps with the gain from the flats of a dataset, if any are usable.

    The mean over all pixels of a dark is `dark_level_dn` at the exposure of the maps, and grows by
    `dark_slope_dn_per_s`.
    """

    def subtract_dark(image: np.ndarray, exposure_s: float | None) -> np.ndarray:
        growth_s = 0.0 if exposure_s is None or maps.slope is None else exposure_s - maps.exposure_s
        return image - (maps.at(exposure_s).offset_dn + dark_level_dn + growth_s * dark_slope_dn_per_s)

    totals, used = [np.zeros(1), np.zeros(1)], 0
    for pair in zip(*_split_in_halves(dataset, "flat"), strict=True):
        images = [frames.read_masked_image(dataset, frame).astype(float) for frame in pair]
        if max(float(np.nanquantile(image, 0.999)) for image in images) < MAX_FLAT_LEVEL * full_scale_dn:
            used += 2
            totals = [
                total + subtract_dark(image, frame.exposure_s)
                for total, image, frame in zip(totals, images, pair, strict=True)
            ]
    if not used:
        return maps
    light = fit_light(totals[0] + totals[1]) / 2
    if not (light > 0).all():
        return maps
    ratios = [total / light for total in totals]
    return replace(maps, gain=shrink_to_mean(*(ratio / np.nanmean(ratio) - 1 for ratio in ratios)), flats=used)


def shrink_to_mean(first: np.ndarray, second: np.ndarray) -> MapEstimate:
    """Return the map that two halves [rows, columns] share, shrunk by a Wiener filter.

    Both halves have the mean 0, and NaN where a pixel is unknown. With the variances s² of the pattern (covariance of
    the halves) and v of the noise of their mean, the mean of the halves is multiplied by w = s²/(s² + v), which leaves
    the standard error √(w v). Outliers are kept as they are.
    """
    mean, half_difference = (first + second) / 2, (first - second) / 2
    # 1.4826 median absolute values are the standard deviation of a normal distribution.
    scatter = 1.4826 * float(np.nanmedian(np.abs(mean)))
    is_outlier = np.abs(mean) > OUTLIER_SD * scatter if scatter > 0 else np.zeros(mean.shape, bool)
    usual = np.isfinite(mean) & ~is_outlier
    noise_variance = float(np.mean(half_difference[usual] ** 2))
    variance = max(float(np.mean((first * second)[usual])), 0.0)
    factor = variance / (variance + noise_variance) if variance > 0 else 0.0
    values = np.where(is_outlier, mean, factor * mean)
    return MapEstimate(values, float(np.sqrt(factor * noise_variance)), float(np.sqrt(variance)))


def fit_light(image: np.ndarray) -> np.ndarray:
    """Return the least-squares polynomial of degree `DEGREE` through an image [rows, columns], at all of its pixels.

    It is fitted to means of blocks, without NaN pixels.
    """
    side = max(1, min(image.shape) // BLOCKS)
    blocks = frames.average_blocks(image, side)
    known = np.isfinite(blocks)
    in_y, in_x = (
        _evaluate_legendre(side * np.arange(count) + (side - 1) / 2, length)
        for count, length in zip(blocks.shape, image.shape, strict=True)
    )
    design = np.array([np.outer(in_y[j], in_x[k])[known] for j, k in TERMS]).T
    coefficients = np.zeros((DEGREE + 1, DEGREE + 1))
    coefficients[tuple(zip(*TERMS, strict=True))] = np.linalg.lstsq(design, blocks[known])[0]
    rows, columns = (_evaluate_legendre(np.arange(length, dtype=float), length) for length in image.shape)
    return rows.T @ coefficients @ columns


def _evaluate_legendre(position: np.ndarray, length: int) -> np.ndarray:
    """Return Legendre polynomials [degree, position] at positions [px] along a side of `length` pixels."""
    return np.polynomial.legendre.legvander((2 * position + 1) / length - 1, DEGREE).T


def build_maps_dataset(maps: SensorMaps | str, title: str, name: str) -> xr.Dataset:
    """Return maps.nc; if there are no maps, the reason is in the attribute `skipped`."""
    ds = xr.Dataset(attrs={"title": title, "dataset": name})
    if isinstance(maps, str):
        return ds.assign_attrs(skipped=maps)
    for key, (units, long_name) in MAPS.items():
        estimate: MapEstimate | None = getattr(maps, key)
        if estimate is None:
            continue
        ds[key] = (("row", "column"), estimate.values.astype("f4"), {"units": units, "long_name": long_name})
        for suffix, text in (("stderr", "standard error of a pixel of"), ("rms", "how far pixels differ in")):
            attributes = {"units": units, "long_name": f"{text} the map {key}"}
            ds[f"{key}_{suffix}"] = ((), getattr(estimate, suffix), attributes)
    for key, units, long_name in (
        ("exposure_s", "s", "mean exposure of the darks"),
        ("darks", "1", "number of darks"),
        ("flats", "1", "number of flats"),
    ):
        ds[key] = ((), getattr(maps, key), {"units": units, "long_name": long_name})
    return ds


def read_maps(ds: xr.Dataset) -> SensorMaps | None:
    """Return the maps of maps.nc; None if it has none."""
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
