"""The data sheet's errors in a fit: what frames say of gain, read noise and black level beside shape and numbers."""

import numpy as np
import pytest
from scipy import linalg

from spotcheck.old_engine.model import light_shape
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import View
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.nuisance import sheet, taken
from spotcheck.old_engine.nuisance.fit import Fitted, fit
from spotcheck.old_engine.nuisance.sheet import against_sheet, fit_sheet
from spotcheck.old_engine.observe.pixels import Expectation, Frame, Lights, Model, Numbers, Sheet
from tests.library import splines

TRUTH = SensorModel(0.11, 6.0, black_level_dn=12.0, full_scale_dn=1023)
SIDE, COUNT, WIDTH, PEAK = 120, 4, 9.0, 600.0
ERRORS = np.array([0.03, 0.05, 0.3])


def case(seed: int, off=(0.0, 0.0, 0.0), faint=1.0, count=COUNT) -> tuple[list[Frame], Model, np.ndarray]:
    """Frames of Gaussian light, a model with a sheet that is off by so many of its errors (3 %, 5 % and 0.3 DN), and
    these errors."""
    rng = np.random.default_rng(seed)
    one, own = np.zeros((1, 1, 1)), np.arange(SIDE, dtype=float)
    view = View(own[None, None], own[None, :, None], one, one, one + 1, one, one, one, one, 1, 1, 60, 60, SIDE, 1)
    peaks = PEAK * faint * np.array([0.3, 0.5, 0.8, 1.0])[-count:]
    numbers = Numbers(np.log(peaks), np.full(count, np.log(WIDTH)), *(60 + rng.uniform(-2, 2, (2, count))))
    frames = []
    for k in range(count):
        distance = (own - numbers.x[k]) ** 2 + (own[:, None] - numbers.y[k]) ** 2
        electrons = rng.poisson(peaks[k] / 0.11 * np.exp(-distance / (2 * WIDTH**2)))
        signal = 12 + 0.11 * (electrons + 6 * rng.standard_normal(electrons.shape))
        frames.append(Frame(np.clip(np.rint(signal), 0, 1023), view))
    errors = ERRORS * (0.11, 6.0, 1.0)
    gain, noise, black = np.array([0.11, 6.0, 12.0]) + errors * off
    sensor = TRUTH._replace(gain_dn_per_e=gain, read_noise_e=noise, black_level_dn=black)
    lights = Lights.common(light_shape.empty(0.5, 5.1), len(frames))
    return frames, Model(Baseline(0.0, "free", False, 1.0), sensor, (), numbers, lights=lights), errors


def drawn(seed: int, off=(0.0, 0.0, 0.0), errors=(1.0, 1.0, 1.0), faint=1.0) -> Fitted:
    """A case, fitted with so many times the sheet's errors."""
    frames, model, stated = case(seed, off, faint)
    model = model._replace(sheet=Sheet(model.sensor, tuple(stated * errors)))
    return fit_sheet(frames, fit(frames, model, 1e3))


def test_frames_correct_a_sheet_that_is_off():
    """Twelve sets with sheets drawn within their errors: pulls of each number with a mean within 3.5 errors of 0 and a
    rms of 1 within 4 (false alarms 5e-4 and 6e-5)."""
    pulls = []
    for seed in range(12):
        off = np.random.default_rng(100 + seed).standard_normal(3)
        found = against_sheet(drawn(seed, off))
        pulls.append([(own.value - truth) / own.stderr for own, truth in zip(found, (0.11, 6.0, 12.0), strict=True)])
        for own, by in zip(found, off, strict=True):
            # Frames know the three better than the sheet.
            part = own.stderr / own.stated_stderr
            assert part < 0.6 and abs(own.stated_errors + by * (1 - part**2)) < 4 * part
    assert abs(np.mean(pulls, axis=0)).max() < 3.5 / np.sqrt(12)
    assert abs(np.mean(np.square(pulls), axis=0) - 1).max() < 4 * np.sqrt(2 / 12)


@pytest.mark.parametrize("which", range(3))
def test_a_contradiction_is_that_of_its_number(which):
    """One number off by 5 of its errors: z within 4 of what the errors let expect, and the others below 4 (6e-5)."""
    found = against_sheet(drawn(3, np.where(np.arange(3) == which, 5.0, 0.0)))
    for k, own in enumerate(found):
        expected = -5.0 * np.sqrt(1 - (own.stderr / own.stated_stderr) ** 2) if k == which else 0.0
        # A sheet that holds the gain too high leaves less noise to read noise, in part of the errors.
        assert abs(own.z - expected) < (1.5 if k == which else 3.0), own


def test_what_the_shape_takes_up(monkeypatch):
    """½ tr(H ∂ ln V/∂θ) of a dense matrix, within 5 %, some ten errors of 60 draws of random signs: V = K light
    + K² noise² + 1/12."""
    monkeypatch.setattr(taken, "DRAWS", 60)
    frames, model, error = case(6, count=1)
    fitted = fit(frames, model._replace(sheet=Sheet(model.sensor, tuple(error))), 1.0, steps=1)
    found = sheet.tilt_of(frames, fitted)
    seen = Expectation(frames, fitted.model).of(frames[0], 0)
    learned = fitted.model.lights
    u, v = (own.ravel() for own in np.broadcast_arrays(seen.u, seen.v))
    matrix = splines.matrix(u, v, learned.step, learned.side)
    matrix *= np.exp(fitted.model.numbers.log_peak[0]) * seen.slope.ravel()[:, None]
    variance = seen.variance.ravel()
    gram = np.array([linalg.cho_solve_banded((fitted.schur.factor, True), row) for row in matrix])
    leverage = np.einsum("pc,pc->p", matrix, gram) / variance
    gain, read = fitted.model.sensor.gain_dn_per_e, fitted.model.sensor.read_noise_e
    light = np.maximum(seen.mean.ravel() - fitted.model.sensor.black_level_dn, 0)
    by_gain, by_noise = light + 2 * gain * read**2, 2 * gain**2 * read
    for k, slope in enumerate((by_gain, by_noise)):
        want = float(leverage @ (slope / variance)) / 2
        assert abs(found[k] - want) < 0.05 * want
    assert abs(found[2]) < 0.05


def test_an_error_of_0_is_fixed():
    """A number without error is not free, and the fit leaves it as it is."""
    own = drawn(4, (0.5, 0.0, 0.0), errors=(0.0, 1.0, 0.0))
    assert [one.name for one in against_sheet(own)] == ["read_noise_e"]
    assert own.model.sensor.gain_dn_per_e == pytest.approx(0.11 * 1.015, rel=1e-12)
    assert own.model.sensor.black_level_dn == 12.0


def test_a_sheet_that_knows_better_than_frames_stands():
    """Hardly any light: the gain stays where the sheet has it, and z says that frames did not move it beyond chance
    (4 errors: 6e-5)."""
    own = against_sheet(drawn(5, (1.0, 0.0, 0.0), errors=(0.1, 1.0, 1.0), faint=0.05))[0]
    assert own.stderr > 0.9 * own.stated_stderr and abs(own.z) < 12
