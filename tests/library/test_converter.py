"""The converter's last step: against the plain sum over whole numbers."""

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import poisson

from spotcheck.model.converter import FAR, FINE, convert
from spotcheck.model.sensor import clipped_normal

FULL_SCALE = 1023.0
DEAD = (0.0, 0.3, 0.8, 2.4)
# On both sides of where one way of computing hands over to the next, and the ends of what was asked for.
SCATTERS = (0.05, 0.1, 0.2, 0.35, 0.5, 0.69, 0.71, 1.0, 1.7, 3.0, 8.0, 20.0)


def some_means(sd: float) -> np.ndarray:
    """Close to both ends, every fraction of a DN between, where the formulas meet, and from −5 to 1030."""
    reach = np.arange(-9.0, 9.01, 0.37) * sd
    near = np.arange(-5.0, 8.0, 0.0731)
    ends = [near, 1023.0 - near, reach, 1023.0 + reach, *(d + FAR * sd + np.array([-1e-3, 1e-3]) for d in DEAD)]
    out = np.concatenate([*ends, np.linspace(-5, 1030, 150), np.linspace(500, 502, 41), [-5.0, 1030.0]])
    return np.unique(out[(out >= -5) & (out <= 1030)])


def converted(mean, sd, dead=0.0, full_scale=FULL_SCALE, third=0.0):
    """The library's mean and variance."""
    out = np.array(mean, float)
    spread = np.broadcast_to(np.square(sd), out.shape).astype(float)
    convert(out, spread, np.broadcast_to(third, out.shape).astype(float), np.full(out.shape, full_scale), dead)
    return out, spread


def summed(mean: float, sd: float, dead: float = 0.0, full_scale: float = FULL_SCALE) -> tuple[float, float]:
    """Mean and variance of the reading: its probabilities, from either tail of the normal law, times whole numbers.

    A signal is rounded to nearest and cut to 0 … full scale; below `dead` it reads 0.
    """
    low = int(np.clip(np.floor(mean - 12 * sd - 2), 0, full_scale))
    high = int(np.clip(np.ceil(mean + 12 * sd + 2), 0, full_scale))
    readings = np.arange(0 if low < dead + 1 else low, high + 1)
    z = (np.maximum(readings[1:] - 0.5, dead) - mean) / sd
    below, above = np.append(-np.inf, z), np.append(z, np.inf)
    probability = np.where(below > 0, ndtr(-below) - ndtr(-above), ndtr(above) - ndtr(below))
    first = float(probability @ (readings - mean))
    return mean + first, float(probability @ (readings - mean - first) ** 2)


def tolerances(sd: float) -> tuple[float, float]:
    """How far mean and variance may be off, and why.

    Below 0.7 DN the library sums too, out to six scatters: readings of probability 1e-9 in all are left out, six
    scatters and a DN away at most, which is 27 DN². No variance is below 1e-8 DN².

    Above, rounding counts as 1/12 DN² of noise, and by Poisson's sum formula the mean is off by exp(−2π² sd²)/π, the
    variance by (4 sd² + 1/π²) times that exponential: 2e-5 and 1e-4 at 0.7 DN, nothing at 1.5. The upper clip has
    Euler–Maclaurin's first term; its next, 7/5760 of a third derivative, is 7/5760 · φ(0)/sd³ = 4.9e-4/sd³ of the mean
    and 7/5760 · 6 φ(1)/sd² = 1.8e-3/sd² of the variance, and terms beyond add a third of it at 0.7 DN. The lower one is
    better: `at_black`.
    """
    if sd < FINE:
        return 2e-8, 5e-8
    wave = np.exp(-2 * np.pi**2 * sd**2)
    return wave / np.pi + 7e-4 / sd**3, (4 * sd**2 + 0.2) * wave + 2.5e-3 / sd**2


def at_black(sd: float) -> tuple[float, float]:
    """As `tolerances`, far from full scale: by Euler–Maclaurin to the fifth derivative the mean is off by the seventh's
    1/1209600 · 15 φ(0)/sd⁷ = 5e-6/sd⁷ and the variance by 1/1209600 · 14 · 5.8 φ(0.6)/sd⁶ at most, some 2.5e-5/sd⁶; and
    terms beyond add half of it at 0.7 DN."""
    if sd < FINE:
        return tolerances(sd)
    wave = np.exp(-2 * np.pi**2 * sd**2)
    return wave / np.pi + 8e-6 / sd**7, (4 * sd**2 + 0.2) * wave + 5e-5 / sd**6


