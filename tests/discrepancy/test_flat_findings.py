"""Findings of flats and darks: linear sensors are consistent, drawn effects are named, and a misfit that no effect
explains names nothing. Levels are drawn by closed forms or pixel by pixel, without the library."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from spotcheck.dataset import folder as dataset
from spotcheck.discrepancy.flat_fit import LevelScatter, estimate_scatter, fit_levels
from spotcheck.discrepancy.flat_levels import FlatLevels, collect_levels, expect_levels, match_dark
from spotcheck.discrepancy.flat_selection import assess_consistency, estimate_rough_scatter, measure_held_out_gain
from spotcheck.discrepancy.flats import analyse_flats, analyse_levels, detect
from spotcheck.model.effect import Need
from spotcheck.model.effects import vocabulary
from tests.samples.drawn_levels import (
    BLACK,
    DARK,
    FULL,
    GAIN,
    LONGEST,
    TOP,
    draw_by_moments,
    draw_by_pixels,
)
from tests.samples.example_datasets import flats

EFFECTS = vocabulary()
# Effects with one variant: their fits take a tenth of the time of those of a clip.
QUICK = [EFFECTS[name] for name in ("nonlinearity", "dark_offset", "photon_budget", "shutter_offset")]
LAWS = [EFFECTS[name] for name in ("nonlinearity", "photon_budget")]


def levels_of(transfer) -> FlatLevels:
    levels = collect_levels(transfer, FULL)
    assert levels is not None
    return levels


def names_of(findings) -> list[str]:
    return [effect.name for effect in findings.effects]


# Readings


def test_linear_sensor_in_closed_form():
    """The mean is the light, the variance K times it; slopes are 1 and K; darks are matched."""
    levels = levels_of(draw_by_moments(1))
    at = expect_levels(levels, levels.declared)
    gain, light = levels.declared.sensor.gain_dn_per_e, levels.declared.law.peak_dn * levels.light
    np.testing.assert_allclose(at.values, [light, gain * light], rtol=1e-6)
    np.testing.assert_allclose(at.light_slopes, np.array([[1.0], [gain]]) * np.ones(len(light)), rtol=1e-4)
    assert np.max(np.abs(at.dark_misfit)) < 1e-2


def test_curved_response_in_closed_form():
    """E(y − c y²) = µ − c (µ² + σ²), its variance (1 − 2 c µ)² σ² + 2 c² σ⁴ but for the third moment of the light."""
    levels, q = levels_of(draw_by_moments(1)), 0.05
    model = replace(levels.declared, effects=(EFFECTS["nonlinearity"].apply({"q": q}),))
    at, c = expect_levels(levels, model), q / FULL
    gain, light = model.sensor.gain_dn_per_e, model.law.peak_dn * levels.light
    variance = gain * light + DARK
    mean = light - c * (light**2 + gain * light)
    np.testing.assert_allclose(at.values[0], mean, atol=0.01)
    slope = 1 - 2 * c * light
    expected = slope**2 * variance + 2 * c**2 * variance**2 - 2 * slope * c * gain**2 * light - DARK
    np.testing.assert_allclose(at.values[1], expected, rtol=2e-4)


def test_electronic_pedestal_is_in_the_darks_too():
    """Only a pedestal of light changes levels over darks."""
    levels = levels_of(draw_by_moments(1))
    plain = expect_levels(levels, levels.declared)
    for form, added in (("electronic", 0.0), ("light", 5.0)):
        model = replace(levels.declared, effects=(EFFECTS["dark_offset"].apply({"level": 5.0}, form),))
        at = expect_levels(levels, model)
        np.testing.assert_allclose(at.values[0] - plain.values[0], added, atol=1e-3)
        np.testing.assert_allclose(at.values[1] - plain.values[1], GAIN * added, atol=0.1)


def test_clipped_darks_need_noise_below_black():
    """A converter whose zero lies 2 DN above true black: no black level from 0 on has such darks, the effect has."""
    levels = levels_of(draw_by_pixels(5, black=-2.0, faintest=0.002))
    assert levels.declared.sensor.black_level_dn < 0.2
    assert np.max(np.abs(match_dark(levels, levels.declared)[2])) > 5
    model = replace(levels.declared, effects=(EFFECTS["black_clipping"].apply({"threshold": 2.0}, "subtracted"),))
    assert np.max(np.abs(match_dark(levels, model)[2])) < 3


# Scatter


def test_standardized_deviations_have_unit_covariance():
    """The covariance of mean and variance by light that both follow, written as a matrix."""
    levels, scatter, slopes = levels_of(draw_by_moments(3)), LevelScatter(7.0, 2.0, 1.5), np.ones((2, 30))
    slopes[1] = GAIN
    standard = scatter.standardize(levels, slopes)
    units = np.zeros((2, 2, 30))
    units[0, 0], units[1, 1] = 1.0, 1.0
    linear = standard.apply(units)
    for k in (0, 15, 29):
        error, variance_error = levels.errors[:, k]
        light, follows = 48.0 * error**2, GAIN / 1.01
        covariance = np.array([[49 * error**2 + 4, follows * light],
                               [follows * light, (1.5 * variance_error) ** 2 + follows**2 * light]])  # fmt: skip
        np.testing.assert_allclose(linear[:, :, k].T @ covariance @ linear[:, :, k], np.eye(2), atol=1e-9)
    deviations = np.random.default_rng(1).standard_normal((2, 30))
    np.testing.assert_allclose(standard.invert(standard.apply(deviations)), deviations, atol=1e-9)


def test_scatter_is_recovered():
    """3000 levels with errors from 0.1 to 10 DN, three times as wide and 2 DN beside: within a step of the grid."""
    rng, count = np.random.default_rng(4), 3000
    errors = np.stack([np.geomspace(0.1, 10, count), np.ones(count)])
    levels = replace(levels_of(draw_by_moments(3)), errors=errors, is_held_out=np.zeros(count, bool))
    still, noise = np.stack([np.ones(count), np.zeros(count)]), rng.standard_normal((2, count))
    found = estimate_scatter(levels, noise * np.sqrt([9 * errors[0] ** 2 + 4, 4 * errors[1] ** 2]), still, 0.0)
    assert found.lamp == pytest.approx(3, rel=0.1) and 1.5 < found.converter_dn < 2.8
    assert found.variance == pytest.approx(2, rel=0.05)
    found = estimate_scatter(levels, noise * errors, still, 0.0)
    assert found.lamp < 1.05 and found.converter_dn < 0.15 and found.variance < 1.05


# Statistics


@pytest.mark.parametrize("lamp", [0.0, 5e-3])
def test_false_alarms_of_detection(lamp):
    """50 sets of linear flats, also under a lamp that scatters ten times as much as pairs of frames say. More than 3
    below 1 % (8 below 5 %) would come by chance once in 300 times."""
    p_values = []
    for seed in range(50):
        levels = levels_of(draw_by_moments(seed, lamp=lamp, count=24))
        fit = fit_levels(levels, ())
        assert fit.has_converged
        p_values.append(detect(levels, fit, estimate_rough_scatter(levels, fit)).p_value)
    assert np.sum(np.array(p_values) < 0.01) <= 3 and np.sum(np.array(p_values) < 0.05) <= 8
    assert 0.3 < np.median(p_values) < 0.8


def test_limits_cover_the_truth():
    """A curvature that is too small to be found lies within 95 % limits: of 30 sets more than 5 outside would come once
    in 300 times. So do pedestals."""
    outside = 0
    for seed in range(30):
        findings = analyse_levels(draw_by_moments(seed, bend=3e-4, offset=0.05), FULL, LAWS[:1])
        (limit,) = findings.limits
        outside += not limit.low <= 3e-4 <= limit.high
    assert outside <= 5


def test_four_times_the_flats_halve_a_limit():
    """As `frames` says. The mean of six pairs of sets, whose ratios scatter by about 0.4, is off by 0.5 once in 400
    times."""
    ratios = []
    for seed in range(6):
        few, many = (
            analyse_levels(draw_by_moments(seed, count=count), FULL, LAWS[:1]).limits[0] for count in (30, 120)
        )
        assert (few.frames, many.frames) == (180, 720)
        ratios.append((few.high - few.low) / (many.high - many.low))
    assert abs(np.mean(ratios) - 2) < 0.5


def test_consistency_follows_its_law():
    """Q of true curvatures is χ² with one degree of freedom less than cells: its mean over 10 sets lies within three
    standard errors. A curvature of means alone is inconsistent."""
    q, cells = [], 0
    for seed in range(10):
        levels = levels_of(draw_by_moments(seed, bend=0.03))
        fit = fit_levels(levels, (EFFECTS["nonlinearity"].apply({"q": 0.03}),))
        test, _ = assess_consistency(levels, fit, fit_levels(levels, ()), "nonlinearity")
        assert test.is_consistent
        q.append(test.q)
        cells = test.cells
    assert abs(np.mean(q) - (cells - 1)) < 3 * np.sqrt(2 * (cells - 1) / 10)
    levels = levels_of(draw_by_moments(1, bend=0.1))
    straight = levels_of(draw_by_moments(1)).values[1]
    levels = replace(levels, values=np.stack([levels.values[0], straight]))
    fit = fit_levels(levels, (EFFECTS["nonlinearity"].apply({"q": 0.1}),))
    assert not assess_consistency(levels, fit, fit_levels(levels, ()), "nonlinearity")[0].is_consistent


def test_held_out_levels_prefer_what_is_there():
    """A curvature of 0.01 always predicts them better. One that is not there does so in about half of 8 sets; all
    would come once in 250 times."""
    gains = {}
    for bend in (0.01, 0.0):
        gains[bend] = []
        for seed in range(8):
            levels = levels_of(draw_by_moments(seed, bend=bend))
            fit = fit_levels(levels, (EFFECTS["nonlinearity"].apply({"q": 0.01}),))
            gains[bend].append(measure_held_out_gain(levels, fit_levels(levels, ()), fit))
    assert min(gains[0.01]) > 10
    assert np.sum(np.array(gains[0.0]) > 0) <= 7 and max(gains[0.0]) < 9


# Findings


@pytest.mark.parametrize(("seed", "lamp"), [(1, 0.0), (2, 0.0), (3, 5e-3)])
def test_linear_flats_are_consistent(seed, lamp):
    """Nothing of the whole vocabulary is named, K is right, and small limits of all that levels can show are given."""
    findings = analyse_levels(draw_by_moments(seed, lamp=lamp), FULL, list(EFFECTS.values()))
    assert findings.has_converged and not findings.effects and findings.detection.p_value > 0.01
    gain = findings.levels.gain
    assert abs(gain.value - GAIN) < 3 * gain.stderr < 0.01 * GAIN
    assert findings.levels.straight_line.value == pytest.approx(GAIN, rel=0.01)
    assert findings.levels.light_scatter == pytest.approx(lamp, rel=0.4, abs=3e-4)
    assert findings.gap.on == "held-out levels" and 0.2 < findings.gap.before < 3
    limits = {limit.effect: limit for limit in findings.limits}
    assert {limit.reason for limit in findings.limits} == {"not found"}
    assert 0 < limits["nonlinearity"].high < (0.01 if lamp else 2e-3) and limits["nonlinearity"].low < 0
    assert limits["dark_offset"].high < (10.0 if lamp else 0.5) and np.isnan(limits["dark_offset"].low)
    # The brightest level reads 3000 DN with a noise of 134 DN.
    assert 3000 < limits["saturation"].low < 3600 and np.isnan(limits["saturation"].high)
    hidden = {effect.name for effect in EFFECTS.values() if effect.hidden_in_flats}
    assert {name for name, _ in findings.not_assessed} == hidden and set(limits) == set(EFFECTS) - hidden


@pytest.mark.parametrize(
    ("changes", "name", "parameter", "true"),
    [
        ({"bend": 0.05}, "nonlinearity", "q", 0.05),
        ({"bend": -0.01}, "nonlinearity", "q", -0.01),
        ({"bend": 0.03, "lamp": 5e-3}, "nonlinearity", "q", 0.03),
        ({"power": 0.05}, "photon_budget", "q", 0.05),
    ],
)
def test_single_effect_is_named(changes, name, parameter, true):
    """With its strength and K within three standard errors, and it predicts held-out levels."""
    findings = analyse_levels(draw_by_moments(21, **changes), FULL, QUICK)
    assert names_of(findings) == [name] and findings.has_converged
    (effect,) = findings.effects
    strength, gain = effect.values[parameter], findings.levels.gain
    assert abs(strength.value - true) < 3 * strength.stderr < 0.3 * abs(true)
    assert abs(gain.value - GAIN) < 3 * gain.stderr
    assert not effect.rivals and effect.consistency.is_consistent and effect.gain > 25 and effect.z > 5
    assert findings.gap.gain > 25 and findings.gap.closed > 0.8 and effect.gap_closed > 0.8
    assert findings.detection.p_value < 1e-4 < findings.unexplained.p_value


def test_clip_of_the_charge_is_named():
    """Pixels that stop at 2800 DN, in front of the read noise."""
    transfer = draw_by_pixels(5, charge=lambda signal: np.minimum(signal, 2800.0))
    findings = analyse_levels(transfer, FULL, [EFFECTS["saturation"], EFFECTS["nonlinearity"]])
    assert names_of(findings) == ["saturation"]
    (effect,) = findings.effects
    assert effect.applied.variant.value == "sharp"
    assert abs(effect.values["level"].value - 2800) < 3 * effect.values["level"].stderr < 30
    assert abs(findings.levels.gain.value - GAIN) < 3 * findings.levels.gain.stderr


def test_lost_black_is_named():
    """The converter's zero lies 2 DN above true black."""
    transfer = draw_by_pixels(5, black=-2.0, faintest=0.002)
    findings = analyse_levels(transfer, FULL, [*QUICK, EFFECTS["black_clipping"]])
    assert names_of(findings) == ["black_clipping"]
    assert findings.effects[0].values["threshold"].value == pytest.approx(2.0, abs=0.3)


