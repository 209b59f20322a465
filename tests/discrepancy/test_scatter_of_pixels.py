"""Noise of dark pixels, fields of granular light and of pixel gains, and hot pixels, on frames that numpy drew."""

from dataclasses import replace
from math import erf, sqrt

import numpy as np
import pytest

from spotcheck.discrepancy.fields import (
    FieldEstimate,
    estimate_granular_light,
    estimate_pixel_gains,
    estimate_white_field,
    measure_fields,
)
from spotcheck.discrepancy.frames import select_pixels
from spotcheck.discrepancy.hot_pixels import mask_hot_pixels
from spotcheck.discrepancy.joint_fit import fit_jointly
from spotcheck.discrepancy.residuals import ResidualImages, measure_residuals
from spotcheck.discrepancy.scatter import DarkNoise, DarkSlopes, Moment, measure_dark_noise
from tests.samples import drawn_frames as drawing
from tests.samples.drawn_frames import DrawnCamera, DrawnFrames, DrawnLight, draw_frames, lay_out
from tests.samples.models_of_frames import SENSOR, frame_set, starting_model

# Bound on the distance of one estimate from its truth in standard errors: two-sided 6.8e-6 for a normal estimate. The
# errors come from the scatter of 24 frames; for Student's t with 23 degrees of freedom it is 1.6e-4.
LARGEST_Z = 4.5
# Twelve sites: errors by jackknife have 11 degrees of freedom, for which |t| > 5.5 has the probability 1.9e-4.
CONDITIONS_OF_FIELDS = lay_out(repeats=3)
LARGEST_T = 5.5


def residuals_of(drawn: DrawnFrames, black_dn: float = drawing.BLACK) -> ResidualImages:
    """Return the residuals of a fit of the spots alone, with the stated read noise."""
    frames = frame_set(drawn)
    model = replace(starting_model(drawn, sensor=replace(SENSOR, black_level_dn=black_dn)), free=())
    fit = fit_jointly(model, select_pixels(frames, model.spots))
    return measure_residuals(fit.model, frames)


# Noise of dark pixels.


# Far above 0 readings follow the light, and their noise is that of the signal with the shot noise of the light.
UNCUT = DarkSlopes(1.0, 0.0, drawing.GAIN, 1.0)


def moments_of_dark_reading(noise_dn: float, black_dn: float) -> tuple[float, float]:
    """Return mean [DN] and variance [DN²] of a normal signal that is rounded to whole DN and cut at 0."""
    codes = np.arange(60)
    at_most = np.array([0.5 * (1 + erf((code + 0.5 - black_dn) / (noise_dn * sqrt(2)))) for code in codes])
    probability = np.diff(at_most, prepend=0.0)
    mean = float(probability @ codes)
    return mean, float(probability @ codes**2) - mean**2


def measure_noise_of(camera: DrawnCamera, seed: int = 1) -> DarkNoise:
    """Return the noise of dark pixels of 24 drawn frames beside that of the stated read noise."""
    noise = drawing.GAIN * drawing.READ_NOISE_E
    (low_mean, low), (high_mean, high) = (moments_of_dark_reading(f * noise, camera.black_dn) for f in (0.99, 1.01))
    squares = (1.01 * noise) ** 2 - (0.99 * noise) ** 2
    (mean, variance), (lit_mean, lit) = (moments_of_dark_reading(noise, camera.black_dn + more) for more in (0.0, 0.01))
    # Light of 0.01 DN brings shot noise as well.
    shot = drawing.GAIN * (high - low) / squares
    slopes = DarkSlopes((high - low) / squares, (high_mean - low_mean) / squares, (lit - variance) / 0.01 + shot,
                        (lit_mean - mean) / 0.01)  # fmt: skip
    drawn = draw_frames(seed, lay_out(), DrawnLight(), camera)
    dark = measure_dark_noise(residuals_of(drawn, camera.black_dn), slopes)
    assert dark is not None
    return dark


