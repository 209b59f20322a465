"""The chain without effects: the baseline and the sensor's moments, once more and in another order of sums."""

import numpy as np
import pytest

from spotcheck.model import chain
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Free, Law, View
from spotcheck.model.sensor import SensorModel, reading
from tests.reference.exact_law import moments as exact_moments
from tests.reference.exact_law import reading_law

EXPOSURES = np.array([1e-4, 5e-4, 9e-4])
P1, P2, LASER = 2.48, 34.55, 1.19
SENSOR = SensorModel(0.11, 13.0, 70.0, np.inf, 40.0, 1023.0)
SENSORS = {
    "the paper's": SENSOR,
    "clipped at black": SENSOR._replace(black_level_dn=0.0),
    "full scale": SENSOR._replace(full_scale_dn=300.0),
    "full well": SENSOR._replace(full_well_e=4000.0),
    "dark current": SENSOR._replace(dark_current_e_per_s=5e5),
    "16 bit": SensorModel(1.3, 3.0, 20.0, np.inf, 100.0, 65535.0),
    "no full scale": SENSOR._replace(full_scale_dn=np.inf),
}


def view_of(count: int = 3, columns: int = 60, rows: int = 50) -> View:
    """`count` frames of 60 × 50 pixels, exposures and centres of their own."""
    k = np.arange(count)[:, None, None]
    return View(
        x=200.0 + np.arange(columns)[None, None, :],
        y=100.0 + np.arange(rows)[None, :, None],
        x0=228.3 + 0.7 * k,
        y0=126.1 - 1.1 * k,
        exposure_s=EXPOSURES[k % 3],
        angle=0.4 * k,
        order=k / max(count - 1, 1),
        wave_cos=0.0 * k,
        wave_sin=0.0 * k,
        longest_s=9e-4,
        reference_s=4e-4,
        frame_x=250.0,
        frame_y=150.0,
        frame_rows=300.0,
        rows_each=1.0,
    )


VIEW = view_of()
LAW = Law(P1, P2, 640.0)
every_budget = pytest.mark.parametrize("budget", ["linear", "spot_area"])
every_cut = pytest.mark.parametrize("cut", [False, True], ids=["", "top hat"])


def own_baseline(budget="linear", cut=False) -> Baseline:
    """A baseline of the paper's numbers."""
    return Baseline(LASER, budget, cut, 9e-4)


def frame_light(baseline: Baseline, k: int, view: View = VIEW) -> np.ndarray:
    """Light [DN] of one frame as the baseline has it."""
    x0, y0, t = (float(v[k, 0, 0]) for v in (view.x0, view.y0, view.exposure_s))
    return baseline.light(view.x[0], view.y[0], t, P1, P2, 640.0, x0, y0)


@every_cut
@every_budget
def test_light_is_the_baselines(budget, cut):
    """The same products in the same order: to a few roundings of 640 DN."""
    baseline = own_baseline(budget, cut)
    own, beside = chain.light(VIEW, baseline, LAW, [])
    assert np.all(np.asarray(beside) == 0)
    for k in range(3):
        np.testing.assert_allclose(own[k], frame_light(baseline, k), rtol=1e-12, atol=1e-12)


@every_cut
@every_budget
@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_moments_are_baseline_and_sensor(sensor, budget, cut):
    """Mean and variance of `sensor.reading` at every pixel, to 1e-8: read noise is 1.4 DN and more, and there both are
    the same closed form, but for what shot noise's skew brings where black cuts it: the next test.

    The chain leaves out a clip that is six scatters away, which is worth φ(6)/36 = 2e-10 of a scatter to the mean and
    some ten times as much to the variance; wells and clips near by are the same formula in another order.
    """
    baseline = own_baseline(budget, cut)
    got = chain.moments(VIEW, baseline, LAW, [], sensor)
    assert got.mean.shape == got.variance.shape == (3, 50, 60)
    for k in range(3):
        want = reading(frame_light(baseline, k), float(VIEW.exposure_s[k, 0, 0]), sensor)
        clear = want.mean > 6 * np.sqrt(want.variance)
        np.testing.assert_allclose(got.mean[k][clear], want.mean[clear], rtol=1e-12, atol=1e-8)
        # A pixel that always reads full scale has the least variance that the chain knows, 1e-8.
        np.testing.assert_allclose(got.variance[k][clear], want.variance[clear], rtol=1e-8, atol=1.1e-8)


