"""Pixels that differ in offset and gain: their maps by darks and flats, and fits that know them."""

import numpy as np
import pytest
import tifffile
from scipy import stats

from spotcheck.characterization.pixel_maps import fit_light, measure_maps, read_maps, shrink_to_mean
from spotcheck.cli import run
from spotcheck.dataset import folder as dataset
from spotcheck.fitting.spotfit import fit_spots
from spotcheck.io import store
from spotcheck.sensor import SensorModel
from spotcheck.sensor.pixel_maps import PixelMaps
from tests.samples.small_datasets import folder

SHAPE = (48, 64)
DSNU, PRNU = 5.0, 0.03
CAMERAS = {
    "noisy": SensorModel(0.5, 5.0, black_level_dn=60.0, full_scale_dn=1023.0),
    # Rounding is as large as its noise, and dark readings are skewed.
    "quiet": SensorModel(0.5, 1.2, black_level_dn=60.0, full_scale_dn=1023.0),
}
TRUTH = np.array([450.0, 31.3, 22.6, 7.0, 5.0, 0.0, 60.0])
FITS = 150
# Of every bound below, per parameter: seven parameters and two cameras raise a false alarm once in 700 seeds at most.
ALARM = 1e-4


def reading(sensor, light_e, gain, offset, rng):
    """Random readings [DN] of pixels of their own, by the closed form: K (Poisson(g ν) + noise) + black + offset."""
    electrons = rng.poisson(light_e * gain) + rng.normal(0, sensor.read_noise_e, light_e.shape)
    dn = np.rint(sensor.gain_dn_per_e * electrons + sensor.black_level_dn + offset)
    return np.clip(dn, 0, sensor.full_scale_dn)


