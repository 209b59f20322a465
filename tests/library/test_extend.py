"""The loop's own decisions: what is worth an alarm, how large a rest is, which form of an effect is kept."""

from types import SimpleNamespace

import numpy as np
import pytest

from spotcheck.discrepancy.detect import Detection
from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.extend import (
    CLEAR,
    Size,
    Tolerance,
    about,
    best_form,
    closer_account,
    consistent,
    much_left,
    resolved,
    size_of,
)
from spotcheck.discrepancy.lasting import lasting
from spotcheck.discrepancy.look import look_at
from spotcheck.discrepancy.noise import hot_field
from spotcheck.discrepancy.shots import design_of
from tests.library.small_verdict import frames, ghost, looked, plain, present

SMALL, LARGE = Size(0.001, 0.01, 0.01), Size(0.003, 0.01, 0.01)


def seen(p, **by_statistic):
    """A detection; `_` in a name stands for `: `."""
    return Detection(p, 400, 3.0, {"mean: all": 9.0, "variance: all": 9.0} | by_statistic)


@pytest.mark.parametrize(
    "detection, size, expected",
    [
        (seen(0.5, line=0.1), LARGE, True),
        (seen(0.0025, line=0.1), SMALL, True),
        (seen(0.0025, line=0.1), LARGE, False),
        (seen(0.0025, line=0.1), SMALL._replace(of_noise=0.03), False),
        (seen(0.0025, line=0.1), SMALL._replace(excess_variance=-0.05), False),
        (seen(0.0025, line=CLEAR + 0.1), SMALL, False),
        (seen(0.01, line=CLEAR + 0.1), SMALL, True),
    ],
)
def test_what_is_worth_an_alarm(detection, size, expected):
    """Chance, or too small to matter in mean, noise and variance; scatter that stands out clearly always matters."""
    assert consistent(detection, size, Tolerance()) is expected


def test_the_size_of_nothing_and_of_something():
    """Frames of the base have no size beyond noise; a ghost of 6 % has the rms that its picture has, within the part
    that p1, p2, peak and centres take up."""
    look, own = looked(plain)
    assert size_of(look, own, 0.0).of_peak < 0.002
    look, own = looked(ghost)
    light = look.light[-1]
    y, x = np.mgrid[: light.shape[0], : light.shape[1]] * float(look.measured.side) + (look.measured.side - 1) / 2
    middle = 29.5
    sigma = np.sqrt((light * (x - middle) ** 2).sum() / light.sum())
    copy = 0.06 * np.exp(-((x - middle - 12) ** 2 + (y - middle + 5) ** 2) / (2 * sigma**2))
    rms = np.sqrt(np.mean(copy**2))
    assert 0.1 * rms < size_of(look, own, 0.0).of_peak < rms


@pytest.mark.parametrize(
    "excess, left, much",
    [(30_000, 1_400, False), (30_000, 1_600, True), (10_000, 450, False), (3_000, 700, False), (3_000, 750, True)],
)
def test_a_tolerance_forgives_a_small_part_of_what_was_found(excess, left, much):
    """At most a twentieth; of 10,800 blocks χ² scatters by 147, so 735 is five standard errors from nothing."""
    look, own = looked(plain)
    blocks = np.ones(10_800, bool)
    look = look._replace(problem=SimpleNamespace(used=blocks))

    def leaving(chi2):
        return own._replace(refit=own.refit._replace(chi2=blocks.sum() + chi2))

    assert much_left(leaving(left), look, leaving(excess), look) == much


@pytest.mark.parametrize("depth, period, expected", [(0.3, 6.0, True), (0.3, 2.0, False), (1.1, 6.0, False)])
def test_stripes_that_pixels_do_not_resolve_are_none(depth, period, expected):
    """A period of two pixels is any other's alias, and light is never below 0."""
    stripes = present("interference_fringes", depth, period, 30.0, 0.0, form="spot")
    own = SimpleNamespace(refit=SimpleNamespace(model=SimpleNamespace(present=(present("smear", 0.1), stripes))))
    assert resolved(own) is expected
    own.refit.model.present = (present("smear", 0.1),)
    assert resolved(own)


