"""The simulated folder, the metrics of both sources, and the template of a new dataset."""

import numpy as np
import pytest
import xarray as xr

from spotcheck.crops.cropping import CENTRINGS, crop_spots
from spotcheck.crops.ingest import check_dataset, ingest_frames
from spotcheck.dataset import folder as dataset
from spotcheck.dataset import frames, template
from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting.crop_fits import FITS, fit_crops
from spotcheck.fitting.spot_states import list_spot_states
from spotcheck.io import store
from spotcheck.metrics import crop_metrics as metrics
from spotcheck.metrics.metrics_table import SOURCES, compute_metrics
from spotcheck.model import simulation
from tests.samples.small_datasets import SENSOR, gaussian, loaded, noisy

SKIPPED = xr.Dataset(attrs={"skipped": "why"})

EXPOSURES = (1e-4, 5e-4, 9e-4)
TEXT = "crop_px: 48\nsensor: {bit_depth: 10, black_level_dn: 40}\nmodel: {photon_budget: linear}\n"


def calibration(p1=0.6, p2=10.0, peak=700.0) -> xr.Dataset:
    """A calibration file with one estimator."""
    ds = xr.Dataset({"estimator": ("estimator", np.array(["regression"], dtype=object))})
    for name, value in (("p1_mean", p1), ("p2_mean", p2), ("peak", peak)):
        ds[name] = ("estimator", [value])
    return ds.assign_attrs(used="regression")


def own_fits(ds, amplitude, sigma) -> xr.Dataset:
    """A fits file with the same amplitude and width in every cell of the fit that it prefers."""
    dims = ("angle", "exposure", "repeat", "centring", "fit")
    out = xr.Dataset({"centring": ("centring", np.array(CENTRINGS, dtype=object))})
    out["fit"] = ("fit", np.array(list(FITS), dtype=object))
    for name, value, other in (("amplitude", amplitude, -1.0), ("sigma_mean", sigma, -1.0), ("status", 0, 64)):
        out[name] = (dims, np.stack([np.full((*ds.shape, 2), v) for v in (value, other)], axis=-1))
    return out.assign_attrs(preferred=next(iter(FITS)))


FULL_SCALE = 1023


def simulate(ds, law, fits, sensor, base, seed=3) -> xr.Dataset:
    """Run the stage; the folder is `base`, and what comes back is the file of mean images, checked on reading."""
    states = list_spot_states(ds, law, fits)
    path = base.with_suffix(".nc")
    simulation.simulate(ds, states, sensor, FULL_SCALE, simulation.Destination(base, path, seed, "c", []), {})
    with store.read(path) as out:
        return out.load()


def three(base, instrument=TEXT):
    """One site at three exposures."""
    return loaded(base, [np.zeros((100, 100), np.uint16)] * 3, instrument, list(EXPOSURES))


def test_the_simulated_folder_keeps_the_contract(tmp_path):
    """The same design, loadable and checkable; means are the model's, peaks follow t/σ²."""
    ds = three(tmp_path / "in")
    out = simulate(ds, calibration(), own_fits(ds, 1, 1), SENSOR, tmp_path / "out")
    again = dataset.load(tmp_path / "out")
    check_dataset(again)
    assert [(f.angle_deg, f.exposure_s, f.repeat) for f in again.frames] == [(0.0, t, 0) for t in EXPOSURES]
    t = np.array(EXPOSURES)
    sigma = 0.6 * np.log(t) + 10.0
    np.testing.assert_allclose(out["sigma"].values.ravel(), sigma, rtol=1e-12)
    peak = 700 * (t / sigma**2) / (t / sigma**2)[-1]
    np.testing.assert_allclose(out["amplitude"].values.ravel(), peak, rtol=1e-12)
    # Stored as float32: seven digits.
    want = gaussian(48, peak[1], 24, 24, sigma[1])
    np.testing.assert_allclose(out["mean_light"].values[0, 1, 0], want, rtol=1e-6, atol=1e-20)
    assert out.attrs["noise"] == "drawn"


def test_simulated_frames_scatter_about_their_mean(tmp_path):
    """Sum over a frame: within five standard errors of light plus black level (false alarm 6e-7)."""
    ds = three(tmp_path / "in")
    out = simulate(ds, calibration(), own_fits(ds, 1, 1), SENSOR, tmp_path / "out")
    again = dataset.load(tmp_path / "out")
    for (index, row), amplitude, sigma in zip(
        again.cells(), out["amplitude"].values.ravel(), out["sigma"].values.ravel(), strict=True
    ):
        pixels = frames.read_image(again, row)
        light = 2 * np.pi * sigma**2 * amplitude + pixels.size * 0.11 * 70 * row.exposure_s
        variance = 0.11 * light + pixels.size * (0.11**2 * 169 + 1 / 12)
        assert pixels.sum() == pytest.approx(light + 40 * pixels.size, abs=5 * np.sqrt(variance)), index


