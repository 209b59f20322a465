"""Whether tests of residuals hold what they claim: false alarms, power, places in words, and the size of what is left.

Most residuals are drawn directly: normal numbers of known variance about Gaussian spots.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from spotcheck.discrepancy import detection
from spotcheck.discrepancy.fields import FieldEstimate
from spotcheck.discrepancy.frames import FrameParameters
from spotcheck.discrepancy.places import KnownScatter, correlated_length, find_places, strongest_cells, to_normal
from spotcheck.discrepancy.residual_sums import sum_residuals
from spotcheck.discrepancy.residuals import ResidualImages, measure_residuals
from tests.samples.drawn_frames import BLACK, DrawnCamera, DrawnLight, draw_frames, lay_out
from tests.samples.models_of_frames import design_of, fit_drawn, frame_set

# Side of drawn crops, width of the spots [px], their peak [DN], and noise [DN].
SIDE, SIGMA, PEAK, NOISE = 64, 6.0, 200.0, 2.0
# Two exposures, two angles and two repeats.
CONDITIONS = lay_out(exposures_s=(1e-3, 4e-3), angles_deg=(0.0, 45.0))


def residual_images(seed: int, conditions=CONDITIONS, spread: int = 3) -> ResidualImages:
    """Return residuals of the right model: noise of `NOISE` DN and of the light of the spots, a tenth of it [DN²]."""
    rng = np.random.default_rng(seed)
    frames = len(conditions)
    left, top = 16 + rng.integers(0, spread, (2, conditions.site.max() + 1))[:, conditions.site]
    x, y = left + SIDE / 2 + rng.uniform(-2, 2, frames), top + SIDE / 2 + rng.uniform(-2, 2, frames)
    peak = PEAK * conditions.exposure_s / conditions.exposure_s.max()
    u = (left[:, None, None] + np.arange(SIDE)[None, None, :] - x[:, None, None]) / SIGMA
    v = (top[:, None, None] + np.arange(SIDE)[None, :, None] - y[:, None, None]) / SIGMA
    light = peak[:, None, None] * np.exp(-(u**2 + v**2) / 2)
    variance = NOISE**2 + 0.1 * light
    return ResidualImages(
        residual=(np.sqrt(variance) * rng.standard_normal(light.shape)).astype(np.float32),
        weight=(1 / variance).astype(np.float32),
        slope=np.ones(light.shape, np.float32),
        spot=light.astype(np.float32),
        is_dark=np.hypot(u, v) > 5,
        left=left,
        top=top,
        design=design_of(conditions),
        spots=FrameParameters(np.log(peak), np.full(frames, np.log(SIGMA)), x, y),
    )


def offsets_of(images: ResidualImages) -> tuple[np.ndarray, np.ndarray]:
    """Return columns and rows of the pixels from the spots [frame, 1, column], [frame, row, 1]."""
    x = (images.left - images.spots.x)[:, None, None] + np.arange(SIDE)
    return x, (images.top - images.spots.y)[:, None, None] + np.arange(SIDE)[:, None]


def with_residual(images: ResidualImages, addition: np.ndarray) -> ResidualImages:
    """Return the images with something added to the residuals [DN]."""
    return replace(images, residual=images.residual + addition.astype(np.float32))


def block_on_sensor(images: ResidualImages, row: int, column: int, height: int, width: int) -> np.ndarray:
    """Return 1 on a part of the sensor, 0 elsewhere [frame, row, column]."""
    y = images.top[:, None, None] + np.arange(SIDE)[None, :, None]
    x = images.left[:, None, None] + np.arange(SIDE)[None, None, :]
    return ((y >= row) & (y < row + height) & (x >= column) & (x < column + width)).astype(float)


# False alarms.


def test_p_values_are_uniform_on_normal_residuals():
    """80 draws: with a rate of 1 %, five or more p-values below 0.01 have a probability of 0.1 %; with one of 10 %, 17
    or more below 0.1 have one of 0.4 %. Tests share residuals, so that p-values are somewhat large: the median may be
    above 0.5."""
    p_values = np.array([detection.test_residuals(residual_images(seed)).p_value for seed in range(80)])
    assert np.sum(p_values < 0.01) <= 4
    assert np.sum(p_values < 0.1) <= 16
    assert np.median(p_values) < 0.75


@pytest.mark.parametrize(
    ("conditions", "factor", "camera"),
    [
        (lay_out(repeats=1), 1.0, DrawnCamera()),
        (lay_out(repeats=1), 0.02, DrawnCamera()),
        (lay_out(exposures_s=(9e-4,), angles_deg=(0.0,), repeats=1), 1.0, DrawnCamera()),
        (lay_out(exposures_s=(9e-4,), angles_deg=(0.0,), repeats=2), 1.4, DrawnCamera()),
    ],
    ids=["12 frames", "low light", "one frame", "bright"],
)
def test_fitted_frames_raise_no_alarm(conditions, factor, camera):
    """Poisson light, read noise and rounding beside a fit: of 4 draws, two or more p-values below 0.02 have a
    probability of 0.2 % each."""
    p_values = []
    for seed in range(4):
        drawn = draw_frames(400 + seed, conditions, camera=camera, peak_factor=factor)
        images = measure_residuals(fit_drawn(drawn).model, frame_set(drawn))
        p_values.append(detection.test_residuals(images, BLACK).p_value)
    assert np.sum(np.array(p_values) < 0.02) <= 1


def test_variances_of_sums_are_those_of_projected_noise():
    """Squared sums of cells in their standard errors are 1 on average: 40 draws of some 160 sums, limit of 4 standard
    errors (6e-5)."""
    squares = []
    for seed in range(40):
        images = residual_images(seed, lay_out(exposures_s=(1e-3,), angles_deg=(0.0,), repeats=1))
        cells = next(cells for cells in sum_residuals(images).means if cells.kind.name == "rings and sectors")
        variance = cells.norms - np.sum(cells.absorbed**2, axis=2)
        used = cells.pixels > 0
        squares.append(np.mean(cells.sums[used] ** 2 / variance[used]))
    error = np.std(squares, ddof=1) / np.sqrt(len(squares))
    assert abs(np.mean(squares) - 1) < 4 * error


def test_errors_of_the_fitted_spot_and_read_noise_change_nothing():
    """A misfit of brightness, width and centre, or a read noise that is 3 % off, is no disagreement."""
    images = residual_images(1)
    x, y = offsets_of(images)
    misfit = images.spot * (0.02 + 0.01 * (x**2 + y**2) / SIGMA**2 + 0.02 * x / SIGMA)
    shifted = detection.test_residuals(with_residual(images, misfit))
    p_value = detection.test_residuals(images).p_value
    assert shifted.p_value == pytest.approx(p_value, rel=0.2)
    weight = 1 / (1 / images.weight + 0.06 * NOISE**2)
    assert detection.test_residuals(replace(images, weight=weight)).p_value > 0.01


# Power, and places in words.


def test_block_of_six_sigma_is_detected_in_its_place():
    """A block of 8 px whose sum over the frames of an exposure is raised by 6.5 standard errors."""
    images = residual_images(2)
    member = images.design.exposure_s == 4e-3
    block = block_on_sensor(images, 24, 64, 8, 8) * member[:, None, None]
    block *= 6.5 * NOISE / np.sqrt(block.sum())
    raised = with_residual(images, block)
    found = detection.test_residuals(raised)
    assert found.p_value < 0.01 < detection.test_residuals(images).p_value
    assert found.tests[0].name == "blocks"
    assert found.tests[0].where == "columns 64 to 71, rows 24 to 31 of frames at 4 ms"
    (place,) = find_places(raised)
    assert place.words == found.tests[0].where
    assert place.z == pytest.approx(found.tests[0].statistic)


def test_one_dark_row_is_detected():
    images = residual_images(3)
    (place,) = find_places(with_residual(images, -0.5 * block_on_sensor(images, 30, 0, 1, 999)))
    assert place.words == "row 30"
    assert place.z < -5


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        # Bounds of ranges of light are 200 DN (k/12)² above a black level of 12 DN.
        (8, 9, "grey levels of 101 to 124 DN"),
        (11, 12, "grey levels above 180 DN"),
        (0, 1, "grey levels below 13 DN"),
    ],
)
def test_noise_of_a_range_of_light_is_detected(low: int, high: int, words: str):
    images = residual_images(4)
    share = images.spot / PEAK
    inside = (share >= (low / 12) ** 2) & (share < (high / 12) ** 2) & ~images.is_dark
    if low == 0:
        # The faintest light fixes the read noise as well: there, the noise of one exposure is raised.
        inside &= (images.design.exposure_s == 4e-3)[:, None, None]
    found = detection.test_residuals(replace(images, residual=np.where(inside, 1.6, 1.0) * images.residual), BLACK)
    assert found.p_value < 1e-3
    assert found.tests[0].name == "noise"
    assert found.tests[0].where.startswith(f"the noise of {words}")


def test_ring_about_the_spot_is_detected():
    images = residual_images(5)
    x, y = offsets_of(images)
    ring = np.abs(np.hypot(x, y) / SIGMA - 2.75) < 0.25
    places = find_places(with_residual(images, 0.6 * ring))
    assert places[0].words == "pixels 2.5 to 3.0 widths from the centre"
    assert places[0].z > 5


@pytest.mark.parametrize(
    ("light", "camera", "name", "where"),
    [
        (DrawnLight(speckle_contrast=0.03), DrawnCamera(), "common pattern", "the same pixel in frames of one site"),
        (DrawnLight(), DrawnCamera(gain_scatter=0.01), "common pattern", "the same pixel at different sites"),
        (DrawnLight(), DrawnCamera(row_dn=0.2), "neighbours", "in dark pixels"),
        (DrawnLight(pedestal_dn=0.1), DrawnCamera(), "grey levels", "dark pixels"),
        (DrawnLight(), DrawnCamera(clip_dn=450.0), "grey levels", "grey levels above"),
        (DrawnLight(ratio=1.02), DrawnCamera(), "rings and sectors", "widths from the centre"),
    ],
    ids=["speckle", "gains", "rows", "pedestal", "clip", "ellipse"],
)
def test_departures_are_detected(light, camera, name: str, where: str):
    drawn = draw_frames(77, lay_out(), light, camera)
    images = measure_residuals(fit_drawn(drawn).model, frame_set(drawn))
    found = detection.test_residuals(images, BLACK)
    test = next(test for test in found.tests if test.name == name)
    assert found.p_value < 1e-20
    assert test.p_value < 1e-20
    assert where in test.where
    assert found.p_value >= 1e-300


def test_places_are_few_and_the_strongest_comes_first():
    images = residual_images(6)
    everything = 3 * block_on_sensor(images, 0, 0, 999, 48) + 0.05 * images.spot**1.5
    places = find_places(with_residual(images, everything))
    sizes = [abs(place.z) for place in places]
    assert 3 <= len(places) <= 5
    assert sizes == sorted(sizes, reverse=True)
    assert find_places(images) == ()


# Records.


def test_images_without_pixels_say_nothing():
    images = residual_images(7)
    empty = replace(images, weight=np.zeros_like(images.weight), is_dark=np.zeros_like(images.is_dark))
    assert detection.test_residuals(empty) == detection.Detection(1.0, ())
    assert find_places(empty) == ()
    left = detection.measure_unexplained(empty)
    assert (left.size, left.z, left.variance_error) == (0.0, 0.0, np.inf)


def test_readings_that_are_no_numbers_are_left_out():
    images = residual_images(8)
    residual = images.residual.copy()
    residual[0, 30, 30] = np.nan
    found = detection.test_residuals(replace(images, residual=residual))
    assert all(np.isfinite([test.statistic, test.p_value, test.z]).all() for test in found.tests)
    assert found.p_value > 1e-3


def test_crops_far_apart_are_tested_in_their_own_columns():
    images = residual_images(9, spread=5000)
    first = np.zeros(images.residual.shape)
    first[:, 10, :] = 1.0
    assert find_places(images) == ()
    (place,) = find_places(with_residual(images, first))
    assert place.words == "row 10"


def test_further_tests_count():
    """With k tests of which one has the p-value p, the p-value is 1 − (1 − p)^k."""
    images = residual_images(10)
    other = detection.deviate_test("read noise", "all frames", -6.0)
    found = detection.test_residuals(images, others=[other])
    assert other.p_value == pytest.approx(2 * stats.norm.sf(6.0))
    assert other.z == pytest.approx(6.0)
    assert found.tests[0] == other
    assert found.p_value == pytest.approx(len(found.tests) * other.p_value, rel=1e-6)


# Size of what is left.


def test_size_of_a_known_misfit():
    """A wave of 3 % of the peak, 12 px long, over all of the spot: the mean over a block takes off some of it."""
    images = residual_images(11)
    y = images.top[:, None, None] + np.arange(SIDE)[None, :, None]
    wave = 0.03 * np.exp(images.spots.log_peak)[:, None, None] * np.sin(2 * np.pi * y / 12)
    left = detection.measure_unexplained(with_residual(images, wave + 0 * images.residual))
    side = 3
    expected = 0.03 / np.sqrt(2) * np.sin(np.pi * side / 12) / (side * np.sin(np.pi / 12))
    assert left.size == pytest.approx(expected, rel=0.05)
    assert left.z > 5
    assert np.isnan(left.share)
    assert np.isnan(left.p_value)


def test_squared_size_of_nothing_is_zero_within_its_error():
    """30 draws: the mean of z has a standard error of at most 0.18, the limit is 4 of these."""
    z = [detection.measure_unexplained(residual_images(seed)).z for seed in range(30)]
    assert abs(np.mean(z)) < 0.75
    assert 0.5 < np.std(z) < 1.4


def test_known_scatter_is_neither_a_disagreement_nor_left_over():
    """Granular light of 3 % and rows of 0.2 DN: of 3 draws each, two or more p-values below 0.02 have a probability of
    0.1 %."""
    grains = KnownScatter((FieldEstimate(9e-4, 2e-5, 1.5, ()),))
    rows = KnownScatter(row_variance=0.04)
    for light, camera, scatter in (
        (DrawnLight(speckle_contrast=0.03, grain_px=1.5), DrawnCamera(), grains),
        (DrawnLight(), DrawnCamera(row_dn=0.2), rows),
    ):
        found, z = [], []
        for seed in range(3):
            drawn = draw_frames(600 + seed, lay_out(), light, camera)
            images = measure_residuals(fit_drawn(drawn).model, frame_set(drawn))
            found.append(detection.test_residuals(images, BLACK, scatter).p_value)
            z.append(detection.measure_unexplained(images, scatter).z)
            assert detection.test_residuals(images, BLACK).p_value < 1e-3
        assert np.sum(np.array(found) < 0.02) <= 1
        assert abs(np.mean(z)) < 2.0


# Formulas against brute force.


@pytest.mark.parametrize(("grain_px", "length"), [(0.5, 1), (1.5, 8), (4.0, 20)])
def test_correlated_length(grain_px: float, length: int):
    i = np.arange(length)
    expected = np.exp(-((i[:, None] - i) ** 2) / (2 * grain_px**2)).sum() / length
    assert correlated_length(grain_px, length) == pytest.approx(expected, rel=1e-6)
    assert correlated_length(np.nan, length) == 1.0


def test_skewed_sums_have_normal_deviates_of_the_same_probability():
    """Against the gamma law of 64 degrees of freedom, skewness 0.25, from 4 σ below to 5 σ above."""
    shape = 64.0
    z = np.linspace(-4.0, 5.0, 20)
    law = stats.gamma(shape)
    lower, upper = law.logcdf(shape + np.sqrt(shape) * z), law.logsf(shape + np.sqrt(shape) * z)
    expected = np.where(z < 0, stats.norm.ppf(np.exp(lower)), stats.norm.isf(np.exp(upper)))
    np.testing.assert_allclose(to_normal(z, np.full(z.shape, 2 / np.sqrt(shape))), expected, atol=0.03)


def test_divisions_of_the_frames_are_tested_once():
    """One exposure and one angle: all frames together and each by itself remain."""
    images = residual_images(12, lay_out(exposures_s=(1e-3,), angles_deg=(0.0,), repeats=3))
    cells = sum_residuals(images).means[0]
    assert [len(cell.frames) for cell in strongest_cells(cells, images.design)] == [3, 1]
