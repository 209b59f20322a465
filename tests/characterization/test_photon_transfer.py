"""Photon transfer of flats and darks: closed forms, coverage of the errors over random sensors, and bad input."""

from dataclasses import replace

import numpy as np
import pytest
import tifffile

from spotcheck.characterization.emva_quantities import QUANTITIES
from spotcheck.characterization.levels import (
    Level,
    PatternVariances,
    add_common_drift,
    estimate_pattern_variances,
    estimate_row_variances,
    measure_level,
    measure_levels,
    read_photons,
)
from spotcheck.characterization.line_fits import fit_line, fit_through_zero
from spotcheck.characterization.photon_transfer import analyse_photon_transfer
from spotcheck.dataset.folder import load
from spotcheck.dataset.manifest import Frame
from spotcheck.errors import InputError
from tests.samples.small_datasets import HEADER, folder

ROWS, COLUMNS, FULL = 48, 64, 4095.0


class Sensor:
    """A linear sensor drawn by numpy alone: electrons are Poisson, the well is full at a level, one rounding."""

    def __init__(self, rng, gain=0.3, noise=9.0, eta=0.5, well=10000.0, black=30.0, current=0.0, dsnu=0.0, prnu=0.0):
        self.rng, self.gain, self.noise, self.eta, self.well = rng, gain, noise, eta, well
        self.black, self.current = black, current
        dark, light = rng.standard_normal((2, ROWS, COLUMNS))
        self.dark_pattern = dsnu * (dark - dark.mean())
        self.light_pattern = 1 + prnu * (light - light.mean())

    def frame(self, photons, exposure):
        mean = self.eta * photons * self.light_pattern + self.current * exposure
        electrons = np.minimum(self.rng.poisson(mean), self.well) + self.dark_pattern
        electrons = electrons + self.noise * self.rng.standard_normal((ROWS, COLUMNS))
        return np.clip(np.rint(self.black + self.gain * electrons), 0, FULL)

    def levels(self, photons=None, frames=2, exposures=None):
        photons = np.linspace(500, 24000, 20) if photons is None else photons
        exposures = 1e-3 * np.arange(1, len(photons) + 1) if exposures is None else exposures
        plan = [("dark", t, 0.0) for t in exposures]
        plan += [("flat", t, light) for light, t in zip(photons, exposures, strict=True)]
        return add_common_drift([
            measure_level((self.frame(light, t) for _ in range(frames)), kind, t, light, FULL)
            for kind, t, light in plan
        ])  # fmt: skip


def test_lines():
    """Slopes and errors of points without scatter are those of the normal equations."""
    x, error = np.array([1.0, 2.0, 4.0]), np.array([0.1, 0.2, 0.1])
    slope, own = fit_through_zero(x, 3 * x, error)
    assert slope == pytest.approx(3) and own == pytest.approx(np.sqrt((x**2) @ error**2) / (x @ x))
    found = fit_line(x, 3 * x + 2, error)
    design = np.stack([x, np.ones(3)], axis=1) / error[:, None]
    covariance = np.linalg.inv(design.T @ design)
    assert (found.slope, found.intercept) == pytest.approx((3, 2))
    assert (found.slope_error, found.intercept_error) == pytest.approx(tuple(np.sqrt(np.diag(covariance))))


def test_two_frames_split_a_pattern_and_hold_no_noise():
    """Variances of columns, rows and pixels 0.25, 0.09 and 1 within 5 %, under noise in time of 9 and of rows of 1; the
    mean of 40 draws, whose standard errors are below 1.7 %, 3.5 % and 0.7 % (columns: √(2/64/40))."""
    rng = np.random.default_rng(1)
    found = []
    for _ in range(40):
        fixed = rng.normal(0, 1, (200, 300)) + rng.normal(0, 0.5, (1, 300)) + rng.normal(0, 0.3, (200, 1))
        a, b = (fixed + rng.normal(0, 3, (200, 300)) + rng.normal(0, 1, (200, 1)) for _ in range(2))
        found.append(estimate_pattern_variances(a, b))
    total, column, row, pixel = np.mean(found, axis=0)
    assert (total, column, pixel) == pytest.approx((1.34, 0.25, 1.0), rel=0.05)
    assert row == pytest.approx(0.09, abs=0.04)