@pytest.mark.parametrize("dead", DEAD)
@pytest.mark.parametrize("sd", SCATTERS)
def test_readings_against_the_sum(sd, dead):
    """Mean and variance of every signal from below black to above full scale."""
    means = some_means(sd)
    mean, variance = converted(means, sd, dead)
    want = np.array([summed(m, sd, dead) for m in means])
    for part, (of_mean, of_variance) in ((means > 500, tolerances(sd)), (means <= 500, at_black(sd))):
        # Six scatters away a clip is left out: φ(6)/36 of a scatter, and 6 φ(6) of a variance.
        np.testing.assert_allclose(mean[part], want[part, 0], rtol=0, atol=of_mean + 2e-10 * sd)
        np.testing.assert_allclose(variance[part], want[part, 1], rtol=0, atol=of_variance + 4e-8 * sd**2)


@pytest.mark.parametrize("dead", DEAD)
@pytest.mark.parametrize("sd", [0.8, 2.0, 8.0, 300.0])
def test_both_ends_within_reach(sd, dead):
    """A converter of hardly more readings than the noise scatters over; the upper end has the tolerance of such."""
    highest = max(round(3 * sd), 6) + 0.0
    means = np.linspace(-3 * sd, dead + 5.9 * sd, 60)
    mean, variance = converted(means, sd, dead, full_scale=highest)
    want = np.array([summed(m, sd, dead, full_scale=highest) for m in means])
    of_mean, of_variance = tolerances(sd)
    np.testing.assert_allclose(mean, want[:, 0], rtol=0, atol=of_mean + 1e-8 * sd)
    np.testing.assert_allclose(variance, want[:, 1], rtol=0, atol=of_variance + 1e-6 * sd**2)


@pytest.mark.parametrize("dead", DEAD)
@pytest.mark.parametrize(("gain", "noise"), [(0.2, 2.0), (0.03, 22.0), (0.1137, 6.99), (0.2, 7.0), (0.3, 25.0)])
def test_shot_noise_is_skewed_where_black_cuts_it(gain, noise, dead):
    """Mean and variance against the plain sum over electrons, with the third moment of shot noise and without.

    Edgeworth's first term leaves the next: of the mean sd φ (excess/24 He₂ + skew²/72 He₄), He₂ φ ≤ 0.4, He₄ φ ≤ 1.2.
    λ electrons beside a noise of σ have skew λ/(λ + σ²)^1.5 ≤ 0.385/σ and excess λ/(λ + σ²)² ≤ 0.25/σ²: 0.0066 sd/σ².
    At a dead zone a reading changes by as much as the zone. The variance is off by some 2 sd times that. A normal law
    is off by more than three times what is left beside what rounding counts for.
    """
    light = np.concatenate([np.linspace(0, 1, 21), np.linspace(1.2, 12, 28)])
    edge = np.maximum(np.arange(0.5, 400), dead)
    want = []
    for electrons in light / gain:
        counts = np.arange(int(electrons + 12 * np.sqrt(electrons) + 30))
        above = poisson.pmf(counts, electrons) @ ndtr((gain * counts[:, None] - edge) / (gain * noise))
        want.append((above.sum(), (2 * np.arange(edge.size) + 1) @ above - above.sum() ** 2))
    sd = np.sqrt((gain * noise) ** 2 + gain * light)
    off = {}
    for third in (0.0, gain**2):
        pairs = [converted([m], own, dead, third=third * m) for m, own in zip(light, sd, strict=True)]
        off[third] = np.abs(np.array(pairs)[:, :, 0] - want)
    reach = 1 + dead / (gain * noise)
    next_term = 0.0066 * sd / noise**2 * reach
    # Light brings the scatter to where sums hand over.
    rounding = at_black(max(gain * noise, FINE))
    assert np.all(off[gain**2][:, 0] < next_term + rounding[0])
    assert np.all(off[gain**2][:, 1] < 2 * sd * next_term * reach + rounding[1])
    assert np.all(3 * off[gain**2].max(axis=0) < off[0.0].max(axis=0) + np.multiply(3, rounding))


@pytest.mark.parametrize("dead", DEAD)
def test_readings_against_draws(dead):
    """400,000 signals a case, rounded and cut one by one; five standard errors, one chance in 1.7 million a number,
    and 40 numbers."""
    rng = np.random.default_rng(17)
    z = rng.standard_normal(400_000)
    for mean, sd in ((0.4, 0.2), (dead, 0.6), (1.1, 1.4), (1021.5, 2.0), (30.0, 20.0)):
        signal = mean + sd * z
        readings = np.clip(np.rint(np.where(signal < dead, 0.0, signal)), 0, FULL_SCALE)
        own, spread = (float(v[0]) for v in converted([mean], sd, dead))
        errors = np.sqrt(readings.var() / z.size), np.sqrt(((readings - readings.mean()) ** 4).mean() / z.size)
        of_mean, of_variance = tolerances(sd)
        assert abs(own - readings.mean()) < 5 * errors[0] + of_mean
        assert abs(spread - readings.var()) < 5 * errors[1] + of_variance