def test_black_cuts_a_skewed_law():
    """Where black cuts readings: the sum over electrons of `tests.reference`, ten times as near as a normal law.

    What is left is the next term of Edgeworth's series, with 13 e- of noise 0.0066/13² of some 2 DN and less.
    """
    sensor = SENSORS["clipped at black"]
    baseline = own_baseline()
    got = chain.moments(VIEW, baseline, LAW, [], sensor)
    light = frame_light(baseline, 0)
    normal = reading(light, float(VIEW.exposure_s[0, 0, 0]), sensor)
    off = []
    for j, k in np.argwhere((light > 0.2) & (light < 8))[::9]:
        electrons = light[j, k] / sensor.gain_dn_per_e + sensor.dark_current_e_per_s * float(VIEW.exposure_s[0, 0, 0])
        mean, variance, _ = exact_moments(reading_law(electrons, sensor))
        own, other = (m.mean[j, k] - mean for m in (chain.Moments(got.mean[0], got.variance[0]), normal))
        off.append((own, other, got.variance[0, j, k] - variance, normal.variance[j, k] - variance))
    worst = np.abs(off).max(axis=0)
    assert len(off) > 10
    assert worst[0] < 1e-4 and 10 * worst[0] < worst[1]
    assert 10 * worst[2] < worst[3]


@pytest.mark.parametrize("black", [0.0, 0.3, 5.5, 40.2])
@pytest.mark.parametrize(("gain", "noise", "off"), [(0.005, 25.0, 2e-3), (0.02, 13.0, 2e-3), (0.1, 1.0, 0.03)])
def test_quiet_sensors_against_the_exact_law(black, gain, noise, off):
    """Noise of 0.1 to 0.6 DN: mean and variance by the sum over electrons of `tests.reference`.

    The chain takes electrons and read noise for one normal law. With 10 e- of read noise and more, the skew of the few
    electrons in a DN is below 0.002 DN. With 1 e-, single electrons show in where readings change over: 0.03 DN.
    """
    sensor = SensorModel(gain, noise, black_level_dn=black, full_scale_dn=255.0)
    view, baseline = view_of(1), own_baseline("free")
    got = chain.moments(view, baseline, Free(np.full((1, 1, 1), 60.0), np.full((1, 1, 1), 7.0)), [], sensor)
    light = baseline.shape(view.x[0], view.y[0], 60.0, 228.3, 126.1, 7.0)
    for j, k in [(0, 0), (20, 20), (26, 28), (26, 40), (26, 45), (30, 35), (40, 28), (46, 30)]:
        mean, variance, _ = exact_moments(reading_law(light[j, k] / gain, sensor))
        assert got.mean[0, j, k] == pytest.approx(mean, abs=off)
        assert got.variance[0, j, k] == pytest.approx(variance, abs=off)


@every_cut
def test_a_free_base_has_peak_and_width_of_its_own(cut):
    """Every view's amplitude and σ_g; no law, whatever the exposure."""
    amplitude = np.array([500.0, 80.0, 900.0])[:, None, None]
    sigma = np.array([8.0, 15.0, 4.5])[:, None, None]
    baseline = own_baseline("free", cut)
    own, _ = chain.light(VIEW, baseline, Free(amplitude, sigma), [])
    for k in range(3):
        x0, y0 = float(VIEW.x0[k, 0, 0]), float(VIEW.y0[k, 0, 0])
        want = baseline.shape(VIEW.x[0], VIEW.y[0], amplitude[k, 0, 0], x0, y0, sigma[k, 0, 0])
        np.testing.assert_allclose(own[k], want, rtol=1e-12, atol=1e-12)
    got, width = chain.spot_state(VIEW, baseline, Free(amplitude, sigma), [], gain=2.0)
    np.testing.assert_array_equal(got, 2 * amplitude)
    np.testing.assert_array_equal(width, sigma)


