"""Laws of brightness and width across frames, on numbers that numpy drew."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from spotcheck.discrepancy.laws import LawFit, NamedLaw, find_laws, is_law
from spotcheck.model.effects import vocabulary
from tests.samples import drawn_frames as drawing
from tests.samples.drawn_frames import Conditions, DrawnNumbers, draw_numbers, lay_out
from tests.samples.models_of_frames import LONGEST_S, search_of

LAWS = [effect for effect in vocabulary().values() if is_law(effect)]
CONDITIONS = lay_out(repeats=3)
# Standard deviation of ln peak from frame to frame beside the errors of the numbers.
FRAME_SCATTER = 0.005


def find_in(numbers: DrawnNumbers) -> tuple[list[NamedLaw], list[tuple[str, ...]], LawFit]:
    """Return the laws of drawn numbers, rivals and the fit, from all laws of the vocabulary."""
    found = find_laws(search_of(numbers), LAWS)
    return list(found.laws), list(found.rivals), found.fit


def names_of(laws: list[NamedLaw]) -> list[str]:
    """Return the names of laws."""
    return sorted(law.applied.effect.name for law in laws)


def reflect_by_angle(conditions: Conditions) -> np.ndarray:
    """Return a factor [frame] on the brightness that follows the fibre angle by 5 %, brightest at 30°."""
    return 1 + 0.05 * np.cos(2 * (conditions.angle - np.deg2rad(30.0)))


def grow_by_power(conditions: Conditions) -> np.ndarray:
    """Return a factor [frame] that is the power 0.1 of the exposure."""
    return (conditions.exposure_s / LONGEST_S) ** 0.1


def drift(conditions: Conditions) -> np.ndarray:
    """Return a factor [frame] that rises by 8 % with the order of acquisition."""
    return 1 + 0.08 * conditions.order


# Factor on the brightness, and the law that it is with its parameters.
BRIGHTNESS_LAWS = {
    "angle": (reflect_by_angle, "angle_reflectance", {"d": 0.05, "gamma0": 30.0}),
    "power": (grow_by_power, "photon_budget", {"q": 0.1}),
    "drift": (drift, "laser_drift", {"total": 0.08}),
}


@pytest.mark.parametrize("name", BRIGHTNESS_LAWS)
def test_a_law_of_the_brightness_is_found(name: str):
    """Exactly the law that was drawn is named, and each parameter is where its error says."""
    factor, effect, truth = BRIGHTNESS_LAWS[name]
    laws, rivals, fit = find_in(draw_numbers(1, CONDITIONS, factor(CONDITIONS), FRAME_SCATTER))
    assert names_of(laws) == [effect] and rivals == [] and fit.has_converged
    assert laws[0].reasons == () and laws[0].z > 5
    for parameter, true_value in truth.items():
        interval = laws[0].intervals[parameter]
        offset = interval.value - true_value
        if parameter == "gamma0":
            # A direction has a period of 180°.
            offset = (offset + 90) % 180 - 90
        # Student's t with about 24 degrees of freedom beyond 5: 4e-5.
        assert abs(offset) < 5 * interval.stderr
    # The law of the exposure is found beside it: Student's t as above.
    for index, (value, true_value) in enumerate([(fit.law.p2, drawing.P2), (fit.law.p1, drawing.P1)], start=1):
        assert fit.names[index] == ("", ("peak_dn", "p2", "p1")[index])
        assert abs(value - true_value) < 5 * np.sqrt(fit.covariance[index, index])


def test_two_laws_are_found_together():
    """A drift and a reflectance that follows the angle are told apart, since the order of the frames is random."""
    factor = reflect_by_angle(CONDITIONS) * drift(CONDITIONS)
    laws, rivals, _ = find_in(draw_numbers(2, CONDITIONS, factor, FRAME_SCATTER))
    assert names_of(laws) == ["angle_reflectance", "laser_drift"] and rivals == []
    assert all(law.reasons == () for law in laws)


def test_a_law_of_the_width_is_found():
    """A width that follows a power of the exposure is told from p1 ln t + p2 by three exposures."""
    numbers = draw_numbers(3, CONDITIONS, frame_scatter=FRAME_SCATTER)
    exponent = 0.2
    log_law = np.log(drawing.follow_law(CONDITIONS)[1])
    log_power = np.log(6.4) + exponent * np.log(CONDITIONS.exposure_s / np.median(CONDITIONS.exposure_s))
    change = log_power - log_law
    # The baseline's peak is proportional to t/σ², which is given at the longest exposure.
    at_longest = change[CONDITIONS.exposure_s.argmax()]
    numbers = replace(
        numbers, log_sigma=numbers.log_sigma + change, log_peak=numbers.log_peak - 2 * (change - at_longest)
    )
    laws, _, _ = find_in(numbers)
    assert names_of(laws) == ["spread_law"] and laws[0].reasons == ()
    interval = laws[0].intervals["exponent"]
    assert abs(interval.value - exponent) < 5 * interval.stderr


@pytest.mark.parametrize("site_scatter", [0.0, 0.03], ids=["alike", "scattering sites"])
def test_plain_numbers_have_no_law(site_scatter: float):
    """Of numbers without a law none is named, also where the brightness scatters by 3 % from site to site.

    A law is named from z = 5 on, which takes the degrees of freedom into account: 6e-7 for one strength, and some 1e-4
    for six sets of numbers and the variants and directions of five laws.
    """
    for seed in range(6):
        numbers = draw_numbers(40 + seed, CONDITIONS, frame_scatter=FRAME_SCATTER, site_scatter=site_scatter)
        laws, _, _ = find_in(numbers)
        assert [law for law in laws if not law.reasons] == []


@pytest.mark.parametrize("name", BRIGHTNESS_LAWS)
def test_intervals_of_laws_cover_the_truth(name: str):
    """Of 60 sets of numbers about 57 have the truth in the 95 % interval of the strength."""
    factor, effect, truth = BRIGHTNESS_LAWS[name]
    parameter, true_value = next(iter(truth.items()))
    covered, count = 0, 60
    for seed in range(count):
        search = search_of(draw_numbers(300 + seed, CONDITIONS, factor(CONDITIONS), FRAME_SCATTER))
        fit = search.fit([vocabulary()[effect]])
        interval = search.judge(fit.effects[0], fit, gain=np.inf).intervals[parameter]
        covered += interval.low < true_value < interval.high
    # False-alarm rate 1e-3 on either side.
    low, high = stats.binom.ppf([1e-3, 1 - 1e-3], count, 0.95)
    assert low <= covered <= high


def test_two_exposures_leave_rivals():
    """A power of the exposure and an offset of the shutter are one number each, which one ratio cannot tell apart."""
    conditions = lay_out(exposures_s=(1e-4, LONGEST_S), repeats=3)
    laws, rivals, _ = find_in(draw_numbers(4, conditions, grow_by_power(conditions), FRAME_SCATTER))
    assert len(laws) == 1
    named = [(name,) for name in names_of(laws)]
    assert sorted([*named, *rivals]) == [("photon_budget",), ("shutter_offset",)]


def test_a_law_that_does_not_fit_is_not_named():
    """A brightness that follows cos 4γ as much as cos 2γ is no reflectance of fibres, and the reason is stated."""
    factor = reflect_by_angle(CONDITIONS) + 0.05 * np.cos(4 * CONDITIONS.angle)
    laws, _, _ = find_in(draw_numbers(5, CONDITIONS, factor, FRAME_SCATTER))
    by_name = {law.applied.effect.name: law for law in laws}
    assert any("lack of fit over angle" in reason for reason in by_name["angle_reflectance"].reasons)


def test_negligible_laws_are_not_named():
    """A drift of 0.3 %, which precise frames show beyond doubt, is reported as negligible: below 0.5 %."""
    conditions = lay_out(repeats=6)
    numbers = draw_numbers(6, conditions, 1 + 0.003 * conditions.order, frame_scatter=0.0, error_share=0.05)
    laws, _, _ = find_in(numbers)
    assert names_of(laws) == ["laser_drift"]
    assert laws[0].reasons == ("negligible",)


def test_scatter_of_frames_and_sites_is_estimated():
    """Brightness that scatters from frame to frame and from site to site gives both deviations, and no width's."""
    conditions = lay_out(angles_deg=tuple(np.arange(0.0, 180.0, 22.5)), repeats=4)
    numbers = draw_numbers(7, conditions, frame_scatter=0.01, site_scatter=0.03)
    variances = search_of(numbers).variances
    assert set(variances.names) == {"frame brightness", "site brightness"}
    # Beside one mean for each of 8 angles and 3 exposures, 32 sites leave 24 degrees of freedom, and the frames within
    # them 48. False-alarm rate 2e-4 each; what frames add to the scatter of sites, 4 %, is far below the width.
    for name, deviation, dof in (("site brightness", 0.03, 24), ("frame brightness", 0.01, 48)):
        low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], dof) / dof
        assert low < variances.value_of(name) / deviation**2 < high
    assert variances.value_of("site width") == 0.0


def test_laws_do_not_widen_the_scatter():
    """A law that is missing from the model leaves the variance components as they are: they are free of the mean."""
    plain = draw_numbers(8, CONDITIONS, frame_scatter=FRAME_SCATTER)
    with_law = draw_numbers(8, CONDITIONS, reflect_by_angle(CONDITIONS) * grow_by_power(CONDITIONS), FRAME_SCATTER)
    first, second = search_of(plain).variances, search_of(with_law).variances
    assert first.names == second.names
    np.testing.assert_allclose(first.variance, second.variance, rtol=1e-3)
