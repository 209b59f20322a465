"""What a spot fit returns: parameters by name, status, one spot or many, in print and as a dataset."""

import re
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from spotcheck.fitting.fit_results import SpotFits
from spotcheck.fitting.spotfit import fit_spots
from spotcheck.io import store
from tests.samples.example_datasets import CAMERA
from tests.samples.small_datasets import noisy


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    """Twelve oblong spots."""
    y, x = np.mgrid[:40, :50]
    light = 500 * np.exp(-(((x - 24.3) / 6) ** 2 + ((y - 20.2) / 4) ** 2) / 2)
    return [noisy(light, seed, CAMERA) for seed in range(12)]


@pytest.fixture(scope="module")
def fits(images) -> SpotFits:
    """Their fits, and one of an image without a spot."""
    return fit_spots([*images, np.full((40, 50), 20.0)], CAMERA)


def test_parameters_by_name(fits):
    """Columns of the two arrays; variances are the diagonal of the covariance, in the same units."""
    for k, name in enumerate(fits.parameters):
        assert np.array_equal(getattr(fits, name), fits.value[:, k], equal_nan=True)
        assert np.array_equal(getattr(fits, f"{name}_stderr"), fits.stderr[:, k], equal_nan=True)
        assert {name, f"{name}_stderr"} <= set(dir(fits))
    for name in fits.parameters[:7]:
        variance = getattr(fits, f"{name}_stderr") ** 2
        np.testing.assert_allclose(fits.covariance_of(name, name), variance, rtol=1e-12)
    assert np.array_equal(fits.covariance_of("offset", "amplitude"), fits.covariance[:, 6, 0], equal_nan=True)
    np.testing.assert_allclose(fits.sigma_major[:12], 6, rtol=0.02)
    with pytest.raises(AttributeError, match="no attribute 'sigma'; the parameters are amplitude, x_centre"):
        _ = fits.sigma


def test_status_by_name_and_as_flags(fits):
    """The names are those of the files' flags."""
    assert fits.status.tolist() == ["ok"] * 12 + ["not_converged"]
    assert fits.flags.tolist() == [0] * 12 + [store.flag("not_converged")]
    assert store.status_names([0, 32 | 16, 64]).tolist() == ["ok", "clipped not_converged", "at_limit"]


def test_some_spots_of_many(fits):
    """By mask, by slice, one by one."""
    good = fits[fits.status == "ok"]
    assert (len(fits), len(good), len(fits[2:4])) == (13, 12, 2) and np.isfinite(good.value).all()
    assert [own.amplitude for own in fits[:3]] == fits.amplitude[:3].tolist()
    one = fits[1]
    assert one.x_centre == fits.x_centre[1] and one.status == "ok" and bool(one)
    for use, words in ((len, "a single spot has no length"), (lambda own: own[0], "a single spot has no index")):
        with pytest.raises(TypeError, match=words):
            use(one)


def test_a_single_image_gives_a_single_spot(images, fits):
    """The very numbers of the first of many, whatever holds the image."""
    for image in (images[0], xr.DataArray(images[0].astype("f4")), images[0].astype(float)):
        one = fit_spots(image, CAMERA)
        assert one.amplitude.shape == () and np.array_equal(one.value, fits.value[0])
    stack = fit_spots(np.stack(images), CAMERA)
    assert np.array_equal(stack.value, fits.value[:12])


def test_masked_pixels_are_left_out(images):
    """A mask is NaN."""
    hole = np.zeros(images[0].shape, bool)
    hole[18:22, 20:25] = True
    want = fit_spots(np.where(hole, np.nan, images[0]), CAMERA)
    for masked in (np.ma.array(images[0], mask=hole), [np.ma.array(images[0], mask=hole)]):
        assert np.array_equal(np.ravel(fit_spots(masked, CAMERA).value), want.value)


BAD_FITS = {
    "row": ([np.zeros(5)], {}, "images: number 0 has the shape (5,); each must be"),
    "cube": (np.zeros((2, 2, 3, 3)), {}, "images: number 0 has the shape (2, 3, 3)"),
    "gain": ([], {"gain_dn_per_e": 0}, "sensor: gain_dn_per_e is 0; it must be"),
    "noise": ([], {"read_noise_e": np.nan}, "sensor: read_noise_e is nan; it"),
}


@pytest.mark.parametrize(("images", "change", "words"), BAD_FITS.values(), ids=BAD_FITS)
def test_what_cannot_be_fitted_is_said(images, change, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        fit_spots(images, replace(CAMERA, **change))


@pytest.mark.parametrize("which", [slice(None), 0, slice(0, 0)], ids=["many", "one", "none"])
def test_fits_as_a_dataset(fits, which, tmp_path):
    """It keeps the contract of every file, and comes back from one; flags with their meanings."""
    own = fits[which]
    store.write(own.to_dataset(), tmp_path / "fits.nc", code="c")
    with store.read(tmp_path / "fits.nc") as ds:
        assert ds["sigma_mean"].attrs["units"] == "pixel" and ds["sigma_mean"].dims == ("spot",)[: np.ndim(own.flags)]
        assert np.array_equal(ds["sigma_mean_stderr"], own.sigma_mean_stderr, equal_nan=True)
        assert np.array_equal(ds["status"], own.flags) and "not_converged" in ds["status"].attrs["flag_meanings"]
        pair = ds["covariance"].sel(parameter="amplitude", other_parameter="offset")
        assert np.array_equal(pair, own.covariance_of("amplitude", "offset"), equal_nan=True)


def test_fits_in_print(fits):
    """How many ended how, a line a spot, at most ten; of a single one a line a parameter, with unit."""
    lines = repr(fits).splitlines()
    assert lines[0] == "13 fitted spots: 1 not_converged, 12 ok" and len(lines) == 14 and lines[-1] == "…"
    assert len({len(line) for line in lines[3:-1]}) == 1 and lines[3].endswith("ok")
    assert repr(fits[:0]) == "0 fitted spots"
    sheet = repr(fits[0]).splitlines()
    assert len(sheet) == 9 and re.fullmatch(r"sigma_mean +\d\.\d{3,4} ± 0\.00\d{1,2} pixel", sheet[-1])
    assert "no value" in repr(fits[12])
