"""Bounds of the sets on real light are those of brute force, and strengths reach what is wanted of them."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BSpline

from tests.validation.generators.light import bound
from tests.validation.generators.light.bound import Reference
from tests.validation.generators.light.case import draw_case
from tests.validation.generators.light.moments import moments
from tests.validation.generators.light.strength import measure_of, tune
from tests.validation.generators.second.case import LASER_WIDTH, Case
from tests.validation.generators.second.optics import coordinates, light, spread
from tests.validation.small_light import small_case, strong

# Bounds


def splines_of(reference: Reference) -> Iterator[list[np.ndarray]]:
    """Every coefficient's light in all frames, by scipy's splines."""
    own, count = reference.case, int(np.ceil(bound.REACH / bound.NODES))
    centres = np.arange(-count, count + 1) * bound.NODES
    splines = [BSpline.basis_element(c + bound.NODES * np.arange(-2, 3), extrapolate=False) for c in centres]
    for up in splines:
        for along in splines:
            images = []
            for frame in reference.frames:
                sigma = spread(own, own.frames[frame].exposure) + LASER_WIDTH
                dx, dy = coordinates(own, frame)
                part = np.nan_to_num(up(dy / sigma)) * np.nan_to_num(along(dx / sigma))
                images.append(light(own, frame).max() * part)
            yield images


def brute(reference: Reference, case: Case, unknown: np.ndarray | None = None) -> tuple[float, float]:
    """Signal-to-noise of the effects of a case with the shape known and free, by one dense least-squares problem. Its
    columns are differences of moments, its splines scipy's."""
    own = reference.case

    def column(change: list) -> np.ndarray:
        base = [moments(own, i) for i in reference.frames]
        return np.concatenate(
            [np.r_[((m.mean - b.mean) / np.sqrt(b.variance))[::2, ::2].ravel(),
                   ((m.variance - b.variance) / (np.sqrt(2) * b.variance))[::2, ::2].ravel()]
             for m, b in zip(change, base, strict=True)]
        )  # fmt: skip

    def of_light(images: list, h: float = 1e-3) -> np.ndarray:
        end = [moments(own, i, light(own, i) + h * d) for i, d in zip(reference.frames, images, strict=True)]
        return column(end) / h

    numbers = []
    for k, i in enumerate(reference.frames):
        t, h = own.frames[i].exposure, 1e-4
        sigma = spread(own, t) + LASER_WIDTH
        site = own.frames[i].site
        image = light(own, i)
        changed = [image * (1 + h)]
        # A width by p2, at the peak as it is.
        wider = replace(own, p2=own.p2 + h * sigma)
        wide = light(wider, i)
        changed.append(wide * image.max() / wide.max())
        for axis in (0, 1):
            moved = own.centres.copy()
            moved[site, axis] += h * sigma
            changed.append(light(replace(own, centres=moved), i))
        zero = np.zeros_like(image)
        numbers += [of_light([(new - image) / h if j == k else zero for j in range(len(reference.frames))])
                    for new in changed]  # fmt: skip
    shape = [of_light(images) if any(image.any() for image in images) else 0 * numbers[0]
             for images in splines_of(reference)]  # fmt: skip
    effect = []
    for i in reference.frames:
        before, after = moments(own, i), moments(case, i)
        # Twice the divergence of two normal laws of mean 0, with a sign.
        ratio = (after.variance / before.variance)[::2, ::2].ravel()
        effect += [((after.mean - before.mean) / np.sqrt(before.variance))[::2, ::2].ravel(),
                   np.sign(ratio - 1) * np.sqrt(ratio - np.log(ratio) - 1)]  # fmt: skip
    beside = np.stack(numbers, 1)
    if unknown is not None:
        beside = beside @ unknown
        prior = np.eye(beside.shape[1]) / np.sqrt(reference.scale)
    else:
        prior = np.zeros((0, beside.shape[1]))
    out = []
    for more in (np.zeros((len(numbers[0]), 0)), np.stack(shape, 1)):
        few = more.shape[1]
        weak = np.eye(few) / (bound.PRIOR * np.sqrt(reference.scale))
        rows = [[beside, more], [prior, np.zeros((len(prior), few))], [np.zeros((few, beside.shape[1])), weak]]
        a = np.vstack([np.hstack(row) for row in rows])
        b = np.r_[np.concatenate(effect), np.zeros(len(prior) + few)]
        left = b - a @ np.linalg.lstsq(a, b, rcond=1e-9)[0]
        out.append(float(np.sqrt(left @ left * reference.scale)))
    return out[0], out[1]


