"""The joint fit: parameters at their bounds, and data that are an expectation."""

import numpy as np
import pytest

from spotcheck.discrepancy.asimov import asimov
from spotcheck.discrepancy.explain import account, expected_of
from spotcheck.discrepancy.name import singles
from spotcheck.model.effect import Parameter
from spotcheck.model.effects import vocabulary
from tests.library.small_verdict import looked, present


def offset(dx, dy, angle, exposure, sigma, spot):
    """A uniform pedestal of 6 DN."""
    return spot + 6.0


@pytest.mark.parametrize("radius", [20.0, 60.0, 150.0])
@pytest.mark.parametrize("form", ["gaussian", "exponential"])
def test_a_parameter_at_its_bound_does_not_hold_back_the_others(form, radius):
    """At one exposure a halo of the largest radius is all but a pedestal. A fit that comes to that bound ends where one
    ends that has no other radius: in −2 ln L to 0.05, of which a fit leaves some thousandths."""
    look, _ = looked(offset, exposures=(1e-4,))
    halo = vocabulary()["scatter_halo"]
    largest = halo.bounds(look.problem.context)[1][1]
    stiff = halo._replace(parameters=(halo.parameters[0], Parameter("radius", "px", largest - 1e-6, largest),
                                      halo.parameters[2]))  # fmt: skip
    narrow = account(look, [present("scatter_halo", 0.01, radius, 1.5, form=form)])
    held = account(look, [present("scatter_halo", 0.01, largest, 1.5, form=form)._replace(effect=stiff)])
    assert narrow.refit.model.present[0].values[1] == pytest.approx(largest)
    assert narrow.refit.score == pytest.approx(held.refit.score, abs=0.05)


def test_no_rival_is_ahead_of_the_truth_where_data_are_its_expectation():
    """Asimov's data have no noise, and still no model gains by expecting less of it (Cowan et al. 2011,
    doi:10.1140/epjc/s10052-011-1554-0): −2 ln L of the truth is the least, to a few hundredths that fits leave."""
    look, _ = looked(offset)
    truth = account(look, [present("dark_offset", 5.0, form="light")])
    ideal = asimov(look, truth.refit.model, truth.component, truth.grain)
    own = account(ideal, truth.refit.model.present, truth.refit.model)
    wider = singles(ideal, [vocabulary()["background_gradient"]])["background_gradient"]
    assert wider.refit.score > own.refit.score - 0.1
    assert np.sum(ideal.problem.scatter[ideal.problem.used] / own.refit.variance[ideal.problem.used]) == pytest.approx(
        ideal.problem.used.sum(), rel=1e-3
    )
    assert expected_of(ideal, own.refit.moments, own.refit.model.present) == pytest.approx(
        [o.value for o in ideal.observables], abs=1e-3
    )


def test_slopes_that_were_taken_far_away_end_no_fit():
    """A halo whose brightness follows no form of the vocabulary, fitted from the best one of another profile. Of the
    8000 in −2 ln L between the profiles starts may leave 20: of a wrong model the steps, which are the means', do not
    quite go down to the least."""

    def halo(dx, dy, angle, exposure, sigma, spot):
        wide = np.exp(-(dx**2 + dy**2) / (2 * 18.0**2))
        return spot + 0.3 * spot.sum() * wide / wide.sum()

    look, _ = looked(halo)
    wrong = account(look, [present("scatter_halo", 0.2, 15.0, 2.0, form="exponential")])
    right = [present("scatter_halo", *values, form="gaussian") for values in ((0.07, 22.0, 2.0), (0.01, 26.0, 1.5))]
    from_there = [account(look, [own], wrong.refit.model).refit.score for own in right]
    from_none = [account(look, [own]).refit.score for own in right]
    assert np.ptp([*from_there, *from_none]) < 20
    assert max(from_there) < wrong.refit.score - 7000
