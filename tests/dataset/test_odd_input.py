"""Odd datasets that pass the checks: each is read as what it says, or the result says why it is empty."""

from dataclasses import replace

import numpy as np
import pytest

from spotcheck.crops.cropping import crop_spots
from spotcheck.crops.ingest import ingest_frames
from spotcheck.fitting.calibration import calibrate
from spotcheck.fitting.crop_fits import fit_crops
from spotcheck.io.store import read
from spotcheck.sensor import ReadingDistribution
from tests.samples.small_datasets import SENSOR, gaussian, loaded, noisy


def test_extra_columns_may_be_called_anything(tmp_path):
    """Names that netCDF refuses or that the table uses itself."""
    ds = loaded(tmp_path, [np.zeros((40, 40), np.uint16)], "crop_px: 24")
    names = ("maximum", "a/b", "frame", "my temp", "9", "x" * 400)
    table = ingest_frames(replace(ds, frames=(replace(ds.frames[0], extra=dict.fromkeys(names, "q")),)))
    assert int(table["maximum"][0]) == 0
    assert sum(v.attrs["long_name"].startswith("column ") for v in table.coords.values()) == len(names)


def test_expected_maximum_of_a_saturated_frame():
    """Full scale, although no pixel has any variance left."""
    assert ReadingDistribution(SENSOR, 1e-4).expected_maximum(np.full((9, 9), 1e5)) == pytest.approx(
        SENSOR.full_scale_dn, abs=1
    )


def test_no_site_at_two_exposures(tmp_path):
    """Three exposures, each at a site of its own: no law can be fitted, and the reason is given."""
    light = gaussian(60, 500.0, 30, 30, 4.0)
    ds = loaded(tmp_path, [noisy(light, k) for k in range(2)], "crop_px: 40\nsensor: {bit_depth: 10}", [1e-4, 5e-4])
    ds = replace(ds, frames=tuple(replace(frame, repeat=k) for k, frame in enumerate(ds.frames)))
    crop_spots(ds, ingest_frames(ds), tmp_path / "crops.nc", code="c", inputs=[])
    own = read(tmp_path / "crops.nc").load()
    found = calibrate(own, fit_crops(own, SENSOR), ds.instrument, SENSOR)
    assert "one site at two exposures" in found.attrs["skipped"]
