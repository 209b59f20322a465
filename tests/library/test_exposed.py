"""Random frames of the extended model: every effect against the chain's own moments, and what scatters against what is
stated.

Statistical tests have fixed seeds. Five standard errors are passed by chance once in 1.7 million comparisons.
"""

import numpy as np
import pytest

from spotcheck.model import chain
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Free, Law, View
from spotcheck.model.effect import Place
from spotcheck.model.effects import vocabulary
from spotcheck.model.exposed import Chance, expose
from spotcheck.model.sensor import SensorModel
from spotcheck.model.simulate import frame_generators, frames
from tests.library.effect_cases import (
    BLUR,
    ELLIPSES,
    EXPOSURES,
    FRINGES,
    GHOST,
    HALO,
    LASER,
    LAWS,
    LONGEST,
    P1,
    P2,
    PEAK,
    PEDESTALS,
    PROFILES,
    REFERENCE,
    SENSOR,
    of,
    present,
    title,
)

LAW, BASELINE = Law(P1, P2, PEAK), Baseline(LASER, "linear", False, LONGEST)
# So many pixels of one frame see the same light, along each axis: 40,000 draws of each of 20 pixels.
COPIES = 200
ACROSS, DOWN = np.array([-58.0, -21.0, 0.5, 13.0, 34.0]), np.array([-40.0, -9.0, 2.5, 27.0])


def one_view(copies: int = 1, exposure_s: float = EXPOSURES[1]) -> View:
    """A frame of 5 × 4 different pixels around the spot, each as often as there are copies."""

    def single(value: float) -> np.ndarray:
        return np.full((1, 1, 1), value)

    x, y = (np.repeat(v, copies) for v in (150.0 + ACROSS, 100.0 + DOWN))
    return View(
        x=x[None, None, :],
        y=y[None, :, None],
        x0=single(150.0),
        y0=single(100.0),
        exposure_s=single(exposure_s),
        angle=single(np.deg2rad(50.0)),
        order=single(0.7),
        wave_cos=single(0.0),
        wave_sin=single(0.0),
        longest_s=LONGEST,
        reference_s=REFERENCE,
        frame_x=209.5,
        frame_y=149.5,
        frame_rows=float(y.size),
        rows_each=1.0,
    )


def wide_view(side: int = 120) -> View:
    """A frame of its own pixels, with the spot in its middle."""
    pixel = np.arange(float(side))
    middle = np.full((1, 1, 1), side / 2)
    view = one_view()._replace(x=pixel[None, None, :], y=pixel[None, :, None], x0=middle, y0=middle)
    return view._replace(frame_rows=float(side))


def drawn(cases, sensor: SensorModel, view: View, chance: Chance, top_hat: bool = False) -> np.ndarray:
    """One frame [row, column]."""
    return expose(view, BASELINE._replace(top_hat=top_hat), LAW, present(cases), sensor, chance).astype(float)


def deviations(readings: np.ndarray, mean: np.ndarray, variance: np.ndarray) -> float:
    """Largest deviation of mean and variance from the draws' [draw, pixel], in standard errors. The moments take
    electrons for normal and half a curvature for a knee: they may be off by 0.3 % of the scatter or 0.01 DN, and 0.8 %
    of a variance or 0.01 DN² (as in test_effects_sensor)."""
    count = len(readings)
    own, spread = readings.mean(axis=0), readings.var(axis=0)
    fourth = ((readings - own) ** 4).mean(axis=0)
    error = np.sqrt(np.maximum(spread, 1e-6) / count) + (0.003 * np.sqrt(spread) + 0.01) / 5
    error_2 = np.sqrt(np.maximum(fourth - spread**2, 1e-6) / count) + (0.008 * spread + 0.01) / 5
    return float(max((np.abs(mean - own) / error).max(), (np.abs(variance - spread) / error_2).max()))


def copied(frame: np.ndarray) -> np.ndarray:
    """Draws of the 20 pixels [draw, pixel]."""
    blocks = frame.reshape(DOWN.size, COPIES, ACROSS.size, COPIES)
    return blocks.transpose(1, 3, 0, 2).reshape(COPIES**2, -1)


LOW = SENSOR._replace(black_level_dn=0.0)
WELL = SENSOR._replace(full_well_e=1500.0)
STEADY = [
    *LAWS,
    *ELLIPSES,
    *PROFILES,
    BLUR,
    *HALO,
    GHOST,
    *(case for case in FRINGES if case.form != "site"),
    *PEDESTALS,
    of("dark_offset", "electronic", level=21.0),
    of("background_gradient", "electronic", level=9.0, slope=13.0, direction=215.0),
    *(of("saturation", form, level=380.0, knee=0.15) for form in vocabulary()["saturation"].forms),
    of("nonlinearity", q=0.4),
    of("nonlinearity", q=-0.5),
    of("black_clipping", "subtracted", threshold=41.0),
    of("black_clipping", "dead zone", threshold=43.3),
    of("excess_read_noise", total=40.0),
    of("smear", fraction=0.3),
]


