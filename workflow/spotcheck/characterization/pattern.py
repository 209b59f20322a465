"""What stays the same from frame to frame: pictures and spectra of the pattern without light and at half of saturation.

EMVA 1288 Release 4.0 Linear, section 8.3, shows both: a spectrogram tells stripes and hum from white non-uniformity.
"""

from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.characterization.levels import Level, photons_of
from spotcheck.characterization.photon_transfer import Transfer
from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset

# Sides of the largest picture that is kept [px]; larger frames are averaged in blocks.
LARGEST = 256
# Lengths of the longest spectrum that is kept.
LONGEST = 1024


class Pattern(NamedTuple):
    """Mean image less its mean [DN], in blocks of `side` pixels; root mean square spectra along rows and columns [DN]
    over frequency [cycles/px], and what noise in time alone brings to them."""

    picture: np.ndarray
    side: int
    along_rows: np.ndarray
    along_columns: np.ndarray
    noise: float


def chosen(found: Transfer) -> dict[str, Level]:
    """The levels that are shown: the darkest exposure with most frames, and the flat nearest to half of saturation."""
    out: dict[str, Level] = {}
    if found.darks:
        out["dark"] = max(found.darks, key=lambda own: (own.frames, -own.exposure_s))
    if found.saturation is not None:
        half = found.signal[found.saturation] / 2
        out["flat"] = found.flats[int(np.argmin(np.abs(found.signal - half)))]
    return out


def pattern_of(dataset: Dataset, level: Level) -> Pattern:
    """The pattern of one level, from all its frames."""
    total: np.ndarray | None = None
    for frame in dataset.frames:
        exposure = np.nan if frame.exposure_s is None else frame.exposure_s
        same = frame.kind == level.kind and np.array_equal([exposure], [level.exposure_s], equal_nan=True)
        if same and np.array_equal([photons_of(frame)], [level.photons], equal_nan=True):
            image = frames.read_masked_image(dataset, frame).astype(np.float32)
            total = image if total is None else total + image
    assert total is not None  # the level was made from them
    mean = total / level.frames
    # Bad pixels have no pattern to show.
    mean = np.nan_to_num(mean - np.nanmean(mean, dtype=float))
    side = max(1, -(-max(mean.shape) // LARGEST))
    rows, columns = (n // side * side for n in mean.shape)
    picture = mean[:rows, :columns].reshape(rows // side, side, columns // side, side).mean(axis=(1, 3))
    noise = float(np.sqrt(max(np.nan_to_num(level.variance), 0.0) / level.frames))
    return Pattern(picture, side, spectrum(mean), spectrum(mean.T), noise)


def spectrum(image: np.ndarray) -> np.ndarray:
    """Root of the mean power over all lines [DN] at 0 … ½ cycles/px; white noise of rms s gives s everywhere."""
    count = image.shape[1]
    power = np.zeros(count // 2 + 1)
    for line in image:
        power += np.abs(np.fft.rfft(line.astype(float))) ** 2
    own = np.sqrt(power / image.shape[0] / count)
    if len(own) <= LONGEST:
        return own
    wide = -(-len(own) // LONGEST)
    kept = len(own) // wide * wide
    return np.sqrt((own[:kept].reshape(-1, wide) ** 2).mean(axis=1))


def add_patterns(ds: xr.Dataset, dataset: Dataset, found: Transfer) -> xr.Dataset:
    """The file of photon transfer with the pictures and spectra of the levels that are shown."""
    for kind, level in chosen(found).items():
        own = pattern_of(dataset, level)
        dims = (f"{kind}_y", f"{kind}_x")
        name = "without light" if kind == "dark" else "at half of saturation"
        ds[f"{kind}_picture"] = (dims, own.picture, {"units": "DN", "long_name": f"mean image {name} less its mean"})
        for axis, values in (("rows", own.along_rows), ("columns", own.along_columns)):
            dim = f"{kind}_{axis}_frequency"
            frequency = np.linspace(0, 0.5, len(values))
            ds[dim] = (dim, frequency, {"units": "1/pixel", "long_name": f"spatial frequency along {axis}"})
            attributes = {"units": "DN", "long_name": f"rms spectrum along {axis} of the mean image {name}"}
            ds[f"{kind}_along_{axis}"] = (dim, values, attributes)
        for key, value, units, text in (
            ("side", own.side, "pixel", "pixels of a block of the picture"),
            ("noise", own.noise, "DN", "rms of noise in time in the mean image"),
            ("at", level.mean, "DN", "mean reading"),
        ):
            ds[f"{kind}_shown_{key}"] = ((), value, {"units": units, "long_name": f"{text} {name}"})
    return ds
