"""What one joint fit makes of a look, where means of conditions are not all that it hears."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from spotcheck.discrepancy.cells import pooled
from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.extend import about, closer_account
from spotcheck.discrepancy.look import look_again, look_at
from spotcheck.discrepancy.pixels import CERTAIN
from spotcheck.discrepancy.refit import NOTHING, Told, refit
from spotcheck.discrepancy.shots import design_of
from spotcheck.discrepancy.stripes import beside_places, depth_error, peak
from tests.library.small_verdict import EXPOSURES, SENSOR, SIDE, frames, looked, plain, present

# One angle: the means of two exposures say little of a drift.
DESIGN = {"angles": (0.0,), "repeats": 6}
FRAMES = len(EXPOSURES) * 6


def drifting(total):
    """Light that runs with the order in which frames are asked for."""
    orders = iter(np.linspace(0, 1, FRAMES))
    return lambda dx, dy, angle, exposure, sigma, spot: spot * (1 + total * next(orders))


def test_a_drift_is_told_by_the_frames_of_a_condition():
    """Over 16 draws the errors of the total have a mean within 4 standard errors of 0 (false alarm 6e-5) and the
    stated scatter within 50 % (known to 18 %); of condition means alone they would be five times as large or more."""
    found, alone = [], []
    for seed in range(16):
        look, _ = looked(drifting(0.05), seed=seed, **DESIGN)
        own = account(look, [present("laser_drift", 0.02, 2.0)]).refit
        found.append((own.model.present[0].values[0], np.sqrt(own.covariance[0, 0])))
        effects = [(p.effect, p.form) for p in own.model.present]
        alone.append(np.sqrt(refit(look.problem, effects, own.model).covariance[0, 0]))
    value, error = np.array(found).T
    off = (value - 0.05) / error
    assert abs(off.mean()) < 4 / np.sqrt(16)
    assert off.std(ddof=1) == pytest.approx(1.0, abs=0.5)
    assert np.median(alone) > 5 * np.median(error)


def test_what_is_told_pulls_and_is_no_part_of_the_score():
    """A value told with the fit's own information moves it half of the way; the score is that of the cells, so it
    rises by that quarter of a χ² that the parabola says."""
    look, _ = looked(drifting(0.05), **DESIGN)
    start = look.problem.start._replace(present=(present("laser_drift", 0.02, 2.0),))
    effects = [(p.effect, p.form) for p in start.present]
    free = refit(look.problem, effects, start)
    value, variance = free.model.present[0].values[0], free.covariance[0, 0]
    distance = 4 * np.sqrt(variance)
    pulled = refit(
        look.problem, effects, free.model, told=[Told(0, np.array([value + distance]), np.array([[1 / variance]]))]
    )
    # The fit stops within 0.02 of the least score: a part of √0.02/4 of the distance.
    assert pulled.model.present[0].values[0] - value == pytest.approx(distance / 2, rel=0.08)
    assert pulled.score - free.score == pytest.approx(distance**2 / 4 / variance, rel=0.1)
    assert pulled.covariance[0, 0] == pytest.approx(variance / 2, rel=0.02)


def test_a_drift_that_settles_is_told_with_its_rate():
    """A laser that warms up: the total within 4 standard errors (false alarm 6e-5), in the form that drew it, and the
    straight course far behind; 100 is ten standard deviations."""
    places = np.linspace(0, 1, FRAMES)
    orders = iter((1 - np.exp(-2.5 * places)) / (1 - np.exp(-2.5)))
    look, _ = looked(lambda dx, dy, angle, exposure, sigma, spot: spot * (1 + 0.2 * next(orders)), **DESIGN)
    own, straight = (account(look, [present("laser_drift", 0.02, 2.0, form=form)]) for form in ("settling", "linear"))
    total, rate = own.refit.model.present[0].values
    error = np.sqrt(np.diag(own.refit.covariance)[:2])
    assert abs(total - 0.2) < 4 * error[0] and abs(rate - 2.5) < 4 * error[1]
    assert straight.score > own.score + 100


def scattered(found):
    """Values and stated errors of some draws [draw, 2], less the truth: the mean within 4 standard errors (false alarm
    6e-5), the stated scatter within 55 % (16 draws tell a scatter to 18 %: three standard deviations)."""
    off, error = np.array(found).T
    z = off / error
    assert abs(z.mean()) < 4 / np.sqrt(len(z))
    assert z.std(ddof=1) == pytest.approx(1.0, abs=0.55)


def test_a_law_of_brightness_that_scatters_is_told_by_how_much_it_does():
    """A power of the exposure beside gains of 3 % rms, which could be any law if nothing said how far they go: the
    same number from whatever start, with an error that the gains' own scatter says."""

    def bright(rng):
        return lambda dx, dy, angle, exposure, sigma, spot: (
            spot * (exposure / 4e-4) ** 0.05 * (1 + 0.03 * rng.standard_normal())
        )

    found = []
    for seed in range(16):
        look, _ = looked(bright(np.random.default_rng(seed)), seed=seed, repeats=12, exposures=(1e-4, 2e-4, 4e-4))
        fits = [
            account(look, [present("power_fluctuation", 0.0), present("photon_budget", q)]).refit for q in (-0.1, 0.1)
        ]
        q, other = (fit.model.present[0].values[0] for fit in fits)
        error = float(np.sqrt(fits[0].covariance[0, 0]))
        assert q == pytest.approx(other, abs=0.02 * error)
        found.append((q - 0.05, error))
    scattered(found)


