"""Numbers that cannot be true together: each is said in a sentence with its keys, and what it spoils is unknown."""

import numpy as np
import pytest

from spotcheck.characterization.characterise import characterise_sensor
from spotcheck.characterization.contradictions import MAX_EXPOSURE_RATIO, describe_long_darks
from spotcheck.characterization.dark_frames import DarkLevels
from spotcheck.characterization.emva_quantities import Quantity
from spotcheck.characterization.sensor_choice import choose_sensor_values, read_sensor_model
from spotcheck.crops.full_scale import FullScale
from spotcheck.dataset.folder import load
from spotcheck.io import store
from spotcheck.sensor import SensorModel
from tests.samples.small_datasets import HEADER, folder

END = FullScale(4095, "bits of the converter")
TRUTH = SensorModel(
    0.5, 9.0, dark_current_e_per_s=300.0, black_level_dn=30.0, full_scale_dn=4095, quantum_efficiency=0.4
)
FLAT_S = np.linspace(2e-3, 3e-2, 9)
PHOTONS = 5e5 * FLAT_S


def stack(photons: float, exposure_s: float, rng: np.random.Generator) -> np.ndarray:
    """Two frames of even light."""
    return TRUTH.draw(np.full((2, 70, 80), photons), rng, exposure_s=exposure_s)


def characterised(dark_s, photons=PHOTONS):
    """The sensor by nine flats of 2 to 30 ms and darks of the given exposures."""
    rng = np.random.default_rng(8)
    bright = [stack(light, t, rng) for light, t in zip(PHOTONS, FLAT_S, strict=True)]
    dark = [stack(0.0, t, rng) for t in dark_s]
    return characterise_sensor(bright, dark, FLAT_S, photons, bit_depth=12, dark_exposure_s=dark_s)


@pytest.mark.parametrize(
    ("dark_s", "known"),
    [([4.0], False), ([4.0, 7.0], False), ([4.0, 5.5, 7.0], True), ([3e-2], True), ([1e-4], True), (FLAT_S, True)],
)
def test_darks_that_last_longer_tell_no_read_noise(dark_s, known):
    """300 e-/s in 4 s are 1200 e-, so that 9 e- of noise look like 36: unknown, and a sentence with both exposures.
    From three exposures on the current is taken off. The gain holds: mean and variance move along its line."""
    found = characterised(dark_s)
    assert abs(found["gain"].value - 0.5) < 4 * found["gain"].stderr
    assert np.isfinite(found["dark_noise"].value) == known == np.isfinite(found["dark_offset"].value)
    said = [text for text in found.remarks if "dark current is not known" in text]
    assert len(said) == (not known)
    if known:
        assert abs(found["dark_noise"].value - 9.0) < 4 * found["dark_noise"].stderr + 0.1
    else:
        assert f"the darks last {min(dark_s):g}" in said[0] and "the flats 0.002 to 0.03 s" in said[0]
        assert found["dark_noise"].why == "the darks last much longer than the flats"


def test_how_much_longer_darks_may_last():
    """Twice as long as the longest that they serve; not recorded exposures and bias frames are no contradiction."""
    assert describe_long_darks([MAX_EXPOSURE_RATIO * 0.02], [0.001, 0.02], "spots") == ""
    assert describe_long_darks([1.01 * MAX_EXPOSURE_RATIO * 0.02], [0.001, 0.02], "spots")
    assert (
        describe_long_darks([], [0.02], "spots")
        == describe_long_darks([3.0], [], "spots")
        == describe_long_darks([0.0], [0.02], "spots")
        == ""
    )
    assert describe_long_darks([np.nan], [0.02], "spots") == ""