@pytest.mark.parametrize("amplitude", [300.0, np.nan])
def test_without_a_law_each_frame_has_its_own_spot(tmp_path, amplitude):
    """A skipped calibration, no sensor: rounded mean images of each frame's fit; a frame without a fit stays dark."""
    ds = loaded(tmp_path / "in", [np.zeros((60, 60), np.uint16)], "crop_px: 24")
    out = simulate(ds, SKIPPED, own_fits(ds, amplitude, 4.0), None, tmp_path / "out")
    want = np.zeros((48, 48)) if np.isnan(amplitude) else gaussian(48, 300.0, 24, 24, 4.0)
    again = dataset.load(tmp_path / "out")
    np.testing.assert_array_equal(frames.read_image(again, again.frames[0]), np.rint(want))
    assert out.attrs["noise"].startswith("none")


def test_a_frame_whose_fit_is_a_dip(tmp_path):
    """Flagged at_limit, yet finite: it must not stop the stage."""
    ds = loaded(tmp_path / "in", [np.zeros((60, 60), np.uint16)], "crop_px: 24")
    simulate(ds, SKIPPED, own_fits(ds, -20.0, 4.0), SENSOR, tmp_path / "out")


def cropped(base, images):
    """Crops and fits of one angle and time, repeats counting up."""
    ds = loaded(base / "in", images, "crop_px: 48\nsensor: {bit_depth: 10}")
    crop_spots(ds, ingest_frames(ds), base / "crops.nc", code="c", inputs=[])
    own = store.read_whole(base / "crops.nc")
    return own, fit_crops(own, SENSOR)


def test_metrics_by_hand(tmp_path):
    """Metrics of each crop, PSNR of the crops at the maximum, means and standard deviations (n − 1) over repeats."""
    both = {}
    for k, source in enumerate(SOURCES):
        images = [noisy(gaussian(100, 500.0 + 30 * k, 50 + 0.3 * r, 48, 6.0), 10 * k + r) for r in range(3)]
        images[2] = np.full((100, 100), 40, np.uint16) if k == 0 else images[2]
        both[source] = cropped(tmp_path / source, images)
    own, fits = ({s: both[s][k] for s in both} for k in range(2))
    out = compute_metrics(own, fits, 1023.0)
    store.check(out, "metrics")
    at = {"angle": 0, "exposure": 0}
    for source in SOURCES:
        image = own[source]["image"].isel(repeat=0, **at).sel(centring="light").values.astype(float)
        got = out.sel(source=source, centring="light").isel(repeat=0, **at)
        assert float(got["sum"]) == pytest.approx(image.sum(), rel=1e-12)
        assert float(got["maximum"]) == image.max()
        # The crop is in single precision, 6e-8, and so are its deviations from the mean.
        assert float(got["speckle_contrast"]) == pytest.approx(image.std() / image.mean(), rel=1e-6)
        own_fit = fits[source]["amplitude"].isel(repeat=0, centring=0, **at)
        assert got["amplitude"].dims == ("fit",) and list(got["fit"].values) == list(FITS)
        np.testing.assert_array_equal(got["amplitude"], own_fit)
    crop = [own[s]["image"].isel(repeat=0, **at).sel(centring="maximum").values.astype(float) for s in own]
    want = 20 * np.log10(65535 / np.sqrt(np.mean((crop[0] - crop[1]) ** 2)))
    got = out["psnr"].isel(repeat=0, **at)
    assert float(got.sel(registration="maximum", data_range="container")) == pytest.approx(want, rel=1e-6)
    gap = got.sel(data_range="container") - got.sel(data_range="sensor")
    np.testing.assert_allclose(gap, 20 * np.log10(65535 / 1023), rtol=1e-9)
    # The frame without light has no metric, and the averages go over the other two.
    values = out["maximum"].sel(source="measured", centring="light").values.ravel()
    assert np.isnan(values[2])
    own_mean = out["maximum_mean"].sel(source="measured", centring="light").squeeze()
    assert float(own_mean) == pytest.approx(values[:2].mean(), rel=1e-12)
    own_sd = out["maximum_sd"].sel(source="measured", centring="light").squeeze()
    assert float(own_sd) == pytest.approx(abs(values[0] - values[1]) / np.sqrt(2), rel=1e-9)


def test_registration_brings_both_centres_together(tmp_path):
    """Two noise-free spots 0.4 px apart: registered they differ by rounding alone, at the maximum they do not."""
    images = [np.rint(40 + gaussian(100, 800.0, 50 + d, 48 - d, 6.0)).astype(np.uint16) for d in (0.0, 0.4)]
    own, fits = {}, {}
    for source, image in zip(SOURCES, images, strict=True):
        own[source], fits[source] = cropped(tmp_path / source, [image])
    got = compute_metrics(own, fits, 1023.0)["psnr"].sel(data_range="sensor").values.ravel()
    # Rounding of both images leaves √(2/12) DN at the least, splines and centres as much again: 0.8 DN is 62 dB.
    assert got[1] > 20 * np.log10(1023 / 0.8) > got[0] + 10
    assert metrics.CONTAINER_RANGE == 65535


def test_the_template_passes_its_own_checks(tmp_path):
    """An example row; every key of the schema as a comment."""
    template.write_template(tmp_path / "empty")
    ds = dataset.load(tmp_path / "empty")
    assert ds.instrument == Instrument() and len(ds.frames) == 1
    text = (tmp_path / "empty" / "instrument.yaml").read_text()
    for key in ("gain_dn_per_e", "photon_budget", "conditions", "fwhm_y_m"):
        assert key in text