@pytest.mark.parametrize("name", ["smear", "saturation", "beam_ellipticity", "angle_reflectance"])
def test_bounds_are_those_of_brute_force(name, monkeypatch):
    """A wide net of nodes, few pixels."""
    monkeypatch.setattr(bound, "NODES", 0.7)
    monkeypatch.setattr(bound, "REACH", 2.8)
    monkeypatch.setitem(bound.SITES, "default", 2)
    case = small_case(size=44, light_="gauss", black=40)
    case.effects[name] = strong(case, name, 0.02 if name == "beam_ellipticity" else None)
    reference = Reference(case)
    unknown = reference.lawful() if name == "angle_reflectance" else None
    found = reference.snr(reference.change(case), unknown)
    assert len(reference.frames) == 4 and reference.scale == 4
    # Slopes of light by width and place are differences of neighbouring pixels: good to (1 px/σ)²/6.
    assert tuple(found) == pytest.approx(brute(reference, case, unknown), rel=0.02, abs=0.1)
    assert found.free < found.known


def test_behind_speckle_what_sites_share_is_left():
    """A field of no contrast changes nothing; behind a strong one, what exposures of one site tell of each other is
    left of a law in exposure, next to nothing of an ellipse in one exposure's place."""
    case = draw_case(4, "default", "gauss", [])
    case.effects["photon_budget"] = strong(case, "photon_budget", 0.03)
    reference = Reference(case)
    change = reference.change(case)
    for unknown in (None, reference.lawful()):
        plain = bound.behind_grain(reference, change, 0.0, 3.0, unknown)
        assert plain == pytest.approx(reference.snr(change, unknown).known, rel=1e-6, abs=1e-3)
    behind = bound.behind_grain(reference, change, 0.4, 3.0, reference.lawful())
    assert 0.2 * plain < behind < plain
    del case.effects["photon_budget"]
    case.effects["angle_reflectance"] = strong(case, "angle_reflectance", 0.03)
    change = reference.change(case)
    # Between sites each pixel tells of the light what its field leaves: |c|²/(1 + |c|²) of 1/C²A, where c is C √A times
    # light over noise of all exposures; and its noise tells as much as without a field. Four angles tell of d by the
    # mean of cos² over all sites, a half.
    area = np.pi * 3.0**2 / (4 * np.log(2))
    one = slice(0, 3)
    noise = np.sqrt(reference.variance[one])
    square = 0.4**2 * area * np.sum((np.stack(reference.light[one])[:, ::2, ::2] / noise) ** 2, axis=0)
    told = 4 * np.sum(square / (1 + square)) / (0.4**2 * area)
    told += 4 * np.sum((case.gain * np.stack(reference.light[one])[:, ::2, ::2] / noise**2) ** 2) / 2
    found = bound.behind_grain(reference, change, 0.4, 3.0, reference.lawful())
    assert found == pytest.approx(0.03 * np.sqrt(told * 32 / 2), rel=0.05)


def test_strengths_reach_what_is_wanted():
    case = replace(draw_case(12, "default", "gauss", []), budget="linear")
    reference = Reference(case)
    for name, wanted in (("nonlinearity", 50.0), ("motion_blur", 80.0), ("beam_ellipticity", 400.0)):
        effect = strong(case, name)
        own = tune(reference, case, effect, wanted)
        assert own.met and not own.floored and own.tied == (name == "beam_ellipticity")
        assert (own.known if own.tied else own.free) == pytest.approx(wanted, rel=0.06)
        assert measure_of(reference, case, effect)(effect.s) == own[1:3]
    # Seen however little there is: as much as a user would call something.
    own = tune(reference, case, strong(case, "dark_offset"), 5.0)
    assert own.floored and own.met and own.free > 50
    own = tune(reference, case, strong(case, "smear"), 1e6)
    assert not own.met and own.free < 1e6


def test_scatter_is_as_strong_as_its_draws_are():
    """The signal-to-noise of a frame's scatter is that of its variance: with frames' errors e it is rms²/e² √(n/2)."""
    case = draw_case(12, "default", "gauss", [])
    reference = Reference(case)
    error = reference.errors(0)[0]
    effect = strong(case, "power_fluctuation", 0.01)
    own = measure_of(reference, case, effect)(0.01)
    assert own.known == pytest.approx(np.sqrt(np.mean((0.01 / error) ** 4) * 96 / 2), rel=1e-9)
    # A frame's brightness from its light alone, the width free beside it: twice the variance of 1/electrons.
    electrons = light(case, 2).sum() / case.gain
    assert error[2] ** 2 == pytest.approx(2 / electrons, rel=0.35)
