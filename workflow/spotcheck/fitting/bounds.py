"""The bounds stage: Cramér–Rao bounds of {µ_p,max, σ_g} over exposure and over photons (Section 4.4, Fig. 13)."""

import numpy as np
import xarray as xr

from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting import fisher
from spotcheck.fitting.calibration import USED
from spotcheck.io import progress
from spotcheck.model import spot
from spotcheck.model.baseline import Baseline, of_instrument
from spotcheck.sensor import SensorModel
from spotcheck.sensor.model import mean_signal

LAWS = {
    "poisson_gauss": "electrons with read noise (Eq. 30)",
    "poisson": "electrons alone (Eq. 31)",
    "dn": "the paper's: a mean in DN put into the Poisson law of Eq. 31",
}
POINTS = 41
# How far the figure's axes reach beyond the exposures of the dataset, and over which factor the photons run.
BEYOND, DECADES = 4.0, 3.0


def peak_bounds(peak_photons: float, sigma_px: float, exposure_s: float, sensor: SensorModel, side: int) -> np.ndarray:
    """Bounds [law, (Var µ_p,max, Var σ_g)] in photons² and px² for a centred Gaussian on side × side pixels."""
    pixel = np.arange(side, dtype=float) - side // 2
    dark_e = sensor.dark_current_e_per_s * exposure_s

    def mean_e(peak, sigma):
        photons = spot.circular_gaussian(pixel[None, :], pixel[:, None], peak, 0.0, 0.0, sigma)
        return mean_signal(photons, dark_e, 1.0, sensor.quantum_efficiency)

    # Without dark current the far pixels expect no electron at all, and then know nothing.
    laws = (
        lambda mean: fisher.read_noise_information(np.maximum(mean, 1e-12), sensor.read_noise_e),
        lambda mean: fisher.poisson_information(np.maximum(mean, 1e-12)),
        lambda mean: sensor.gain_dn_per_e * fisher.poisson_information(np.maximum(mean, 1e-12)),
    )
    matrices = (fisher.of_mean(mean_e, (peak_photons, sigma_px), law) for law in laws)
    return np.array([fisher.bounds(matrix) for matrix in matrices])


def bounds_of(
    calibration: xr.Dataset,
    instrument: Instrument,
    exposures: np.ndarray,
    sensor: SensorModel | None,
    side: int,
) -> xr.Dataset:
    """Bounds file; `skipped` with its reason where there is no calibration or no sensor."""
    ds = xr.Dataset(attrs={name: calibration.attrs[name] for name in ("title", "dataset")})
    if "skipped" in calibration.attrs:
        return ds.assign_attrs(skipped=calibration.attrs["skipped"])
    if sensor is None:
        return ds.assign_attrs(skipped="bounds need gain and read noise of the sensor")
    baseline = of_instrument(instrument, exposures)
    p1, p2, peak = (float(calibration[n].sel(estimator=USED)) for n in ("p1_mean", "p2_mean", "peak"))
    if not np.isfinite(peak):
        return ds.assign_attrs(skipped="bounds need a peak that is not at full scale")
    fine = np.geomspace(exposures.min() / BEYOND, exposures.max() * BEYOND, POINTS)
    fine = fine[baseline.sigma(fine, p1, p2) > 1.0]
    states = [_state(baseline, t, p1, p2, peak, sensor) for t in fine]
    reference = _state(baseline, float(np.median(exposures)), p1, p2, peak, sensor)
    photons = reference[0] * np.logspace(-DECADES / 2, DECADES / 2, POINTS)
    ds["law"] = (
        "law",
        np.array(list(LAWS), dtype=object),
        {"units": "1", "long_name": "density that the information is of"},
    )
    ds["fine_exposure"] = ("fine_exposure", fine, {"units": "s", "long_name": "exposure time"})
    ds["photons"] = ("photons", photons, {"units": "1", "long_name": "photons on the brightest pixel"})
    middle = float(np.median(exposures))
    asked = [(*s, float(t)) for s, t in zip(states, fine, strict=True)]
    asked += [(float(n), reference[1], middle) for n in photons]
    found = [peak_bounds(n, sigma, t, sensor, side) for n, sigma, t in progress.track(asked, "computing bounds")]
    over_exposure, over_photons = np.array(found[: len(fine)]), np.array(found[len(fine) :])
    for name, dim, values in (
        ("exposure", "fine_exposure", over_exposure),
        ("photons", "photons", over_photons),
    ):
        for k, (parameter, units) in enumerate((("peak", "1"), ("sigma", "pixel2"))):
            long_name = f"bound on the variance of {'mu_p,max' if k == 0 else 'sigma_g'}"
            ds[f"var_{parameter}_over_{name}"] = (
                (dim, "law"),
                values[..., k],
                {"units": units, "long_name": long_name},
            )
    ds["peak_photons"] = (
        "fine_exposure",
        np.array([s[0] for s in states]),
        {"units": "1", "long_name": "photons on the brightest pixel at each exposure"},
    )
    pitch = instrument.sensor.pixel_pitch_m
    ds["pixel_pitch"] = ((), pitch or np.nan, {"units": "m", "long_name": "pixel pitch"})
    return ds.assign_attrs({f"law_{name}": text for name, text in LAWS.items()})


def _state(baseline: Baseline, t: float, p1: float, p2: float, peak: float, sensor: SensorModel) -> tuple[float, float]:
    """Photons on the brightest pixel, and σ_g [px], at an exposure [s]."""
    amplitude = peak * baseline.relative_peak(t, p1, p2)
    return float(amplitude / (sensor.gain_dn_per_e * sensor.quantum_efficiency)), float(baseline.sigma(t, p1, p2))