def test_the_error_of_white_noise():
    """Read noise of 9 e- where 6 are stated, beside brightness that scatters by 2 %, which is no white noise."""

    def noisier(image, rng):
        white = np.sqrt(9.0**2 - SENSOR.read_noise_e**2) * SENSOR.gain_dn_per_e
        return image + rng.normal(0, white, image.shape)

    found = []
    for seed in range(16):
        rng = np.random.default_rng(100 + seed)
        light = lambda *a, rng=rng: a[-1] * (1 + rng.normal(0, 0.02))  # noqa: E731
        shots, base, setting = frames(light, after=noisier, seed=seed)
        look = look_at(shots, design_of(shots), base, setting)
        own = account(look, [present("excess_read_noise", 7.0), present("power_fluctuation", 0.0)])
        # At the first look a frame's own brightness bends within blocks, which a closer one takes off.
        own = closer_account(about(shots, look, own), own)
        total = next(p.values[0] for p in own.refit.model.present if p.effect.name == "excess_read_noise")
        found.append((total - 9.0, own.component_error["read"]))
    scattered(found)


def of_sites(draw):
    """Light that is changed by what `draw()` gives for each site, the same at all its exposures."""
    now = {}

    def light(dx, dy, angle, exposure, sigma, spot):
        if exposure == EXPOSURES[0]:
            now["field"] = draw()
        return spot * now["field"](dx, dy)

    return light


def test_the_error_of_a_grain():
    """Normal fields of contrast 0.1 that correlate as exp(−d²/2 grain²), grain 2.4 px. Over 16 sets the mean is known
    to 0.015 px, and right within four of these."""
    found = []
    for seed in range(16):
        rng = np.random.default_rng(200 + seed)

        def field(rng=rng):
            smooth = gaussian_filter(rng.standard_normal((2 * SIDE, 2 * SIDE)), 2.4 / np.sqrt(2), mode="wrap")
            own = 1 + 0.1 * (smooth / smooth.std())[:SIDE, :SIDE]
            return lambda dx, dy: own

        look, _ = looked(of_sites(field), seed=seed)
        own = account(look, [present("speckle", 0.0, 0.0)])
        found.append((own.grain - 2.4, own.component_error["size"]))
    scattered(found)
    assert np.mean([off for off, _ in found]) == pytest.approx(0, abs=0.06)


def test_the_error_of_a_depth():
    """Stripes of 2 % and 9 px, at each site with a phase of its own."""
    found = []
    for seed in range(16):
        rng = np.random.default_rng(300 + seed)

        def stripes(rng=rng):
            phase = rng.uniform(0, 2 * np.pi)
            return lambda dx, dy: 1 + 0.02 * np.cos(2 * np.pi * dx / 9.0 + phase)

        look, _ = looked(of_sites(stripes), seed=seed)
        depth, period, direction = peak(look.measured)
        found.append((depth - 0.02, depth_error(depth, beside_places(look.measured, period, direction)[1])))
    scattered(found)