def spot_e(sensor, peak_dn=TRUTH[0], shape=SHAPE):
    """Mean electrons of the spot."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    _, x0, y0, major, minor, _, _ = TRUTH
    return peak_dn / sensor.gain_dn_per_e * np.exp(-(((x - x0) / major) ** 2 + ((y - y0) / minor) ** 2) / 2)


def pulls(sensor, known: bool, seed: int, peak_dn: float = TRUTH[0]) -> np.ndarray:
    """Deviations from the truth in standard errors [fit, parameter] of fits, with uncertain maps or without any."""
    rng, out = np.random.default_rng(seed), []
    for _ in range(FITS):
        offset, gain = rng.normal(0, DSNU, SHAPE), rng.normal(1, PRNU, SHAPE)
        maps = PixelMaps(offset + rng.normal(0, 1.0, SHAPE), gain + rng.normal(0, 0.01, SHAPE), 1.0, 0.01)
        image = reading(sensor, spot_e(sensor, peak_dn), gain, offset, rng)
        fit = fit_spots(image, sensor, maps=maps if known else None)
        if fit.status == "ok":
            apart = fit.value[:7] - [peak_dn, *TRUTH[1:]]
            apart[5] = (apart[5] + 90) % 180 - 90
            out.append(apart / fit.stderr[:7])
    return np.array(out)


@pytest.mark.parametrize("name", CAMERAS)
def test_fits_that_know_their_pixels_err_as_they_say(name):
    """DSNU 5 DN and PRNU 3 %, known to 1 DN and 1 %, also with a clipped peak: the mean of every parameter's pull is 0
    within 0.3 errors beside chance (log-likelihoods have a bias of second order), and its variance is 1. Without maps
    the variance of most is beyond the same bound."""
    low, high = stats.chi2.ppf([ALARM / 2, 1 - ALARM / 2], FITS - 1) / (FITS - 1)
    chance = stats.norm.isf(ALARM / 2) / np.sqrt(FITS)
    for peak in (TRUTH[0], 1200.0):
        own = pulls(CAMERAS[name], True, 3, peak)
        assert len(own) == FITS
        assert (np.abs(own.mean(axis=0)) < 0.3 + chance).all()
        assert (own.var(axis=0, ddof=1) > low).all() and (own.var(axis=0, ddof=1) < high).all()
    alike = pulls(CAMERAS[name], False, 3)
    assert np.count_nonzero((alike**2).mean(axis=0) > high) >= 5


def test_equal_pixels_change_nothing():
    """Maps of pixels that are alike and certain: the fit is that without maps, to a hundredth of its errors, which is
    what a table between readings misses of that at them."""
    sensor = CAMERAS["noisy"]
    image = reading(sensor, spot_e(sensor), 1.0, 0.0, np.random.default_rng(4))
    plain = fit_spots(image, sensor)
    own = fit_spots(image, sensor, maps=PixelMaps(np.zeros(SHAPE), np.ones(SHAPE)))
    assert own.value[:5] == pytest.approx(plain.value[:5], abs=1e-2 * plain.stderr[:5].min())
    assert own.stderr[:5] == pytest.approx(plain.stderr[:5], rel=1e-2)


def test_pixels_that_no_map_knows_are_left_out():
    """NaN in a map is NaN in the image; beyond the sensor a map knows nothing; shapes must agree."""
    sensor = CAMERAS["noisy"]
    image = reading(sensor, spot_e(sensor), 1.0, 0.0, np.random.default_rng(4))
    maps = PixelMaps(np.zeros(SHAPE), np.ones(SHAPE))
    maps.offset_dn[10, 20], image[10, 20] = np.nan, 1000.0
    masked = np.where(np.isnan(maps.offset_dn), np.nan, image)
    assert (fit_spots(image, sensor, maps=maps).value == fit_spots(masked, sensor, maps=maps).value).all()
    cut = maps.cut(-2, 60, 10, 8)
    assert np.isfinite(cut.gain).sum() == 8 * 4 and np.isfinite(cut.gain[2:, :4]).all()
    assert np.isnan(maps.cut(100, 100, 4, 4).gain).all()
    with pytest.raises(ValueError, match=r"maps: have the shape \(10, 8\), but image 0 has \(48, 64\)"):
        fit_spots(image, sensor, maps=cut)


# Maps by darks and flats.


def test_noise_makes_no_map():
    """Halves that share nothing give no pattern beyond what chance makes of 3072 pixels, and one that they share comes
    out with the error that is stated (rms of a normal law to 5 errors, 1 in 2e6)."""
    rng = np.random.default_rng(5)
    halves = rng.normal(0, 2.0, (2, *SHAPE))
    alike = shrink_to_mean(*halves)
    # Σ ab of n pairs scatters by σ²√n: four of these are a rms of 2 √(4/√n).
    assert alike.rms < 2 * np.sqrt(4 / np.sqrt(halves[0].size)) and alike.stderr <= 2 / np.sqrt(2)
    pattern = rng.normal(0, DSNU, SHAPE)
    pattern[3, 4] = 400.0
    found = shrink_to_mean(*(pattern + halves))
    assert found.values[3, 4] == pytest.approx(400, abs=5 * 2 / np.sqrt(2))
    off = np.delete((found.values - pattern).ravel(), 3 * SHAPE[1] + 4)
    assert np.std(off) == pytest.approx(found.stderr, rel=5 / np.sqrt(2 * off.size))
    assert found.rms == pytest.approx(DSNU, rel=5 / np.sqrt(2 * off.size))


def test_uneven_light_is_no_pattern():
    """A lamp that is darker at the border, with pixels missing, is the polynomial that it is."""
    y, x = np.mgrid[:90, :120]
    lamp = 1000 - 0.05 * (x - 55) ** 2 - 0.03 * (y - 40) ** 2 + 1e-5 * (x - 60) ** 4
    seen = lamp.copy()
    seen[20:23, 30:35] = np.nan
    # Means of blocks of 2 px are not the polynomial's own: its curvature makes them differ by 1/8 of it.
    assert fit_light(seen) == pytest.approx(lamp, abs=0.5)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder of darks, flats and spots of one camera, with the offset at no exposure [DN], its slope [DN/s] and the
    gain of every pixel."""
    base, rng, sensor = tmp_path_factory.mktemp("made") / "data", np.random.default_rng(6), CAMERAS["noisy"]
    offset, slope, gain = rng.normal(0, DSNU, SHAPE), rng.normal(0, 2000.0, SHAPE), rng.normal(1, PRNU, SHAPE)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    lamp = 1 - 1e-4 * ((x - 30) ** 2 + (y - 20) ** 2)
    (base / "frames").mkdir(parents=True)
    rows = []
    plan = [("dark", t, r, 0.0 * lamp) for t in (1e-3, 3e-3) for r in range(6)]
    plan += [("flat", 1e-3, r, 800 * lamp) for r in range(10)]
    plan += [("spot", 1e-3, r, spot_e(sensor)) for r in range(4)]
    for k, (kind, t, repeat, light) in enumerate(plan):
        tifffile.imwrite(base / f"frames/f{k}.tif", reading(sensor, light, gain, offset + t * slope, rng).astype("u2"))
        rows.append(f"frames/f{k}.tif,{kind},{0 if kind == 'spot' else ''},{t},{repeat}")
    text = "{crop_px: 40, sensor: {bit_depth: 10, gain_dn_per_e: 0.5, read_noise_e: 5, black_level_dn: 60}}"
    return folder(base, rows, text), offset, slope, gain


