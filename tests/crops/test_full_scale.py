"""Where readings stop, seen in frames without a bit depth: plateaus of any converter, and what only looks like one."""

import numpy as np
import pytest

from spotcheck.characterization.sensor_choice import choose_sensor_values, read_sensor_model
from spotcheck.crops.full_scale import FullScale, find_full_scale, find_reading_step, measure_extremes
from spotcheck.crops.ingest import ingest_frames, read_full_scale
from spotcheck.dataset.instrument import Instrument, Sensor
from spotcheck.fitting.crop_fits import fit_crops, select_preferred_fits
from spotcheck.io import store
from spotcheck.model.spot import elliptical_gaussian
from tests.samples.small_datasets import crops_of, loaded

GAIN, NOISE_E, BLACK = 0.4, 4.0, 25.0


def spot(rng, amplitude, highest, shape=(110, 120), widths=(8.0, 6.0), shift=0) -> np.ndarray:
    """A drawn spot of an amplitude [DN] that a converter ends at its highest number."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    light = elliptical_gaussian(x, y, amplitude, 58.2, 53.7, *widths, np.radians(20.0))
    electrons = rng.poisson(light / GAIN) + rng.normal(0, NOISE_E, shape)
    return np.clip(np.rint(BLACK + GAIN * electrons), 0, highest).astype(np.uint16) << shift


@pytest.mark.parametrize(("highest", "shift"), [(1023, 0), (1023, 6), (16383, 0), (4095, 4), (3871, 0)])
def test_a_clipped_spot_is_fitted_as_one_without_a_bit_depth(tmp_path, highest, shift):
    """Amplitude 2.5 times full scale and both widths within four standard errors; flagged; one number for all stages.
    Any end will do: also one that is no power of two, as where a camera subtracts its black level."""
    rng, amplitude = np.random.default_rng(highest + shift), 2.5 * highest
    frames = [spot(rng, amplitude, highest, shift=shift) for _ in range(3)]
    unit = 2**shift
    sheet = f"sensor: {{gain_dn_per_e: {GAIN * unit}, read_noise_e: {NOISE_E}, black_level_dn: {BLACK * unit}}}"
    dataset = loaded(tmp_path, frames, f"crop_px: 96\n{sheet}")
    table = ingest_frames(dataset)
    assert int(table["full_scale"]) == highest * unit and (table["at_full_scale"] > 10).all()
    said = "\n".join(store.remarks_of(table))
    assert f"3 frames stop at exactly {highest * unit} DN" in said
    depth = {1023: "sensor.bit_depth 10", 16383: "sensor.bit_depth 14", 4095: "sensor.bit_depth 12", 3871: "give it"}
    assert depth[highest] in said and (f"value_shift_bits {shift}" in said) == bool(shift)
    sensor = read_sensor_model(choose_sensor_values(dataset, read_full_scale(table), []))
    fits = select_preferred_fits(fit_crops(crops_of(dataset), sensor))
    assert sensor.full_scale_dn == highest * unit
    assert set(store.status_names(fits["status"].values).ravel()) == {"clipped"}
    for name, truth in (("amplitude", amplitude * unit), ("sigma_major", 8.0), ("sigma_minor", 6.0)):
        off = (fits[name].values - truth) / fits[f"{name}_stderr"].values
        # Of 9 numbers in 5 cases one in 350 runs is beyond; steps of 2^shift add 1/12 of their square, below 10 %.
        assert np.abs(off).max() < 4, (name, off)


def end_of(*frames: np.ndarray, bits: int = 16, **sensor) -> FullScale:
    """Where the readings of frames stop, in a container of so many bits."""
    given = Instrument(sensor=Sensor(**sensor), given_keys=frozenset(f"sensor.{key}" for key in sensor))
    return find_full_scale([measure_extremes(pixels) for pixels in frames], given, bits)


@pytest.mark.parametrize("seed", range(40))
def test_what_is_not_clipped_has_no_end(seed):
    """Spots, flats and darks of many levels and noises: full scale is that of the container. A false alarm in one of
    1e5 frames would fail here once in 1000 runs."""
    rng = np.random.default_rng(seed)
    level, noise = 10 ** rng.uniform(0.5, 4), 10 ** rng.uniform(-0.5, 1.5)
    frames = [
        spot(rng, level, 65535),
        np.rint(np.maximum(rng.normal(level, noise, (90, 100)), 0)).astype(np.uint16),
        np.rint(20 + rng.exponential(level / 3, (90, 100))).astype(np.uint16),
    ]
    assert [end_of(pixels).reading for pixels in frames] == [65535] * 3


def test_frames_of_one_number_are_clipped_beside_others_only():
    """Black frames of a camera without noise, all 0 or 41 or mostly so, are not; a flat of 1023 is beside darks."""
    mostly = np.full((50, 50), 41, np.uint16)
    mostly[::3] = 40
    for pixels in (np.zeros((50, 50), np.uint16), np.full((50, 50), 41, np.uint16), mostly):
        assert end_of(pixels).reading == 65535
    assert end_of(mostly, np.full((50, 50), 1023, np.uint16)).reading == 1023
    assert end_of(bits=8).reading == 255


# Stated depth, highest reading, full scale, and what the remark says.
STATED = [
    *((12, highest, highest, "") for highest in (4080, 4094, 4095)),
    (12, 4000, 4095, "the verdict looks for saturation"),
    (16, 4095, 65535, "sensor.bit_depth 12 would be right"),
    (16, 2900, 65535, "the verdict looks for saturation"),
]


@pytest.mark.parametrize(("depth", "highest", "end", "words"), STATED)
def test_a_plateau_below_the_stated_depth(depth, highest, end, words):
    """Within 1 % of it it is the end. Further below the depth stands, and a remark says which would be right; a stop
    that no converter has is left to the verdict."""
    found = end_of(spot(np.random.default_rng(5), 3 * highest, highest), bit_depth=depth)
    assert found.reading == end and len(found.remarks) == bool(words)
    assert all(f"stops at exactly {highest} DN" in remark and words in remark for remark in found.remarks)


@pytest.mark.parametrize(("stated", "remarks"), [(700, 0), (650, 1)])
def test_full_scale_is_taken_from_the_file(stated, remarks):
    """A reading below that of its bits; frames that read more are remarked on."""
    found = end_of(spot(np.random.default_rng(6), 900, 700), bit_depth=10, full_scale_dn=stated)
    assert (found.reading, found.source, len(found.remarks)) == (stated, "instrument.yaml", remarks)


@pytest.mark.parametrize("shift", [0, 1, 4, 6])
def test_left_aligned_values_are_said(shift):
    """The lowest bit that any reading has set."""
    pixels = spot(np.random.default_rng(4), 600, 1023, shift=shift)
    end = end_of(pixels)
    assert find_reading_step(measure_extremes(pixels).bits) == 2**shift
    assert ([f"sensor.value_shift_bits to {shift}" in text for text in end.remarks] == [True]) == bool(shift)