@pytest.mark.parametrize("case", STEADY, ids=title)
def test_an_effect_against_the_moments(case):
    """Mean and variance of 20 pixels under every effect and form that has a mean of its own."""
    # At the longest exposure the light passes the level, at the others laws differ from the baseline's.
    exposure = LONGEST if case.name == "saturation" else EXPOSURES[1]
    view, single = one_view(COPIES, exposure), one_view(1, exposure)
    frame = drawn([case], SENSOR, view, Chance(3, 0, 0))
    # Smear: each of the four rows stands for its copies.
    single = single._replace(rows_each=float(COPIES), frame_rows=view.frame_rows)
    want = chain.moments(single, BASELINE, LAW, present([case]), SENSOR)
    assert deviations(copied(frame), want.mean.ravel(), want.variance.ravel()) < 5


TOGETHER = {
    "nothing": ([], SENSOR, False),
    "at black": ([], LOW, False),
    "top hat": ([], SENSOR, True),
    "full well": ([], WELL, False),
    "light": ([LAWS[0], ELLIPSES[0], PROFILES[0], BLUR, HALO[0], GHOST, FRINGES[0], PEDESTALS[0]], SENSOR, True),
    "sensor": ([of("saturation", "sharp", level=170.0, knee=0.1), of("nonlinearity", q=0.3),
                of("excess_read_noise", total=25.0), of("black_clipping", "subtracted", threshold=38.0),
                of("dark_offset", "electronic", level=12.0)], SENSOR, False),
    "late knee": ([of("saturation", "sharp with noise", level=170.0, knee=0.1), of("excess_read_noise", total=60.0),
                   PEDESTALS[0]], SENSOR, False),
}  # fmt: skip


@pytest.mark.parametrize(("cases", "sensor", "top_hat"), TOGETHER.values(), ids=TOGETHER)
def test_effects_together_against_the_moments(cases, sensor, top_hat):
    """The order of the chain is the moments' order, which test_effects_light and _sensor hold to the contract."""
    frame = drawn(cases, sensor, one_view(COPIES), Chance(4, 1, 0), top_hat)
    want = chain.moments(one_view(), BASELINE._replace(top_hat=top_hat), LAW, present(cases), sensor)
    assert deviations(copied(frame), want.mean.ravel(), want.variance.ravel()) < 5