def assert_is_near(moment: Moment, true_value: float, bias: float = 0.0) -> None:
    """Check that a moment is within a bias and `LARGEST_Z` standard errors of the truth, and that these are small: 4 %
    of the variance of the stated read noise, and 6 % of the truth."""
    assert abs(moment.value - true_value) < bias + LARGEST_Z * moment.stderr
    assert 0 < moment.stderr < 0.04 * (drawing.GAIN * drawing.READ_NOISE_E) ** 2 + 0.06 * true_value


def test_plain_dark_pixels_have_no_further_noise():
    """All moments of plain frames are 0 within their errors: six moments, one false alarm in 1000."""
    dark = measure_noise_of(DrawnCamera())
    for name in ("white", "row", "column", "next_row", "neighbour"):
        assert_is_near(getattr(dark, name), 0.0)


# Black level [DN], and the bias of a measured variance in terms of the truth: none far above 0. At 0.5 DN many dark
# readings are cut, whose response is taken for linear. A variance 20 % larger than stated makes that 10 % wrong.
BLACK_LEVELS = pytest.mark.parametrize(("black_dn", "bias"), [(12.0, 0.0), (0.5, 0.1)], ids=["uncut", "cut at 0"])


@BLACK_LEVELS
def test_excess_read_noise_is_measured(black_dn: float, bias: float):
    """Noise beyond the stated one is found as white noise: rows, columns and neighbours share nothing."""
    dark = measure_noise_of(DrawnCamera(read_noise_e=6.6, black_dn=black_dn))
    excess = drawing.GAIN**2 * (6.6**2 - drawing.READ_NOISE_E**2)
    assert_is_near(dark.white, excess, bias * excess)
    # Half of the information is spent on telling noise from light where readings are cut.
    assert dark.white.value > 5 * dark.white.stderr
    # Mean readings near the cut rise with the noise, alike in all pixels: 0.1 of the excess again.
    for moment in (dark.row, dark.column, dark.next_row, dark.neighbour):
        assert_is_near(moment, 0.0, bias * excess)


@BLACK_LEVELS
def test_row_noise_is_measured(black_dn: float, bias: float):
    """Offsets of rows that are new in each frame are found as such, and not as white noise."""
    row_dn = 0.3
    dark = measure_noise_of(DrawnCamera(row_dn=row_dn, black_dn=black_dn))
    for moment in (dark.row, dark.neighbour):
        assert_is_near(moment, row_dn**2, bias * row_dn**2)
    for moment in (dark.white, dark.column, dark.next_row):
        assert_is_near(moment, 0.0, bias * row_dn**2)
    # The same row in different frames: products of independent offsets of 72 rows in 24 · 23/2 pairs of frames average
    # to 0 within row²/√(72 · 276). The noise of the pixels of a row, some 25 of them, adds 0.02 DN² to row².
    assert abs(dark.same_row.value) < bias * row_dn**2 + LARGEST_Z * (row_dn**2 + 0.02) / np.sqrt(72 * 276)


def test_a_static_row_pattern_is_the_same_in_all_frames():
    """Offsets of rows that stay are told from row noise by products between frames."""
    drawn = draw_frames(2, lay_out(), DrawnLight(), DrawnCamera())
    # Each crop gets the same offsets; whole DN, so that readings stay whole.
    offsets = np.random.default_rng(8).integers(0, 2, drawing.SIDE)
    images = residuals_of(replace(drawn, readings=drawn.readings + offsets[:, None] - 0.5))
    dark = measure_dark_noise(images, UNCUT)
    assert dark is not None
    # Offsets of ±0.5 DN have the variance 0.25 DN² but for their mean, which some 70 rows leave uncertain by 0.06 DN.
    assert dark.same_row.value == pytest.approx(0.25, abs=0.03)
    assert dark.row.value == pytest.approx(0.25, abs=0.03)


