"""Where the sensor's quantities come from: data sheet, dark frames, neighbour differences, default."""

import numpy as np
import pytest

from spotcheck.characterization.dark_frames import DarkLevels, select_dark_levels
from spotcheck.characterization.emva_quantities import Quantity
from spotcheck.characterization.sensor_choice import choose_sensor_values, read_sources
from spotcheck.crops.full_scale import FullScale
from spotcheck.dataset.frames import reduce_frame
from spotcheck.model.spot import elliptical_gaussian
from spotcheck.sensor import SensorModel
from tests.reference.numpy_chain import draw
from tests.samples.small_datasets import loaded

TRUTH = SensorModel(0.25, 8.0, black_level_dn=60.0, full_scale_dn=4095)
END = FullScale(4095, "bits of the converter")
FRAME = [np.full((40, 40), 60, np.uint16)]


def test_a_given_key_a_default_and_an_unknown(tmp_path):
    """Each quantity says which it is."""
    ds = choose_sensor_values(loaded(tmp_path, FRAME, "crop_px: 24\nsensor: {black_level_dn: 5}"), END, [])
    assert ds["black_level_dn"].attrs["source"] == "instrument.yaml"
    assert ds["dark_current_e_per_s"].attrs["source"] == "default"
    assert np.isnan(float(ds["gain_dn_per_e"])) and ds["gain_dn_per_e"].attrs["source"].startswith("unknown")


def test_dark_frames_replace_a_missing_black_level(tmp_path):
    """Their mean, with its standard error; a given key stands."""
    ds = choose_sensor_values(loaded(tmp_path / "a", FRAME, "crop_px: 24"), END, [], DarkLevels([59.0, 60.0, 61.0]))
    assert float(ds["black_level_dn"]) == 60 and ds["black_level_dn"].attrs["source"] == "mean of 3 dark frames"
    assert float(ds["black_level_dn_stderr"]) == pytest.approx(1 / np.sqrt(3))
    ds = choose_sensor_values(
        loaded(tmp_path / "b", FRAME, "crop_px: 24\nsensor: {black_level_dn: 5}"), END, [], DarkLevels([60.0])
    )
    assert float(ds["black_level_dn"]) == 5


@pytest.mark.parametrize("seed", range(6))
def test_gain_and_read_noise_of_a_camera_without_a_data_sheet(tmp_path, seed):
    """Twelve spots: K = 0.25 and 8 e- within four of their standard errors (false alarm of the file 8e-4), to 5 %."""
    rng = np.random.default_rng(seed)
    pixel = np.arange(100.0)
    crops = []
    for k in range(12):
        light = elliptical_gaussian(pixel[None], pixel[:, None], 400.0 + 200 * k, 50, 49, 17.0, 12.0, 0.4)
        crops.append(draw(light, 0.0, TRUTH, rng).astype(np.float32))
    text = "crop_px: 24\nsensor: {bit_depth: 12, black_level_dn: 60}"
    ds = choose_sensor_values(loaded(tmp_path, FRAME, text), END, crops)
    for name, truth in (("gain_dn_per_e", 0.25), ("read_noise_e", 8.0)):
        value, error = float(ds[name]), float(ds[f"{name}_stderr"])
        assert abs(value - truth) < 4 * error, (name, value, error)
    assert float(ds["gain_dn_per_e"]) == pytest.approx(0.25, rel=0.05)
    assert "in 12 frames" in ds["gain_dn_per_e"].attrs["source"]


def spots_that_stop(rng, level_e, exposures=(0.5, 1.0, 2.0), plateau=False):
    """Spots of 2000 to 8000 DN in light whose signal stops at a level; with `plateau` their light is cut instead."""
    y, x = np.mgrid[:100, :100].astype(float)
    out = []
    for k in range(12):
        peak = 4000.0 * exposures[k % len(exposures)]
        light = peak * np.exp(-((x - 50) ** 2 + (y - 49) ** 2) / (2 * 14.0**2))
        light = np.minimum(light, 0.5 * peak) if plateau else light
        electrons = np.minimum(rng.poisson(light / 0.25), level_e) + rng.normal(0, 8.0, light.shape)
        out.append(np.clip(np.rint(60 + 0.25 * electrons), 0, 4095).astype(np.float32))
    return out


