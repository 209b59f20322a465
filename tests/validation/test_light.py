"""The sets on real light: nothing is asked of the library, and what is drawn is what the closed forms say."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.validation.generators.light import beams
from tests.validation.generators.light.case import draw_case
from tests.validation.generators.light.moments import moments
from tests.validation.generators.light.outside import MECHANISMS
from tests.validation.generators.second.case import LASER_WIDTH, Case, Effect
from tests.validation.generators.second.effects import VOCABULARY
from tests.validation.generators.second.optics import coordinates, light, spot, spread
from tests.validation.generators.second.sensor import read_out
from tests.validation.records import ROOT
from tests.validation.small_light import small_case, strong

MODELS = ("spotcheck.model", "spotcheck.discrepancy", "spotcheck.fitting", "spotcheck.characterization", "rig")


# Independence


def test_nothing_of_the_library_is_asked():
    """Followed through every file of the tests that the makers import."""
    here = ROOT / "tests/validation/generators"
    todo = [path for name in ("light", "second") for path in sorted((here / name).glob("*.py"))]
    seen: set[Path] = set()
    while todo:
        path = todo.pop()
        seen.add(path)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [own.name for own in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [str(node.module), *(f"{node.module}.{own.name}" for own in node.names)]
            for name in names:
                # The second generator's report counts by outcome, which knows no model.
                assert not any(name == own or name.startswith(f"{own}.") for own in MODELS), (path, name)
                file = (ROOT / name.replace(".", "/")).with_suffix(".py")
                if name.startswith("tests.") and file.exists() and file not in seen:
                    todo.append(file)
    assert len(seen) > 20


# Light


def test_beams_are_in_the_coordinates_of_their_gaussian():
    """Every kind of drawn light, and a real beam: off as much as is wanted, best fitted by the unit Gaussian, and 0
    beyond the crop."""
    rng = np.random.default_rng(1)
    found = [beams.drawn(kind, rng) for kind in beams.DRAWN]
    assert all(beams.OFF[0] * 0.99 < own.off < beams.OFF[1] * 1.01 for own in found)
    found += [beams.real(beams.real_names()[2])] if beams.there() else []
    axis = np.arange(-beams.CORE, beams.CORE + 0.01, 0.1)
    u, v = np.meshgrid(axis, axis)
    inside = np.hypot(u, v) <= beams.CORE
    u, v = u[inside], v[inside]
    gauss = np.exp(-(u**2 + v**2) / 2)
    for own in found:
        off = own(u, v) - gauss
        # Least squares: what is off is at right angles to every slope of the Gaussian.
        slopes = gauss * np.stack([np.ones_like(u), u, v, u**2 + v**2])
        assert np.abs(np.linalg.lstsq(slopes.T, off, rcond=None)[0]).max() < 2e-4, own.name
        assert own(np.array([beams.ENDS + 0.1]), np.array([0.0])) < 1e-12
        assert np.all(own(u, v) >= 0) and own.off > 0.005


class Round:
    """A Gaussian as if it were any shape."""

    name, top, off = "round", 1.0, 0.0

    def __call__(self, u, v):
        return np.exp(-(u**2 + v**2) / 2)


@pytest.mark.parametrize("name", ["super_gaussian", "fibre_anisotropy", "ghost_reflection", "motion_blur"])
def test_a_shape_of_its_own_takes_effects_as_the_gaussian_does(name):
    case = small_case(names=(name,))
    case.effects[name] = strong(case, name)
    assert light(replace(case, shape=Round()), 1) == pytest.approx(light(case, 1), rel=1e-9, abs=1e-9)


# Closed forms

DRAWS = 160


@pytest.mark.parametrize("name", [*VOCABULARY, *(own for own in MECHANISMS if own != "bad_frames")])
def test_readings_have_the_mean_and_variance_of_the_closed_form(name):
    """Frames drawn again and again. Over 1600 px the rms of z is 1 ± 0.018, the mean ratio of variances 1 ± 0.003: six
    and more standard errors are allowed, and 0.02 DN of rounding."""
    case = small_case(names=(name,), light_="drawn", read_noise=12.0, black=0 if name == "black_clipping" else 12)
    case.effects[name] = strong(case, name)
    i = 3
    expected = moments(case, i)
    drawn = np.stack([_coded(case, i, seed) for seed in range(DRAWS)])
    error = np.maximum(np.abs(drawn.mean(0) - expected.mean) - 0.02, 0) / np.sqrt(expected.variance / DRAWS)
    # Where hardly a draw passes a threshold, that is by the tail of a Poisson law, which is no normal one.
    assert np.sqrt(np.mean(error[expected.variance > 0.05] ** 2)) < 1.15
    if name not in ("black_clipping", "saturation"):
        assert np.mean(drawn.var(0, ddof=1) / expected.variance) == pytest.approx(1, abs=0.03)
    else:
        # Where noise is cut little is left of a variance; it is compared in sum.
        assert drawn.var(0, ddof=1).sum() == pytest.approx(expected.variance.sum(), rel=0.03)


def _coded(case: Case, i: int, seed: int) -> np.ndarray:
    return read_out(case, i, np.random.default_rng([seed, i]))


def _changes(case: Case, effect: Effect, i: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Change of the mean [DN], the light before [DN], and the change of variance over it."""
    base, own = moments(case, i), moments(case.only(effect), i)
    return own.mean - base.mean, light(case, i), own.variance / base.variance


