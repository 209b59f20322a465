"""Gain from two frames of one site: speckle that both share drops out. Frames are drawn by numpy alone."""

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter
from scipy.ndimage import shift as moved

from spotcheck.characterization.frame_pairs import align_images, convert_to_curve, iterate_pairs, tally_differences
from spotcheck.characterization.noise_curve import fit_gain
from spotcheck.characterization.spot_estimates import estimate_from_spots

GAIN, NOISE, SIDE, TOP = 0.2, 8.0, 200, 12000.0
FLOOR = GAIN**2 * NOISE**2 + 1 / 12


def frame(electrons, rng, black=50.0, clip=np.inf):
    """One reading of expected electrons; a well that is full at `clip` [e-]."""
    seen = np.minimum(rng.poisson(electrons), clip) + NOISE * rng.standard_normal(electrons.shape)
    return np.clip(np.rint(black + GAIN * seen), 0, 4095)


def speckled(rng, contrast=0.5, grain=1.0, width=30.0):
    """Light of a spot [e-, peak about TOP] with grain of that contrast."""
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE / 2
    fields = gaussian_filter(rng.standard_normal((round(2 / contrast**2), SIDE, SIDE)), (0, grain, grain))
    field = (fields**2).sum(axis=0)
    return 0.4 * TOP * np.exp(-(x**2 + y**2) / (2 * width**2)) * field / field.mean()


def gain_of(pairs, black=50.0, full_scale=4095.0):
    """Gain of some pairs."""
    return fit_gain(convert_to_curve(sum(tally_differences(*two, black, full_scale) for two in pairs), black), black)


def drawn(seed, parts=(0.5, 1.0), count=4, **how):
    """Pairs of frames of some sites, one of half the other's light."""
    rng = np.random.default_rng(seed)
    sites = [speckled(rng) for _ in range(count)]
    return [tuple(frame(part * light, rng, **how) for part in parts) for light in sites]


def test_gain_and_floor_of_speckled_spots():
    """Over 24 draws: means within 4 standard errors (false alarm 1e-4) and 1.5 % of the truth, since r is known from
    noisy frames; scatter within 50 % of what is stated (a scatter of 24 is known to 15 %)."""
    found = [gain_of(drawn(seed)) for seed in range(24)]
    for name, truth in (("gain", GAIN), ("floor", FLOOR)):
        values = np.array([getattr(own, name) for own in found])
        stated = np.mean([getattr(own, f"{name}_stderr") for own in found])
        assert abs(values.mean() - truth) < 4 * values.std(ddof=1) / np.sqrt(24) + 0.015 * truth
        assert values.std(ddof=1) == pytest.approx(stated, rel=0.5)


def test_neighbouring_pixels_cannot_tell_it():
    """Grain as fine as the pixels: of six draws the pairs are taken each time, with an error of less than 2 %; what
    neighbours say alone is unknown or ten times worse."""
    for seed in range(6):
        pairs = drawn(seed)
        crops = [one for two in pairs for one in two]
        both = estimate_from_spots(crops, {"exposures of a site": pairs}, 50.0, 4095.0)
        assert both.method == "differences of 4 pairs of exposures of a site"
        assert both.gain.gain_stderr < 0.02 * GAIN
        alone = estimate_from_spots(crops, {}, 50.0, 4095.0).gain
        assert alone is None or alone.gain_stderr > 5 * both.gain.gain_stderr


def test_a_frame_that_moved_by_a_part_of_a_pixel():
    """0.2 px between the exposures: the gain stays within 4 of its errors and 3 %, since a shift by slopes is its first
    order; left alone, grain of 1 px would leave (0.2/1)² of a variance that is hundreds of times the noise."""
    rng = np.random.default_rng(3)
    pairs = []
    for _ in range(4):
        light = speckled(rng, grain=2.5)
        second = np.maximum(moved(light, (0.2, -0.1), order=3, mode="nearest"), 0)
        pairs.append((frame(0.5 * light, rng), frame(second, rng)))
    own = gain_of(pairs)
    assert abs(own.gain - GAIN) < 4 * own.gain_stderr + 0.03 * GAIN