def test_noise_in_time_is_half_of_the_difference():
    """Of equal patterns nothing is left, nor of a lamp that drifts."""
    pattern = np.random.default_rng(2).normal(0, 50, (20, 30))
    assert estimate_row_variances(pattern, pattern + 7).max() == pytest.approx(0, abs=1e-20)
    a, b = np.zeros((1, 4)), np.array([[2.0, -2.0, 2.0, -2.0]])
    assert estimate_row_variances(a, b)[0] == pytest.approx(2.0)


@pytest.mark.slow
def test_errors_cover_random_sensors():
    """Over 200 random sensors gain, dark noise, dark offset and quantum efficiency lie within their standard errors in
    60 to 76 of 100 (68 ± 8 is 2.4 standard errors of the share: one in 60 leaves it by chance, seeds are fixed), and
    none further than 5 off."""
    pulls = {name: [] for name in ("gain", "dark_noise", "dark_offset", "quantum_efficiency")}
    rng = np.random.default_rng(20)
    for _ in range(200):
        true = {"gain": rng.uniform(0.1, 0.6), "dark_noise": rng.uniform(4, 20), "quantum_efficiency": 0.5,
                "dark_offset": rng.uniform(25, 60)}  # fmt: skip
        well = 3600 / true["gain"]
        sensor = Sensor(rng, true["gain"], true["dark_noise"], 0.5, well, true["dark_offset"])
        photons = np.linspace(0.02, 1.1, 24) * well / 0.5
        found = analyse_photon_transfer(sensor.levels(photons), FULL).quantities
        for name, own in pulls.items():
            own.append((found[name].value - true[name]) / found[name].stderr)
    for name, own in pulls.items():
        share = np.mean(np.abs(own) < 1)
        assert 0.60 <= share <= 0.76, (name, share)
        assert np.abs(own).max() < 5, name


def test_everything_of_one_sensor():
    """All quantities of a sensor that has everything: within four of their standard errors, or of a level's step."""
    rng = np.random.default_rng(5)
    sensor = Sensor(rng, gain=0.3, noise=9.0, eta=0.5, well=10000.0, black=30.0, current=4000.0, dsnu=6.0, prnu=0.02)
    found = analyse_photon_transfer(sensor.levels(frames=8), FULL)
    assert found.remarks == [] and set(found.quantities) == set(QUANTITIES)
    expected = {
        "gain": 0.3, "dark_noise": 9.0, "dark_offset": 30.0, "dark_current": 4000.0, "responsivity": 0.15,
        "quantum_efficiency": 0.5, "dsnu": 6.0, "dsnu_pixel": 6.0, "prnu": 2.0, "prnu_pixel": 2.0,
        "full_well": 10000.0,
    }  # fmt: skip
    for name, true in expected.items():
        own = found.quantities[name]
        assert abs(own.value - true) < 4 * own.stderr, own
    least = 0.5 + np.sqrt(81 + 1 / 12 / 0.09 + 0.25)
    assert found.quantities["threshold"].value == pytest.approx(least, rel=0.02)
    ratio = found.quantities["full_well"].value / found.quantities["threshold"].value
    assert found.quantities["dynamic_range"].value == pytest.approx(ratio)
    assert found.quantities["snr_max"].value == pytest.approx(100, rel=0.05)