def test_without_noise_a_signal_is_rounded_once():
    """To the nearest whole number, within both ends; halves are either."""
    signal = np.array([-3.0, -0.2, 0.0, 0.49, 0.51, 7.3, 511.8, 1022.4, 1022.6, 1030.0])
    mean, variance = converted(signal, 0.0)
    np.testing.assert_allclose(mean, [0, 0, 0, 0, 1, 7, 512, 1022, 1023, 1023], atol=1e-9)
    np.testing.assert_allclose(variance, 0.0, atol=1.1e-8)
    half = converted([8.5], 0.0)[0][0]
    assert half == pytest.approx(8.5, abs=1e-6)


def test_a_dead_zone_reads_0():
    """Signals below it; those above keep their own number, also where the zone ends between two."""
    signal = np.array([0.0, 2.3, 2.45, 2.6, 3.2, 40.0])
    np.testing.assert_allclose(converted(signal, 0.0, dead=2.4)[0], [0, 0, 2, 3, 3, 40], atol=1e-9)
    # Below half a DN it is rounding that reads 0.
    for got, want in zip(converted(signal, 0.3, dead=0.4), converted(signal, 0.3), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-7)


@pytest.mark.parametrize("sd", SCATTERS)
@pytest.mark.parametrize("dead", DEAD)
def test_moments_are_continuous(sd, dead):
    """No step where one formula hands over to another: neighbours 1e-4 of a scatter apart are as far apart as the two
    ways of computing may disagree, plus what a mean, at most ten times as steep as its signal, moves."""
    reach = [d + side * FAR * sd for d in (0.0, dead, FULL_SCALE) for side in (-1, 1)]
    seams = np.array([v for v in reach if -5 < v < 1030])
    step = 1e-4 * min(sd, 1.0)
    low, high = (converted(seams + side * step, sd, dead) for side in (-1, 1))
    of_mean, of_variance = tolerances(sd)
    assert np.abs(high[0] - low[0]).max() < 2 * of_mean + 20 * step
    assert np.abs(high[1] - low[1]).max() < 2 * of_variance + 40 * step * max(sd, 1.0)


def test_mean_rises_with_the_signal():
    """Whatever noise and dead zone: more light never reads less."""
    signal = np.linspace(-8, 30, 3001)
    for sd in SCATTERS:
        for dead in DEAD:
            mean, variance = converted(signal, sd, dead)
            assert np.all(np.diff(mean) > -2 * tolerances(sd)[0])
            assert variance.min() >= 1e-8 and mean.min() > -tolerances(sd)[0]


@pytest.mark.parametrize("sd", [0.8, 2.0, 20.0])
def test_it_agrees_with_the_sensors_closed_form(sd):
    """`clipped_normal` of model/sensor, which fits and bounds use: one formula at full scale, and at black as far as
    its rounding goes."""
    means = some_means(sd)
    want = clipped_normal(means, np.full(means.size, sd**2), 0.0, 0.0, FULL_SCALE, rounding=1 / 12)
    mean, variance = converted(means, sd)
    # A clip six scatters away is left out: φ(6)/36 of a scatter.
    high = means > 500
    np.testing.assert_allclose(mean[high], want.mean[high], rtol=1e-13, atol=1e-9 * sd)
    np.testing.assert_allclose(variance[high], want.variance[high], rtol=1e-7, atol=1.1e-8)
    of_mean, of_variance = tolerances(sd)
    np.testing.assert_allclose(mean, want.mean, rtol=0, atol=of_mean + 1e-9 * sd)
    np.testing.assert_allclose(variance, want.variance, rtol=0, atol=of_variance + 4e-8 * sd**2)


def test_no_full_scale():
    """A converter that is wide enough is one without an end."""
    signal = np.array([5.0, 900.0, 60_000.0])
    for a, b in zip(converted(signal, 3.0, full_scale=1e9), converted(signal, 3.0, full_scale=65_535.0), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("sd", [0.3, 0.5, 2.0])
def test_every_signal_has_its_own_highest_reading(sd):
    """Signals about levels of their own; below 0.7 DN of noise a level between two readings is the nearer one's."""
    level = np.array([300.0, 400.0, 510.4])
    mean = level[:, None] + sd * np.linspace(-7, 9, 30)
    out, spread = mean.ravel().copy(), np.full(mean.size, sd**2)
    convert(out, spread, np.zeros(mean.size), np.repeat(level, 30), 0.0)
    for k, (m, own, variance) in enumerate(zip(mean.ravel(), out, spread, strict=True)):
        highest = level[k // 30]
        if highest == round(highest) or sd < FINE:
            first, second = summed(m, sd, full_scale=round(highest))
            at_mean, at_variance = tolerances(sd)
            assert own == pytest.approx(first, abs=at_mean)
            assert variance == pytest.approx(second, abs=at_variance)
        # Far above it nothing but the level is read.
        assert own <= highest + 0.5