def test_strangers_change_frames_as_they_say():
    case = small_case(names=("outside:",), light_="drawn", dark_current=0.0)
    middle = (case.size - 1) / 2
    y, x = np.mgrid[: case.size, : case.size] - middle

    own = strong(case, "vignetting", 0.05)
    change, before, _ = _changes(case, own)
    square = ((x - own.form["x_px"]) ** 2 + (y - own.form["y_px"]) ** 2) / 1e4
    assert change == pytest.approx(-0.05 * square * before, abs=1e-6)

    own = strong(case, "gain_of_halves", 0.04)
    change, before, _ = _changes(case, own)
    right = change > 1e-9
    assert change[right] == pytest.approx(0.04 * before[right], abs=1e-3) and not right[:, :8].any()

    rows = np.stack([_changes(case, strong(case, "flicker_rows", 2.0), i)[0][:, 0] for i in range(4)])
    assert rows.std(axis=1) == pytest.approx(2.0, rel=0.02) and np.abs(np.corrcoef(rows)[0, 1:]).max() < 0.8

    own = strong(case, "converter_steps", 3.0)
    change, before, _ = _changes(case, own)
    high = ((before + case.black) // own.form["every_codes"]) % 2 == 1
    assert set(np.unique(np.round(change, 6))) == {0.0, 3.0} and np.mean((change > 1) == high) > 0.95

    own = strong(case, "dust", 0.2)
    change, before, _ = _changes(case, own)
    assert (change / np.maximum(before, 1e-9)).min() == pytest.approx(-0.2, rel=0.1) and change.max() <= 1e-9

    own = strong(case, "image_lag", 0.1)
    assert _changes(case, own)[0] == pytest.approx(0.1 * spot(case, 2), abs=1e-6)

    change, before, ratio = _changes(case, strong(case, "excess_shot_noise", 0.5))
    noise = case.gain * before / (case.gain * before + (case.gain * case.read_noise) ** 2 + 1 / 12)
    assert np.all(change == 0) and ratio == pytest.approx(1 + 0.5 * noise, rel=2e-3)


def test_some_strangers_are_in_some_frames_only_or_grow():
    case = draw_case(5, "default", "gauss", ["outside:"])
    for name, few in (("bad_frames", 5), ("second_spot_sometimes", 0)):
        own = strong(case, name)
        changed = [not np.array_equal(light(case.only(own), i), light(case, i)) for i in range(len(case.frames))]
        assert sum(changed) == few if few else 5 < sum(changed) < 60
    own = strong(case, "trefoil_by_exposure", 0.1)
    turned = np.radians(float(str(own.form["direction_deg"])))
    for i, part in ((0, 0.1 / 9), (1, 0.1 / 3), (2, 0.1)):
        # Half way down the flank along a lobe the light lies where it would at a radius shorter by the part.
        dx, dy = coordinates(case, i)
        sigma = spread(case, case.frames[i].exposure) + LASER_WIDTH
        at = np.abs(np.angle(np.exp(3j * (np.arctan2(dy, dx) - turned)))) < 0.05
        rho2 = (dx**2 + dy**2)[at] * (1 - part) ** 2 / (2 * sigma**2)
        image, base = light(case.only(own), i)[at], light(case, i)
        # cos(0.05) is 0.9988.
        assert image / base.max() == pytest.approx(np.exp(-rho2), abs=0.004)
