"""Images and spectra of the fixed pattern without light and at half of saturation.

EMVA 1288 Release 4.0 Linear, section 8.3, asks for both: a spectrogram distinguishes stripes and hum from white
non-uniformity.
"""

from dataclasses import dataclass

import numpy as np
import xarray as xr

from spotcheck.characterization.levels import Level, group_frames
from spotcheck.characterization.photon_transfer import Transfer
from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset

# Longest side of a stored image [px]; larger frames are averaged in blocks.
MAX_SIDE = 256
# Largest number of frequencies of a stored spectrum; longer ones are averaged.
MAX_FREQUENCIES = 1024


@dataclass(frozen=True)
class FixedPattern:
    """The mean image of a level, from which its mean is subtracted."""

    image: np.ndarray  # means of blocks [DN], [block row, block column]
    side: int  # side of a block [px]
    along_rows: np.ndarray  # rms spectrum along rows [DN], frequencies from 0 to ½ cycles/px
    along_columns: np.ndarray  # rms spectrum along columns [DN]
    noise: float  # rms of the temporal noise in the mean image [DN], which each spectrum contains


def select_levels(transfer: Transfer) -> dict[str, Level]:
    """Return the levels that are shown: `dark`, that with most frames, and `flat`, the nearest to half of saturation.

    A level that does not exist is left out. The shortest exposure decides between dark levels of equally many frames.
    """
    levels: dict[str, Level] = {}
    if transfer.darks:
        levels["dark"] = max(transfer.darks, key=lambda dark: (dark.frames, -dark.exposure_s))
    if transfer.saturation is not None:
        half = transfer.signal[transfer.saturation] / 2
        levels["flat"] = transfer.flats[int(np.argmin(np.abs(transfer.signal - half)))]
    return levels


def measure_pattern(dataset: Dataset, level: Level) -> FixedPattern:
    """Return the pattern of one level of a dataset from all frames of the level."""
    total = np.zeros(level.shape, np.float32)
    for (kind, *light), frames_of_level in group_frames(dataset).items():
        if kind == level.kind and np.array_equal(light, [level.exposure_s, level.photons], equal_nan=True):
            for frame in frames_of_level:
                total += frames.read_masked_image(dataset, frame).astype(np.float32)
    mean = total / level.frames
    # Bad pixels (NaN) show no pattern.
    mean = np.nan_to_num(mean - np.nanmean(mean, dtype=float))
    side = max(1, -(-max(mean.shape) // MAX_SIDE))
    noise = float(np.sqrt(max(np.nan_to_num(level.variance), 0.0) / level.frames))
    return FixedPattern(
        frames.average_blocks(mean, side), side, compute_spectrum(mean), compute_spectrum(mean.T), noise
    )


def compute_spectrum(image: np.ndarray) -> np.ndarray:
    """Return the rms spectrum along the rows of an image [rows, columns], from 0 to ½ cycles/px.

    It is the root of the mean power over all rows, in the unit of the image; white noise of rms s gives s at each
    frequency.
    """
    columns = image.shape[1]
    power = np.zeros(columns // 2 + 1)
    for row in image:
        power += np.abs(np.fft.rfft(row.astype(float))) ** 2
    spectrum = np.sqrt(power / image.shape[0] / columns)
    if len(spectrum) <= MAX_FREQUENCIES:
        return spectrum
    averaged = -(-len(spectrum) // MAX_FREQUENCIES)
    whole = len(spectrum) // averaged * averaged
    return np.sqrt((spectrum[:whole].reshape(-1, averaged) ** 2).mean(axis=1))


def add_patterns(ds: xr.Dataset, dataset: Dataset, transfer: Transfer) -> xr.Dataset:
    """Return transfer.nc with images and spectra of the levels of `select_levels` added to it."""
    for kind, level in select_levels(transfer).items():
        pattern = measure_pattern(dataset, level)
        name = "without light" if kind == "dark" else "at half of saturation"
        attributes = {"units": "DN", "long_name": f"mean image {name} less its mean"}
        ds[f"{kind}_picture"] = ((f"{kind}_y", f"{kind}_x"), pattern.image, attributes)
        for axis, spectrum in (("rows", pattern.along_rows), ("columns", pattern.along_columns)):
            dim = f"{kind}_{axis}_frequency"
            frequency = np.linspace(0, 0.5, len(spectrum))
            ds[dim] = (dim, frequency, {"units": "1/pixel", "long_name": f"spatial frequency along {axis}"})
            attributes = {"units": "DN", "long_name": f"rms spectrum along {axis} of the mean image {name}"}
            ds[f"{kind}_along_{axis}"] = (dim, spectrum, attributes)
        for key, value, units, text in (
            ("side", pattern.side, "pixel", "pixels of a block of the picture"),
            ("noise", pattern.noise, "DN", "rms of noise in time in the mean image"),
            ("at", level.mean, "DN", "mean reading"),
        ):
            ds[f"{kind}_shown_{key}"] = ((), value, {"units": units, "long_name": f"{text} {name}"})
    return ds
