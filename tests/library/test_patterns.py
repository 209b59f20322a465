"""What pixels and rows share, on frames drawn by numpy alone: sizes within their errors, nothing where nothing is."""

from functools import cache

import numpy as np
import pytest
from scipy import stats

from spotcheck.old_engine.evidence import grain, patterns
from spotcheck.old_engine.evidence.patterns import Variance, gathered, patterns_of, variance_of
from spotcheck.old_engine.evidence.pixels import Ready
from spotcheck.old_engine.evidence.windows import LAGS, products
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.nuisance.fit import fit
from tests.library.small_light import CONTEXT, PENALTY, beam, designed, drawn, gaussian, started

SEEDS = range(6)
# Six sites of three exposures; spots up to 3 px off, so that pixels of the sensor do not stay on one place of the
# shape.
SITES, SPREAD = 6, 3.0
RATE = 1e-3


@cache
def told(seed: int, *, learned: bool = True, sites: int = SITES, exposures: int = 3, **kinds):
    """Sums of sites and places of rows beside a fit without any pattern."""
    kinds.setdefault("shape", beam if learned else gaussian)
    images, known = drawn(seed, sites=sites, spread=SPREAD, **kinds)
    own = np.arange(len(known)) % 3 >= 3 - exposures
    frames, model = started(images[own], known[own])
    if not learned:
        model = model._replace(lights=None)
    design = designed(known).take(own)
    return gathered(frames, design, Ready(frames, fit(frames, model, PENALTY), []))


def variances(seed: int, **kinds) -> dict[str, Variance]:
    """Of the sensor's field, of those of the sites beside it, and of rows."""
    sites, rows = told(seed, **kinds)
    sensor = patterns.of_sensor(sites)
    field = variance_of(patterns.shared(sites), sensor.value, grain.neighbours(sites[0].grain))
    return {"sensor": sensor, "site": field, "row": variance_of(rows)}


def found(seed: int, **kinds):
    return {own.own.effect.name: own for own in patterns_of(*told(seed, **kinds), vocabulary().values(), CONTEXT)}


def test_variance_by_drawn_sums():
    """S ~ N(0, N + θ N²) at 4,000 places of unlike weight, 300 times: bias below 4 of its own errors (6e-5), pulls of
    variance 1 within 4 of its (6e-5), also where a part is known, and where the fit leaves a part."""
    rng = np.random.default_rng(1)
    n = np.exp(rng.uniform(0, 6, 4000))
    part = rng.uniform(0.5, 1.0, 4000)
    cell = np.arange(4000) % 16
    for known in (0.0, 2e-3):
        values = []
        for _ in range(300):
            s = rng.standard_normal(4000) * np.sqrt(n + part * (4e-3 + known) * n**2)
            places = patterns.Places(s**2 - n, n**2, part, 2 * n**2, cell, np.arange(4000) // 20)
            own = variance_of(places, known)
            values.append((own.value, own.error))
        value, error = np.transpose(values)
        assert abs(value.mean() - 4e-3) < 4 * value.std() / np.sqrt(300)
        assert abs(np.var((value - 4e-3) / error) - 1) < 0.15 + 4 * np.sqrt(2 / 300)


def test_products_of_pixels():
    """By loops over pixels."""
    image = np.random.default_rng(2).standard_normal((18, 16))
    want = [
        sum(
            image[r, c] * image[r + down, c + right] for r in range(18 - down) for c in range(16) if 0 <= c + right < 16
        )
        for down, right in LAGS
    ]
    np.testing.assert_allclose(products(image), want, atol=1e-12)


@pytest.mark.parametrize("size", [0.0, 0.8, 3.0])
def test_drawn_fields_correlate_as_they_should(size):
    """Mean products of 200 fields of 64 × 64: exp(−d²/2g²) within 5 of their errors at each of 17 distances (1e-5)."""
    rng = np.random.default_rng(3)
    parts = []
    for _ in range(200):
        field = grain.drawn_field(rng, (64, 64), size)
        parts.append([np.mean(field * np.roll(field, (-down, -right), (0, 1))) for down, right in LAGS])
    square = np.array([down**2 + right**2 for down, right in LAGS])
    want = np.exp(-square / (2 * max(size, 0.1) ** 2))
    off = np.mean(parts, 0) - want
    assert (np.abs(off) < 5 * np.std(parts, 0) / np.sqrt(200) + 1e-12).all()
    assert grain.neighbours(size) == pytest.approx(max(np.pi * size**2, 1.0), rel=0.03 if size != 0.8 else 0.1)


@pytest.mark.parametrize("step", [1, 3])
def test_correlation_from_its_own_law(step):
    """The grain is one in pixels, however many lie from one that is looked at to the next."""
    square = step**2 * np.array([down**2 + right**2 for down, right in LAGS])
    for size in (0.5 * step, 1.5 * step, 6.0 * step):
        own = grain.correlation_of(0.01 * 300 * np.exp(-square / (2 * size**2)), np.full(len(LAGS), 300.0), step)
        assert own.variance == pytest.approx(0.01, rel=1e-3) and own.grain == pytest.approx(size, rel=1e-3)


@pytest.mark.parametrize("learned", [False, True])
@pytest.mark.parametrize(
    ("kinds", "kind", "size", "name"),
    [
        ({"speckle": (0.1, 1.5)}, "site", 0.1, "speckle"),
        ({"prnu": 0.01}, "sensor", 0.01, "fixed_pattern"),
        ({"rows": 0.5}, "row", 0.5, "row_noise"),
        ({}, "", 0.0, ""),
    ],
)
def test_sizes_and_no_leaks(kinds, kind, size, name, learned):
    """Six sets each: the mean pull of what is there within 3.3/√6 of 0 (1e-3), or 2 % of its size; of what is not there
    the variance beyond 3.7 errors in none (six times 1e-4, each of two or three kinds), so that no other name comes."""
    pulls = []
    for seed in SEEDS:
        every = variances(seed, learned=learned, **kinds)
        for own, told_of in every.items():
            if own == kind:
                pulls.append((told_of.value - size**2) / told_of.error)
                slack = 0.04 * size**2 / told_of.error
            else:
                assert told_of.value < 3.7 * told_of.error and not told_of.sure, (seed, own, told_of)
        assert list(found(seed, learned=learned, **kinds)) == ([name] if name else [])
    if pulls:
        assert abs(np.mean(pulls)) < stats.norm.isf(RATE / 2) / np.sqrt(len(pulls)) + slack


@pytest.mark.parametrize("learned", [False, True])
def test_a_field_of_sites_that_have_one_frame(learned):
    """Twelve sites of one exposure, four sets: contrast 0.1 and grain 1.5 px within 3.3 errors of the mean of four
    (1e-3) and 2 %, and nothing without a field."""
    values = []
    for seed in range(4):
        own = found(seed, learned=learned, sites=12, exposures=1, speckle=(0.1, 1.5))
        assert list(own) == ["speckle"]
        values.append((*own["speckle"].own.values, own["speckle"].error))
        assert not found(seed, learned=learned, sites=12, exposures=1)
    contrast, size, error = np.transpose(values)
    assert abs(contrast.mean() - 0.1) < 3.3 * error.mean() / 2 + 0.002
    assert abs(size.mean() - 1.5) < 3.3 * size.std(ddof=1) / 2 + 0.03
