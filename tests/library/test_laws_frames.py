"""Laws on the numbers of frames that are fitted to drawn frames, and what each cell of the spot says in them."""

from functools import cache

import numpy as np
import pytest

from spotcheck.old_engine.evidence.influence import CELLS, RADII, influence_of, numbers_of
from spotcheck.old_engine.evidence.laws import again, laws_of
from spotcheck.old_engine.evidence.pixels import AZIMUTHS, cells_of
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import View
from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.model.light_shape import empty
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.nuisance.fit import contrasts, fit, sums_of
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Frame, Lights, Model, Numbers

SENSOR = SensorModel(0.11, 6.0, black_level_dn=12.0, full_scale_dn=1023)
SIDE, EXPOSURES, ANGLES, REPEATS = 80, (1e-4, 3e-4, 9e-4), (0.0, 45.0, 90.0, 135.0), 2
# The law's own numbers: σ_g [px] at the longest exposure, and its slope in ln t.
WIDTH, P1, PEAK = 7.0, 0.6, 700.0


def light(x, y, sigma):
    """A spot of peak 1 that is no Gaussian: four lobes of 4 %, and a broader foot."""
    u, v = x / sigma, y / sigma
    square = u * u + v * v
    lobes = 0.04 * np.exp(-square / 1.6) * ((u * u - v * v) ** 2 - 4 * u * u * v * v) / (1 + square)
    return np.maximum(0.97 * np.exp(-square / 2) + 0.03 * np.exp(-square / 4) + lobes, 0)


def drawn(seed: int, late=0.0, power=0.0, jitter=0.0) -> tuple[list[Frame], Design, np.ndarray]:
    """Frames by a chain of a few lines; their design, and their numbers [number, frame]."""
    rng = np.random.default_rng(seed)
    pixel = np.arange(SIDE, dtype=float)
    frames, rows, numbers = [], [], []
    for site in range(len(ANGLES) * REPEATS):
        place = SIDE / 2 + rng.uniform(-3, 3, 2)
        for t in EXPOSURES:
            sigma = WIDTH + P1 * np.log(t / EXPOSURES[-1])
            peak = PEAK * (t + late) / EXPOSURES[-1] * (WIDTH / sigma) ** 2 * (1 + power * rng.standard_normal())
            x0, y0 = place + jitter * rng.standard_normal(2)
            electrons = rng.poisson(peak * light(pixel[None] - x0, pixel[:, None] - y0, sigma) / SENSOR.gain_dn_per_e)
            readings = SENSOR.gain_dn_per_e * (electrons + SENSOR.read_noise_e * rng.standard_normal((SIDE, SIDE)))
            pixels = np.clip(np.rint(readings + SENSOR.black_level_dn), 0, SENSOR.full_scale_dn)
            frames.append(Frame(pixels, view(t)))
            rows.append((site, ANGLES[site % len(ANGLES)], t))
            numbers.append((np.log(peak), np.log(sigma), x0, y0))
    site, angle, exposure = (np.array(own) for own in zip(*rows, strict=True))
    condition = np.unique(np.stack([angle, exposure]), axis=1, return_inverse=True)[1].ravel()
    return (
        frames,
        Design(site, condition, angle, exposure, np.linspace(0, 1, len(frames)), angle.astype(str)),
        np.array(numbers).T,
    )


def view(exposure_s: float) -> View:
    one = np.ones((1, 1, 1))
    pixel = np.arange(SIDE, dtype=float)
    return View(pixel[None, None], pixel[None, :, None], one, one, exposure_s * one, 0 * one, 0 * one, 0 * one, 0 * one,
                EXPOSURES[-1], EXPOSURES[1], 0.0, 0.0, float(SIDE), 1.0)  # fmt: skip


@cache
def fitted(seed: int, **options):
    frames, design, truth = drawn(seed, **options)
    # A start that is a little off, as any is.
    start = Numbers(*(truth + 0.01 * np.random.default_rng(seed).standard_normal(truth.shape)))
    lights = Lights.common(empty(0.2, 5.1), len(start.x))
    model = Model(Baseline(0.0, "free", False, 1.0), SENSOR, (), start, lights=lights)
    own = fit(frames, model, 1.0)
    return frames, design, own, influence_of(frames, own)


