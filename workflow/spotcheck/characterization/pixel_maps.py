"""Maps of a sensor's pixels from its own darks and flats, with what they are uncertain by.

Frames of each level take turns in two halves, which share a pattern but no noise: what the halves have in common is the
sensor's, what they differ by is the noise of their mean. A pixel is then moved towards all others by as much as noise
could have set it apart (Wiener's filter), so that maps of few frames bring in no noise where pixels are alike.

# ASSUME: offsets are linear in exposure (dark current), and as quiet as the others'. Flats are lit by light whose
# unevenness is a polynomial of the fourth degree over the frame; what is finer is the sensor's.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.characterization.levels import photons_of
from spotcheck.characterization.photon_transfer import MOST_AT_ZERO
from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame
from spotcheck.sensor.pixel_maps import PixelMaps

# Flats above this part of full scale may be bent or cut.
BRIGHTEST = 0.7
# A pixel that is this many scatters of all pixels off is itself, and not moved: hot ones are.
ALONE = 6.0
# Degree of the polynomial that light of flats is.
DEGREE = 4
# Blocks a side on which it is fitted.
BLOCKS = 32


class Field(NamedTuple):
    """Numbers of pixels [rows, columns], 0 on average; the standard error of one, and how far they differ (rms)."""

    values: np.ndarray
    stderr: float
    rms: float


class SensorMaps(NamedTuple):
    """Offsets [DN] at the mean exposure [s] of the darks, their slope [DN/s], and gains less 1 (None: not known), each
    less its mean; and how many darks and flats they are from."""

    offset: Field
    slope: Field | None
    exposure_s: float
    gain: Field | None
    darks: int
    flats: int

    def at(self, exposure_s: float | None) -> PixelMaps:
        """The maps at an exposure [s]; where it is not known, at that of the darks."""
        values, variance = self.offset.values, self.offset.stderr**2
        apart = 0.0 if exposure_s is None else exposure_s - self.exposure_s
        if self.slope is not None and np.isfinite(apart):
            values, variance = values + apart * self.slope.values, variance + (apart * self.slope.stderr) ** 2
        if self.gain is None:
            return PixelMaps(values, np.where(np.isnan(values), np.nan, 1.0), float(np.sqrt(variance)))
        return PixelMaps(values, 1 + self.gain.values, float(np.sqrt(variance)), self.gain.stderr)


def halves_of(own: Sequence[Frame]) -> tuple[list[Frame], list[Frame]]:
    """Frames of one kind in two halves of equal levels; the last one of an odd number in a level is left out."""
    levels: dict[tuple, list[Frame]] = {}
    for frame in own:
        levels.setdefault((frame.exposure_s, str(photons_of(frame))), []).append(frame)
    pairs = [level[k : k + 2] for level in levels.values() for k in range(0, len(level) - 1, 2)]
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]


def maps_of(dataset: Dataset, full_scale_dn: float) -> SensorMaps | str:
    """Maps by the darks and flats of a dataset, or why there are none. Frames are read one at a time."""
    darks = halves_of([own for own in dataset.frames if own.kind == "dark"])
    if not darks[0]:
        return "there are no two darks of one exposure"
    times = np.array([np.nan if own.exposure_s is None else own.exposure_s for own in darks[0]])
    spread = times - times.mean() if np.isfinite(times).all() else np.zeros(len(times))
    weights = spread / max(float(spread @ spread), 1e-300)
    means, slopes, zeros, pixels = [], [], 0, 0
    for half in darks:
        mean = growth = np.zeros(1)
        for frame, weight in zip(half, weights, strict=True):
            image = frames.read_masked_image(dataset, frame).astype(float)
            zeros, pixels = zeros + int(np.count_nonzero(image <= 0)), pixels + image.size
            mean, growth = mean + image / len(half), growth + weight * image
        means.append(mean)
        slopes.append(growth)
    if zeros > MOST_AT_ZERO * pixels:
        return f"{100 * zeros / pixels:.1f} % of the darks' pixels read 0, so that their offsets are not known"
    offset = shrunk(*(own - np.nanmean(own) for own in means))
    slope = shrunk(*(own - np.nanmean(own) for own in slopes)) if spread.any() else None
    found = SensorMaps(offset, slope, float(times.mean()), None, 2 * len(darks[0]), 0)
    level = (float(np.nanmean(means)), float(np.nanmean(slopes)))

    def dark(exposure_s: float | None) -> np.ndarray:
        apart = 0.0 if exposure_s is None or not spread.any() else exposure_s - found.exposure_s
        return found.at(exposure_s).offset_dn + level[0] + apart * level[1]

    return _with_flats(found, dataset, full_scale_dn, dark)


def _with_flats(
    found: SensorMaps, dataset: Dataset, full_scale_dn: float, dark: Callable[[float | None], np.ndarray]
) -> SensorMaps:
    """The maps with gains, where flats tell them."""
    flats = halves_of([own for own in dataset.frames if own.kind == "flat"])
    totals, used = [np.zeros(1), np.zeros(1)], 0
    for pair in zip(*flats, strict=True):
        images = [frames.read_masked_image(dataset, own).astype(float) for own in pair]
        if max(float(np.nanquantile(image, 0.999)) for image in images) < BRIGHTEST * full_scale_dn:
            used += 2
            totals = [total + image - dark(own.exposure_s) for total, image, own in
                      zip(totals, images, pair, strict=True)]  # fmt: skip
    if not used:
        return found
    even = smooth(totals[0] + totals[1]) / 2
    if not (even > 0).all():
        return found
    ratios = [total / even for total in totals]
    return found._replace(gain=shrunk(*(own / np.nanmean(own) - 1 for own in ratios)), flats=used)


def shrunk(first: np.ndarray, second: np.ndarray) -> Field:
    """The field that two halves share, each pixel moved towards 0 by the part of its variance that is noise. Both
    halves are 0 on average, with NaN where a pixel is not known."""
    mean, apart = (first + second) / 2, (first - second) / 2
    scatter = 1.4826 * float(np.nanmedian(np.abs(mean)))
    alone = np.abs(mean) > ALONE * scatter if scatter > 0 else np.zeros(mean.shape, bool)
    usual = np.isfinite(mean) & ~alone
    noise, own = float(np.mean(apart[usual] ** 2)), max(float(np.mean((first * second)[usual])), 0.0)
    part = own / (own + noise) if own > 0 else 0.0
    return Field(np.where(alone, mean, part * mean), float(np.sqrt(part * noise)), float(np.sqrt(own)))


def smooth(image: np.ndarray) -> np.ndarray:
    """The polynomial in x and y that an image is by least squares, fitted on its blocks; NaN pixels do not count."""
    side = max(1, min(image.shape) // BLOCKS)
    blocks = frames.average_blocks(image, side)
    y, x = (side * np.arange(n) + (side - 1) / 2 for n in blocks.shape)
    known = np.isfinite(blocks)
    basis = [_basis(own, n) for own, n in zip((y, x), image.shape, strict=True)]
    columns = [np.outer(a, b)[known] for j, a in enumerate(basis[0]) for b in basis[1][: DEGREE + 1 - j]]
    values, *_ = np.linalg.lstsq(np.array(columns).T, blocks[known])
    coefficients = np.zeros((DEGREE + 1, DEGREE + 1))
    coefficients[[j for j in range(DEGREE + 1) for _ in range(DEGREE + 1 - j)],
                 [k for j in range(DEGREE + 1) for k in range(DEGREE + 1 - j)]] = values  # fmt: skip
    rows, across = (_basis(np.arange(n, dtype=float), n) for n in image.shape)
    return rows.T @ coefficients @ across


def _basis(place: np.ndarray, length: int) -> np.ndarray:
    """Legendre polynomials over a side of so many pixels [degree, place]."""
    return np.polynomial.legendre.legvander((2 * place + 1) / length - 1, DEGREE).T


# As a file.

NAMES = {
    "offset": ("DN", "how far each pixel reads above all on average, at the mean exposure of the darks"),
    "slope": ("DN/s", "by how much that grows with exposure"),
    "gain": ("1", "how much more of the light than the average each pixel turns into electrons"),
}


def dataset_of(found: SensorMaps | str, title: str, name: str) -> xr.Dataset:
    """maps.nc; with the attribute `skipped` where there are none."""
    ds = xr.Dataset(attrs={"title": title, "dataset": name})
    if isinstance(found, str):
        return ds.assign_attrs(skipped=found)
    for key, (units, long_name) in NAMES.items():
        own = getattr(found, key)
        if own is None:
            continue
        ds[key] = (("row", "column"), own.values.astype("f4"), {"units": units, "long_name": long_name})
        for part, text in (("stderr", "standard error of a pixel of"), ("rms", "how far pixels differ in")):
            ds[f"{key}_{part}"] = ((), getattr(own, part), {"units": units, "long_name": f"{text} the map {key}"})
    for key, units, long_name in (("exposure_s", "s", "mean exposure of the darks"), ("darks", "1", "number of darks"),
                                  ("flats", "1", "number of flats")):  # fmt: skip
        ds[key] = ((), getattr(found, key), {"units": units, "long_name": long_name})
    return ds


def maps_in(ds: xr.Dataset) -> SensorMaps | None:
    """The maps of a file; None where it says why there are none."""
    if "skipped" in ds.attrs:
        return None
    fields = [
        Field(ds[key].values.astype(float), float(ds[f"{key}_stderr"]), float(ds[f"{key}_rms"])) if key in ds else None
        for key in NAMES
    ]
    assert fields[0] is not None
    return SensorMaps(fields[0], fields[1], float(ds["exposure_s"]), fields[2], int(ds["darks"]), int(ds["flats"]))