def test_photons_by_the_second_are_seen():
    """A lamp of 5e5 photons a second, given as such in every row or with the lamp changed: what rests on it is
    unknown, and the gain is not."""
    found = characterised([3e-2], np.full(len(FLAT_S), 5e5))
    said = [text for text in found.remarks if "photons a second" in text]
    assert len(said) == 1 and "photons_per_px" in said[0] and "during the exposure" in said[0]
    assert np.isnan(found["quantum_efficiency"].value) and np.isnan(found["full_well"].value)
    assert abs(found["gain"].value - 0.5) < 4 * found["gain"].stderr
    right = characterised([3e-2])
    assert not any("photons" in text for text in right.remarks)
    assert abs(right["quantum_efficiency"].value - 0.4) < 4 * right["quantum_efficiency"].stderr


def test_more_electrons_than_photons_are_impossible():
    """Photons given as a sixth of what they were: an efficiency of 2.4, within its error of 2 %."""
    found = characterised([3e-2], PHOTONS / 6)
    assert any(
        "efficiency would be 2." in text and "photons_per_px of manifest.csv is too small" in text
        for text in found.remarks
    )
    assert np.isnan(found["quantum_efficiency"].value) and np.isfinite(found["threshold"].value)


def quantity(name: str, value: float, stderr: float) -> Quantity:
    """A measured number."""
    return Quantity(name, "", value, stderr, "")


MEASURED = {"gain": quantity("gain", 0.2, 1e-3), "dark_noise": quantity("dark_noise", 12.0, 0.1),
            "dark_offset": quantity("dark_offset", 50.0, 0.1)}  # fmt: skip
# Keys of the sensor → words of the sentence, and which quantity is then unknown or not taken.
AGAINST_FLATS = {
    "gain the other way round": (
        "gain_dn_per_e: 5", ("sensor.gain_dn_per_e is 5", "5 e-/DN are 0.2 DN/e-"), "gain_dn_per_e",
    ),
    "gain of another setting": (
        "gain_dn_per_e: 0.8", ("sensor.gain_dn_per_e is 0.8", "0.2000 ± 0.0010"), "gain_dn_per_e",
    ),
    "read noise in DN": ("read_noise_e: 2.4", ("sensor.read_noise_e is 2.4", "2.4 DN are 12 e-"), "read_noise_e"),
    "black level above the frames": ("black_level_dn: 130", ("black_level_dn is 130", "reads 50 DN"), None),
    "well below the readings": (
        "full_well_e: 900", ("full_well_e is 900", "230 DN", "up to 3000 DN", "14750 e-"), None,
    ),
    "dark current above full scale": (
        "dark_current_e_per_s: 2e6", ("dark_current_e_per_s is 2e+06", "above the full scale of 4095 DN"), None,
    ),
}  # fmt: skip


def settled(base, sensor: str, rows=("frames/a.tif,spot,0,0.02,0",), darks=DarkLevels(darkest_dn=50.0), **options):  # noqa: B008
    """The sensor of a dataset of these keys and rows."""
    dataset = load(folder(base, list(rows), f"crop_px: 24\nsensor: {{bit_depth: 12, {sensor}}}", HEADER))
    return choose_sensor_values(dataset, END, [], darks, options.get("measured", MEASURED), highest_dn=3000.0)


@pytest.mark.parametrize(("sensor", "words", "unknown"), AGAINST_FLATS.values(), ids=AGAINST_FLATS)
def test_a_data_sheet_against_flats_and_readings(tmp_path, sensor, words, unknown):
    """One sentence with key, value and what would be right; what it spoils is unknown and says so."""
    ds = settled(tmp_path, sensor)
    said = store.remarks_of(ds)
    assert len(said) == 1 and all(word in said[0] for word in ("instrument.yaml", *words)), said
    if unknown:
        assert np.isnan(float(ds[unknown])) and ds[unknown].attrs["source"] == f"unknown: {said[0]}"
        assert read_sensor_model(ds) is None
    else:
        assert read_sensor_model(ds) is not None


