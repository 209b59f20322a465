"""The bounds stage: Cramér–Rao bounds of {µ_p,max, σ_g} over exposure and over photons (Section 4.4, Fig. 13).

µ_p,max is the number of photons on the brightest pixel of a spot, σ_g [px] the width of its Gaussian. The width law
(`WidthLaw`) gives σ_g and the peak of a spot over the exposure time; the baseline (`Baseline`) is the model of the
light that the instrument file declares.
"""

import numpy as np
import xarray as xr

from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting import fisher
from spotcheck.fitting.calibration import read_width_law
from spotcheck.fitting.variables import add_variable
from spotcheck.fitting.width_law import WidthLaw
from spotcheck.io import progress
from spotcheck.model import spot
from spotcheck.model.baseline import Baseline, build_baseline, jacobian
from spotcheck.sensor import SensorModel
from spotcheck.sensor.model import mean_signal

# Densities of a reading under which bounds are computed; the dimension `law` of bounds.nc.
DENSITIES = {
    "poisson_gauss": "electrons with read noise (Eq. 30)",
    "poisson": "electrons alone (Eq. 31)",
    "dn": "the paper's: a mean in DN put into the Poisson law of Eq. 31",
}
# Parameters of a bound: name in the variables of bounds.nc, units of its variance, symbol.
BOUND_PARAMETERS = (("peak", "1", "mu_p,max"), ("sigma", "pixel2", "sigma_g"))
# Points of a curve over exposure time or photons.
POINTS = 41
# Factor by which curves extend below the shortest and above the longest exposure, and decades of the photon axis.
EXPOSURE_MARGIN, PHOTON_DECADES = 4.0, 3.0
# Curves leave exposures out at which σ_g is smaller [px]: pixels no longer sample such a spot.
NARROWEST_PX = 1.0
# Least mean of a pixel [e-]. Without dark current, pixels far from the spot expect no electron, and 1/ν is infinite.
LEAST_MEAN_E = 1e-12


def compute_peak_bounds(
    peak_photons: float, sigma_px: float, exposure_s: float, sensor: SensorModel, side: int
) -> np.ndarray:
    """Return bounds [density, (Var µ_p,max, Var σ_g)] in photons² and px² for one image of a centred Gaussian.

    Parameters
    ----------
    peak_photons : photons on the brightest pixel, µ_p,max.
    sigma_px : width σ_g of the Gaussian [px].
    exposure_s : exposure time [s], for dark current alone.
    sensor : gain, read noise, dark current and quantum efficiency.
    side : rows and columns of the image [px].

    Returns
    -------
    np.ndarray
        One row for each of `DENSITIES`.
    """
    pixel = np.arange(side, dtype=float) - side // 2
    dark_e = sensor.dark_current_e_per_s * exposure_s

    def mean_e(peak, sigma):
        """Return the mean electrons [row, column] for a peak [photons] and a width [px]."""
        photons = spot.circular_gaussian(pixel[None, :], pixel[:, None], peak, 0.0, 0.0, sigma)
        return mean_signal(photons, dark_e, 1.0, sensor.quantum_efficiency)

    mean = np.maximum(mean_e(peak_photons, sigma_px), LEAST_MEAN_E)
    slopes = jacobian(mean_e, (peak_photons, sigma_px))
    poisson_information = fisher.poisson_information(mean)
    # Information of a pixel on its mean electrons [1/e-²], in the order of `DENSITIES`. The paper takes the mean in DN
    # for the mean of a Poisson distribution, which gives K times the information.
    informations = (
        fisher.read_noise_information(mean, sensor.read_noise_e),
        poisson_information,
        sensor.gain_dn_per_e * poisson_information,
    )
    return np.array([fisher.cramer_rao_bounds(fisher.information(slopes, values)) for values in informations])