TEXT = "crop_px: 24\nsensor: {bit_depth: 12, black_level_dn: 60}"


def test_spots_tell_where_the_signal_stops(tmp_path):
    """Twelve clipped spots: gain within 5 %, full well within 2 % and four standard errors; the chain does not take
    it, as the verdict is to find it."""
    crops = spots_that_stop(np.random.default_rng(3), 10000.0)
    ds = choose_sensor_values(loaded(tmp_path, FRAME, TEXT), END, crops)
    by_spots = {name: float(ds[f"{name}_by"].sel(source="spots")) for name in ("gain_dn_per_e", "full_well_e")}
    assert by_spots["gain_dn_per_e"] == pytest.approx(0.25, rel=0.05)
    assert by_spots["full_well_e"] * by_spots["gain_dn_per_e"] == pytest.approx(2500, rel=0.02)
    assert np.isinf(float(ds["full_well_e"])) and ds["full_well_e"].attrs["source"] == "none given"


def test_what_does_not_stop_has_no_full_well(tmp_path):
    """Neither spots below saturation, nor light with a plateau of its own, at another level in every exposure."""
    free = spots_that_stop(np.random.default_rng(4), 1e9, exposures=(0.5, 0.7, 0.9))
    flat = spots_that_stop(np.random.default_rng(5), 1e9, exposures=(0.5, 1.0, 1.6), plateau=True)
    for k, crops in enumerate((free, flat)):
        ds = choose_sensor_values(loaded(tmp_path / f"{k}", FRAME, TEXT), END, crops)
        assert np.isnan(float(ds["full_well_e_by"].sel(source="spots")))


@pytest.mark.parametrize(("level", "plateau", "known"), [(9000.0, False, True), (1e9, True, False)])
def test_a_plateau_of_the_light_keeps_its_noise(tmp_path, level, plateau, known):
    """Under the paper's flat-topped light readings that gather are the sensor's end only if their noise is gone: frames
    of one exposure in pairs, all of which gather at the same level."""
    crops = spots_that_stop(np.random.default_rng(7), level, exposures=(1.25,) if plateau else (1.5,), plateau=plateau)
    pairs = {"repeats": list(zip(crops[::2], crops[1::2], strict=True))}
    text = TEXT + "\nmodel: {top_hat: true}"
    ds = choose_sensor_values(loaded(tmp_path, FRAME, text), END, crops, pairs=pairs)
    full_well = float(ds["full_well_e_by"].sel(source="spots"))
    assert np.isfinite(full_well) == known
    if known:
        # The level is known to a bin of 4 %, the gain to its error.
        assert full_well == pytest.approx(level, rel=0.05)


def test_flats_speak_before_spots_and_after_the_data_sheet(tmp_path):
    """Gain of the flats where the data sheet is silent; all three side by side."""
    measured = {
        "gain": Quantity("gain", "K", 0.26, 0.001, "DN/e-"),
        "dark_noise": Quantity("dark_noise", "σ_d", 8.1, 0.1, "e-"),
        "dark_current": Quantity("dark_current", "μ_I", -2.0, 3.0, "e-/s"),
        "full_well": Quantity("full_well", "μ_e.sat", 9900.0, 50.0, "e-"),
    }
    crops = spots_that_stop(np.random.default_rng(6), 10000.0)
    ds = choose_sensor_values(loaded(tmp_path / "a", FRAME, TEXT), END, crops, measured=measured)
    assert (float(ds["gain_dn_per_e"]), float(ds["read_noise_e"])) == (0.26, 8.1)
    assert float(ds["dark_current_e_per_s"]) == 0 and np.isinf(float(ds["full_well_e"]))
    assert ds["gain_dn_per_e"].attrs["source"] == "photon transfer of flats and darks"
    assert read_sources(ds)["gain_dn_per_e"] == "flats and darks"
    by_spots = choose_sensor_values(loaded(tmp_path / "c", FRAME, TEXT), END, crops)
    assert read_sources(by_spots)["gain_dn_per_e"] == read_sources(by_spots)["read_noise_e"] == "spots"
    assert read_sources(by_spots)["black_level_dn"] == "data sheet" and "dark_current_e_per_s" not in read_sources(
        by_spots
    )
    sheet = TEXT.replace("bit_depth: 12", "bit_depth: 12, gain_dn_per_e: 0.3")
    ds = choose_sensor_values(loaded(tmp_path / "b", FRAME, sheet), END, crops, measured=measured)
    assert float(ds["gain_dn_per_e"]) == 0.3 and float(ds["read_noise_e"]) == 8.1
    assert np.isfinite(ds["gain_dn_per_e_by"].values).all()