def test_few_dark_pixels_are_not_assessed():
    """Two frames hold fewer dark pixels than a measurement needs."""
    drawn = draw_frames(1, lay_out(angles_deg=(0.0,), repeats=1)).select(np.arange(2))
    assert measure_dark_noise(residuals_of(drawn), UNCUT) is None


# Relative fields.


def estimate_fields(light: DrawnLight, camera: DrawnCamera, seed: int = 1) -> tuple[FieldEstimate, FieldEstimate]:
    """Return granular light and gains of pixels of 36 drawn frames of 12 sites."""
    covariances = measure_fields(residuals_of(draw_frames(seed, CONDITIONS_OF_FIELDS, light, camera)))
    return estimate_granular_light(covariances), estimate_pixel_gains(covariances)


def is_seen(estimate: FieldEstimate) -> bool:
    """Return whether a field is there beyond doubt."""
    return not estimate.reasons and estimate.variance > 5 * estimate.stderr


SPECKLE = DrawnLight(speckle_contrast=0.04, grain_px=1.0)
GAINS = DrawnCamera(gain_scatter=0.02)
# Part of the variance of granular light that the four parameters of each spot take with them: 4 of the grains that a
# spot holds, π (2σ)²/(2π grain²) = 2 σ²/grain² or some 80.
ABSORBED_SHARE = 0.08


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("camera", [DrawnCamera(), GAINS], ids=["alone", "with gains"])
def test_granular_light_is_measured(camera: DrawnCamera, seed: int):
    """A field that is new at each site has its contrast and grain, with and without gains of pixels."""
    grains, _ = estimate_fields(SPECKLE, camera, seed)
    assert is_seen(grains)
    offset = grains.variance - SPECKLE.speckle_contrast**2
    tolerance = LARGEST_T * grains.stderr
    assert -tolerance - ABSORBED_SHARE * SPECKLE.speckle_contrast**2 < offset < tolerance
    # What the spots absorb are the longest waves of the field, which makes grains look smaller by about as much, 8 %;
    # sets of frames scatter by 3 %.
    assert 0.78 < grains.grain_px / SPECKLE.grain_px < 1.05


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("light", [DrawnLight(), SPECKLE], ids=["alone", "with granular light"])
def test_gains_of_pixels_are_measured(light: DrawnLight, seed: int):
    """Gains that are fixed to the sensor have their scatter, with and without granular light."""
    _, gains = estimate_fields(light, GAINS, seed)
    assert is_seen(gains)
    # Errors by jackknife over hundreds of blocks: normal.
    assert abs(gains.variance - GAINS.gain_scatter**2) < LARGEST_Z * gains.stderr


def test_fields_are_not_confused():
    """Granular light alone shows no gains, gains alone show no granular light, and plain frames neither."""
    for light, camera, has_grains, has_gains in (
        (SPECKLE, DrawnCamera(), True, False),
        (DrawnLight(), GAINS, False, True),
        (DrawnLight(), DrawnCamera(), False, False),
        (DrawnLight(), DrawnCamera(row_dn=0.5), False, False),
    ):
        grains, gains = estimate_fields(light, camera, seed=3)
        assert (is_seen(grains), is_seen(gains)) == (has_grains, has_gains)
        # The field that is not there has no variance beyond its error.
        if not has_grains:
            assert abs(grains.variance) < LARGEST_T * grains.stderr
        if not has_gains:
            assert abs(gains.variance) < LARGEST_Z * gains.stderr


def test_a_misfit_of_the_shape_is_no_gain_of_pixels():
    """An ellipse that the model lacks is correlated over several pixels, which gains of pixels are not."""
    _, gains = estimate_fields(DrawnLight(ratio=1.03, direction_deg=20.0), DrawnCamera(), seed=2)
    assert not is_seen(gains)
    # The relative misfit is of the order of (ratio − 1)²/4 on average, and 2 px beside a pixel 10 % less.
    assert abs(gains.variance) < 0.1 * 0.03**2 / 4