def test_stripes_where_nothing_tells_anything():
    """Sites without weight have no amplitude and no noise; nothing fails."""
    look, _ = looked()
    sums = look.measured.sums
    dark = look.measured._replace(sums=sums._replace(pull=0 * sums.pull, weight=0 * sums.weight))
    amplitude, noise = beside_places(dark, 9.0, 30.0)
    assert not amplitude.any() and not noise.any()


def test_where_noise_is_clipped_readings_count_no_more_than_what_is_certain():
    """A converter's clip far below the light: every reading there is one number, without noise. A level that is off by
    0.05 DN must not be worth 10⁸ standard deviations: as pixels of 0.12 DN² it is worth (0.05 DN)² · pixels / 0.12."""
    look, _ = looked(plain)
    model = look.problem.start._replace(present=(present("saturation", 200.0, 0.03, form="sharp with noise"),))
    at = look.problem.evaluate(model)
    above = look.light > 300.0
    np.testing.assert_allclose(pooled(at.mean)[above], 200.0 + SENSOR.black_level_dn, atol=1e-6)
    assert pooled(at.variance)[above].max() < 1e-6
    variance = look.problem.variance(at, NOTHING)[above]
    want = look.cells.variance[above] * CERTAIN / look.problem.variance_start[above]
    np.testing.assert_allclose(variance, want, rtol=1e-12)


def test_a_level_that_stops_noise_too_is_told_by_readings_that_repeat():
    """About a clip at a reading of 400 a closer look leaves all pixels out that read it: no other lies above it, and
    nothing but they could say that it is no higher. Within the half DN that rounding hides."""
    shots, base, setting = frames(after=lambda image, rng: np.minimum(image, 400.0))
    look = look_at(shots, design_of(shots), base, setting)
    first = account(look, [present("saturation", 380.0, 0.03, form="sharp with noise")])
    near = look_again(shots, look, first.refit.model, first.latent)
    assert near.problem.used.sum() < look.problem.used.sum()
    own = account(near, [present("saturation", 450.0, 0.03, form="sharp with noise")])
    assert own.refit.model.present[0].values[0] == pytest.approx(400 - SENSOR.black_level_dn, abs=0.5)


@pytest.mark.parametrize("name, values, more", [("dark_offset", (0.1,), 1), ("ghost_reflection", (0.01, 9.0, 5.0), 3),
                                                ("spread_law", (0.1,), 0)])  # fmt: skip
def test_every_free_number_costs_two(name, values, more):
    """Akaike 1974 (doi:10.1109/TAC.1974.1100705); a law of the width has one number for the one that it takes away.
    What noise within blocks says changes by far less than one number costs."""
    look, empty = looked(exposures=(1e-4, 2e-4, 4e-4))
    own = account(look, (present(name, *values),))
    assert own.score - own.refit.score == pytest.approx(empty.score - empty.refit.score + 2 * more, abs=0.7)


def test_where_every_condition_is_one_frame_its_centre_tells_the_jitter():
    """Three frames of one site: the variance is that of the three places, with two degrees of freedom an axis."""
    places = {1e-4: (0.3, 0.0), 2e-4: (-0.1, 0.2), 4e-4: (-0.2, -0.2)}

    def moved(dx, dy, angle, exposure, sigma, spot):
        x, y = places[exposure]
        return np.max(spot) * np.exp(-((dx - x) ** 2 + (dy - y) ** 2) / (2 * sigma**2))

    look, still = looked(moved, angles=(0.0,), exposures=tuple(places), repeats=1)
    own = account(look, (present("pointing_jitter", 0.1),))
    true = float(np.var(list(places.values()), axis=0, ddof=1).mean())
    assert own.component["centre"] == pytest.approx(true, rel=0.1)  # centres are known to 0.02 px
    assert own.component_error["centre"] == pytest.approx(own.component["centre"] * np.sqrt(2 / 4))
    assert own.score < still.score - 20