def compute_bounds(
    calibration: xr.Dataset, instrument: Instrument, exposures: np.ndarray, sensor: SensorModel | None, side: int
) -> xr.Dataset:
    """Compute bounds.nc: bounds over the exposure time, and over the photons at the median exposure.

    Parameters
    ----------
    calibration : calibration.nc of the dataset.
    instrument : optics, laser and photon budget.
    exposures : exposure times of the dataset [exposure] in s.
    sensor : model of the sensor; None if gain or read noise is unknown.
    side : rows and columns of the image [px].

    Returns
    -------
    xr.Dataset
        Content of bounds.nc. Without a width law or a sensor it has only the attribute `skipped` with the reason.
    """
    ds = xr.Dataset(attrs={name: calibration.attrs[name] for name in ("title", "dataset")})
    if "skipped" in calibration.attrs:
        return ds.assign_attrs(skipped=calibration.attrs["skipped"])
    if sensor is None:
        return ds.assign_attrs(skipped="bounds need gain and read noise of the sensor")
    law = read_width_law(calibration)
    if law is None:
        return ds.assign_attrs(skipped="bounds need a peak that is not at full scale")
    baseline = build_baseline(instrument, exposures)
    curve_exposures, median_exposure = sample_exposures(baseline, law, exposures), float(np.median(exposures))
    dn_per_photon = sensor.gain_dn_per_e * sensor.quantum_efficiency
    peaks, sigmas = law.spot_at(baseline, curve_exposures)
    peak_photons = peaks / dn_per_photon
    median_peak, median_sigma = law.spot_at(baseline, median_exposure)
    photons = median_peak / dn_per_photon * np.logspace(-PHOTON_DECADES / 2, PHOTON_DECADES / 2, POINTS)
    add_variable(
        ds, "law", "law", np.array([*DENSITIES], dtype=object), "1", "density of a reading under which the bound holds"
    )
    add_variable(ds, "fine_exposure", "fine_exposure", curve_exposures, "s", "exposure time")
    add_variable(ds, "photons", "photons", photons, "1", "photons on the brightest pixel")
    # Photons, σ_g [px] and exposure time [s] of the points of both curves.
    points = [*zip(peak_photons, sigmas, curve_exposures, strict=True)]
    points += [(n, median_sigma, median_exposure) for n in photons]
    variances = np.array(
        [compute_peak_bounds(n, sigma, t, sensor, side) for n, sigma, t in progress.track(points, "computing bounds")]
    )
    over_exposure, over_photons = np.split(variances, [len(curve_exposures)])
    curves = (("exposure", "fine_exposure", over_exposure), ("photons", "photons", over_photons))
    for suffix, dim, values in curves:
        for k, (parameter, units, symbol) in enumerate(BOUND_PARAMETERS):
            name = f"var_{parameter}_over_{suffix}"
            add_variable(ds, name, (dim, "law"), values[..., k], units, f"bound on the variance of {symbol}")
    long_name = "photons on the brightest pixel at each exposure"
    add_variable(ds, "peak_photons", "fine_exposure", peak_photons, "1", long_name)
    add_variable(ds, "pixel_pitch", (), instrument.sensor.pixel_pitch_m or np.nan, "m", "pixel pitch")
    return ds.assign_attrs({f"law_{name}": text for name, text in DENSITIES.items()})


def sample_exposures(baseline: Baseline, law: WidthLaw, exposures: np.ndarray) -> np.ndarray:
    """Return the exposure times [point] in s at which curves over exposure are computed.

    `POINTS` times are evenly spaced in ln t, from the shortest of `exposures` [s] divided by `EXPOSURE_MARGIN` to the
    longest times it. Times at which σ_g is `NARROWEST_PX` or less are left out.
    """
    times = np.geomspace(exposures.min() / EXPOSURE_MARGIN, exposures.max() * EXPOSURE_MARGIN, POINTS)
    _, sigma = law.spot_at(baseline, times)
    return times[sigma > NARROWEST_PX]