def test_maps_are_the_sensors_own(made):
    """Offset at an exposure and gain of each pixel, to the errors that are stated: the rms of 3072 to 6 of its errors,
    and 5 % or, of gains, 10 % for what means of frames and the lamp's polynomial take up."""
    base, offset, slope, gain = made
    found = measure_maps(dataset.load(base), 1023)
    assert (found.darks, found.flats) == (12, 10)
    for t in (1e-3, 2.5e-3):
        maps, true = found.at(t), offset + t * slope
        off = maps.offset_dn - (true - true.mean())
        assert 0 < maps.offset_stderr_dn < 2.5 * 0.5 * 5 / np.sqrt(12)
        assert np.std(off) == pytest.approx(maps.offset_stderr_dn, rel=0.05 + 6 / np.sqrt(2 * off.size))
    off = maps.gain - gain / gain.mean()
    assert np.std(off) == pytest.approx(maps.gain_stderr, rel=0.1 + 6 / np.sqrt(2 * off.size))
    assert found.gain.rms == pytest.approx(PRNU, rel=0.1) and found.at(None).offset_dn.shape == SHAPE


def test_the_stage_says_what_maps_change(made, tmp_path):
    """Fits with maps have χ² 1, and fits.nc tells what it was before; without maps it holds nothing of them."""
    base, files = (
        str(made[0]),
        {name: str(tmp_path / f"{name}.nc") for name in ("frames", "crops", "sensor", "maps", "fits")},
    )
    run(["ingest", base, "--output", files["frames"]])
    run(["crop", base, "--frames", files["frames"], "--output", files["crops"]])
    seen = ["--crops", files["crops"]]
    run(["sensor", base, *seen, "--frames", files["frames"], "--output", files["sensor"]])
    run(["maps", base, "--frames", files["frames"], "--output", files["maps"]])
    fit = ["fit", base, *seen, "--sensor", files["sensor"], "--output", files["fits"]]
    run(fit)
    with store.read(files["fits"]) as plain:
        before = plain["chi2_reduced"].sel(centring="light", fit="likelihood").values.ravel()
        assert not [name for name in plain.variables if name == "chi2_without_maps" or name.endswith("_moved")]
    run([*fit, "--maps", files["maps"]])
    with store.read(files["fits"]) as fits:
        own = fits.sel(centring="light")
        after = own["chi2_reduced"].sel(fit="likelihood").values.ravel()
        assert own["chi2_without_maps"].values.ravel() == pytest.approx(before, rel=1e-9, nan_ok=True)
        # Of some 1600 pixels; five standard deviations of χ².
        assert after == pytest.approx(1, abs=5 * np.sqrt(2 / 1600)) and np.nanmin(before) > 2
        moved = own["sigma_mean_moved"].values.ravel()
        assert (np.isfinite(moved) == np.isfinite(before)).all()
        (said,) = [text for text in store.remarks_of(fits) if "maps of pixels" in text]
        assert said.startswith(
            "maps of pixels by 12 darks and 10 flats are in the law of 4 fits (1 of them fails without"
        )


@pytest.mark.parametrize(
    ("images", "why"),
    [([10], "no two darks of one exposure"), ([0, 0], "100.0 % of the darks' pixels read 0")],
)
def test_darks_that_tell_no_offsets(images, why, tmp_path):
    """A single dark, or darks that are cut at 0: maps.nc says why there are none, and fits go without."""
    (tmp_path / "frames").mkdir()
    rows = []
    for k, value in enumerate(images):
        tifffile.imwrite(tmp_path / f"frames/f{k}.tif", np.full(SHAPE, value, np.uint16))
        rows.append(f"frames/f{k}.tif,dark,,1e-3,{k}")
    base = folder(tmp_path, rows)
    run(["ingest", str(base), "--output", str(tmp_path / "frames.nc")])
    run(["maps", str(base), "--frames", str(tmp_path / "frames.nc"), "--output", str(tmp_path / "maps.nc")])
    with store.read(tmp_path / "maps.nc") as maps:
        assert why in maps.attrs["skipped"] and read_maps(maps) is None