def test_a_response_that_bends_is_told_by_the_linearity_error():
    """Signal y − 0.05 y²/full scale: largest deviations from the line of relative least squares as numpy has them."""
    exposures = np.linspace(1e-3, 2e-2, 20)
    light = np.linspace(200, 4000, 20)
    signal = light - 0.05 * light**2 / FULL
    shape, none = (ROWS, COLUMNS), PatternVariances(0, 0, 0, 0)
    dark = Level("dark", 1e-3, 0.0, 2, 30.0, 0.01, 5.0, 0.1, 0, 0, none, shape)
    variance = np.where(np.arange(20) < 19, 5 + 0.3 * signal, 1.0)
    flats = [Level("flat", t, p, 2, 30 + s, 0.01, v, 0.1, 0, 0.2 * (s > 3700), none, shape)
             for t, p, s, v in zip(exposures, light / 0.15, signal, variance, strict=True)]  # fmt: skip
    found = analyse_photon_transfer([dark, *flats], FULL)
    use = (signal > 0.05 * signal[18]) & (signal < 0.95 * signal[18])
    x, y = light[use] / 0.15, signal[use]
    coefficients = np.polyfit(x, y, 1, w=1 / y)
    off = 100 * (y / np.polyval(coefficients, x) - 1)
    assert found.quantities["linearity_error"].value == pytest.approx(np.abs(off).mean(), rel=1e-9)
    assert found.quantities["linearity_lowest"].value == pytest.approx(off.min(), rel=1e-9)
    assert found.saturation == 18


# Bad input: what can be computed is, the rest says why not.


def plain(rng, **changes):
    return Sensor(rng).levels(**changes)


def why(found, name):
    return found.quantities[name].why


def test_a_single_flat():
    """No noise of one frame, and no gain of one level of light alone? One pair gives a gain, a single frame none."""
    levels = plain(np.random.default_rng(6))
    darks = [own for own in levels if own.kind == "dark"]
    flats = [own for own in levels if own.kind == "flat"]
    single = replace(flats[3], frames=1, variance=np.nan, variance_error=np.nan)
    found = analyse_photon_transfer([*darks, single], FULL)
    assert why(found, "gain") == "there are no flats in pairs" and "single frame" in found.remarks[0]
    assert np.isfinite(found.quantities["dark_noise_dn"].value)
    pair = analyse_photon_transfer([*darks, flats[3]], FULL)
    assert pair.quantities["gain"].value == pytest.approx(0.3, rel=0.1)
    assert why(pair, "full_well") == "no flat is saturated"


NO_GAIN = {
    "no darks": (lambda own: own if own.kind == "flat" else None, "there are no dark frames in pairs"),
    "every flat saturated": (
        lambda own: replace(own, mean=FULL, variance=0.0, at_full=1.0) if own.kind == "flat" else own,
        "every flat is saturated",
    ),
    "flats darker than the darks": (
        lambda own: replace(own, mean=own.mean + 2000) if own.kind == "dark" else own if own.photons < 9000 else None,
        "no flat lies above its dark",
    ),
    "copies of one frame": (
        lambda own: replace(own, variance=0.0, variance_error=0.0),
        "the noise of the flats does not grow with their light",
    ),
}


@pytest.mark.parametrize(("change", "reason"), NO_GAIN.values(), ids=NO_GAIN)
def test_levels_that_give_no_gain(change, reason):
    """Gain and full well have the reason; the dark offset, which needs darks alone, is known."""
    levels = [level for own in plain(np.random.default_rng(7)) if (level := change(own)) is not None]
    found = analyse_photon_transfer(levels, FULL)
    assert why(found, "gain") == why(found, "full_well") == reason and found.saturation is None
    assert np.isfinite(found.quantities["dark_offset"].value) == (reason != NO_GAIN["no darks"][1])
    assert (reason in found.remarks) == (reason == "every flat is saturated")


def test_one_exposure_for_all():
    """The light varies at one exposure: everything but the dark current, and the dark's own error in every point."""
    rng = np.random.default_rng(9)
    sensor = Sensor(rng)
    found = analyse_photon_transfer(sensor.levels(exposures=np.full(20, 1e-3))[19:], FULL)
    assert why(found, "dark_current") == "fewer than three exposures of darks"
    own = found.quantities["gain"]
    assert abs(own.value - 0.3) < 4 * own.stderr


