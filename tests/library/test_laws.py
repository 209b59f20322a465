"""Laws on the numbers of frames: components against closed forms, trials on numbers drawn with a known covariance."""

import numpy as np
import pytest
from scipy import stats

from spotcheck.old_engine.evidence import accounts, components, laws, scatter
from spotcheck.old_engine.evidence.components import Component
from spotcheck.old_engine.evidence.influence import CELLS, FrameNumbers
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import Law, spot_state
from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.observe.design import Design, missing, view_of

SENSOR = SensorModel(0.11, 6.0, black_level_dn=12.0, full_scale_dn=1023)
LINEAR = Baseline(0.0, "linear", False, 9e-4)
# σ_g of 18 px at the longest exposure, 15.4 px at the shortest.
LAW = Law(1.2, 18 - 1.2 * np.log(9e-4), 700.0)
# Standard errors at the longest exposure: ln peak, ln σ_g, centre [px]; of fainter frames more.
ERRORS = np.array([5e-4, 3e-4, 0.02, 0.02])


def design(repeats: int = 2, exposures=(1e-4, 3e-4, 9e-4)) -> Design:
    """Sites at four angles, each seen at all exposures."""
    sites = np.repeat(np.arange(4 * repeats), len(exposures))
    angle = np.array([0.0, 45.0, 90.0, 135.0])[sites % 4]
    condition = np.arange(len(sites)) % (4 * len(exposures))
    return Design(
        sites, condition, angle, np.tile(exposures, 4 * repeats), np.linspace(0, 1, len(sites)), angle.astype(str)
    )


def effect(name: str, *values: float, form: str | None = None) -> Present:
    own = vocabulary()[name]
    return Present(own, own.forms[0] if form is None else form, values)


def drawn(rng, own: Design, present=(), sites=0.0, frames=0.0, centre=0.0, baseline=LINEAR, noise=1.0) -> FrameNumbers:
    """Numbers of frames with correlated noise, known but for what all frames share; rms of brightness from site to site
    and from frame to frame, and of centres [px] about the place of their site."""
    count = len(own.site)
    peak, sigma = spot_state(view_of(own), baseline, LAW, present)
    shared = np.eye(4)
    shared[0, 1] = shared[1, 0] = -0.5
    fainter = np.sqrt(own.exposure_s.max() / own.exposure_s)
    errors = np.outer(fainter, ERRORS).ravel()
    covariance = np.kron(np.eye(count), shared) * np.outer(errors, errors)
    values = np.stack([np.log(peak).ravel(), np.log(sigma).ravel(), np.zeros(count), np.zeros(count)])
    values += noise * (np.linalg.cholesky(covariance) @ rng.standard_normal(4 * count)).reshape(count, 4).T
    values[0] += sites * rng.standard_normal(count)[own.site] + frames * rng.standard_normal(count)
    values[2:] += rng.uniform(-3, 3, (2, count))[:, own.site] + centre * rng.standard_normal((2, count))
    apart = np.kron(np.eye(count) - 1 / count, np.eye(4))
    return FrameNumbers(values, apart @ covariance @ apart, np.zeros((4 * count, 0)))


def tried(numbers, own, *names, baseline=LINEAR, present=()):
    """Laws, and trials by name."""
    effects = [vocabulary()[name] for name in names]
    out = laws.laws_of(numbers, own, baseline, SENSOR, 240.0, present, effects)
    return out, {trial.present.effect.name: trial for trial in out.trials}


def test_balanced_layout_is_the_analysis_of_variance():
    """REML of a balanced one-way layout: τ = (MS_between − MS_within)/m (Searle et al., sec. 3.8), and the mean has
    sites − 1 degrees of freedom exactly."""
    rng, sites, each = np.random.default_rng(2), 7, 5
    y = rng.standard_normal((sites, each)) + 2 * rng.standard_normal((sites, 1))
    between = each * y.mean(1).var(ddof=1)
    within = y.var(axis=1, ddof=1).mean()
    members = np.kron(np.eye(sites), np.ones((each, 1)))
    parts = (Component("brightness", "site", members), Component("brightness", "frame", np.eye(sites * each)))
    one, known = np.ones((sites * each, 1)), 1e-12 * np.eye(sites * each)
    found = components.estimate(known, parts, one, y.ravel() - y.mean(), np.array([0.1, 0.1]), restricted=True)
    np.testing.assert_allclose(found.tau, [(between - within) / each, within], rtol=1e-3)
    covariance, _, doubt = components.reckoned(found, one)
    assert covariance[0, 0] == pytest.approx(between / y.size, rel=1e-3)
    assert 2 * covariance[0, 0] ** 2 / doubt[0] == pytest.approx(sites - 1, rel=1e-3)


