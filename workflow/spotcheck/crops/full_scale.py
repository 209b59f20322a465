"""Full scale of a dataset: the largest reading, from the data sheet or from clipped frames.

All pixels that exceed the range of the converter have the same reading. A clipped frame therefore has a plateau: many
pixels at exactly its highest reading, where light and noise alone would spread them over many readings.

# ASSUME: no light is so flat and no noise so small that pixels gather at exactly the highest reading without a clip.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from spotcheck.dataset.frames import get_full_scale
from spotcheck.dataset.instrument import Instrument

# Number of readings below the highest that a plateau is compared with. In so narrow a range, a spot has about as many
# pixels at each reading, and at least one of the readings occurs where the light is not clipped.
READINGS_BELOW = 16
# A plateau has at least this many pixels, and this many times those of the most frequent reading below it. If the mean
# number of pixels per reading is 1, ten occur by chance once in 1e7 frames.
MIN_PLATEAU_PX, MIN_PLATEAU_RATIO = 10, 5
# A plateau above this part of the stated range is the end of the converter: many stop slightly below their largest
# number, at 4080 or 4094 of 4095. A lower plateau is saturation of the sensor, which the verdict detects.
END_OF_RANGE = 0.99
# If the highest reading is fewer steps than this, all readings may be multiples of the step by chance.
MIN_STEPS = 16


@dataclass(frozen=True)
class ReadingExtremes:
    """Statistics of the extreme readings of a frame."""

    lowest: int  # lowest reading [DN]
    highest: int  # highest reading [DN]
    at_highest: int  # number of pixels at the highest reading
    most_below: int  # largest number of pixels at one of the `READINGS_BELOW` readings (steps) below the highest
    bits: int  # bitwise OR of all readings: the bits that any reading sets

    def has_plateau(self, lowest: int | None = None) -> bool:
        """Return whether pixels gather at the highest reading.

        `lowest` is the lowest reading of the dataset [DN], by default of this frame. A highest reading close to it is
        no plateau: frames without light and noise have one reading everywhere.
        """
        gathers = self.at_highest >= max(MIN_PLATEAU_PX, MIN_PLATEAU_RATIO * self.most_below)
        lowest = self.lowest if lowest is None else lowest
        return gathers and self.highest - lowest >= READINGS_BELOW * find_reading_step(self.bits)


class FullScale(NamedTuple):
    """Largest possible reading of the frames of a dataset."""

    reading: int  # largest possible reading [DN]
    source: str  # how it is known, in words; starts with `FROM_FRAMES` if clipped frames show it
    remarks: tuple[str, ...] = ()  # sentences for the user


# First word of `FullScale.source` if the value was found in clipped frames: "where 2 frames stop".
FROM_FRAMES = "where"


def measure_extremes(pixels: np.ndarray) -> ReadingExtremes:
    """Return the statistics of the extreme readings of a frame: unsigned integers [DN] of any shape, at least one."""
    highest, bits = int(pixels.max()), int(np.bitwise_or.reduce(pixels, axis=None))
    step = find_reading_step(bits)
    # Distances [DN] from the highest reading. The range ends at 0, below which unsigned integers cannot go.
    distance = highest - pixels[pixels >= highest - min(READINGS_BELOW * step, highest)].astype(np.int64)
    # Number of pixels at the highest reading and at each step below.
    counts = np.bincount(distance // step, minlength=2)
    return ReadingExtremes(int(pixels.min()), highest, int(counts[0]), int(counts[1:].max()), bits)


def find_reading_step(bits: int) -> int:
    """Return the smallest step between readings [DN]: the lowest bit that any reading sets, or 1 if none is set.

    `bits` is the bitwise OR of the readings. The step is 16 if 12 bits are stored in the upper bits of 16.
    """
    return bits & -bits or 1


def find_full_scale(extremes: Sequence[ReadingExtremes], instrument: Instrument, container_bits: int) -> FullScale:
    """Return the largest possible reading of a dataset.

    The first of these that is available is used: `sensor.full_scale_dn` of instrument.yaml; the plateau of the
    brightest frames, unless it is below `END_OF_RANGE` of the range of `sensor.bit_depth`; the range of
    `sensor.bit_depth`; the range of the stored pixel. Remarks say which keys of instrument.yaml to correct.

    Parameters
    ----------
    extremes : sequence of ReadingExtremes
        One for each frame, of readings after the shift by `sensor.value_shift_bits`. Without frames, the value comes
        from instrument.yaml or the stored pixel.
    instrument : Instrument
        Keys of instrument.yaml, of which `full_scale_dn` and `bit_depth` may be None.
    container_bits : int
        Bits of a stored pixel.
    """
    range_end, depth = get_full_scale(instrument, container_bits), instrument.sensor.bit_depth
    bits = int(np.bitwise_or.reduce([frame.bits for frame in extremes])) if extremes else 0
    highest = max((frame.highest for frame in extremes), default=0)
    remarks = _check_alignment(highest, bits, instrument)
    # The data sheet, or the user, states the value.
    if (stated := instrument.sensor.full_scale_dn) is not None:
        file = instrument.get_file_name("sensor.full_scale_dn")
        too_low = f"{file}: sensor.full_scale_dn is {stated}, but frames read up to {highest} DN; correct it"
        return FullScale(stated, "instrument.yaml", (*remarks, too_low) if highest > stated else remarks)
    # Frames that show a plateau at the highest reading of the dataset.
    lowest = min((frame.lowest for frame in extremes), default=0)
    clipped_frames = [frame for frame in extremes if frame.highest == highest and frame.has_plateau(lowest)]
    converter_source = "bits of the converter"
    if not clipped_frames or highest == range_end:
        container_source = f"container of {container_bits} bit (sensor.bit_depth is missing)"
        return FullScale(range_end, converter_source if depth else container_source, remarks)
    # Clauses for sources and remarks: "2 frames stop at exactly 4000 DN".
    frames_stop = f"{len(clipped_frames)} frames stop" if len(clipped_frames) > 1 else "1 frame stops"
    if depth and highest > END_OF_RANGE * range_end:
        return FullScale(highest, f"{FROM_FRAMES} {frames_stop}, within 1 % of sensor.bit_depth {depth}", remarks)
    most_pixels = max(frame.at_highest for frame in clipped_frames)
    frames_stop_at = f"{frames_stop} at exactly {highest} DN, up to {most_pixels} pixels of one"
    # The plateau is far from the end of the stated range, or no range is stated.
    proposal = _propose_bit_depth(highest, bits)
    if depth is None:
        advice = f"{proposal} would say so" if proposal else "give it"
        remark = (
            f"instrument.yaml: sensor.bit_depth is missing, and {frames_stop_at}, which is taken for full scale;"
            f" {advice}"
        )
        return FullScale(highest, f"{FROM_FRAMES} {frames_stop} (sensor.bit_depth is missing)", (*remarks, remark))
    file = instrument.get_file_name("sensor.bit_depth")
    advice = (
        f"{proposal} would be right" if proposal else "fits take them as whole, and the verdict looks for saturation"
    )
    remark = (
        f"{file}: sensor.bit_depth is {depth}, whose largest reading is {range_end} DN, but {frames_stop_at}; {advice}"
    )
    return FullScale(range_end, converter_source, (*remarks, remark))


def _propose_bit_depth(highest: int, bits: int) -> str:
    """Return the keys of instrument.yaml for a converter whose largest reading is `highest` [DN], as text.

    It is "" if no converter ends there: the number of readings is then no power of two. `bits` is the bitwise OR of all
    readings.
    """
    step = find_reading_step(bits)
    # Number of possible readings, 0 included.
    reading_count = highest // step + 1
    # A power of two has no bit in common with the number below it.
    if reading_count & (reading_count - 1):
        return ""
    shift = f" and sensor.value_shift_bits {step.bit_length() - 1}" if step > 1 else ""
    return f"sensor.bit_depth {reading_count.bit_length() - 1}{shift}"


def _check_alignment(highest: int, bits: int, instrument: Instrument) -> tuple[str, ...]:
    """Return a remark if all readings are multiples of a step above 1 and the highest is `MIN_STEPS` steps or more.

    The bits of the converter are then the upper ones of the stored pixel, and rounding noise is larger than assumed.
    `highest` [DN] and `bits` (bitwise OR) are those of readings after the shift by `sensor.value_shift_bits`. The
    result is an empty tuple otherwise.
    """
    step = find_reading_step(bits)
    if step == 1 or highest < MIN_STEPS * step:
        return ()
    shift = instrument.sensor.value_shift_bits + step.bit_length() - 1
    return (
        f"every reading is a multiple of {step}: set sensor.value_shift_bits to {shift}, and give gain and"
        f" black level in steps of {step}",
    )