def shifted(rms: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of the readings over a normal centre, by Gauss–Hermite quadrature."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    weights = np.outer(weights, weights).ravel() / weights.sum() ** 2
    view = one_view()
    at = [
        chain.moments(view._replace(x0=view.x0 + rms * a, y0=view.y0 + rms * b), BASELINE, LAW, (), SENSOR)
        for a in nodes
        for b in nodes
    ]
    means, variances = (np.array([m[k].ravel() for m in at]) for k in (0, 1))
    mean = weights @ means
    return mean, weights @ variances + weights @ (means - mean) ** 2


SCATTERED = {
    "power_fluctuation": of("power_fluctuation", rms=0.12),
    "pointing_jitter": of("pointing_jitter", rms=4.0),
    "row_noise": of("row_noise", rms=3.0),
    "speckle": of("speckle", contrast=0.2, grain=0.9),
    "fixed_pattern": of("fixed_pattern", prnu=0.07, hot_pixels=3.0),
    "interference_fringes": FRINGES[2],
}


def test_every_effect_is_drawn():
    """All of the vocabulary but a shape, which is not drawn by a function: see `test_light_file`."""
    fitted = {name for name, effect in vocabulary().items() if effect.place is not Place.SHAPE}
    assert {case.name for case in STEADY} | set(SCATTERED) == fitted


@pytest.mark.parametrize("name", SCATTERED)
def test_what_scatters_against_the_moments(name):
    """3,000 frames, each of another site and sensor: the mean is the chain's, the variance the chain's and that of what
    scatters (law of total variance)."""
    case = SCATTERED[name]
    stack = np.array([drawn([case], SENSOR, one_view(), Chance(k, k, k)).ravel() for k in range(3000)])
    plain = chain.moments(one_view(), BASELINE, LAW, (), SENSOR)
    mean, variance = plain.mean.ravel(), plain.variance.ravel()
    light = np.ravel(chain.light(one_view(), BASELINE, LAW, ())[0])
    if name == "pointing_jitter":
        mean, variance = shifted(4.0)
    elif name == "row_noise":
        variance = variance + 3.0**2
    else:
        relative = {"power_fluctuation": 0.12, "speckle": 0.2, "fixed_pattern": 0.07}.get(name, 0.2 / np.sqrt(2))
        variance = variance + (relative * light) ** 2
    assert deviations(stack, mean, variance) < 5


# What scatters, seen almost without noise: 4e7 electrons at the peak.
CLEAN = SensorModel(1e-3, 1.0, 0.0, np.inf, 0.0, 65535.0)
BRIGHT = Law(P1, P2, 40000.0)


def clean(cases, chance: Chance, exposure_s: float = LONGEST, side: int = 120) -> np.ndarray:
    """One frame of 120 × 120 pixels over what it would be without effects, where the spot is bright; NaN elsewhere."""
    view = wide_view(side)._replace(exposure_s=np.full((1, 1, 1), exposure_s))
    frame = expose(view, BASELINE, BRIGHT, present(cases), CLEAN, chance)
    plain = chain.light(view, BASELINE, BRIGHT, ())[0][0]
    return np.where(plain > 4000, frame / np.maximum(plain, 1.0), np.nan)


def test_gain_scatter():
    """400 frames of one site: the rms of their brightness, within five of its standard errors (rms/√2N)."""
    case = of("power_fluctuation", rms=0.05)
    gains = np.array([np.nanmean(clean([case], Chance(1, k, 0), side=60)) for k in range(400)])
    assert gains.mean() == pytest.approx(1, abs=5 * 0.05 / 20)
    assert gains.std() == pytest.approx(0.05, abs=5 * 0.05 / np.sqrt(800))


def test_centre_scatter():
    """300 frames: the rms of the centroid along each axis, and no correlation of the two."""
    case, pixel = of("pointing_jitter", rms=0.6), np.arange(120.0) - 60
    small = Law(0.0, 9.0 - LASER, 40000.0)
    centres = []
    for k in range(300):
        frame = expose(wide_view(), BASELINE, small, present([case]), CLEAN, Chance(2, k, 0)).astype(float)
        centres.append((frame.sum(axis=0) @ pixel / frame.sum(), frame.sum(axis=1) @ pixel / frame.sum()))
    centres = np.array(centres)
    assert centres.std(axis=0) == pytest.approx(0.6, abs=5 * 0.6 / np.sqrt(600))
    assert abs(np.corrcoef(centres.T)[0, 1]) < 5 / np.sqrt(300)


def test_row_noise():
    """Offsets of 120 rows in each of 20 frames: rms as stated, anew in every frame and row, the same along a row."""
    case, dark = of("row_noise", rms=2.5), Law(P1, P2, 1e-9)
    sensor = SENSOR._replace(read_noise_e=20.0)
    rows = []
    for k in range(20):
        frame = expose(wide_view(), BASELINE, dark, present([case]), sensor, Chance(5, k, 0)).astype(float)
        rows.append(frame.mean(axis=1) - 40)
        left, right = frame[:, :60].mean(axis=1), frame[:, 60:].mean(axis=1)
        # Noise of a half row: 2.2/√60 = 0.28 DN beside 2.5.
        assert np.corrcoef(left, right)[0, 1] > 0.95
    rows = np.array(rows)
    noise = (0.11 * 20) ** 2 / 120
    assert rows.var() == pytest.approx(2.5**2 + noise, rel=5 * np.sqrt(2 / rows.size))
    assert abs(np.corrcoef(rows[0], rows[1])[0, 1]) < 5 / np.sqrt(120)


def test_pixel_gains():
    """PRNU: its rms, one field for all frames and sites, another for another sensor (seed), and on pedestals too."""
    case = of("fixed_pattern", prnu=0.02, hot_pixels=0.0)
    one, other = clean([case], Chance(6, 0, 0)), clean([case], Chance(6, 9, 4))
    seen = np.isfinite(one)
    assert seen.sum() > 4000
    assert one[seen].std() == pytest.approx(0.02, rel=5 / np.sqrt(2 * seen.sum()))
    assert np.corrcoef(one[seen], other[seen])[0, 1] > 0.99
    third = clean([case], Chance(7, 0, 0))
    assert abs(np.corrcoef(one[seen], third[seen])[0, 1]) < 5 / np.sqrt(seen.sum())
    flat = expose(wide_view(), BASELINE, Law(P1, P2, 1e-9), present([case, of("dark_offset", "light", level=3e4)]),
                  CLEAN, Chance(6, 0, 0))  # fmt: skip
    assert np.corrcoef(flat[seen], one[seen])[0, 1] > 0.99


def test_speckle():
    """The same field at every exposure of a site, new at each; contrast and grain as stated; pedestals have none."""
    case = of("speckle", contrast=0.15, grain=3.0)
    first = [clean([case], Chance(8, k, 5), t) for k, t in enumerate(EXPOSURES[1:])]
    seen = np.isfinite(first[0]) & np.isfinite(first[1])
    assert np.corrcoef(first[0][seen], first[1][seen])[0, 1] > 0.99
    elsewhere = clean([case], Chance(8, 0, 6))
    # Some 110 × 110/(4π grain²) grains are independent: 0.1 is one standard error of a correlation.
    assert abs(np.corrcoef(first[1][seen], elsewhere[seen])[0, 1]) < 0.5
    fields = np.array([clean([case], Chance(8, 0, site)) for site in range(40)])
    deviation = np.where(np.isfinite(fields), fields - 1, 0.0)
    # 40 sites of 100 grains: 1.1 % is one standard error of the contrast.
    assert np.nanstd(fields) == pytest.approx(0.15, rel=0.06)
    lag = 3
    pairs = np.isfinite(fields[:, :, lag:]) & np.isfinite(fields[:, :, :-lag])
    correlation = (deviation[:, :, lag:] * deviation[:, :, :-lag])[pairs].mean() / np.nanvar(fields)
    assert correlation == pytest.approx(np.exp(-0.5), abs=0.06)
    flat = expose(wide_view(), BASELINE, Law(P1, P2, 1e-9), present([case, of("dark_offset", "light", level=3e4)]),
                  CLEAN, Chance(8, 0, 5))  # fmt: skip
    assert flat.std() < 3 * np.sqrt(1e-3 * 3e4 + 1 / 12)


def test_fringes_have_a_phase_of_their_own_at_each_site():
    """And the same at all exposures of a site."""
    case = FRINGES[2]
    one, same, other = (
        clean([case], Chance(9, k, site), t) for k, site, t in ((0, 0, 9e-4), (1, 0, 3e-4), (2, 1, 9e-4))
    )
    seen = np.isfinite(one) & np.isfinite(same)
    assert np.corrcoef(one[seen], same[seen])[0, 1] > 0.99
    assert np.corrcoef(one[seen], other[seen])[0, 1] < 0.9
    assert one[seen].std() == pytest.approx(case.values["d"] / np.sqrt(2), rel=0.1)


def test_a_frame_does_not_depend_on_others():
    """Its number, site and seed decide it; without effects its noise comes from the generator of `simulate`."""
    cases = [SCATTERED[name] for name in SCATTERED]
    again = [drawn(cases, SENSOR, one_view(), Chance(1, k, k // 2)) for k in (0, 1, 2, 3, 2, 0)]
    np.testing.assert_array_equal(again[0], again[5])
    np.testing.assert_array_equal(again[2], again[4])
    assert (again[0] != again[1]).any() and (again[0] != drawn(cases, SENSOR, one_view(), Chance(2, 0, 0))).any()
    assert Chance(1, 3, 0).readings().random() == frame_generators(1, 4)[3].random()


def test_another_effect_leaves_the_draws_of_the_others():
    """A jitter comes and the field of the site stays."""
    speckle, jitter = SCATTERED["speckle"], of("pointing_jitter", rms=1e-9)
    one, both = (clean(cases, Chance(3, 1, 1)) for cases in ([speckle], [jitter, speckle]))
    np.testing.assert_array_equal(one, both)


def test_without_effects_it_is_the_simulated_baseline():
    """Readings of both simulators have one law: means and variances of 20 pixels agree within five standard errors."""
    view, exposure = one_view(COPIES), EXPOSURES[1]
    light = chain.light(view, BASELINE, LAW, ())[0][0]
    (other,) = frames([light], exposure, LOW, [np.random.default_rng(5)])
    readings = copied(other.astype(float))
    want, spread = readings.mean(axis=0), readings.var(axis=0)
    own = copied(drawn([], LOW, view, Chance(11, 0, 0)))
    error = np.sqrt(2 * spread / len(own))
    assert (np.abs(own.mean(axis=0) - want) / error).max() < 5
    np.testing.assert_allclose(own.var(axis=0), spread, rtol=5 * np.sqrt(2 * 3 / len(own)))


def test_more_light_than_a_converter_holds():
    """A peak of 1e30 DN is full scale, and no error; a base without a law is drawn as well."""
    frame = expose(one_view(), BASELINE, LAW._replace(peak=1e30), [], SENSOR, Chance(0, 0, 0))
    assert frame.max() == 1023
    own = Free(np.full((1, 1, 1), 300.0), np.full((1, 1, 1), 12.0))
    assert 200 < expose(wide_view(), BASELINE, own, [], SENSOR, Chance(0, 0, 0)).max() < 450