@pytest.mark.parametrize("restricted", [True, False])
def test_score_is_the_slope_of_the_likelihood(restricted):
    rng = np.random.default_rng(3)
    half = rng.standard_normal((12, 12))
    known, slopes, rest = half @ half.T, rng.standard_normal((12, 2)), 3 * rng.standard_normal(12)
    parts = (Component("a", "site", np.kron(np.eye(4), np.ones((3, 1)))), Component("a", "frame", np.eye(12)))

    def at(tau):
        return components.estimated(known, parts, slopes, rest, tau, restricted=restricted)

    tau = np.array([0.7, 0.3])
    for k in range(2):
        step = 1e-5 * np.eye(2)[k]
        slope = (at(tau + step).deviance - at(tau - step).deviance) / 2e-5
        assert at(tau).score[k] == pytest.approx(-slope / 2, rel=1e-5)


def test_z_is_as_unlikely_as_t():
    for t, freedom in ((0.3, 3.0), (2.5, 5.0), (-6.0, 20.0)):
        z = components.z_of(t, freedom)
        assert 2 * stats.norm.sf(abs(z)) == pytest.approx(2 * stats.t.sf(abs(t), freedom)) and z * t > 0
    assert stats.norm.sf(components.z_of(3.0, 9.0, 2)) * 2 == pytest.approx(stats.f.sf(4.5, 2, 9.0))
    assert components.z_of(8.0, np.inf) == pytest.approx(8.0)
    # Where the tail underflows, another way takes over.
    assert components.z_of(60.0, 1e9) == pytest.approx(60.0, rel=1e-3)


def test_p1_and_p2_are_off_by_their_errors():
    """Mean and variance of 200 pulls: within 4 standard errors of 0 and 1 (false alarms: 2 in 10,000). What the laws
    doubt of a width that all frames share is no error of theirs."""
    own, pulls = design(), []
    for seed in range(200):
        numbers = drawn(np.random.default_rng([seed, 4]), own)
        base = laws.laws_of(numbers, own, LINEAR, SENSOR, 240.0, effects=()).base
        pulls.append(np.divide(np.subtract(base.law[:2], LAW[:2]), base.law_errors))
    pulls = np.array(pulls)
    assert np.all(np.abs(pulls.mean(0)) < 4 / np.sqrt(200))
    assert np.all(np.abs(pulls.var(0) - 1) < 4 * np.sqrt(2 / 200)), pulls.var(0)


def test_laws_are_recovered_without_noise():
    """Exactly, however far from the start: ln(1 + t₀/t) is 0.26 at the shortest exposure."""
    own, rng = design(), np.random.default_rng(1)
    cases = [
        (effect("shutter_offset", 3e-5), LINEAR),
        (effect("photon_budget", 0.3), LINEAR),
        (effect("spread_law", 0.25), LINEAR),
        (effect("laser_drift", -0.2, 1.0, form="linear"), LINEAR),
        (effect("laser_drift", 0.3, 6.0, form="settling"), LINEAR),
        (effect("shutter_offset", -2e-5), Baseline(4.0, "spot_area", False, 9e-4)),
    ]
    for true, baseline in cases:
        numbers = drawn(rng, own, [true], noise=0.0, baseline=baseline)
        out, trials = tried(numbers, own, true.effect.name, baseline=baseline)
        trial = trials[true.effect.name]
        assert trial.value == pytest.approx(true.values[0], rel=1e-3), true.effect.name
        assert trial.present.form == true.form
        assert trial.gain > 50 and abs(trial.z) > 5
        without = laws.again(out.base, out.base.mean.problem.components)
        assert without.deviance - trial.gain == pytest.approx(trial.alone, abs=0.1)


