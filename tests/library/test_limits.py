"""Limits hold what they say: an effect about as large as its limit lies below it in 95 of 100 sets.

Each test counts over sets with seeds of their own. Fewer than `least` of them have the truth below a limit of 95 % once
in 1,000 by chance; limits that say nothing are found by their median, which may be no more than some times the truth.
"""

import numpy as np
import pytest
from scipy import stats

from spotcheck.old_engine.conclude.judgement import TIED_WITH_SHAPE
from spotcheck.old_engine.conclude.limits import limits_of, of_law, of_scatter
from spotcheck.old_engine.conclude.reach import ONE_SIDED, reach_of_pixels
from spotcheck.old_engine.evidence.laws import Laws, laws_of
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.nuisance.fit import fit
from spotcheck.old_engine.search.candidates import Tied
from spotcheck.old_engine.search.forward import Outcome
from tests.library import test_laws
from tests.library.small_light import CONTEXT, GAIN, NOISE, PENALTY, SIDE, designed, drawn, gaussian, started

SEEDS = 24


def least(count: int) -> int:
    """Fewer of so many sets are covered once in 1,000."""
    return int(stats.binom.ppf(1e-3, count, 0.95))


def fitted(seed: int, sites: int = 2, shape=gaussian, **kinds):
    """Frames of the declared light with something drawn into them, the engine's fit without it, and their design."""
    images, known = drawn(seed, sites=sites, shape=shape, **kinds)
    frames, model = started(images, known)
    return frames, fit(frames, model._replace(lights=None), PENALTY), designed(known)


def oval(u, v, ratio=1.004, direction=22.5):
    """An ellipse whose long axis lies halfway between two directions from which fits start."""
    angle = np.deg2rad(direction)
    along, across = u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle)
    return gaussian(along / ratio**0.5, across * ratio**0.5)


MEANS = {"dark_offset": (0.012, {"pedestal": 0.012}), "beam_ellipticity": (1.004, {"shape": oval}),
         "saturation": (715.0, {"clip": 715.0})}  # fmt: skip


@pytest.mark.parametrize("name", MEANS)
def test_effects_of_the_mean_image(name):
    """A pedestal, an ellipse, and a level at which the brightest pixels stop."""
    (truth, kinds), effect = MEANS[name], vocabulary()[name]
    ends = []
    for seed in range(SEEDS):
        frames, fit, design = fitted(seed, **kinds)
        own = reach_of_pixels(frames, fit, design, [effect], CONTEXT)[name]
        ends.append(own.low if np.isinf(effect.neutral) else own.high)
    away = np.array(ends) - truth
    covered = away < 0 if np.isinf(effect.neutral) else away > 0
    assert covered.sum() >= least(SEEDS)
    reach = abs(np.median(ends) - (0 if np.isinf(effect.neutral) else effect.neutral))
    scale = truth if np.isinf(effect.neutral) else abs(truth - effect.neutral)
    assert 1 / 3 < reach / scale < 3


def test_a_limit_of_nothing_is_noise():
    """A pedestal that is not there: limit and closed form 1.645 σ/√n, σ by photons and read noise of all pixels; up to
    the part that says that there is some, which is 0 in half of the sets and raises the median by nothing."""
    frames, fit, design = fitted(3)
    own = reach_of_pixels(frames, fit, design, [vocabulary()["dark_offset"]], CONTEXT)["dark_offset"]
    variance = GAIN**2 * NOISE**2 + 1 / 12
    bound = ONE_SIDED * np.sqrt(variance / (len(frames) * SIDE**2))
    assert bound < own.high < 4 * bound
    assert own.times == pytest.approx(4, rel=0.5)


FIELDS = {"row_noise": (0.06, {"rows": 0.06}), "fixed_pattern": (0.004, {"prnu": 0.004}),
          "excess_read_noise": (1.02 * NOISE, {"read": 1.02 * NOISE})}  # fmt: skip


@pytest.mark.parametrize("name", FIELDS)
def test_effects_of_the_noise(name):
    """Offsets of rows, gains of pixels, and more read noise than stated."""
    (truth, kinds), effect = FIELDS[name], vocabulary()[name]
    ends = []
    for seed in range(SEEDS):
        frames, fit, design = fitted(seed, spread=0.0, **kinds)
        outcome = Outcome(tuple(frames), fit, fit, (), ())
        (own,) = limits_of(outcome, Laws(None, (), ()), design, [effect], CONTEXT)
        ends.append(own.high)
    assert (np.array(ends) > truth).sum() >= least(SEEDS)
    assert truth < np.median(ends) < 3 * truth


def test_less_noise_than_stated_leaves_room_for_more():
    """Where darks show less than the sheet says, a limit is still beyond what it says, by the error of the darks."""
    frames, fit, design = fitted(0, spread=0.0, read=0.9 * NOISE)
    outcome, effect = Outcome(tuple(frames), fit, fit, (), ()), vocabulary()["excess_read_noise"]
    (own,) = limits_of(outcome, Laws(None, (), ()), design, [effect], CONTEXT)
    assert CONTEXT.read_noise_e < own.high < 1.1 * CONTEXT.read_noise_e


LAWS = {"photon_budget": (0.003,), "shutter_offset": (4e-7,)}
SETS = 40


@pytest.mark.parametrize("name", LAWS)
def test_laws_of_the_frames(name):
    """Over numbers of frames that scatter from site to site and from frame to frame by 0.3 %: both ends."""
    design = test_laws.design()
    present = (test_laws.effect(name, *LAWS[name]),)
    covered, width = 0, []
    for seed in range(SETS):
        rng = np.random.default_rng(seed)
        numbers = test_laws.drawn(rng, design, present, sites=0.003, frames=0.003)
        _, trials = test_laws.tried(numbers, design, name)
        own = of_law(trials[name], CONTEXT)
        covered += own.low < LAWS[name][0] < own.high
        width.append(own.high - own.low)
    assert covered >= least(SETS)
    assert np.median(width) < 20 * LAWS[name][0]


@pytest.mark.parametrize(("name", "rms"), [("power_fluctuation", 0.003), ("pointing_jitter", 0.05)])
def test_scatter_of_the_frames(name, rms):
    """Of brightness and of the centre."""
    design = test_laws.design()
    highs = []
    for seed in range(SETS):
        rng = np.random.default_rng(seed)
        kinds = {"frames": rms} if name == "power_fluctuation" else {"centre": rms}
        numbers = test_laws.drawn(rng, design, **kinds)
        told = laws_of(numbers, design, test_laws.LINEAR, test_laws.SENSOR, 240.0, (), [vocabulary()[name]])
        (own,) = told.scatters
        highs.append(of_scatter(own).high)
    covered = int((np.array(highs) > rms).sum())
    assert covered >= least(SETS)
    assert rms < np.median(highs) < 2.5 * rms


def test_what_has_no_limit_says_why():
    """Tied with the light's shape, a law that stands in another's place, and what frames do not tell."""
    frames, fit, design = fitted(0)
    known = [vocabulary()[name] for name in ("scatter_halo", "spread_law", "beam_profile", "laser_drift")]
    outcome = Outcome(tuple(frames), fit, fit, (), (Tied(known[0], 0.0),))
    rows = limits_of(outcome, Laws(None, (), ()), design, known, CONTEXT)
    assert [own.effect for own in rows] == [own.name for own in known]
    assert rows[0].why == TIED_WITH_SHAPE and "no size" in rows[1].why and "shape" in rows[2].why
    assert all(np.isnan([own.low, own.high]).all() for own in rows)