def test_one_base_of_a_law_is_that_of_free_ones():
    """A law only says what each view's peak and width are."""
    baseline = own_baseline()
    peak, sigma = chain.spot_state(VIEW, baseline, LAW, [])
    by_law = chain.moments(VIEW, baseline, LAW, [], SENSOR)
    freely = chain.moments(VIEW, baseline, Free(peak, sigma), [], SENSOR)
    for a, b in zip(by_law, freely, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_peak_is_that_at_the_longest_exposure():
    """`Law.peak` [DN] belongs to `longest_s`, which need not be among the views."""
    for budget in ("linear", "spot_area"):
        view = VIEW._replace(exposure_s=VIEW.exposure_s[:1], x0=VIEW.x0[:1], y0=VIEW.y0[:1])
        peak, sigma = chain.spot_state(view, own_baseline(budget), LAW, [])
        np.testing.assert_allclose(sigma, P1 * np.log(1e-4) + P2 + LASER, rtol=1e-13)
        spread = sigma - LASER
        longest = P1 * np.log(9e-4) + P2
        law = (spread / sigma / (longest / (longest + LASER))) ** 2
        if budget == "linear":
            law = 1e-4 / 9e-4 * ((longest + LASER) / sigma) ** 2
        np.testing.assert_allclose(peak, 640.0 * law, rtol=1e-12)


def test_brightness_is_a_factor_on_the_peak():
    """One number, or one a view; the light scales, the dark signal does not."""
    baseline = own_baseline()
    one = chain.moments(VIEW, baseline, LAW, [], SENSOR, brightness=0.5)
    half = chain.moments(VIEW, baseline, LAW._replace(peak=320.0), [], SENSOR)
    for a, b in zip(one, half, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)
    factors = np.array([0.2, 1.0, 1.7])[:, None, None]
    each = chain.moments(VIEW, baseline, LAW, [], SENSOR, brightness=factors)
    for k in range(3):
        alone = chain.moments(VIEW, baseline, LAW._replace(peak=640.0 * float(factors[k, 0, 0])), [], SENSOR)
        np.testing.assert_allclose(each.mean[k], alone.mean[k], rtol=1e-12)
        np.testing.assert_allclose(each.variance[k], alone.variance[k], rtol=1e-12)
    dark = chain.moments(VIEW, baseline, LAW, [], SENSOR, brightness=0.0)
    np.testing.assert_allclose(dark.mean, 40 + 0.11 * 70 * VIEW.exposure_s + np.zeros((3, 50, 60)), rtol=1e-12)


def test_views_do_not_know_of_each_other():
    """Five at once are five alone; x may differ from view to view, where crops lie apart."""
    baseline, view = own_baseline(), view_of(5)
    view = view._replace(x=view.x + 3.0 * np.arange(5)[:, None, None], x0=view.x0 + 3.0 * np.arange(5)[:, None, None])
    together = chain.moments(view, baseline, LAW, [], SENSOR)
    assert together.mean.shape == (5, 50, 60)
    for k in range(5):
        own = {name: getattr(view, name)[k : k + 1] for name in ("x", "x0", "y0", "exposure_s", "angle", "order",
                                                                 "wave_cos", "wave_sin")}  # fmt: skip
        alone = chain.moments(view._replace(**own), baseline, LAW, [], SENSOR)
        np.testing.assert_array_equal(alone.mean[0], together.mean[k])
        np.testing.assert_array_equal(alone.variance[0], together.variance[k])


def test_points_may_lie_anywhere():
    """Between pixels as on them: every third of a pixel, and a single one."""
    baseline = own_baseline()
    thirds = VIEW._replace(x=200.0 + np.arange(178)[None, None, :] / 3)
    fine, coarse = (chain.moments(v, baseline, LAW, [], SENSOR) for v in (thirds, VIEW))
    np.testing.assert_allclose(fine.mean[:, :, ::3], coarse.mean, rtol=1e-12)
    one = chain.moments(VIEW._replace(x=VIEW.x[:, :, 7:8], y=VIEW.y[:, 9:10]), baseline, LAW, [], SENSOR)
    assert one.mean.shape == (3, 1, 1)
    np.testing.assert_allclose(one.mean[:, 0, 0], coarse.mean[:, 9, 7], rtol=1e-13)


def test_moments_change_nothing_they_were_given():
    """The converter works in place, on arrays of its own."""
    before = [np.array(v, copy=True) for v in VIEW]
    base = Free(np.full((3, 1, 1), 400.0), np.full((3, 1, 1), 9.0))
    first = chain.moments(VIEW, own_baseline("free"), base, [], SENSOR)
    kept = [np.array(v, copy=True) for v in first]
    second = chain.moments(VIEW, own_baseline("free"), base, [], SENSOR)
    for a, b in zip(before, VIEW, strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(kept, second, strict=True):
        np.testing.assert_array_equal(a, b)
    assert base.amplitude[0, 0, 0] == 400.0