def test_noise_that_reaches_zero_is_no_effect():
    """Darks that the converter's lower end cuts, at a black level of 1 DN, have the distribution of a linear sensor."""
    findings = analyse_levels(draw_by_pixels(6, black=1.0, faintest=0.002), FULL, [*QUICK, EFFECTS["black_clipping"]])
    assert not findings.effects and findings.detection.p_value > 0.01


def test_pedestal_is_tied_with_a_late_shutter():
    """A constant more of light is a constant more of exposure: rivals, beside a curvature without any. Alone the two
    look like another power of the exposure."""
    findings = analyse_levels(draw_by_moments(23, bend=0.03, offset=24.0), FULL, QUICK)
    candidates = {frozenset({effect.name, *effect.rivals}): effect for effect in findings.effects}
    assert set(candidates) == {frozenset({"nonlinearity"}), frozenset({"dark_offset", "shutter_offset"})}
    q = candidates[frozenset({"nonlinearity"})].values["q"]
    assert abs(q.value - 0.03) < 3 * q.stderr
    (tied,) = candidates[frozenset({"dark_offset", "shutter_offset"})].values.values()
    true = 24.0 if tied.unit == "DN" else 24.0 / TOP * LONGEST
    assert abs(tied.value - true) < 3 * tied.stderr
    assert "does as well in the place of" in "".join(limit.reason for limit in findings.limits)


