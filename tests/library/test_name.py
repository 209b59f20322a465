"""The search over sets of effects: what is tried, what holds, and which name stands where two explain."""

import numpy as np
import pytest
from scipy.special import ndtr

from spotcheck.discrepancy import name
from spotcheck.discrepancy.assess import assessable
from spotcheck.discrepancy.explain import account
from spotcheck.model.effect import Place
from spotcheck.model.effects import vocabulary
from tests.library.small_verdict import ghost, looked, plain, present

FEW = ("ghost_reflection", "dark_offset", "background_gradient", "fibre_anisotropy", "power_fluctuation")


def effects(*names):
    """Effects of the vocabulary."""
    return [vocabulary()[own] for own in names]


def offset(dx, dy, angle, exposure, sigma, spot):
    """A uniform pedestal of 6 DN."""
    return spot + 6.0


def both(dx, dy, angle, exposure, sigma, spot):
    """A ghost and a pedestal."""
    return ghost(dx, dy, angle, exposure, sigma, spot) + 6.0


def enough(leader, own):
    """Holds where the means of blocks are explained: χ² within five standard deviations of what is expected."""
    freedom = own.refit.residual.size - own.refit.freedom
    return own, own.refit.chi2 < freedom + 5 * np.sqrt(2 * freedom)


@pytest.mark.parametrize(
    "options, why",
    [
        ({"exposures": (1e-4,)}, {"photon_budget": "one exposure", "spread_law": "two exposures fit"}),
        ({"angles": (0.0, 45.0)}, {"angle_reflectance": "fewer than three"}),
        ({"exposures": (None,)}, {"photon_budget": "one exposure", "laser_drift": "free"}),
        ({"exposures": (1e-4,), "repeats": 1, "angles": (0.0,)}, {"power_fluctuation": "too few frames"}),
    ],
)
def test_what_a_design_cannot_show_is_not_assessed(options, why):
    """With the reason, before any effect is fitted; all are on one of the two lists, but for a shape, which is
    learned."""
    look, _ = looked(**options)
    can, cannot = assessable(look)
    learned = {name for name, effect in vocabulary().items() if effect.place is Place.SHAPE}
    assert {effect.name for effect in can} | set(cannot) == set(vocabulary()) - learned
    assert not {effect.name for effect in can} & set(cannot)
    for effect, words in why.items():
        assert words in cannot[effect], cannot[effect]


def test_one_effect_is_enough_where_one_explains():
    """The search stops at the first size that holds; every effect that promises something has its own account."""
    look, _ = looked(ghost)
    found = name.search(look, effects(*FEW), enough, lambda own: look)
    assert [own.names for own in found.holding] == [("ghost_reflection",)]
    assert found.best is found.holding[0] and "ghost_reflection" in found.singles


def test_two_where_no_single_one_explains():
    """The pair, with what each of them is; no third beside it."""
    look, _ = looked(both)
    found = name.search(look, effects(*FEW), enough, lambda own: look)
    assert set(found.holding[0].names) == {"ghost_reflection", "dark_offset"}
    assert all(len(own.names) == 2 for own in found.holding)


def test_nothing_holds_where_nothing_is_good_enough():
    """The best that was tried is there, but no explanation; never more effects than the most."""
    look, _ = looked(both)
    found = name.search(look, effects(*FEW), lambda leader, own: (own, False), lambda own: look)
    assert found.holding == [] and found.best is not None and len(found.best.names) <= name.MOST


def test_the_simpler_of_two_is_the_name():
    """A uniform pedestal is no gradient of slope zero, though that explains it as well."""
    look, _ = looked(offset)
    simple, general = (
        account(look, [present("dark_offset", 3.0)]),
        account(look, [present("background_gradient", 1.0, 3.0, 10.0)]),
    )
    assert abs(simple.score - general.score) < name.TIED
    assert name._simplest([general, simple]) == [simple]
    # Sets that share all but these two count in the same way; others do not.
    pair, other = (
        account(look, [present("ghost_reflection", 0.01, 12.0, -5.0), *own.refit.model.present])
        for own in (simple, general)
    )
    assert name._simplest([other, pair]) == [pair]
    assert name._simplest([general, pair]) == [general, pair]


def test_the_simpler_is_compared_wherever_a_first_look_has_it():
    """Blocks blur what is strong, and a rival's free numbers make up for it: what it contains stays in the contest."""
    look, _ = looked(offset)
    empty = account(look, ())
    simple, general = (
        account(look, [present("dark_offset", 3.0)]),
        account(look, [present("background_gradient", 1.0, 3.0, 10.0)]),
    )
    off = 0.1 * empty.score
    far = simple._replace(score=simple.score + off, refit=simple.refit._replace(score=simple.refit.score + off))
    exact = {own.names: own for own in (simple, general)}
    found = name._contest([general, far], empty, lambda leader, own: (exact[own.names], True))
    assert {own.names for own, _ in found} == {("dark_offset",), ("background_gradient",)}