def test_errors_of_all_parameters():
    """40 sets with an amplitude of many errors and a phase: pulls of both by the base's own values and errors, mean and
    variance by chance once in 1,000; the error of a phase ψ of an amplitude q in cos 2(γ − ψ) is that of q over 2q."""
    own, rng, pulls = design(), np.random.default_rng(19), []
    true = effect("angle_reflectance", 0.02, 30.0)
    for _ in range(40):
        out, _ = tried(drawn(rng, own, [true]), own, present=[true])
        values, errors = out.base.present[0].values, laws.errors_of(out.base)["angle_reflectance"]
        pulls.append((np.array(values) - true.values) / errors)
        assert np.deg2rad(errors[1]) == pytest.approx(errors[0] / 0.04, rel=0.3)
    assert np.all(abs(np.mean(pulls, 0)) < 3.3 / np.sqrt(40))
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], 40) / 40
    assert np.all((np.mean(np.square(pulls), 0) > low) & (np.mean(np.square(pulls), 0) < high))


def test_amplitude_and_phase():
    own = design()
    numbers = drawn(np.random.default_rng(1), own, [effect("angle_reflectance", 0.05, 30.0)], noise=0.0)
    trial = tried(numbers, own, "angle_reflectance")[1]["angle_reflectance"]
    assert trial.present.values[0] == pytest.approx(0.05, rel=1e-3)
    assert np.cos(2 * np.deg2rad(trial.present.values[1] - 30)) == pytest.approx(1, abs=1e-4)


def test_z_without_an_effect_is_normal():
    """100 sets with scatter of sites as large as six errors, of frames as large as two: mean, variance and tails of z.
    Each bound is passed by chance less than once in 1,000 where z is normal."""
    own, rng, found = design(), np.random.default_rng(11), []
    for _ in range(100):
        _, trials = tried(drawn(rng, own, sites=3e-3, frames=1e-3), own, "shutter_offset")
        found.append(trials["shutter_offset"].z)
    z = np.array(found)
    assert abs(z.mean()) < 3.3 / np.sqrt(len(z))
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], len(z) - 1) / (len(z) - 1)
    assert low < z.var(ddof=1) < high
    assert np.sum(np.abs(z) > 2.576) <= stats.binom.isf(1e-3, len(z), 0.01)


def test_values_are_within_their_errors():
    """40 sets with a late shutter of ten errors: pulls of Student's t, mean and variance by chance once in 1,000."""
    own, rng, pulls = design(), np.random.default_rng(12), []
    for _ in range(40):
        _, trials = tried(drawn(rng, own, [effect("shutter_offset", 2e-6)], sites=3e-3), own, "shutter_offset")
        trial = trials["shutter_offset"]
        assert trial.z > 5
        pulls.append(components.z_of((trial.value - 2e-6) / trial.error, trial.freedom))
    assert abs(np.mean(pulls)) < 3.3 / np.sqrt(40)
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], 40) / 40
    assert low < np.mean(np.square(pulls)) < high


def test_the_true_law_is_the_best_of_rivals():
    """A late shutter: −2 ln L without scatter is lowest for it, by far; beside it nothing is left."""
    own, rng = design(), np.random.default_rng(13)
    names = ("shutter_offset", "photon_budget", "spread_law", "power_fluctuation", "laser_drift")
    numbers = drawn(rng, own, [effect("shutter_offset", 3e-6)])
    out, trials = tried(numbers, own, *names)
    alone = {name: trial.alone for name, trial in trials.items()}
    best = alone.pop("shutter_offset")
    without = laws.again(out.base, tuple(own for own in out.base.found.components if own.of == "width"))
    assert best < min(alone.values()) - 25 and best < without.deviance - 25
    # What all frames of an exposure share is no scatter of frames.
    assert trials["power_fluctuation"].z < 3
    beside, trials = tried(numbers, own, *names, present=[trials["shutter_offset"].present])
    assert "shutter_offset" not in trials and all(abs(trial.z) < 3 for trial in trials.values())
    assert beside.base.present[0].values[0] == pytest.approx(3e-6, rel=0.1)


