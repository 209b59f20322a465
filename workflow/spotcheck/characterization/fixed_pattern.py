"""Images and spectra of the fixed pattern without light and at half of saturation, for transfer.nc.

The fixed pattern is the mean image of a level less its mean; a level is all frames of one light and one exposure.
EMVA 1288 Release 4.0 Linear, section 8.3, asks for image and spectrum: a spectrum distinguishes stripes and hum from
white non-uniformity.
"""

from dataclasses import dataclass

import numpy as np
import xarray as xr

from spotcheck.characterization.levels import Level, group_frames
from spotcheck.characterization.photon_transfer import Transfer
from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset

# Largest number of blocks along a side of a stored image; frames with more pixels are averaged in blocks.
MAX_SIDE = 256
# Largest number of frequencies of a stored spectrum; in longer spectra, neighbouring frequencies are averaged.
MAX_FREQUENCIES = 1024


@dataclass(frozen=True)
class FixedPattern:
    """Image and spectra of the mean image of a level, from which its mean is subtracted."""

    image: np.ndarray  # means of square blocks [DN], [block row, block column]
    side: int  # side of a block [px]
    along_rows: "Spectrum"  # spectrum along rows
    along_columns: "Spectrum"  # spectrum along columns
    noise: float  # rms of the temporal noise in the mean image [DN], which each spectrum contains


@dataclass(frozen=True)
class Spectrum:
    """Rms spectrum of an image along one of its axes."""

    frequency: np.ndarray  # spatial frequency [cycles/px]
    rms: np.ndarray  # root of the mean power [DN], [frequency]


def select_levels(transfer: Transfer) -> dict[str, Level]:
    """Return the levels whose pattern is stored, under the keys "dark" and "flat".

    "dark" is the dark level with most frames; of several, that with the shortest exposure. "flat" is the flat level
    nearest to half of the signal at saturation. A key is missing if there are no darks, or no flat shows saturation.
    `transfer` has the levels `darks` and `flats`, the `signal` of each flat over its dark [DN], and the index
    `saturation` of the flat at saturation.
    """
    levels: dict[str, Level] = {}
    if transfer.darks:
        levels["dark"] = max(transfer.darks, key=lambda dark: (dark.frames, -dark.exposure_s))
    if transfer.saturation is not None:
        half_signal = transfer.signal[transfer.saturation] / 2
        levels["flat"] = transfer.flats[int(np.argmin(np.abs(transfer.signal - half_signal)))]
    return levels


def measure_pattern(dataset: Dataset, level: Level) -> FixedPattern:
    """Return the pattern of one level from all of its frames, which are read one at a time from the dataset."""
    total = np.zeros(level.shape, np.float32)
    for (kind, *condition), level_frames in group_frames(dataset).items():
        # A level has the exposure and the photons of its frames; unknown ones are NaN in both.
        if kind == level.kind and np.array_equal(condition, [level.exposure_s, level.photons], equal_nan=True):
            for frame in level_frames:
                total += frames.read_masked_image(dataset, frame).astype(np.float32)
    mean = total / level.frames
    # Bad pixels (NaN) show no pattern.
    deviation = np.nan_to_num(mean - np.nanmean(mean, dtype=float))
    # Rounded up, so that there are at most `MAX_SIDE` blocks.
    side = -(-max(deviation.shape) // MAX_SIDE)
    noise = float(np.sqrt(max(np.nan_to_num(level.variance), 0.0) / level.frames))
    image = frames.average_blocks(deviation, side)
    return FixedPattern(image, side, compute_spectrum(deviation), compute_spectrum(deviation.T), noise)


def compute_spectrum(image: np.ndarray) -> Spectrum:
    """Return the rms spectrum along the rows of an image [rows, columns], from 0 to ½ cycles/px.

    It is the root of the mean power over all rows, in the unit of the image; white noise of rms s gives s at each
    frequency. If there are more than `MAX_FREQUENCIES`, the power of neighbouring frequencies is averaged, and the
    last frequencies that do not fill a group are dropped. The mean of the image is not subtracted. A NaN makes the
    whole spectrum NaN.
    """
    columns = image.shape[1]
    power = np.zeros(columns // 2 + 1)
    for row in image:
        power += np.abs(np.fft.rfft(row.astype(float))) ** 2
    power /= image.shape[0] * columns
    group_size = -(-len(power) // MAX_FREQUENCIES)
    used_count = len(power) // group_size * group_size
    frequency, power = (
        values[:used_count].reshape(-1, group_size).mean(axis=1) for values in (np.fft.rfftfreq(columns), power)
    )
    return Spectrum(frequency, np.sqrt(power))


def add_patterns(ds: xr.Dataset, dataset: Dataset, transfer: Transfer) -> xr.Dataset:
    """Add images and spectra of the levels that `select_levels` chooses to `ds`, and return it.

    The variables of the dark level are `dark_picture`, `dark_along_rows`, `dark_along_columns`, and the numbers
    `dark_shown_side`, `dark_shown_noise` and `dark_shown_at` (its mean reading). Those of the flat begin with `flat_`.

    Parameters
    ----------
    ds : content of transfer.nc, which is changed in place.
    dataset : dataset whose frames are read.
    transfer : photon transfer of its flats and darks.
    """
    for kind, level in select_levels(transfer).items():
        pattern = measure_pattern(dataset, level)
        phrase = "without light" if kind == "dark" else "at half of saturation"
        attributes = {"units": "DN", "long_name": f"mean image {phrase} less its mean"}
        ds[f"{kind}_picture"] = ((f"{kind}_y", f"{kind}_x"), pattern.image, attributes)
        for axis, spectrum in (("rows", pattern.along_rows), ("columns", pattern.along_columns)):
            dim = f"{kind}_{axis}_frequency"
            ds[dim] = (dim, spectrum.frequency, {"units": "1/pixel", "long_name": f"spatial frequency along {axis}"})
            attributes = {"units": "DN", "long_name": f"rms spectrum along {axis} of the mean image {phrase}"}
            ds[f"{kind}_along_{axis}"] = (dim, spectrum.rms, attributes)
        for suffix, value, units, long_name in (
            ("side", pattern.side, "pixel", "pixels of a block of the picture"),
            ("noise", pattern.noise, "DN", "rms of noise in time in the mean image"),
            ("at", level.mean, "DN", "mean reading"),
        ):
            ds[f"{kind}_shown_{suffix}"] = ((), value, {"units": units, "long_name": f"{long_name} {phrase}"})
    return ds