def test_the_form_that_the_data_want_is_kept():
    """Halos of one width and different profiles: from the wrong form the right one is found, and kept from there."""

    def halo(dx, dy, angle, exposure, sigma, spot):
        wide = np.exp(-(dx**2 + dy**2) / (2 * 18.0**2))
        return spot + 0.3 * spot.sum() * wide / wide.sum()

    shots, base, setting = frames(halo)
    look = look_at(shots, design_of(shots), base, setting)
    near_to = lambda own: about(shots, look, own)  # noqa: E731
    wrong = account(look, [present("scatter_halo", 0.2, 15.0, 2.0, form="exponential")])
    found, _ = best_form(look, wrong, near_to)
    assert found.key == (("scatter_halo", "gaussian"),)
    assert best_form(look, found, near_to)[0].key == found.key


def test_a_rival_is_compared_in_the_form_that_it_has_at_the_closer_look():
    """A pedestal of the electronics about which a gradient was drawn: as light it has shot noise that is not there."""
    shots, base, setting = frames(after=lambda image, rng: image + 9.0, repeats=6)
    look = look_at(shots, design_of(shots), base, setting)
    near = about(shots, look, account(look, [present("background_gradient", 0.0, 9.0, 0.0, form="electronic")]))
    wrong = closer_account(near, account(look, [present("dark_offset", 9.0, form="light")]))
    found, seen_at = best_form(near, wrong, lambda _: near)
    assert found.key == (("dark_offset", "electronic"),) and found.score < wrong.score - 100
    assert seen_at is near


def test_a_closer_look_remembers_what_it_takes_off():
    """Each frame's own brightness is off at the closer look: how much they scatter is what was seen before."""
    rng = np.random.default_rng(5)
    shots, base, setting = frames(lambda *a: a[-1] * (1 + rng.normal(0, 0.02)), repeats=6)
    look = look_at(shots, design_of(shots), base, setting)
    own = account(look, [present("power_fluctuation", 0.0)])
    near = about(shots, look, own)
    exact = closer_account(near, own)
    assert exact.component["gain"] == own.component["gain"]
    assert exact.component_error["gain"] == own.component_error["gain"]
    # 24 frames tell a scatter to 15 %: four standard deviations.
    assert np.sqrt(exact.component["gain"]) == pytest.approx(0.02, rel=0.6)


SPIKE = (14, 40)


def hot_once(spike, frame):
    """Adds readings to one pixel: in every frame, or in the one of that number."""
    count = iter(range(1000))

    def after(image, rng):
        image[SPIKE] += spike if frame is None or next(count) == frame else 0.0
        return image

    return after


@pytest.mark.parametrize(("spike", "frame", "expected"), [(6.0, None, True), (120.0, 5, False)])
def test_a_hot_pixel_is_hot_in_every_frame_and_a_ray_hits_once(spike, frame, expected):
    """Alike in the sum of all 12 frames, some ten standard deviations; what each frame has tells them apart."""
    shots, base, setting = frames(after=hot_once(spike, frame))
    look = look_at(shots, design_of(shots), base, setting)
    assert np.argwhere(hot_field(look.measured, 0.0)).tolist() == [list(SPIKE)]
    assert lasting(shots, look, 0.0) is expected


def test_too_few_frames_tell_no_ray_from_a_hot_pixel():
    """Two frames: what one of them has may be either, so that nothing is refused."""
    shots, base, setting = frames(after=hot_once(60.0, 0), angles=(0.0,), exposures=(4e-4,), repeats=2)
    look = look_at(shots, design_of(shots), base, setting)
    assert hot_field(look.measured, 0.0).any()
    assert lasting(shots, look, 0.0)
