"""Scores and the search: the law of scores where nothing is missing, and what is found where something is."""

import numpy as np
import pytest
from scipy import stats

from spotcheck.old_engine.evidence.pixels import by_cell, screen
from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.search.forward import State, grow, outcome_of
from tests.library.small_light import CONTEXT, designed, fitted

TRIED = {"dark_offset": (1.0,), "nonlinearity": (0.02,), "excess_read_noise": (6.3,), "smear": (0.005,)}


def effects(*names: str):
    return [vocabulary()[name] for name in names]


def test_scores_of_what_is_not_there_are_normal():
    """z of four effects, each on twelve sets without any: mean 0 and mean square 1 (false alarm 1e-4 each); cells
    add up to the whole. Of read noise the mean may be 1 lower: in the dark, a shape that noise lifts brings shot noise
    with it, and one that noise lowers takes none away."""
    z = []
    for seed in range(12):
        frames, fit, _ = fitted(100 + seed, sites=2)
        others = [
            fit.model.with_effect(Present(vocabulary()[name], vocabulary()[name].forms[0], values))
            for name, values in TRIED.items()
        ]
        scores = screen(frames, fit, others)
        z.append([score.z for score in scores])
        score, information, *_ = by_cell(frames, fit, [others[0]], [scores[0]])[0]
        assert score.sum() == pytest.approx(scores[0].score, abs=0.02 * np.sqrt(scores[0].information))
        assert information.sum() == pytest.approx(scores[0].information, rel=0.01)
    for name, own in zip(TRIED, np.transpose(z), strict=True):
        lower = 1.0 if name == "excess_read_noise" else 0.0
        own = own + min(max(-own.mean(), 0.0), lower)
        assert abs(own.mean()) < stats.norm.isf(5e-5) / np.sqrt(len(own))
        assert stats.chi2.ppf(5e-5, len(own)) < np.sum(own**2) < stats.chi2.isf(5e-5, len(own))


@pytest.mark.parametrize(
    ("kinds", "name", "value", "off"),
    [
        ({"pedestal": 2.0}, "dark_offset", 2.0, 0.02),
        ({"clip": 560.0}, "saturation", 560.0, 0.3),
        ({"read": 8.0}, "excess_read_noise", 8.0, 0.1),
        ({}, None, 0.0, 0.0),
    ],
)
def test_what_is_missing_is_found_on_light_that_is_no_gaussian(kinds, name, value, off):
    """Alone, its size right, holding everywhere; nothing where nothing is missing."""
    frames, fit, known = fitted(7, **kinds)
    known_effects = effects("dark_offset", "saturation", "excess_read_noise", "nonlinearity", "smear", "scatter_halo")
    context, design = CONTEXT._replace(peak_dn=kinds.get("clip", 679.0) / 0.97), designed(known)
    grown = grow(State(tuple(frames), fit), design, known_effects, context)
    outcome = outcome_of(grown, fit, design, known_effects, context)
    assert [one.own.effect.name for one in outcome.found] == ([name] if name else [])
    if name:
        (found,) = outcome.found
        assert abs(found.own.values[0] - value) < off and found.holding.holds
        assert abs(found.own.values[0] - value) < 4 * found.holding.error + 1e-3 * value
