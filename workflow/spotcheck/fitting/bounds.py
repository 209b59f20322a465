"""The bounds stage: Cramér–Rao bounds of {µ_p,max, σ_g} over exposure and over photons (Section 4.4, Fig. 13)."""

import numpy as np
import xarray as xr

from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting import fisher
from spotcheck.fitting.calibration import read_width_law
from spotcheck.fitting.variables import add_variable
from spotcheck.fitting.width_law import WidthLaw
from spotcheck.io import progress
from spotcheck.model import spot
from spotcheck.model.baseline import Baseline, of_instrument
from spotcheck.sensor import SensorModel
from spotcheck.sensor.model import mean_signal

DENSITIES = {
    "poisson_gauss": "electrons with read noise (Eq. 30)",
    "poisson": "electrons alone (Eq. 31)",
    "dn": "the paper's: a mean in DN put into the Poisson law of Eq. 31",
}
# Points of a curve over exposure time or photons.
POINTS = 41
# Factor by which curves extend below the shortest and above the longest exposure, and decades of the photon axis.
EXPOSURE_MARGIN, PHOTON_DECADES = 4.0, 3.0
# Curves leave exposures out at which σ_g is smaller [px]: pixels no longer sample such a spot.
NARROWEST_PX = 1.0


def compute_peak_bounds(
    peak_photons: float, sigma_px: float, exposure_s: float, sensor: SensorModel, side: int
) -> np.ndarray:
    """Return bounds [density, (Var µ_p,max, Var σ_g)] in photons² and px² for a centred Gaussian.

    The image has side × side pixels; the densities are those of `DENSITIES`.
    """
    pixel = np.arange(side, dtype=float) - side // 2
    dark_e = sensor.dark_current_e_per_s * exposure_s

    def mean_e(peak, sigma):
        photons = spot.circular_gaussian(pixel[None, :], pixel[:, None], peak, 0.0, 0.0, sigma)
        return mean_signal(photons, dark_e, 1.0, sensor.quantum_efficiency)

    # Without dark current far pixels expect no electron at all, and 1/ν is infinite there.
    pixel_informations = (
        lambda mean: fisher.read_noise_information(np.maximum(mean, 1e-12), sensor.read_noise_e),
        lambda mean: fisher.poisson_information(np.maximum(mean, 1e-12)),
        lambda mean: sensor.gain_dn_per_e * fisher.poisson_information(np.maximum(mean, 1e-12)),
    )
    matrices = (
        fisher.information_of_mean(mean_e, (peak_photons, sigma_px), information) for information in pixel_informations
    )
    return np.array([fisher.cramer_rao_bounds(matrix) for matrix in matrices])


def compute_bounds(
    calibration: xr.Dataset, instrument: Instrument, exposures: np.ndarray, sensor: SensorModel | None, side: int
) -> xr.Dataset:
    """Return bounds.nc; only the attribute `skipped` with the reason without a calibration or a sensor.

    Parameters
    ----------
    calibration : calibration.nc of the dataset.
    instrument : optics, laser and photon budget.
    exposures : exposure times of the dataset [s].
    sensor : model of the sensor; None if gain or read noise is unknown.
    side : rows and columns of the image [px].
    """
    ds = xr.Dataset(attrs={name: calibration.attrs[name] for name in ("title", "dataset")})
    if "skipped" in calibration.attrs:
        return ds.assign_attrs(skipped=calibration.attrs["skipped"])
    if sensor is None:
        return ds.assign_attrs(skipped="bounds need gain and read noise of the sensor")
    law = read_width_law(calibration)
    if law is None:
        return ds.assign_attrs(skipped="bounds need a peak that is not at full scale")
    baseline = of_instrument(instrument, exposures)
    fine, middle = sample_exposures(baseline, law, exposures), float(np.median(exposures))
    photons_per_dn = sensor.gain_dn_per_e * sensor.quantum_efficiency

    def spot_at(exposure_s: float) -> tuple[float, float]:
        """Photons on the brightest pixel, and σ_g [px]."""
        peak, sigma = law.spot_at(baseline, exposure_s)
        return float(peak / photons_per_dn), float(sigma)

    spots = [spot_at(t) for t in fine]
    middle_photons, middle_sigma = spot_at(middle)
    photons = middle_photons * np.logspace(-PHOTON_DECADES / 2, PHOTON_DECADES / 2, POINTS)
    densities = np.array(list(DENSITIES), dtype=object)
    add_variable(ds, "law", "law", densities, "1", "density that the information is of")
    add_variable(ds, "fine_exposure", "fine_exposure", fine, "s", "exposure time")
    add_variable(ds, "photons", "photons", photons, "1", "photons on the brightest pixel")
    cases = [(*values, float(t)) for values, t in zip(spots, fine, strict=True)]
    cases += [(float(n), middle_sigma, middle) for n in photons]
    variances = np.array(
        [compute_peak_bounds(n, sigma, t, sensor, side) for n, sigma, t in progress.track(cases, "computing bounds")]
    )
    curves = (("exposure", "fine_exposure", variances[: len(fine)]), ("photons", "photons", variances[len(fine) :]))
    for suffix, dim, values in curves:
        for k, (parameter, units, symbol) in enumerate((("peak", "1", "mu_p,max"), ("sigma", "pixel2", "sigma_g"))):
            name = f"var_{parameter}_over_{suffix}"
            add_variable(ds, name, (dim, "law"), values[..., k], units, f"bound on the variance of {symbol}")
    peaks = np.array([n for n, _ in spots])
    add_variable(ds, "peak_photons", "fine_exposure", peaks, "1", "photons on the brightest pixel at each exposure")
    add_variable(ds, "pixel_pitch", (), instrument.sensor.pixel_pitch_m or np.nan, "m", "pixel pitch")
    return ds.assign_attrs({f"law_{name}": text for name, text in DENSITIES.items()})


def sample_exposures(baseline: Baseline, law: WidthLaw, exposures: np.ndarray) -> np.ndarray:
    """Return exposure times [s] for curves, evenly spaced in ln t around those of the dataset."""
    fine = np.geomspace(exposures.min() / EXPOSURE_MARGIN, exposures.max() * EXPOSURE_MARGIN, POINTS)
    return fine[law.spot_at(baseline, fine)[1] > NARROWEST_PX]
