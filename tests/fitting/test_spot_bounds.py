"""Bounds of a spot in one image: those of the law that the fit uses, which its fits reach."""

from dataclasses import replace

import numpy as np
import pytest

from spotcheck.fitting.optimization import convert_widths
from spotcheck.fitting.reading_kernel import build_reading_law
from spotcheck.fitting.spot_bounds import spot_bounds
from spotcheck.fitting.spot_score import LIKELIHOOD, score_spot
from spotcheck.fitting.spotfit import fit_spots
from spotcheck.sensor import SensorModel
from tests.samples.example_datasets import CAMERA

# Sensor, peak [DN], offset [DN]: bright, clipped at full scale over 3 % of the pixels, faint.
SCENES = {
    "bright": (CAMERA, 600.0, 20.0),
    "clipped": (replace(CAMERA, full_scale_dn=400.0), 600.0, 20.0),
    "faint": (SensorModel(0.5, 2.0, black_level_dn=10.0, full_scale_dn=255.0), 12.0, 11.0),
}


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_the_fit_scatters_as_the_bound_says(scene):
    """Standard deviation of 600 fits over the bound: 1 within 4.5 standard errors, 4.5/√1200 = 0.13, and 0.03 for what
    a likelihood is short of its bound at a finite number of photons. False alarm 7e-6 a number, 24 of them."""
    sensor, amplitude, offset = scene
    y, x = np.mgrid[:40, :50]
    own = {"amplitude": amplitude, "sigma_major": 6.0, "sigma_minor": 4.2, "x_centre": 24.3, "y_centre": 19.6}
    bounds = spot_bounds(sensor, (40, 50), **own, orientation=90.0, offset=offset)
    light = (
        amplitude * np.exp(-(((x - 24.3) / 4.2) ** 2 + ((y - 19.6) / 6.0) ** 2) / 2) + offset - sensor.black_level_dn
    )
    rng = np.random.default_rng(3)
    fits = fit_spots([sensor.draw(light / sensor.gain_dn_per_e, rng) for _ in range(600)], sensor)
    assert (fits.status == "ok").all()
    for name, bound in bounds._asdict().items():
        assert getattr(fits, name).std(ddof=1) / bound == pytest.approx(1, abs=0.16), name


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
@pytest.mark.parametrize("top_hat", [False, True])
def test_the_bound_is_of_the_law_that_the_fit_uses(scene, top_hat):
    """Information of one pass of the fit over the expected image, inverted: equal to 1e-6, derivatives being exact in
    both; near full scale to 1 %, where that of the pass follows the reading."""
    sensor, amplitude, offset = scene
    theta = np.array([amplitude, 24.3, 19.6, *convert_widths(6.0, 4.2, 0.5), offset])
    bounds = spot_bounds(
        sensor, (40, 50), amplitude=amplitude, sigma_major=6.0, sigma_minor=4.2, orientation=np.degrees(0.5),
        offset=offset, x_centre=24.3, y_centre=19.6, top_hat=top_hat,
    )  # fmt: skip
    flat = np.full((40, 50), offset)
    _, information, _, _ = score_spot(flat, theta, LIKELIHOOD, build_reading_law(sensor), top_hat)
    want = np.sqrt(np.diag(np.linalg.inv(information)))
    got = [bounds.amplitude, bounds.x_centre, bounds.y_centre, bounds.offset]
    np.testing.assert_allclose(got, want[[0, 1, 2, 6]], rtol=1e-6)


def test_bounds_of_a_round_spot_and_of_dark_current():
    """A turn means nothing; both axes are alike by symmetry; dark current is an offset of K µ_I t."""
    bounds = spot_bounds(CAMERA, (41, 41), amplitude=300, sigma_major=5)
    assert bounds.orientation == np.inf and bounds.sigma_major == pytest.approx(bounds.sigma_minor, rel=1e-9)
    near = spot_bounds(CAMERA, (41, 41), amplitude=300, sigma_major=5, sigma_minor=4.999)
    assert near.sigma_mean == pytest.approx(bounds.sigma_mean, rel=1e-3)
    warm = replace(CAMERA, dark_current_e_per_s=1e5)
    timed = spot_bounds(warm, (41, 41), amplitude=300, sigma_major=5, exposure_s=1e-2)
    assert timed == spot_bounds(CAMERA, (41, 41), amplitude=300, sigma_major=5, offset=20 + 0.11 * 1000)
    assert timed.sigma_mean > bounds.sigma_mean


def test_no_bound_where_nothing_is_told():
    """A spot beside the image, and one of which every pixel is at full scale."""
    for options in ({"x_centre": 500.0}, {"offset": 3000.0}):
        bounds = spot_bounds(CAMERA, (41, 41), amplitude=300, sigma_major=5, **options)
        assert np.isinf(bounds).all()


BAD_BOUNDS = {
    "amplitude": ({"amplitude": 0}, "amplitude: is 0; it must be a number above 0"),
    "width": ({"sigma_major": np.nan}, "sigma_major: is nan; it must be a number above 0"),
    "axes": ({"sigma_minor": 9.0}, "sigma_minor: is 9.0, longer than sigma_major, 5.0; exchange the two"),
    "shape": ({"shape": (0, 5)}, "shape: is (0, 5); it must be the rows and columns of an image"),
}


@pytest.mark.parametrize(("wrong", "words"), BAD_BOUNDS.values(), ids=BAD_BOUNDS)
def test_a_design_that_means_nothing(wrong, words):
    with pytest.raises(ValueError) as error:
        spot_bounds(CAMERA, **({"shape": (9, 9), "amplitude": 300.0, "sigma_major": 5.0} | wrong))
    assert str(error.value) == words