def test_granular_light_of_single_frames():
    """With one frame for each site the noise hides the covariance at lag 0, and neighbours give contrast and grain."""
    drawn = draw_frames(4, lay_out(exposures_s=drawing.EXPOSURES_S[-1:], repeats=6), SPECKLE)
    grains = estimate_granular_light(measure_fields(residuals_of(drawn)))
    assert is_seen(grains)
    # Extrapolated from the neighbours: as above, and another 10 % for the shape of the correlation.
    offset = grains.variance - SPECKLE.speckle_contrast**2
    tolerance = LARGEST_T * grains.stderr + 0.1 * SPECKLE.speckle_contrast**2
    assert -tolerance - ABSORBED_SHARE * SPECKLE.speckle_contrast**2 < offset < tolerance


def test_one_site_does_not_tell_grains_from_gains():
    """The reason against granular light is stated where all frames are of one site."""
    drawn = draw_frames(5, lay_out(angles_deg=(0.0,), repeats=1), SPECKLE)
    grains = estimate_granular_light(measure_fields(residuals_of(drawn)))
    assert "one site: tied with gains of pixels" in grains.reasons


@pytest.mark.parametrize("gain_scatter", [0.0, 0.03])
def test_the_scatter_of_single_pixels_is_measured_in_one_frame(gain_scatter: float):
    """Gains of pixels are what neighbours do not share, in spite of an ellipse that the model lacks."""
    light = DrawnLight(ratio=1.05, direction_deg=20.0)
    drawn = draw_frames(7, lay_out(), light, DrawnCamera(gain_scatter=gain_scatter)).select(np.arange(2, 3))
    field = estimate_white_field(residuals_of(drawn))
    assert abs(field.variance - gain_scatter**2) < LARGEST_Z * field.stderr
    assert (field.variance > 5 * field.stderr) == (gain_scatter > 0) and field.stderr < 2e-4


# Hot pixels.

# (row, column, offset [DN]): in the dark, on the flank and in the middle of the spots, far above the scatter there.
HOT_PIXELS = ((76, 24, 15.0), (30, 40, 60.0), (48, 47, 250.0))


@pytest.mark.parametrize("hot_pixels", [(), HOT_PIXELS], ids=["none", "three"])
def test_hot_pixels_are_masked(hot_pixels: tuple[tuple[int, int, float], ...]):
    """Exactly the hot pixels are masked, in every crop at their place on the sensor; nothing else changes."""
    drawn = draw_frames(6, lay_out(), SPECKLE, DrawnCamera(gain_scatter=0.01, hot_pixels=hot_pixels))
    frames, count = mask_hot_pixels(frame_set(drawn), SENSOR)
    assert count == len(hot_pixels)
    masked = np.isnan(frames.readings)
    for frame in range(len(frames)):
        rows, columns = np.nonzero(masked[frame])
        places = set(zip(rows + drawn.top[frame], columns + drawn.left[frame], strict=True))
        assert places == {(row, column) for row, column, _ in hot_pixels}
    np.testing.assert_array_equal(frames.readings[~masked], drawn.readings[~masked])


@pytest.mark.parametrize(("contrast", "found"), [(0.0, len(HOT_PIXELS)), (0.6, 0)], ids=["smooth", "grains"])
def test_hot_pixels_of_one_frame(contrast: float, found: int):
    """Where the light is smooth a single frame shows hot pixels; grains could be mistaken for them."""
    light = DrawnLight(speckle_contrast=contrast)
    # Noise is larger than in the mean of many frames.
    camera = DrawnCamera(hot_pixels=tuple((row, column, 4 * offset_dn) for row, column, offset_dn in HOT_PIXELS))
    drawn = draw_frames(6, lay_out(), light, camera).select(np.arange(2, 3))
    frames, count = mask_hot_pixels(frame_set(drawn), SENSOR)
    assert count == found == np.isnan(frames.readings).sum()
