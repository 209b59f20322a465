"""REML variance components against the closed forms of a balanced one-way analysis of variance, and their intervals."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from spotcheck.discrepancy.mixed_model import VarianceComponents, deviation_interval, fit_reml

# Groups, and values in each: observations y_ij = mean + a_i + e_ij.
GROUPS, MEMBERS = 8, 5
# Part of the variance of e that is known beforehand, such as that of photon noise.
KNOWN_VARIANCE = 0.25


@dataclass(frozen=True)
class OneWay:
    """Values of a balanced one-way layout and their mean squares."""

    values: np.ndarray  # [group, member]

    @property
    def between(self) -> float:
        """Mean square between groups, on GROUPS − 1 degrees of freedom."""
        return float(self.values.mean(axis=1).var(ddof=1) * MEMBERS)

    @property
    def within(self) -> float:
        """Mean square within groups, on GROUPS (MEMBERS − 1) degrees of freedom."""
        return float(self.values.var(axis=1, ddof=1).mean())


def draw_one_way(seed: int, group_sd: float, member_sd: float) -> OneWay:
    """Draw a layout with a mean of 3."""
    rng = np.random.default_rng(seed)
    return OneWay(
        3.0 + group_sd * rng.standard_normal((GROUPS, 1)) + member_sd * rng.standard_normal((GROUPS, MEMBERS))
    )


def fit_one_way(layout: OneWay, *names: str) -> VarianceComponents:
    """Estimate components of a layout beside its mean and the known variance."""
    identity = np.eye(GROUPS * MEMBERS)
    matrices = {"group": np.kron(np.eye(GROUPS), np.ones((MEMBERS, MEMBERS))), "member": identity}
    components = {name: matrices[name] for name in names}
    mean = np.ones((GROUPS * MEMBERS, 1))
    return fit_reml(layout.values.ravel(), mean, KNOWN_VARIANCE * identity, components)


@pytest.mark.parametrize("seed", range(5))
def test_reml_is_the_analysis_of_variance(seed: int):
    """Variances, their covariance and the likelihood ratio are those of between and within mean squares."""
    layout = draw_one_way(seed, group_sd=2.0, member_sd=1.5)
    between, within = layout.between, layout.within
    fitted = fit_one_way(layout, "group", "member")
    # Searle, Casella & McCulloch (1992), chapter 4: for balanced data REML is the analysis of variance.
    expected = {"group": (between - within) / MEMBERS, "member": within - KNOWN_VARIANCE}
    dof_between, dof_within = GROUPS - 1, GROUPS * (MEMBERS - 1)
    var_member = 2 * within**2 / dof_within
    covariance = np.array(
        [
            [(2 * between**2 / dof_between + var_member) / MEMBERS**2, -var_member / MEMBERS],
            [-var_member / MEMBERS, var_member],
        ]
    )
    for index, name in enumerate(fitted.names):
        # The fit ends at a promised gain of 1e-5 in ln L: within √1e-5, 0.3 %, of a standard error of the optimum.
        tolerance = 5e-3 * np.sqrt(covariance[index, index])
        assert abs(fitted.value_of(name) - expected[name]) < tolerance
    # The covariance is as exact as the variances that it follows from, 0.5 % of 20 … 60 %.
    np.testing.assert_allclose(fitted.covariance, covariance, rtol=0.01)
    # −2 ln L with and without groups, both at their optimum: ln det V + n − 1.
    total = (dof_between * between + dof_within * within) / (dof_between + dof_within)
    ratio = (dof_between + dof_within) * np.log(total) - dof_between * np.log(between) - dof_within * np.log(within)
    alone = fit_one_way(layout, "member")
    assert alone.deviance - fitted.deviance == pytest.approx(ratio, abs=1e-3)
    assert alone.value_of("member") == pytest.approx(total - KNOWN_VARIANCE, rel=5e-3)
    assert alone.value_of("group") == 0.0


def test_a_variance_at_its_bound_stays_there():
    """Groups whose means scatter less than their members allow have a variance of exactly 0."""
    layout = next(
        layout for seed in range(100) if (layout := draw_one_way(seed, 0.0, 1.5)).between < 0.5 * layout.within
    )
    fitted = fit_one_way(layout, "group", "member")
    assert fitted.value_of("group") == 0.0
    # The other variance is that of the total mean square.
    total = layout.values.var(ddof=1)
    assert fitted.value_of("member") == pytest.approx(total - KNOWN_VARIANCE, rel=5e-3)


def test_all_variances_at_their_bound():
    """Values that scatter less than what is known have no component at all."""
    layout = draw_one_way(0, 0.0, 0.2)
    fitted = fit_one_way(layout, "group", "member")
    np.testing.assert_array_equal(fitted.variance, 0.0)


def test_reml_is_free_of_the_mean():
    """The mean's columns take degrees of freedom and nothing else: their coefficients change no estimate."""
    layout = draw_one_way(1, 2.0, 1.5)
    fitted = fit_one_way(layout, "group", "member")
    moved = fit_one_way(OneWay(layout.values + 1000.0), "group", "member")
    np.testing.assert_allclose(moved.variance, fitted.variance, rtol=1e-6)
    # A column that repeats another one adds nothing.
    identity = np.eye(GROUPS * MEMBERS)
    twice = fit_reml(
        layout.values.ravel(), np.ones((GROUPS * MEMBERS, 2)), KNOWN_VARIANCE * identity, {"member": identity}
    )
    np.testing.assert_allclose(twice.variance, fit_one_way(layout, "member").variance, rtol=1e-9)


def test_reml_without_components():
    """Without components −2 ln L is that of the known covariance."""
    layout = draw_one_way(2, 0.0, 0.5)
    fitted = fit_one_way(layout)
    dof = GROUPS * MEMBERS - 1
    expected = dof * np.log(KNOWN_VARIANCE) + dof * layout.values.var(ddof=1) / KNOWN_VARIANCE
    assert fitted.names == () and fitted.deviance == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("variance", [0.0, 1e-6, 0.3, 1.0, 40.0])
@pytest.mark.parametrize("relative_error", [0.0, 0.05, 0.5, 0.99, 1.01, 3.0, 100.0])
def test_deviation_interval_contains_its_value(variance: float, relative_error: float):
    """The standard deviation lies in its interval, which has no negative end."""
    interval = deviation_interval(variance, (relative_error * variance) ** 2 if variance else relative_error**2)
    assert interval.value == pytest.approx(np.sqrt(variance))
    assert 0.0 <= interval.low <= interval.value <= interval.high
    assert np.isfinite(interval.high) and interval.stderr >= 0


def test_deviation_interval_covers_the_truth():
    """The interval of a deviation that was estimated from k normal values holds the true one 19 times of 20."""
    count, values, true_sd = 2000, 8, 2.0
    estimates = (true_sd * np.random.default_rng(6).standard_normal((count, values))).var(axis=1, ddof=1)
    # The variance of the estimate as it is known beside the truth: 2 σ⁴/dof.
    intervals = [deviation_interval(estimate, 2 * estimate**2 / (values - 1)) for estimate in estimates]
    covered = sum(interval.low <= true_sd <= interval.high for interval in intervals)
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], count, 0.95)
    assert low <= covered <= high