def test_black_level_goes_with_the_dark_current(tmp_path):
    """With a dark current it is the offset at no exposure; without, or beside darks with light, what darks read."""
    offset = Quantity("dark_offset", "μ_y.dark", 58.0, 0.1, "DN")
    current = Quantity("dark_current", "μ_I", 200.0, 3.0, "e-/s")
    means, text = [59.0, 60.0, 61.0], "crop_px: 24"
    cases = (({"dark_offset": offset, "dark_current": current}, "", 58.0), ({"dark_offset": offset}, "", 60.0),
             ({"dark_offset": offset, "dark_current": current}, "1 of 4 dark frames hold light", 60.0))  # fmt: skip
    for k, (measured, remark, black) in enumerate(cases):
        ds = choose_sensor_values(loaded(tmp_path / f"{k}", FRAME, text), END, [], DarkLevels(means, remark), measured)
        assert float(ds["black_level_dn"]) == black


def spot_frame(rng, black_dn, ambient_dn=0.0):
    """A reduced frame of 240 × 320 px with a Gaussian spot on a pedestal, gain 0.5 DN/e- and 4 e- of read noise."""
    y, x = np.mgrid[:240, :320]
    light = ambient_dn + 500 * np.exp(-((x - 170) ** 2 + (y - 110) ** 2) / (2 * 9.0**2))
    electrons = rng.poisson(light / 0.5) + rng.normal(0, 4.0, light.shape)
    return reduce_frame(np.clip(np.rint(black_dn + 0.5 * electrons), 0, 4095).astype(np.uint16))


@pytest.mark.parametrize(("black_dn", "count"), [(64.0, 1), (240.0, 5)])
def test_dark_pixels_give_the_black_level_without_a_sheet_and_darks(tmp_path, black_dn, count):
    """Within 0.2 DN, ten standard errors of the level of a frame; a sheet and darks, even lit ones, go before it."""
    rng = np.random.default_rng(1)
    spots = [spot_frame(rng, black_dn) for _ in range(count)]
    darks = select_dark_levels([], spots, 4095.0)
    ds = choose_sensor_values(loaded(tmp_path / "a", FRAME, "crop_px: 24"), END, [], darks)
    assert float(ds["black_level_dn"]) == pytest.approx(black_dn, abs=0.2)
    assert 0 < float(ds["black_level_dn_stderr"]) < 0.3
    assert ds["black_level_dn"].attrs["source"].startswith("dark pixels of the spot frames")
    stated = loaded(tmp_path / "b", FRAME, "crop_px: 24\nsensor: {black_level_dn: 5}")
    assert float(choose_sensor_values(stated, END, [], darks)["black_level_dn"]) == 5
    lit_darks = select_dark_levels([spot_frame(rng, 300.0)], spots, 4095.0)
    unknown = choose_sensor_values(loaded(tmp_path / "c", FRAME, "crop_px: 24"), END, [], lit_darks)["black_level_dn"]
    assert float(unknown) == 0 and unknown.attrs["source"].startswith("default; 1 of 1 dark frames hold light")


def test_stray_light_of_some_frames_is_in_the_error_of_the_black_level():
    """The darkest frame gives the level; the scatter of the frames, 20 DN here, is in its error."""
    rng = np.random.default_rng(2)
    frames = [spot_frame(rng, 64.0, ambient) for ambient in (0.0, 20.0, 40.0)]
    level, error = select_dark_levels([], frames, 4095.0).dark_pixels
    assert level == pytest.approx(64, abs=0.2) and error == pytest.approx(20, abs=1)
