"""The data sheet's errors in a fit: what frames say of gain, read noise and black level beside shape and numbers."""

import numpy as np
import pytest

from spotcheck.discrepancy.nuisance.fit import Fitted, fit
from spotcheck.discrepancy.nuisance.sheet import against_sheet, free_of_sheet
from spotcheck.discrepancy.observe.pixels import Frame, Model, Numbers
from spotcheck.model import light_shape
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import View
from spotcheck.model.sensor import SensorModel

TRUTH = SensorModel(0.11, 6.0, black_level_dn=12.0, full_scale_dn=1023)
SIDE, COUNT, WIDTH, PEAK = 120, 4, 9.0, 600.0
ERRORS = np.array([0.03, 0.05, 0.3])


def drawn(seed: int, off=(0.0, 0.0, 0.0), errors=(1.0, 1.0, 1.0), faint=1.0) -> Fitted:
    """Frames of Gaussian light, fitted with a sheet that is off by so many of its errors: 3 %, 5 % and 0.3 DN."""
    rng = np.random.default_rng(seed)
    one, own = np.zeros((1, 1, 1)), np.arange(SIDE, dtype=float)
    view = View(own[None, None], own[None, :, None], one, one, one + 1, one, one, one, one, 1, 1, 60, 60, SIDE, 1)
    peaks = PEAK * faint * np.array([0.3, 0.5, 0.8, 1.0])
    numbers = Numbers(np.log(peaks), np.full(COUNT, np.log(WIDTH)), *(60 + rng.uniform(-2, 2, (2, COUNT))))
    frames = []
    for k in range(COUNT):
        distance = (own - numbers.x[k]) ** 2 + (own[:, None] - numbers.y[k]) ** 2
        electrons = rng.poisson(peaks[k] / 0.11 * np.exp(-distance / (2 * WIDTH**2)))
        signal = 12 + 0.11 * (electrons + 6 * rng.standard_normal(electrons.shape))
        frames.append(Frame(np.clip(np.rint(signal), 0, 1023), view))
    step = ERRORS * (0.11, 6.0, 1.0)
    numbers_of_sheet = np.array([0.11, 6.0, 12.0]) + step * off
    sheet = TRUTH._replace(**dict(zip(("gain_dn_per_e", "read_noise_e", "black_level_dn"), numbers_of_sheet)))
    model = Model(Baseline(0.0, "free", False, 1.0, light_shape.empty(0.5, 5.1)), sheet, (), numbers)
    return fit(frames, fit(frames, model, 1e3).model, 1e3, free_of_sheet(sheet, step * errors))


def test_frames_correct_a_sheet_that_is_off():
    """Twelve sets with sheets drawn within their errors: 36 pulls of what is fitted, of rms 1 within 4 errors (6e-5)
    but for the gain, which the shape's 400 coefficients take up to 1 error of noise from."""
    pulls = []
    for seed in range(12):
        off = np.random.default_rng(100 + seed).standard_normal(3)
        found = against_sheet(drawn(seed, off))
        pulls.append([(own.value - truth) / own.stderr for own, truth in zip(found, (0.11, 6.0, 12.0), strict=True)])
        for own, by in zip(found, off, strict=True):
            # Frames know the three many times better than the sheet.
            assert own.stderr < 0.4 * own.stated_stderr
            assert abs(own.stated_errors + by) < 4 * own.stderr / own.stated_stderr + 0.02
    pulls = np.array(pulls)
    assert (pulls**2).sum() < 36 + 4 * np.sqrt(2 * 36) + 12
    assert abs(pulls[:, 1:].mean(axis=0)).max() < 4 / np.sqrt(12)


@pytest.mark.parametrize("which", range(3))
def test_a_contradiction_is_that_of_its_number(which):
    """One number off by 5 of its errors: said to be off by as many, within 1; the others within 4 of theirs."""
    off = np.where(np.arange(3) == which, 5.0, 0.0)
    found = against_sheet(drawn(3, off, errors=(0.5, 0.5, 0.5)))
    for k, own in enumerate(found):
        assert abs(own.stated_errors + (10.0 if k == which else 0.0)) < (1.0 if k == which else 4.0), own
    assert abs(found[which].z) > 5


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