def test_what_a_set_does_not_need_is_dropped():
    """A pair that was reached by way of one that mimicked gives way to the single one that holds."""
    look, _ = looked(ghost)
    pair = account(look, [present("ghost_reflection", 0.05, 12.0, -5.0), present("dark_offset", 0.1)])
    fewer = name._fewer(look, pair, enough, np.inf)
    assert fewer is not None and fewer.names == ("ghost_reflection",)
    assert name._fewer(look, fewer, enough, np.inf) is None


def test_what_noise_alone_sets_apart_is_no_name():
    """At one angle an oval beam is an oval spread. Were the other by chance 20 behind in −2 ln L, which noise of one
    standard deviation does to what is expected to be 10 behind, both are answers; not so where 1,000 are expected, nor
    where more is seen than chance ever does."""

    def oval(dx, dy, angle, exposure, sigma, spot):
        return np.max(spot) * np.exp(-((dx / 1.05) ** 2 + dy**2) / (2 * sigma**2))

    look, empty = looked(oval, angles=(0.0,))
    found = name.singles(look, effects("fibre_anisotropy", "beam_ellipticity", "ghost_reflection"))
    ranked = sorted(found.values(), key=lambda own: own.score)
    best, rival, other = ranked
    assert other.names == ("ghost_reflection",) and abs(rival.score - best.score) < 0.1

    def answers(behind, which):
        closer = lambda leader, own: (own._replace(score=best.score + behind), True)  # noqa: E731
        near = {own.names[0]: own for own in (best, which._replace(score=best.score + behind))}
        return name._inseparable(best, near, empty, closer, lambda own: look)

    assert [own.names for own in answers(20.0, rival)] == [rival.names]
    assert answers(1.05 * name.FAR, rival) == []
    assert answers(20.0, other) == []


def test_what_grows_by_its_square_is_followed_from_a_weak_start():
    """A smear as long as the spot is wide, at one exposure, passes for an ellipse, of which the fit comes first. The
    truth is behind that by noise at most: four standard deviations. Its length, known to half a percent, is right
    within four of them."""
    length, cos, sin = 7.0, np.cos(np.pi / 6), np.sin(np.pi / 6)

    def smeared(dx, dy, angle, exposure, sigma, spot):
        along, across = dx * cos + dy * sin, dy * cos - dx * sin
        ends = ndtr((along + length / 2) / sigma) - ndtr((along - length / 2) / sigma)
        return np.max(spot) * ends * np.sqrt(2 * np.pi) * sigma / length * np.exp(-(across**2) / (2 * sigma**2))

    look, _ = looked(smeared, angles=(0.0,), exposures=(4e-4,), repeats=12)
    found = name.singles(look, effects("beam_ellipticity", "motion_blur"))
    assert found["motion_blur"].score < found["beam_ellipticity"].score + name.TIED
    assert found["motion_blur"].refit.model.present[0].values[0] * 4e-4 == pytest.approx(length, rel=0.02)


def test_free_gains_leave_when_a_law_of_the_brightness_has_come():
    """Rows that scatter and a drift: free gains stand in for the drift until that is tried beside them."""
    count = iter(range(1000))

    def drift(dx, dy, angle, exposure, sigma, spot):
        return spot * (1 + 0.1 * next(count) / 23)

    look, empty = looked(drift, repeats=6)
    gains = account(look, [present("power_fluctuation", 0.0)])
    closer = lambda leader, own: (own, own.score < gains.score + 1)  # noqa: E731
    found = name._beside_scatter(look, [(gains, True)], effects("laser_drift"), empty, closer)
    assert set(found[0][0].names) == {"power_fluctuation", "laser_drift"}
    assert name._thinned(look, found, closer, name.EARNS)[0][0].names == ("laser_drift",)


def test_free_gains_do_not_take_a_law_of_the_brightness_away():
    """Brightness that scatters by 2 % and grows by another power of the exposure: gains alone hold, but not as well."""
    rng = np.random.default_rng(3)

    def both_of_them(dx, dy, angle, exposure, sigma, spot):
        return spot * (exposure / 4e-4) ** 0.08 * (1 + 0.02 * rng.standard_normal())

    look, empty = looked(both_of_them, repeats=12, exposures=(1e-4, 2e-4, 4e-4))
    gains = account(look, [present("power_fluctuation", 0.0)])
    holds = lambda leader, own: (own, "power_fluctuation" in own.names)  # noqa: E731
    found = name._beside_scatter(look, [(gains, True)], effects("photon_budget"), empty, holds)
    kept = name._thinned(look, found, holds, name.EARNS)[0][0]
    assert set(kept.names) == {"power_fluctuation", "photon_budget"}
    assert name._thinned(look, found, holds)[0][0].names == ("power_fluctuation",)


def test_effects_that_only_scatter_are_told_from_those_of_the_mean():
    """White noise is no component of variance, and promises as little to the means."""
    noisy = {own.name for own in vocabulary().values() if name.scatters(own)}
    assert noisy == {"speckle", "power_fluctuation", "pointing_jitter", "fixed_pattern", "row_noise",
                     "excess_read_noise"}  # fmt: skip


def test_no_effect_no_name():
    """Frames of the base alone: the best effect does not earn its place by far."""
    look, empty = looked(plain)
    alone = name.singles(look, effects(*FEW))
    assert min(own.score for own in alone.values()) > empty.score - name.EARNS