def test_what_a_contradicted_key_leaves(tmp_path):
    """A black level above what frames read gives way to the darks', and where nothing else tells it stays under its own
    name; a full well below it gives way to none."""
    ds = settled(tmp_path / "a", "black_level_dn: 130")
    assert float(ds["black_level_dn"]) == 50 and float(ds["black_level_dn_by"].sel(source="data sheet")) == 130
    alone = settled(tmp_path / "alone", "black_level_dn: 130, black_level_dn_stderr: 2", measured={})
    how = "instrument.yaml, although frames contradict it: no other source gives a value"
    assert (float(alone["black_level_dn"]), alone["black_level_dn"].attrs["source"]) == (130, how)
    ds = settled(tmp_path / "b", "full_well_e: 900")
    assert np.isinf(float(ds["full_well_e"])) and "full_well_e is 900" in ds["full_well_e"].attrs["source"]


def test_a_noise_that_rounding_hides_is_no_contradiction(tmp_path):
    """Darks of no noise give 0.396 DN at most, 1.98 e- at 0.2 DN/e-: a data sheet of 1 e- may well be right."""
    measured = MEASURED | {"dark_noise": quantity("dark_noise", 1.98, 0.01)}
    ds = settled(tmp_path, "read_noise_e: 1", measured=measured)
    assert float(ds["read_noise_e"]) == 1 and not any("flats and darks" in text for text in store.remarks_of(ds))


def test_an_efficiency_that_flats_contradict_stays(tmp_path):
    """It is said, and the noise of a reading does not rest on it."""
    measured = MEASURED | {"quantum_efficiency": quantity("quantum_efficiency", 0.3, 0.005)}
    ds = settled(tmp_path, "quantum_efficiency: 0.6", measured=measured)
    assert float(ds["quantum_efficiency"]) == 0.6 and "quantum_efficiency is 0.6" in store.remarks_of(ds)[0]


@pytest.mark.parametrize(
    "sensor", ["gain_dn_per_e: 0.22, read_noise_e: 13", "full_well_e: 15000, black_level_dn: 50.5"]
)
def test_a_data_sheet_that_agrees_is_no_remark(tmp_path, sensor):
    """Typical values are off by some percent, and a level by its rounding."""
    ds = settled(tmp_path, sensor)
    assert store.remarks_of(ds) == [] and read_sensor_model(ds) is not None


DARK_ROWS = ("frames/a.tif,spot,0,0.02,0", "frames/d.tif,dark,,5,0", "frames/e.tif,dark,,5,1")
LONG = {"gain": MEASURED["gain"], "dark_noise": quantity("dark_noise", 41.0, 0.3),
        "dark_offset": quantity("dark_offset", 370.0, 0.1)}  # fmt: skip


def test_long_darks_beside_short_spots(tmp_path):
    """Neither black level nor read noise comes from darks of 5 s where spots last 20 ms; with the dark current of the
    data sheet, 320 e-/s, both do, less 1600 e-: √(41² − 1600) = 9 e- and 370 − 0.2 · 1600 = 50 DN."""
    darks = DarkLevels([370.0, 370.0], "", 50.0)
    ds = settled(tmp_path / "a", "gain_dn_per_e: 0.2", DARK_ROWS, darks, measured=LONG)
    (said,) = store.remarks_of(ds)
    assert "the darks last 5 s and the spots 0.02 s" in said and said in ds["black_level_dn"].attrs["source"]
    assert np.isnan(float(ds["read_noise_e"])) and float(ds["black_level_dn"]) == 0
    ds = settled(tmp_path / "b", "dark_current_e_per_s: 320", DARK_ROWS, darks, measured=LONG)
    assert store.remarks_of(ds) == []
    assert float(ds["read_noise_e"]) == pytest.approx(9.0) and float(ds["black_level_dn"]) == pytest.approx(50.0)
    ds = settled(tmp_path / "c", "dark_current_e_per_s: 3200", DARK_ROWS, darks, measured=LONG)
    (said,) = store.remarks_of(ds)
    assert "sensor.dark_current_e_per_s is 3200, which is 1.6e+04 e- in darks of 5 s" in said
    assert np.isnan(float(ds["read_noise_e"]))