@cache
def judged(seed: int, late=0.0, power=0.0, jitter=0.0):
    _, design, own, influence = fitted(seed, late=late, power=power, jitter=jitter)
    baseline = Baseline(0.0, "linear", False, EXPOSURES[-1])
    out = laws_of(numbers_of(own, influence), design, baseline, SENSOR, float(SIDE), effects=[*vocabulary().values()])
    return (
        out,
        {trial.present.effect.name: trial for trial in out.trials},
        {s.present.effect.name: s for s in out.scatters},
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_nothing_is_found_where_nothing_is(seed):
    """Seven numbers, each of them past 4 once in 16,000 sets if normal: in three sets by chance 1 in 800."""
    out, trials, scatters = judged(seed)
    assert set(trials) >= {"shutter_offset", "photon_budget", "spread_law", "angle_reflectance", "laser_drift"}
    for own in (*trials.values(), *scatters.values()):
        assert abs(own.z) < 4, own
    # p1 over the reference width; an error of some thousandths.
    assert out.base.theta[0] / out.base.theta[1] == pytest.approx(P1 / (WIDTH + P1 * np.log(1 / 3)), rel=0.03)


def test_a_late_shutter():
    _, trials, scatters = judged(4, late=4e-6)
    own = trials["shutter_offset"]
    assert own.z > 5 and abs(own.value - 4e-6) < 4 * own.error < 1.5e-6
    others = [trial.alone for name, trial in trials.items() if name != "shutter_offset"]
    assert own.alone < min(others) - 25
    assert all(found.z < 4 for found in scatters.values())


def test_a_scatter_of_power():
    out, trials, scatters = judged(5, power=0.03)
    own = trials["power_fluctuation"]
    assert own.z > 5 and abs(own.value - 0.03) < 3 * own.error
    assert own.value == scatters["power_fluctuation"].value
    # It is nuisance to all others, and alone with them nothing fits.
    assert all(abs(trial.z) < 4 for name, trial in trials.items() if name != "power_fluctuation")
    without = again(out.base, tuple(one for one in out.base.found.components if one.of == "width"))
    assert scatters["pointing_jitter"].z < 4 and own.alone < without.deviance - 1000


def test_a_scatter_of_the_centre():
    _, trials, scatters = judged(6, jitter=0.2)
    own = scatters["pointing_jitter"]
    assert own.z > 5 and abs(own.value - 0.2) < 3 * own.error
    assert all(abs(trial.z) < 4 for trial in trials.values())


def test_cells():
    """Eight azimuths by three radii; each radius holds a third of a Gaussian's light, within errors of 0.5 %."""
    u, v = np.random.default_rng(1).standard_normal((2, 100_000))
    cell = cells_of(u, v, RADII)
    np.testing.assert_allclose(np.bincount(cell, minlength=CELLS), len(u) / CELLS, rtol=0.08)
    np.testing.assert_allclose(np.bincount(cell // AZIMUTHS) / len(u), 1 / 3, atol=0.005)


@pytest.mark.parametrize(
    "present",
    [(), (("ghost_reflection", "", (0.1, 6.0, -4.0)), ("interference_fringes", "spot", (0.1, 9.0, 30.0, 0.0)))],
)
def test_cells_together_make_the_step_of_the_fit(present):
    """The influence of all cells is the step that the scores of all pixels ask for, also of a spot with a ghost under
    stripes."""
    frames, _, own, _ = fitted(1, late=0.0, power=0.0, jitter=0.0)
    present = tuple(Present(vocabulary()[name], form, values) for name, form, values in present)
    own = fit(frames, own.model._replace(present=present), own.penalty, steps=0)
    influence = influence_of(frames, own)
    sums = sums_of(frames, own.model, curved=False)
    basis = contrasts(own.model)
    _, step = own.schur.solve(sums.shape, basis.T @ sums.others)
    np.testing.assert_allclose(influence.sum(1), basis @ step, atol=1e-9)


def test_cells_differ_by_noise_alone_where_the_model_is_right():
    """K/(K − 4) Σ (d − d̄)² over the known variance is 1 on average over 96 numbers; each has an error of 0.3, so their
    mean one of 0.03, and the shape's own share of the noise is some hundredths."""
    _, _, own, influence = fitted(1, late=0.0, power=0.0, jitter=0.0)
    numbers = numbers_of(own, influence)
    ratio = CELLS**2 / (CELLS - 4) * numbers.influence.var(axis=1) / np.diag(numbers.covariance)
    assert np.mean(ratio) == pytest.approx(1, abs=0.12)
    assert 0.2 < ratio.min() and ratio.max() < 3


def test_numbers_are_known_as_well_as_said():
    """ln peak, ln σ_g and centre of 72 frames against the truth, but for what all frames share: the mean of z² is 1
    within 0.12 or so (free numbers of 69 frames each, four standard errors of 0.17)."""
    square = []
    for seed in (1, 2, 3):
        own, truth = fitted(seed, late=0.0, power=0.0, jitter=0.0)[2], drawn(seed)[2]
        numbers = numbers_of(own)
        off = numbers.values - truth
        off = off - off.mean(1, keepdims=True)
        errors = np.sqrt(np.diag(numbers.covariance)).reshape(-1, 4).T
        square.append(((off / errors) ** 2).mean(1))
    np.testing.assert_allclose(np.mean(square, 0), 1, atol=4 * 0.17)


def test_noise_that_rows_share_adds_to_what_is_known():
    """A covariance of ln peaks beyond the weights adds as it is, but for what all frames share; of centres in σ."""
    own = fitted(1, late=0.0, power=0.0, jitter=0.0)[2]
    frames = len(own.model.numbers.x)
    more = np.kron(np.eye(frames), np.diag([4e-6, 0.0, 9e-6, 0.0]))
    added = (numbers_of(own, more=more).covariance - numbers_of(own).covariance).reshape(frames, 4, frames, 4)
    apart, width = np.eye(frames) - 1 / frames, np.exp(own.model.numbers.log_width)
    np.testing.assert_allclose(added[:, 0, :, 0], 4e-6 * apart, atol=1e-12)
    np.testing.assert_allclose(added[:, 2, :, 2], 9e-6 * apart * np.outer(width, width), atol=1e-10)
    np.testing.assert_allclose(added[:, 0, :, 2], 0, atol=1e-12)