def test_misfit_that_no_effect_explains_names_nothing():
    """A response with a wave of 20 DN: all of it is left, 20/√2 DN of 3000."""
    findings = analyse_levels(draw_by_moments(5, wave=20.0), FULL, QUICK)
    assert not findings.effects
    assert findings.unexplained.size == pytest.approx(20 / np.sqrt(2) / TOP, rel=0.15)
    assert findings.unexplained.z > 5


def test_negligible_effect_is_not_named():
    """A curvature of 0.003 is certain, but too small to matter."""
    findings = analyse_levels(draw_by_moments(1, bend=0.003), FULL, LAWS)
    assert not findings.effects and findings.detection.p_value < 0.01
    limit = next(limit for limit in findings.limits if limit.effect == "nonlinearity")
    assert limit.reason == "too small to matter" and limit.low < 0.003 < limit.high and limit.frames is None
    assert limit.remark


def test_too_few_levels():
    findings = analyse_levels(draw_by_moments(24, count=3), FULL, QUICK)
    assert "fewer than 6 levels" in findings.reason or "noise" in findings.reason
    assert findings.detection is None and not findings.effects and findings.levels is None


def test_light_that_does_not_follow_the_exposure_hides_its_laws():
    transfer = draw_by_moments(25)
    flats = [replace(level, photons=level.photons * (1 + 0.3 * np.sin(k))) for k, level in enumerate(transfer.flats)]
    findings = analyse_levels(replace(transfer, flats=flats), FULL, [EFFECTS["shutter_offset"]])
    ((name, reason),) = findings.not_assessed
    assert name == "shutter_offset" and reason in [f"it needs {need.value}" for need in Need]


