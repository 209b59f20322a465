"""What a design can show is asked of what is left: one effect more, to first order."""

import numpy as np
import pytest

from spotcheck.discrepancy.assess import BY_CHANCE, LIKELIEST, likeliest
from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.extend import about
from spotcheck.discrepancy.look import look_at
from spotcheck.discrepancy.noise import hot_power
from spotcheck.discrepancy.shots import design_of
from tests.library.small_verdict import frames, looked, present


def test_a_faint_effect_is_seen_as_well_as_a_fit_of_it_would():
    """A score test and a likelihood ratio agree where the effect is small (Rao 1948,
    doi:10.1017/S0305004100023987): the first is the largest over many effects, so at least as large but for what
    curvature takes."""
    look, own = looked(lambda dx, dy, angle, exposure, sigma, spot: spot + 0.25)
    fitted = account(look, (present("dark_offset", 0.2),))
    gain = np.sqrt(own.refit.chi2 - fitted.refit.chi2)
    assert gain > 2 * BY_CHANCE
    assert likeliest(look, own)[LIKELIEST] > 0.97 * gain


def test_an_effect_that_was_added_asks_for_nothing_more():
    """With it in the model what is left is chance again."""
    look, own = looked(lambda dx, dy, angle, exposure, sigma, spot: spot + 1.0)
    assert likeliest(look, own)[LIKELIEST] > 5 * BY_CHANCE
    assert likeliest(look, account(look, (present("dark_offset", 1.0),)))[LIKELIEST] < 5


def test_without_any_effect_it_is_what_chance_brings():
    """Some fifteen independent directions: beyond 5 once in 10^5 sets, so a false alarm of 1 in 10^4 over the ten here;
    and not always 0."""
    found = [likeliest(*looked(seed=seed))[LIKELIEST] for seed in range(10)]
    assert max(found) < 5
    assert np.median(found) == pytest.approx(2.0, abs=1.0)  # the largest of 5 to 50 normal numbers


def dead(image, rng):
    """Readings of a converter whose zero is black, and that shows none below 2 DN."""
    return np.where(image - 12 < 2, 0.0, image - 12)


def test_noise_that_just_passes_a_dead_zone_is_not_hot():
    """The few dark readings of one frame that pass lie nine spreads of what is left beyond its mean, but not beyond the
    noise of 0.7 DN before the cut."""
    shots, base, setting = frames(angles=(0.0,), exposures=(1e-4,), repeats=1, after=dead)
    setting = setting._replace(sensor=setting.sensor._replace(black_level_dn=0.0))
    look = look_at(shots, design_of(shots), base, setting)
    own = account(look, (present("black_clipping", 1.5, form="dead zone"),))
    assert own.refit.model.present[0].values[0] == pytest.approx(1.5, abs=0.5)  # readings are whole numbers
    assert hot_power(about(shots, look, own).measured) == 0


def test_where_no_block_is_left_nothing_is_asked_for():
    """As of a crop that is clipped throughout."""
    look, own = looked()
    look.problem.used[:] = False
    assert likeliest(look, own) == {LIKELIEST: 0.0}