def narrow(seed, width, motion, count=20, side=48):
    """Pairs of plain spots of that width [px], one of 4/7 of the other's light, that move by so much [px]."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:side, :side] - side / 2
    pairs = []
    for _ in range(count):
        shifts = rng.uniform(-0.5, 0.5, 2) + rng.normal(0, motion, (2, 2))
        pairs.append(tuple(frame(part * TOP / 2 * np.exp(-((y - down) ** 2 + (x - right) ** 2) / (2 * width**2)), rng)
                           for part, (down, right) in zip((4 / 7, 1.0), shifts, strict=True)))  # fmt: skip
    return pairs


@pytest.mark.parametrize(("width", "motion", "known"), [(1.5, 0.3, False), (2.5, 0.3, False), (2.5, 0.05, True),
                                                        (4.0, 0.0, True), (4.0, 0.3, True)])  # fmt: skip
def test_spots_narrower_than_a_block(width, motion, known):
    """Either neighbours share what is left, and nothing is said, or the mean of six gains is within 4 standard errors
    (false alarm 1e-4) and 7 % of the truth: a spot that moved by 0.08 of its width leaves that much."""
    found = [own for seed in range(6) if (own := gain_of(narrow(seed, width, motion))) is not None]
    assert not known or len(found) == 6
    if found:
        error = np.sqrt(sum(own.gain_stderr**2 for own in found)) / len(found)
        assert abs(np.mean([own.gain for own in found]) - GAIN) < 4 * error + 0.07 * GAIN


def test_readings_that_stop_or_are_cut_are_left_out():
    """A well that is full at half of the peak, and a black level of 0: the gain stays."""
    full = 50.0 + 0.9 * GAIN * 0.5 * TOP
    for how, black, top in (({"clip": 0.5 * TOP}, 50.0, full), ({"black": 0.0}, 0.0, 4095.0)):
        own = gain_of([pair for seed in (1, 2, 3) for pair in drawn(seed, **how)], black, top)
        assert abs(own.gain - GAIN) < 4 * own.gain_stderr + 0.015 * GAIN
        assert abs(own.floor - FLOOR) < 4 * own.floor_stderr + 0.015 * FLOOR


def test_sites_that_differ_tell_nothing():
    """Frames of two sites share no grain: no gain, or one that says that it is worth nothing."""
    one, two = drawn(1, count=4), drawn(2, count=4)
    own = gain_of([(a[1], b[1]) for a, b in zip(one, two, strict=True)])
    assert own is None or own.gain_stderr > 0.1 * own.gain


@pytest.mark.parametrize("image", [np.full((40, 40), np.nan), np.full((40, 40), 4095.0), np.ones((6, 6))])
def test_nothing_to_see(image):
    """Gaps, saturation all over, and crops smaller than a block: an empty curve."""
    assert convert_to_curve(tally_differences(image, image, 0.0, 4095.0), 0.0).level.size == 0


def test_aligned_parts_show_the_same_pixels():
    """Any two corners: what is left of both images is equal where they were cut from one frame."""
    whole = np.arange(60 * 60).reshape(60, 60)
    for down, right in ((0, 0), (3, -5), (-4, 2), (-1, -7)):
        first = whole[10:40, 12:42]
        second = whole[10 + down : 40 + down, 12 + right : 42 + right]
        one, two = align_images(first, second, down, right)
        assert (one == two).all() and one.shape == (30 - abs(down), 30 - abs(right))


@pytest.mark.parametrize(("down", "right"), [(30, 0), (0, -31), (-45, 12), (70, 70)])
def test_crops_far_apart_share_nothing(down, right):
    """Spots of two frames at other ends of the sensor: nothing of them is compared."""
    one, two = align_images(np.ones((30, 30)), np.ones((30, 30)), down, right)
    assert one.shape == two.shape and one.size == 0
    assert not tally_differences(one, two, 0.0, 4095.0).any()


def test_pairs_are_neighbours_and_no_frame_is_taken_twice():
    """Of five exposures of a site of which one is missing: the two brightest, then the two darkest that are left."""
    image = np.arange(5.0)[:, None, None] * np.ones((1, 12, 12))
    grid = xr.Dataset({"image": (("exposure", "y", "x"), image)})
    for name in ("top", "left"):
        grid[name] = ("exposure", np.zeros(5, int))
    grid["status"] = ("exposure", np.array([0, 0, 0, 1, 0]))
    assert [(one[0, 0], two[0, 0]) for one, two in iterate_pairs(grid, "exposure")] == [(2, 4), (0, 1)]
    assert list(iterate_pairs(grid, "repeat")) == []
