"""Where readings stop: the converter's largest number, as the data sheet gives it or as the frames show it.

Every pixel that would read more than the converter can say reads the same number, so a clip is a plateau: many pixels
at exactly the highest reading, where light and noise alone would spread them over many.

# ASSUME: no light is so flat and no noise so small that pixels gather at exactly the highest reading without a clip.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.dataset.frames import get_full_scale
from spotcheck.dataset.instrument import Instrument

# Readings below the highest that a plateau is compared with: enough that one of them is read where light goes on, few
# enough that a spot has about as many pixels in each.
BENEATH = 16
# A plateau has this many pixels at least, and this many times those of the fullest reading beneath. Where the mean
# number of pixels in a reading is 1, ten come about by chance once in 1e7 frames.
LEAST_PX, GATHER = 10, 5


# A plateau above this part of a stated full scale is the converter's end: many stop some readings below their last
# number, at 4080 or 4094 of 4095. Below it the sensor saturates, which the verdict is to find.
NEAR_END = 0.99


class Top(NamedTuple):
    """Highest and lowest reading of a frame [DN]; how many pixels read the highest, and how many the fullest of the
    `BENEATH` readings below it; and the bits that any of its readings has set."""

    highest: int
    lowest: int
    pixels: int
    beneath: int
    bits: int

    def stops(self, lowest: int) -> bool:
        """Whether pixels gather at the highest reading, above a lowest of all frames; frames of hardly any light and no
        noise read one number everywhere."""
        gathers = self.pixels >= max(LEAST_PX, GATHER * self.beneath)
        return gathers and self.highest - lowest >= BENEATH * step_of(self.bits)


class End(NamedTuple):
    """The largest reading [DN] that a frame of a dataset can hold, how that is known, and remarks for the user."""

    reading: int
    source: str
    remarks: tuple[str, ...] = ()


def top_of(pixels: np.ndarray) -> Top:
    """What the largest readings of a frame [rows, columns] are."""
    highest, bits = int(pixels.max()), int(np.bitwise_or.reduce(pixels, axis=None))
    near = highest - pixels[pixels >= highest - min(BENEATH * step_of(bits), highest)].astype(np.int64)
    count = np.bincount(near // step_of(bits), minlength=2)
    return Top(highest, int(pixels.min()), int(count[0]), int(count[1:].max()), bits)


def step_of(bits: int) -> int:
    """Least step between readings [DN] by the bits that they have set: 16 of 12 bits left-aligned in 16."""
    return bits & -bits or 1


def end_of(tops: Sequence[Top], instrument: Instrument, container_bits: int) -> End:
    """Where the readings of all frames of a dataset stop: where instrument.yaml says so; at the largest number of the
    converter where its depth is given, or at a plateau just below that; else at the plateau of its brightest frames;
    else at the largest number of the container."""
    declared, depth = get_full_scale(instrument, container_bits), instrument.sensor.bit_depth
    bits = int(np.bitwise_or.reduce([own.bits for own in tops])) if tops else 0
    remarks = _on_alignment(tops, bits, instrument)
    highest = max((own.highest for own in tops), default=0)
    if (stated := instrument.sensor.full_scale_dn) is not None:
        file = instrument.get_file_name("sensor.full_scale_dn")
        above = f"{file}: sensor.full_scale_dn is {stated}, but frames read up to {highest} DN; correct it"
        return End(stated, "instrument.yaml", (*remarks, above) if highest > stated else remarks)
    lowest = min((own.lowest for own in tops), default=0)
    stopped = [own for own in tops if own.highest == highest and own.stops(lowest)]
    if not stopped or highest == declared:
        source = (
            "bits of the converter" if depth else f"container of {container_bits} bit (sensor.bit_depth is missing)"
        )
        return End(declared, source, remarks)
    frames = f"{len(stopped)} frames stop" if len(stopped) > 1 else "1 frame stops"
    if depth and highest > NEAR_END * declared:
        return End(highest, f"where {frames}, within 1 % of sensor.bit_depth {depth}", remarks)
    seen = f"{frames} at exactly {highest} DN, up to {max(own.pixels for own in stopped)} pixels of one"
    step = step_of(bits)
    width = (highest // step + 1).bit_length() - 1
    right = f"sensor.bit_depth {width}" + (f" and sensor.value_shift_bits {step.bit_length() - 1}" if step > 1 else "")
    whole = highest // step + 1 == 2**width
    if depth is None:
        missing = f"instrument.yaml: sensor.bit_depth is missing, and {seen}, which is taken for full scale"
        remarks += (f"{missing}; {f'{right} would say so' if whole else 'give it'}",)
        return End(highest, f"where {frames} (sensor.bit_depth is missing)", remarks)
    file = instrument.get_file_name("sensor.bit_depth")
    what = f"{file}: sensor.bit_depth is {depth}, whose largest reading is {declared} DN, but {seen}"
    ask = f"{right} would be right" if whole else "fits take them as whole, and the verdict looks for saturation"
    return End(declared, "bits of the converter", (*remarks, f"{what}; {ask}"))


def _on_alignment(tops: Sequence[Top], bits: int, instrument: Instrument) -> tuple[str, ...]:
    """Whether values are left-aligned and nobody says so: their step then adds more noise than rounding to 1 DN."""
    step, shift = step_of(bits), instrument.sensor.value_shift_bits
    if step == 1 or max(own.highest for own in tops) < BENEATH * step:
        return ()
    unused = step.bit_length() - 1
    return (
        f"every reading is a multiple of {step}: set sensor.value_shift_bits to {shift + unused}, and give gain and"
        f" black level in steps of {step}",
    )