def test_unknown_dark_quantities():
    """Offset and noise that contradict others are unknown; the darks themselves are used."""
    transfer = draw_by_moments(7)
    unknown = {name: replace(transfer.quantities[name], value=np.nan) for name in ("dark_offset", "dark_noise_dn")}
    levels = levels_of(replace(transfer, quantities=transfer.quantities | unknown))
    assert levels.dark[0] == pytest.approx(BLACK, abs=0.1) and levels.dark[1] == pytest.approx(DARK, rel=0.05)


def test_light_without_noise():
    """K ends at its bound if the noise does not grow with the light, and the fit is finite."""
    levels = levels_of(draw_by_moments(5))
    fit = fit_levels(replace(levels, values=np.stack([levels.values[0], 0 * levels.values[1]])), ())
    assert fit.model.sensor.gain_dn_per_e == pytest.approx(levels.declared.sensor.gain_dn_per_e / 10, rel=1e-3)
    assert np.isfinite(fit.deviance)


def test_dataset_of_flats(tmp_path):
    """A folder of frames: twenty levels up to saturation, of which the unsaturated ones are used."""
    found = dataset.load(flats(tmp_path / "flats"))
    table = xr.Dataset({"full_scale": 4095.0, "copy_of": ("frame", np.full(len(found.frames), -1))})
    findings = analyse_flats(found, table, QUICK)
    assert not findings.effects and 15 <= findings.levels.number < 20
    assert abs(findings.levels.gain.value - 0.3) < 3 * findings.levels.gain.stderr