def test_photons_for_some_rows_only():
    """Responsivity from the rows that have them; linearity then runs over exposure."""
    levels = plain(np.random.default_rng(10))
    some = [replace(own, photons=np.nan) if own.kind == "flat" and k % 2 else own for k, own in enumerate(levels)]
    found = analyse_photon_transfer(some, FULL)
    assert found.quantities["quantum_efficiency"].value == pytest.approx(0.5, rel=0.02)
    assert why(found, "saturation_photons") == "photons_per_px is not given for the flat at saturation"
    none = [replace(own, photons=np.nan) if own.kind == "flat" else own for own in levels]
    without = analyse_photon_transfer(none, FULL)
    assert why(without, "quantum_efficiency") == "photons_per_px is not given for the flats"
    assert np.isfinite(without.quantities["linearity_error"].value)
    well = without.quantities["full_well"]
    assert abs(well.value - 10000) < 4 * well.stderr


def test_an_exposure_of_a_dark_that_is_not_given():
    """It has no part in the dark current, which four standard errors hold."""
    sensor = Sensor(np.random.default_rng(15), current=4000.0)
    levels = sensor.levels()
    levels[0] = replace(levels[0], exposure_s=np.nan)
    current = analyse_photon_transfer(levels, FULL).quantities["dark_current"]
    assert abs(current.value - 4000) < 4 * current.stderr


def test_light_in_some_darks():
    levels = plain(np.random.default_rng(11))
    lit = [replace(own, mean=own.mean + 40, variance=own.variance + 12) if k in (2, 9) else own
           for k, own in enumerate(levels)]  # fmt: skip
    found = analyse_photon_transfer(lit, FULL)
    assert found.remarks[0].startswith("2 of 20 dark levels hold light")
    assert found.quantities["dark_offset"].value == pytest.approx(30, abs=0.2)
    assert abs(found.quantities["gain"].value - 0.3) < 4 * found.quantities["gain"].stderr


def test_darks_that_are_cut_at_zero():
    found = analyse_photon_transfer(Sensor(np.random.default_rng(12), black=0.0).levels(), FULL)
    assert any("read 0: part of the noise is cut off" in remark for remark in found.remarks)


def test_photons_must_be_a_number():
    assert np.isnan(read_photons(frame("")))
    assert read_photons(frame("12.5")) == 12.5
    with pytest.raises(InputError, match="photons_per_px is 'many'; it must be a number, 0 or more"):
        read_photons(frame("many"))


def frame(text):
    return Frame(2, "a.png", 0, "flat", None, 1e-3, 0, {"photons_per_px": text})


def test_levels_of_a_folder_are_grouped(tmp_path):
    """By kind, exposure and light; darks first; the numbers are those of the images."""
    rng, rows, images = np.random.default_rng(13), [], {}
    for kind, exposure, photons in (("flat", 1e-3, 900), ("dark", 1e-3, 0), ("flat", 1e-3, 300)):
        for repeat in range(3):
            name = f"{kind}{photons}_{repeat}.tif"
            images[name] = rng.poisson(30 + photons, (40, 50)).astype(np.uint16)
            tifffile.imwrite(tmp_path / name, images[name])
            # Repeats count on at an exposure, whatever the light.
            rows.append(f"{name},{kind},,{exposure},{repeat + photons},{photons if kind == 'flat' else ''}")
    folder(tmp_path, rows, "crop_px: 24\nsensor: {bit_depth: 12}\n", f"{HEADER},photons_per_px")
    found = measure_levels(load(tmp_path), 4095.0)
    assert [(own.kind, own.photons, own.frames) for own in found] == [
        ("dark", 0, 3),
        ("flat", 300, 3),
        ("flat", 900, 3),
    ]
    first, second = (images[f"flat300_{k}.tif"].astype(float) for k in (0, 1))
    assert found[1].variance == pytest.approx(estimate_row_variances(first, second).mean())
    assert found[1].mean == pytest.approx(np.mean([images[f"flat300_{k}.tif"].mean() for k in range(3)]))