@pytest.mark.parametrize(
    ("present", "name"),
    [(("shutter_offset", 8e-6), "shutter_offset"), (("angle_reflectance", 0.02, 30.0), "angle_reflectance")],
)
def test_groups_agree_about_a_law_that_is_right(present, name):
    """Q over frames that a law changes alike: of 60 draws with scatter of sites and frames it has the mean of χ² within
    four errors, as many degrees of freedom as groups leave, and exceeds its 1 % point at most four times (1 in 300)."""
    rng, own, law = np.random.default_rng(21), design(4), effect(*present)
    found = []
    for _ in range(60):
        out, _ = tried(drawn(rng, own, [law], sites=0.002, frames=0.001), own, name, present=[law])
        found.append(laws.agreement(out.base, 0))
    q, freedom = np.array(found).T
    assert len(set(freedom)) == 1 and freedom[0] >= 1
    assert abs(q.mean() - freedom[0]) < 4 * np.sqrt(2 * freedom[0] / 60)
    assert np.sum(stats.chi2.sf(q, freedom) < 0.01) <= 4


def test_groups_disagree_about_a_law_that_is_wrong():
    """Light that the exposure before left behind, 100 frames of the longest to one of the shortest, is no late
    shutter: three exposures say so, by far more than chance."""
    rng, own = np.random.default_rng(22), design(4)
    numbers = drawn(rng, own, sites=0.001, frames=0.001)
    numbers.values[0] += np.log1p(0.01 * np.roll(own.exposure_s, 1) / own.exposure_s)
    out, _ = tried(numbers, own, "shutter_offset", present=[effect("shutter_offset", 8e-6)])
    q, freedom = laws.agreement(out.base, 0)
    assert freedom >= 1 and stats.chi2.sf(q, freedom) < 1e-9


