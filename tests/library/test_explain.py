"""What one joint fit makes of a look, where means of conditions are not all that it hears."""

import numpy as np
import pytest

from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.refit import Told, refit
from tests.library.small_verdict import EXPOSURES, looked, present

# One angle: the means of two exposures say little of a drift.
DESIGN = {"angles": (0.0,), "repeats": 6}
FRAMES = len(EXPOSURES) * 6


def drifting(total):
    """Light that runs with the order in which frames are asked for."""
    orders = iter(np.linspace(0, 1, FRAMES))
    return lambda dx, dy, angle, exposure, sigma, spot: spot * (1 + total * next(orders))


def test_a_drift_is_told_by_the_frames_of_a_condition():
    """Over 16 draws the errors of the total have a mean within 4 standard errors of 0 (false alarm 6e-5) and the
    stated scatter within 50 % (known to 18 %); of condition means alone they would be five times as large or more."""
    found, alone = [], []
    for seed in range(16):
        look, _ = looked(drifting(0.05), seed=seed, **DESIGN)
        own = account(look, [present("laser_drift", 0.02)]).refit
        found.append((own.model.present[0].values[0], np.sqrt(own.covariance[0, 0])))
        effects = [(p.effect, p.form) for p in own.model.present]
        alone.append(np.sqrt(refit(look.problem, effects, own.model).covariance[0, 0]))
    value, error = np.array(found).T
    off = (value - 0.05) / error
    assert abs(off.mean()) < 4 / np.sqrt(16)
    assert off.std(ddof=1) == pytest.approx(1.0, abs=0.5)
    assert np.median(alone) > 5 * np.median(error)


def test_what_is_told_pulls_and_is_no_part_of_the_score():
    """A value told with the fit's own information moves it half of the way; the score is that of the cells, so it
    rises by that quarter of a χ² that the parabola says."""
    look, _ = looked(drifting(0.05), **DESIGN)
    start = look.problem.start._replace(present=(present("laser_drift", 0.02),))
    effects = [(p.effect, p.form) for p in start.present]
    free = refit(look.problem, effects, start)
    value, variance = free.model.present[0].values[0], free.covariance[0, 0]
    distance = 4 * np.sqrt(variance)
    pulled = refit(look.problem, effects, free.model, told=[Told(0, 0, value + distance, 1 / variance)])
    # The fit stops within 0.02 of the least score: a part of √0.02/4 of the distance.
    assert pulled.model.present[0].values[0] - value == pytest.approx(distance / 2, rel=0.08)
    assert pulled.score - free.score == pytest.approx(distance**2 / 4 / variance, rel=0.1)
    assert pulled.covariance[0, 0] == pytest.approx(variance / 2, rel=0.02)
