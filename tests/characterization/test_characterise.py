"""A sensor by flats and darks, from arrays and from a folder, beside the package of the standard."""

import re

import numpy as np
import pytest
import xarray as xr

from spotcheck.characterization.characterise import characterise_dataset, characterise_sensor
from spotcheck.cli import main
from spotcheck.errors import InputError
from spotcheck.io import store
from tests.samples.example_datasets import levels


def test_arrays_and_folder_give_the_same_sensor(there):
    """To rounding: the same frames, level by level."""
    bright, dark, exposures, photons = levels()
    found = characterise_sensor(bright, list(dark), exposures, photons, bit_depth=12)
    other = characterise_dataset("my-flats")
    assert list(found) == list(other) and len(found) == 26
    for name, own in found.items():
        again = other[name]
        assert (own.name, own.symbol, own.unit, own.why) == (name, again.symbol, again.unit, again.why)
        assert (own.value, own.stderr) == pytest.approx((again.value, again.stderr), rel=1e-12, nan_ok=True), name


def test_a_sensor_without_photons_and_one_exposure():
    """What is not given stays unknown, with the reason; one exposure serves all levels, and fewer darks."""
    bright, dark, _, _ = levels()
    found = characterise_sensor(bright, dark[:1], 1e-3, bit_depth=12)
    assert found["quantum_efficiency"].why == "photons_per_px is not given for the flats"
    assert np.isnan(found["dark_current"].value) and str(found["dark_current"]) == (
        "μ_I is unknown: fewer than three exposures of darks"
    )
    # 0.3 DN/e- within four standard errors.
    assert abs(found["gain"].value - 0.3) < 4 * found["gain"].stderr


def test_characterisation_in_print_and_as_a_dataset(there, tmp_path):
    """A line a quantity, with symbol and unit or reason; the content of transfer.nc."""
    found = characterise_dataset("my-flats")
    lines = repr(found).splitlines()
    assert lines[0] == "EMVA 1288 of my flats: 20 levels of light, 20 dark levels" and len(lines) == 27
    assert re.fullmatch(r"gain +K +0\.\d{3,4} ± 0\.00\d{1,2} DN/e-", lines[1])
    ds = store.check(found.to_dataset(), "transfer.nc")
    assert float(ds["value"].sel(quantity="gain")) == found["gain"].value
    main(["ingest", "my-flats", "--output", str(tmp_path / "frames.nc")])
    main(["transfer", "my-flats", "--frames", str(tmp_path / "frames.nc"), "--output", str(tmp_path / "transfer.nc")])
    with store.read(tmp_path / "transfer.nc") as written:
        for name in ds.variables:
            xr.testing.assert_equal(ds[name], written[name])
    with pytest.raises(KeyError):
        _ = found["gian"]


NINE = np.zeros((3, 2, 4, 4))
SHAPE = "dark: level 0 has the shape (4, 4); it must be [frame, row, column] with two frames"
BAD_LEVELS = {
    "no level": ({"bright": []}, "bright: holds no level; give at least one pair of frames"),
    "image": ({"dark": [NINE[0, 0]]}, SHAPE),
    "single": ({"bright": NINE[:, :1]}, "bright: level 0 has a single frame, and noise needs two of one light"),
    "sizes": ({"dark": NINE[..., :3]}, "bright, dark: have frames of 4 × 3 and 4 × 4 pixels; all must have one size"),
    "NaN": ({"dark": NINE * np.nan}, "dark: level 0 holds NaN or infinity; every pixel must have a reading"),
    "bits": ({"bright": NINE + 300}, "bright: level 0 holds 300 DN, above the 255 of bit_depth; correct it"),
    "depth": ({"bit_depth": 0}, "bit_depth: is 0; it must be from 1 to 16"),
    "exposures": (
        {"exposure_s": [1e-3, 2e-3]},
        "exposure_s: has the shape (2,), but bright has 3 levels; give one number a level",
    ),
    "photons": ({"photons": [1, 2]}, "photons: has the shape (2,), but bright has 3 levels; give one number a level"),
    "negative": ({"photons": [1, 2, -3]}, "photons: holds a number that is not finite, or below 0"),
    "darks": (
        {"exposure_s": [1e-3, 2e-3, 3e-3], "dark": NINE[:2]},
        "dark_exposure_s: is missing, and dark has 2 levels where bright has 3; give the exposure of every dark level",
    ),
}


@pytest.mark.parametrize(("wrong", "words"), BAD_LEVELS.values(), ids=BAD_LEVELS)
def test_levels_that_cannot_be_used(wrong, words):
    with pytest.raises(ValueError) as error:
        characterise_sensor(**({"bright": NINE, "dark": NINE, "exposure_s": 1e-3, "bit_depth": 8} | wrong))
    assert str(error.value) == words


def test_a_folder_without_flats(there):
    with pytest.raises(InputError, match=r"manifest\.csv: has no frame of kind flat or dark"):
        characterise_dataset("my-frames")