def test_cells_that_disagree_widen_errors():
    """Influence of cells as large as the known errors ask for changes nothing; one that is more adds its excess."""
    own, rng = design(), np.random.default_rng(14)
    plain = drawn(rng, own)
    _, trials = tried(plain, own, "shutter_offset")
    first = trials["shutter_offset"]
    # A pattern over the exposures, of opposite sign in every other cell.
    pattern = np.zeros((len(own.site), 4))
    pattern[:, 0] = np.log(own.exposure_s)
    sign = np.tile([1.0, -1.0], CELLS // 2)
    seen = {}
    for size in (1e-6, 1e-3):
        _, trials = tried(plain._replace(influence=size * pattern.ravel()[:, None] * sign), own, "shutter_offset")
        seen[size] = trials["shutter_offset"]
    assert seen[1e-6].error == pytest.approx(first.error)
    # p1, p2 and t₀ take Δ ln peak = a ln t all by themselves: t₀ by least squares from the same rows.
    problem = accounts.problem_of(plain, own, LINEAR, SENSOR, 240.0)
    mean = accounts.mean_of(problem, [seen[1e-3].present])
    start = accounts.start_of(mean), accounts.beginnings(problem)[0]
    best = accounts.account(mean, problem.components, restricted=True, start=start)
    made = problem.lift @ np.concatenate([1e-3 * pattern[:, 0], 0 * pattern[:, 0]])
    weight = best.found.inverse
    answer = np.linalg.solve(best.slopes.T @ weight @ best.slopes, best.slopes.T @ weight @ made)[-1]
    want = CELLS**2 / (CELLS - 4) * answer**2
    assert want > 100 * first.error**2
    assert seen[1e-3].error ** 2 == pytest.approx(first.error**2 + want, rel=0.05)
    assert abs(seen[1e-3].z) < abs(first.z) + 1e-9 and seen[1e-3].freedom < CELLS


@pytest.mark.parametrize("axes", [1, 2])
def test_what_is_left_of_a_variance_without_the_outermost(axes):
    """Against 200,000 draws (error 0.3 %), and in a plane 1 + p ln p/(1 − p)."""
    square = np.sort((np.random.default_rng(4).standard_normal((200_000, axes)) ** 2).sum(1))
    assert scatter.narrowed(0.1, axes) == pytest.approx(square[:180_000].mean() / axes, rel=0.01)
    assert scatter.narrowed(0.1, 2) == pytest.approx(1 + 0.1 * np.log(0.1) / 0.9)
    assert scatter.narrowed(0.0, axes) == 1


def scatters(numbers, own):
    effects = [vocabulary()[name] for name in ("pointing_jitter", "power_fluctuation")]
    return {found.present.effect.name: found for found in scatter.scatters_of(numbers, own, effects)}


def test_scatter_without_any():
    """300 sets, also with bright and dim sites: z passes 2.33 once in 100 (bound: by chance once in 1,000)."""
    own, rng = design(), np.random.default_rng(15)
    found = [scatters(drawn(rng, own, sites=5e-3), own) for _ in range(300)]
    for name in found[0]:
        z = np.array([each[name].z for each in found])
        assert np.sum(z > 2.326) <= stats.binom.isf(1e-3, len(z), 0.01), name
        # Half of all stand at 0; trimming leaves fewer far out, not many.
        assert 0.35 < np.mean(z == 0) < 0.7, name
        assert np.mean(z > 1.0) > 0.07, name


def test_scatter_is_recovered():
    """60 sets: the mean rms within four standard errors, and known as well as said, within a third."""
    own, rng = design(repeats=4), np.random.default_rng(16)
    found = [scatters(drawn(rng, own, frames=0.01, centre=0.3), own) for _ in range(60)]
    for name, true in (("power_fluctuation", 0.01), ("pointing_jitter", 0.3)):
        values = np.array([each[name].value for each in found])
        assert abs(values.mean() - true) < 4 * values.std() / np.sqrt(60), name
        assert np.mean([each[name].error for each in found]) == pytest.approx(values.std(ddof=1), rel=0.33), name
        assert min(each[name].z for each in found) > 5, name


def test_bad_frames_and_shifts_of_an_exposure_are_no_scatter():
    own, rng = design(), np.random.default_rng(17)
    numbers = drawn(rng, own)
    values = numbers.values.copy()
    values[2] += np.where(own.exposure_s < 2e-4, 1.0, 0.0)
    values[0] += np.where(own.exposure_s < 2e-4, 0.1, 0.0)
    for found in scatters(numbers._replace(values=values), own).values():
        assert found.z < 2.6
    values[3, 5] += 2.0
    values[0, 5] -= 0.3
    every = np.arange(len(own.site))
    for name, found in scatters(numbers._replace(values=values), own).items():
        axes = scatter.AXES[vocabulary()[name].component]
        assert found.z < 2.6
        # Left in, it would have been one.
        assert scatter.scatter_of(numbers._replace(values=values), own, axes, every).gain > 25


def test_what_a_design_cannot_show():
    effects, own = vocabulary(), design()
    assert not missing(effects["spread_law"], own, law=True)
    assert missing(effects["spread_law"], design(exposures=(1e-4, 9e-4)), law=True) == "three exposures"
    assert missing(effects["photon_budget"], own, law=False) == "law"
    assert missing(effects["laser_drift"], own._replace(order=np.full(len(own.site), np.nan)), law=True) == "order"
    free = laws.laws_of(drawn(np.random.default_rng(1), own), own, LINEAR._replace(photon_budget="free"), SENSOR, 240.0,
                        effects=[*effects.values()])  # fmt: skip
    assert free.base is None and not free.trials
    assert [found.present.effect.name for found in free.scatters] == ["pointing_jitter"]


def test_one_exposure_and_single_frames_of_sites():
    """Neither leaves a site's scatter beside that of frames, or p1; brightness still follows the angle."""
    own = design(repeats=6, exposures=(9e-4,))
    numbers = drawn(np.random.default_rng(18), own, [effect("angle_reflectance", 0.03, 45.0)], frames=2e-3)
    out, trials = tried(numbers, own, "angle_reflectance", "power_fluctuation", "shutter_offset")
    assert {part.shared for part in out.base.found.components} == {"frame"} and len(out.base.theta) == 1
    assert set(trials) == {"angle_reflectance", "power_fluctuation"}
    reflectance = trials["angle_reflectance"]
    assert abs(reflectance.value - 0.03) < 4 * reflectance.error and reflectance.z > 5
    assert abs(trials["power_fluctuation"].value - 2e-3) < 4 * trials["power_fluctuation"].error
