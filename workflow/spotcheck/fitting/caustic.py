"""The caustic of a beam: hyperbola through fitted widths at several distances, waist, divergence, M² (ISO 11146-1).

ISO 11146-1:2021, clause 9, fits d²(z) = a + b z + c z² to beam diameters d at distances z along the beam. This module
fits w²(z) with the radius w = d/2 = 2σ of a Gaussian (its 1/e² radius). Its coefficients are a quarter of those of the
standard.

# ASSUME: the fitted Gaussian stands for the beam. The standard takes second moments, which include side lobes and halo
# that a Gaussian fit leaves out: for a beam that is not Gaussian, M² from fits is too small.

A scan is a series of frames at several distances z. It has one hyperbola for each of the two axes of the beam, which
keep their direction (`beam_axes`), and one for the mean of both widths. A beam is stigmatic if both axes are equal and
astigmatic otherwise. The mean of an astigmatic beam is no hyperbola and has no M². A beam whose axes rotate along z has
no M² here; it needs the measurements of ISO 11146-2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy import optimize, stats

from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting.beam_axes import BeamAxes, SpotWidths, fit_beam_axes, project_widths
from spotcheck.fitting.beam_quality import describe_impossible_m2, list_low_axes
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.variables import add_variable
from spotcheck.io import store
from spotcheck.io.number_text import quantity_text

# Declared condition of a dataset that holds the distance along the beam [m].
CONDITION = "z_m"
# Parameters of a spot fit that `SpotWidths` holds, in its order.
WIDTH_PARAMETERS = ("sigma_major", "sigma_minor", "orientation")
# Axes of caustic.nc by name.
AXES = {
    "x": "axis of the beam nearer to +x",
    "y": "axis of the beam across it",
    "mean": "mean of the longer and the shorter width of each frame",
}
# Coefficients of the hyperbola.
COEFFICIENTS = 3
# Different distances that a fit needs: one more than coefficients, to estimate the scatter about the hyperbola.
FEWEST_POSITIONS = 4
# Confidence level of the intervals of the file and the figure.
LEVEL = 0.6827
# Least relative scatter [1] of the radii, which stands for 0, and the largest that is tried.
LEAST_SCATTER, LARGEST_SCATTER = 1e-9, 10.0
# Iterations of the weights, which follow the fitted curve.
MAX_ITERATIONS = 20
# Least fitted w² in the weights, as a fraction of the measured one: a fitted hyperbola may fall below 0.
LEAST_SQUARE = 1e-6
# Parameters of a beam: name, unit and description.
QUANTITIES = {
    "waist_radius": ("m", "1/e2 radius w0 at the waist"),
    "waist_position": ("m", "distance z0 of the waist"),
    "divergence": ("rad", "half-angle of divergence theta"),
    "rayleigh_length": ("m", "Rayleigh length z_R"),
    "m2": ("1", "beam propagation ratio M2"),
}


@dataclass(frozen=True, eq=False)
class Hyperbola:
    """The fitted squared radius w²(z) = a + b (z − origin) + c (z − origin)²."""

    origin: float  # distance that the coefficients count from [m]
    coefficients: np.ndarray  # a, b, c [m², m, 1]
    covariance: np.ndarray  # covariance of the coefficients [3, 3], by the errors of the radii and their scatter
    scatter: float  # relative scatter of the radii in addition to their errors [1]
    chi2_reduced: float  # χ² per degree of freedom by the errors of the radii alone
    degrees: int  # degrees of freedom, points less three

    def radius(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return w and its standard error [m] at distances z [point] in m; NaN where w² is not positive."""
        powers = np.vander(z - self.origin, COEFFICIENTS, increasing=True)
        square = powers @ self.coefficients
        square_stderr = np.sqrt(np.einsum("ij,jk,ik->i", powers, self.covariance, powers))
        radius = np.sqrt(np.where(square > 0, square, np.nan))
        return radius, square_stderr / (2 * radius)


def fit_hyperbola(z: np.ndarray, radius: np.ndarray, stderr: np.ndarray) -> Hyperbola:
    """Fit the squared radius w² over z by weighted least squares.

    If the points scatter by more than their errors, one relative scatter of w is added in quadrature to all errors so
    that χ² per degree of freedom becomes 1. Weights follow the fitted curve, not the points: a point that is low by
    chance must not weigh more.

    Parameters
    ----------
    z : distances [point] in m.
    radius, stderr : radii w and their standard errors [point] in m.
    """
    origin = float(np.mean(z))
    powers = np.vander(z - origin, COEFFICIENTS, increasing=True)
    degrees_of_freedom = len(z) - COEFFICIENTS
    square = radius**2

    def fit_with_scatter(scatter: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Return coefficients [3], their covariance, and χ² per degree of freedom for a relative scatter of w."""
        fitted_square = square
        for _ in range(MAX_ITERATIONS):
            # Standard deviation of w²: 2 w times that of w.
            sd = 2 * np.sqrt(fitted_square) * np.hypot(stderr, scatter * np.sqrt(fitted_square))
            weighted = powers / sd[:, None]
            covariance = np.linalg.inv(weighted.T @ weighted)
            coefficients = covariance @ weighted.T @ (square / sd)
            previous, fitted_square = fitted_square, np.maximum(powers @ coefficients, LEAST_SQUARE * square)
            if np.allclose(previous, fitted_square, rtol=1e-12, atol=0):
                break
        chi2 = np.sum(((square - powers @ coefficients) / sd) ** 2)
        return coefficients, covariance, float(chi2 / degrees_of_freedom)

    # The least scatter instead of 0 keeps weights finite for points without an error.
    coefficients, covariance, chi2_reduced = fit_with_scatter(LEAST_SCATTER)
    scatter = 0.0
    if chi2_reduced > 1:
        # χ² falls with the scatter over many decades: the root of ln χ² is sought over ln scatter.
        ends = np.log(LEAST_SCATTER), np.log(LARGEST_SCATTER)
        scatter = float(np.exp(optimize.brentq(lambda ln_s: np.log(fit_with_scatter(np.exp(ln_s))[2]), *ends)))
        coefficients, covariance, _ = fit_with_scatter(max(scatter, LEAST_SCATTER))
    return Hyperbola(origin, coefficients, covariance, scatter, chi2_reduced, degrees_of_freedom)


def derive_beam_parameters(fit: Hyperbola, wavelength_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the values [5] and covariance [5, 5] of `QUANTITIES`; all NaN if the hyperbola has no waist.

    With D = 4ac − b²: w0² = D/(4c), z0 = −b/(2c), θ = √c, z_R = √D/(2c), M² = π w0 θ/λ = π √D/(2λ).
    """
    a, b, c = fit.coefficients
    discriminant = 4 * a * c - b * b
    if not (c > 0 and discriminant > 0):
        return np.full(len(QUANTITIES), np.nan), np.full((len(QUANTITIES),) * 2, np.nan)
    root = np.sqrt(discriminant)
    waist, theta, rayleigh = root / (2 * np.sqrt(c)), np.sqrt(c), root / (2 * c)
    m2 = np.pi * root / (2 * wavelength_m)
    values = np.array([waist, fit.origin - b / (2 * c), theta, rayleigh, m2])
    root_slopes = np.array([2 * c, -b, 2 * a]) / root  # d√D / d(a, b, c)
    c_slopes = np.array([0.0, 0.0, 1.0])  # dc / d(a, b, c)
    slopes = np.array(  # d values / d(a, b, c)
        [
            root_slopes / (2 * np.sqrt(c)) - waist / (2 * c) * c_slopes,
            [0.0, -1 / (2 * c), b / (2 * c * c)],
            c_slopes / (2 * theta),
            root_slopes / (2 * c) - rayleigh / c * c_slopes,
            np.pi * root_slopes / (2 * wavelength_m),
        ]
    )
    return values, slopes @ fit.covariance @ slopes.T


class Caustic(NamedTuple):
    """Parameters of a beam along its axis with standard errors such as `m2_stderr`; NaN if the radii have no waist.

    Attributes
    ----------
    waist_radius : 1/e² radius of the waist, w0 [m].
    waist_position : distance of the waist, z0 [m].
    divergence : half-angle of divergence, θ [rad].
    rayleigh_length : z_R [m].
    m2 : beam propagation ratio M² [1].
    chi2_reduced : χ² per degree of freedom of the hyperbola by the errors of the radii alone; NaN if one of them is 0.
    scatter : relative scatter of the radii in addition to their errors; 0 if these explain the residuals.
    degrees_of_freedom : points less three.
    hyperbola : the fitted w²(z) with its covariance; `radius` evaluates it.

    Examples
    --------
    >>> import spotcheck
    >>> z, radius = [0, 0.1, 0.2, 0.3, 0.4], [3e-4, 2e-4, 1.5e-4, 2e-4, 3e-4]
    >>> found = spotcheck.fit_caustic(z, radius, 5e-6, wavelength_m=1e-6)
    >>> radius, stderr = found.radius(0.25)
    >>> print(f"{1e6 * radius:.0f} ± {1e6 * stderr:.0f} µm")
    164 ± 4 µm
    """

    waist_radius: float
    waist_radius_stderr: float
    waist_position: float
    waist_position_stderr: float
    divergence: float
    divergence_stderr: float
    rayleigh_length: float
    rayleigh_length_stderr: float
    m2: float
    m2_stderr: float
    chi2_reduced: float
    scatter: float
    degrees_of_freedom: int
    hyperbola: Hyperbola

    def radius(self, z_m: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the 1/e² radius of the fitted beam and its standard error [m], in the shape of the distances `z_m`.

        Both are NaN where the fitted w² is not positive.
        """
        z = np.asarray(z_m, dtype=float)
        radius, stderr = self.hyperbola.radius(z.ravel())
        return radius.reshape(z.shape)[()], stderr.reshape(z.shape)[()]

    def __repr__(self) -> str:
        """Return one line for the goodness of fit and one for each of `QUANTITIES`."""
        lines = [f"caustic: χ² per degree of freedom {self.chi2_reduced:.3g}, scatter {100 * self.scatter:.2g} %"]
        for name, (unit, _) in QUANTITIES.items():
            text = quantity_text(getattr(self, name), getattr(self, f"{name}_stderr"), unit)
            lines.append(f"{name:<15} {text}")
        return "\n".join(lines)


def fit_caustic(z_m: ArrayLike, radius_m: ArrayLike, stderr_m: ArrayLike, *, wavelength_m: float) -> Caustic:
    """Fit waist, divergence, Rayleigh length and M² of a beam to its radii along z (ISO 11146-1:2021, clause 9).

    The radius is the 1/e² radius of the intensity: twice the standard deviation of a Gaussian, half the diameter d of
    the standard. A fitted `sigma_mean` in pixels is thus a radius of 2 σ times the pixel pitch. The standard takes
    second moments; for a beam that is not Gaussian, M² from fits of a Gaussian is too small.

    Parameters
    ----------
    z_m : distances along the beam [m], at least four different ones. The standard asks for ten, half of them within a
        Rayleigh length of the waist and half beyond two.
    radius_m : 1/e² radius at each distance [m].
    stderr_m : its standard error [m], or one for all. If the radii scatter by more, or if it is 0, the relative scatter
        about the hyperbola is estimated from the residuals.
    wavelength_m : wavelength in the medium [m].

    Returns
    -------
    Caustic
        Parameters of the beam with their standard errors.

    Raises
    ------
    ValueError
        Fewer than four distances, arrays of different lengths, or numbers that are no radius, error or wavelength.

    Examples
    --------
    >>> import numpy as np, spotcheck
    >>> z = np.linspace(-0.3, 0.3, 13)
    >>> radius = 150e-6 * np.sqrt(1 + ((z - 0.02) / 0.093) ** 2) + np.random.default_rng(1).normal(0, 2e-6, 13)
    >>> found = spotcheck.fit_caustic(z, radius, 2e-6, wavelength_m=632.8e-9)
    >>> found
    caustic: χ² per degree of freedom 0.491, scatter 0 %
    waist_radius    150.4 ± 1.1 µm
    waist_position  20.1 ± 0.4 mm
    divergence      1.613 ± 0.004 mrad
    rayleigh_length 93.2 ± 0.8 mm
    m2              1.205 ± 0.008
    """
    z, radius = (np.atleast_1d(np.asarray(v, dtype=float)) for v in (z_m, radius_m))
    stderr = np.asarray(stderr_m, dtype=float)
    if z.ndim != 1 or radius.shape != z.shape or stderr.shape not in ((), z.shape):
        raise ValueError(
            f"z_m, radius_m, stderr_m: have the shapes {z.shape}, {radius.shape} and {stderr.shape};"
            " give a radius and an error for every distance"
        )
    stderr = np.broadcast_to(stderr, z.shape)
    for name, is_valid, requirement in (
        ("z_m", np.isfinite(z), "finite"),
        ("radius_m", np.isfinite(radius) & (radius > 0), "above 0"),
        ("stderr_m", np.isfinite(stderr) & (stderr >= 0), "0 or above"),
        ("wavelength_m", np.isfinite(wavelength_m) & (wavelength_m > 0), "above 0"),
    ):
        if not np.all(is_valid):
            raise ValueError(f"{name}: every number must be {requirement}, in metres")
    if (positions := len(np.unique(z))) < FEWEST_POSITIONS:
        raise ValueError(f"z_m: has {positions} different distances; a caustic needs {FEWEST_POSITIONS} or more")
    hyperbola = fit_hyperbola(z, radius, stderr)
    values, covariance = derive_beam_parameters(hyperbola, wavelength_m)
    # Each value is followed by its standard error, as in the fields of `Caustic`.
    values_and_errors = np.column_stack([values, np.sqrt(np.diag(covariance))]).ravel()
    chi2 = hyperbola.chi2_reduced if stderr.all() else np.nan
    return Caustic._make([*values_and_errors.tolist(), chi2, hyperbola.scatter, hyperbola.degrees, hyperbola])


def compute_interval_half_width(stderr: np.ndarray, degrees: int) -> np.ndarray:
    """Return half of the 68 % interval: the standard error times Student's t of the degrees of freedom.

    The few points of a scan estimate the scatter about the hyperbola, hence Student's t.
    """
    return stderr * stats.t.ppf((1 + LEVEL) / 2, degrees)


def explain_missing_caustic(instrument: Instrument) -> str:
    """Return a sentence that names the key of instrument.yaml without which there is no caustic; "" if none is missing.

    A dataset without the condition z has no caustic by design, so that nothing is missing.
    """
    if CONDITION not in instrument.conditions:
        return ""
    needed = {
        "sensor.pixel_pitch_m": instrument.sensor.pixel_pitch_m,
        "laser.wavelength_m": instrument.laser.wavelength_m,
    }
    missing = next((key for key, value in needed.items() if value is None), None)
    return f"a caustic needs {missing}, which instrument.yaml does not give" if missing else ""


def compute_caustic(fits: xr.Dataset, instrument: Instrument) -> xr.Dataset:
    """Compute caustic.nc of a scan along z.

    Parameters
    ----------
    fits : fits.nc of the dataset, with the distance along the beam as the coordinate `CONDITION`.
    instrument : pixel pitch, wavelength and declared conditions.

    Returns
    -------
    xr.Dataset
        Content of caustic.nc; without a caustic only the attribute `skipped` with the reason. The attribute `beam` is
        "stigmatic" (ratio of the axes at least 0.87 in every frame) or "simple astigmatic".
    """
    ds = xr.Dataset(attrs={name: fits.attrs[name] for name in ("title", "dataset", "not_recorded")})
    if CONDITION not in instrument.conditions or CONDITION not in fits.coords:
        return ds.assign_attrs(skipped=f"a caustic needs the declared condition {CONDITION}")
    if reason := explain_missing_caustic(instrument):
        return ds.assign_attrs(skipped=reason)
    pitch, wavelength = instrument.sensor.pixel_pitch_m, instrument.laser.wavelength_m
    assert pitch is not None and wavelength is not None
    spots = select_preferred_fits(fits)
    grid = tuple(str(d) for d in spots["status"].dims)
    spots = spots.transpose(*grid).where((spots["status"] & store.UNTRUSTED) == 0)
    z = spots[CONDITION].broadcast_like(spots["status"]).transpose(*grid).values
    columns = [spots[f"{name}{suffix}"].values for suffix in ("", "_stderr") for name in WIDTH_PARAMETERS]
    mean_width = spots["sigma_mean"].values, spots["sigma_mean_stderr"].values
    # The last column is the error of the orientation. It may be infinite, for a round spot.
    is_usable = np.isfinite(np.stack([*columns[:-1], *mean_width])).all(axis=0)
    positions = np.unique(z[is_usable])
    if len(positions) < FEWEST_POSITIONS:
        return ds.assign_attrs(
            skipped=f"a caustic needs usable spots at {FEWEST_POSITIONS} positions or more,"
            f" and {len(positions)} have one"
        )
    axes = fit_beam_axes(SpotWidths(*(column[is_usable] for column in columns)))
    if axes.rotated_spot is not None:
        return ds.assign_attrs(skipped=describe_axis_rotation(axes, z[is_usable]))

    widths = SpotWidths(*columns)
    # Width σ and its standard error [axis, 2, *grid] in px, in the order of `AXES`.
    projected = np.array([project_widths(widths, axes.azimuth), project_widths(widths, axes.azimuth + 90), mean_width])
    # From σ [px] to the 1/e² radius 2σ [m].
    radius, stderr = (np.where(is_usable, projected[:, k], np.nan) * 2 * pitch for k in (0, 1))
    hyperbolas = [fit_hyperbola(z[is_usable], r[is_usable], s[is_usable]) for r, s in zip(radius, stderr, strict=True)]
    ds = ds.assign_coords({d: fits[d] for d in grid if d in fits.coords})
    _add_axes(ds, axes)
    _add_hyperbolas(ds, hyperbolas)
    _add_beam_parameters(ds, hyperbolas, wavelength, axes.is_stigmatic)
    long_name = "1/e2 beam radius, twice the fitted standard deviation"
    add_variable(ds, "beam_radius", ("axis", *grid), radius, "m", long_name)
    add_variable(ds, "beam_radius_stderr", ("axis", *grid), stderr, "m", "standard error of the beam radius")
    _add_position_counts(ds, positions)
    ds = store.add_remarks(ds, _check_m2(ds, pitch, wavelength))
    return ds.assign_attrs(
        beam="stigmatic" if axes.is_stigmatic else "simple astigmatic",
        width="twice the standard deviation of the fitted Gaussian, not the second moment of ISO 11146-1",
        level=f"intervals of {100 * LEVEL:.0f} %: standard error times Student's t at degrees_of_freedom",
    )


def describe_axis_rotation(axes: BeamAxes, z: np.ndarray) -> str:
    """Return the reason why a beam whose axes rotate has no M²; `z` [spot] in m are the distances of the spots."""
    assert axes.rotated_spot is not None
    spot, angle = axes.rotated_spot
    return (
        f"the axes of the beam turn along z: those at {CONDITION} = {z[spot]:.4g} lie {angle:.0f}° from those of the"
        " whole scan; such a beam is generally astigmatic, and its M² needs the measurements of ISO 11146-2"
    )


def select_beam_rows(ds: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return the parts of caustic.nc that describe the beam, by label: both axes, or their mean for a round beam."""
    if not np.isfinite(float(ds["azimuth_stderr"])):
        return {"mean of both axes": ds.sel(axis="mean")}
    azimuth = float(ds["azimuth"])
    return {f"axis at {azimuth + turn:.1f}°": ds.sel(axis=name) for name, turn in (("x", 0), ("y", 90))}


def _check_m2(ds: xr.Dataset, pitch: float, wavelength: float) -> list[str]:
    """Return a remark if M² of an axis is below 1, which no beam can have; otherwise an empty list.

    The remark asks to correct the input if M² is below 1 significantly, and otherwise not to quote M². `pitch` [m] and
    `wavelength` [m] are those of the instrument file.
    """
    values = zip(ds["m2"].values.tolist(), ds["m2_stderr"].values.tolist(), strict=True)
    m2_by_axis = dict(zip(AXES, values, strict=True))
    factors = f"sensor.pixel_pitch_m ({pitch:g})", f"laser.wavelength_m ({wavelength:g})"
    if remark := describe_impossible_m2(m2_by_axis, *factors, CONDITION):
        return [remark]
    if low := list_low_axes(m2_by_axis, 1.0):
        return [
            f"M² is below 1 ({low}), so do not quote it: a Gaussian fit leaves out light outside the Gaussian, which M²"
            " after ISO 11146 includes; take M² by second moments, which `spotcheck look` gives"
        ]
    return []


def _add_axes(ds: xr.Dataset, axes: BeamAxes) -> None:
    """Add the names of the axes and the direction of the first to caustic.nc."""
    long_name = "; ".join(f"{name}: {text}" for name, text in AXES.items())
    add_variable(ds, "axis", "axis", np.array(list(AXES), dtype=object), "1", long_name)
    direction = "direction of the beam's x axis from +x (right) towards +y (down)"
    add_variable(ds, "azimuth", (), axes.azimuth, "degree", direction)
    long_name = f"standard error of the {direction}; infinite for a round beam"
    add_variable(ds, "azimuth_stderr", (), axes.azimuth_stderr, "degree", long_name)


def _add_hyperbolas(ds: xr.Dataset, hyperbolas: list[Hyperbola]) -> None:
    """Add the coefficients of each axis, their covariance, and the goodness of fit to caustic.nc."""
    for name in ("power", "other_power"):
        add_variable(ds, name, name, np.arange(COEFFICIENTS), "1", "power of z less the origin")
    polynomial = "coefficients a, b, c of the squared radius over z less the origin"
    for name, attribute, units, long_name in (
        ("coefficient", "coefficients", "m2, m, 1", polynomial),
        ("coefficient_covariance", "covariance", "products of those of coefficient", "covariance of the coefficients"),
        ("origin", "origin", "m", "distance that the coefficients count from"),
        ("scatter", "scatter", "1", "relative scatter of the radius added to its standard error"),
        ("chi2_reduced", "chi2_reduced", "1", "chi-square per degree of freedom without the scatter"),
        ("degrees_of_freedom", "degrees", "1", "points less three"),
    ):
        values = np.array([getattr(hyperbola, attribute) for hyperbola in hyperbolas])
        add_variable(ds, name, ("axis", "power", "other_power")[: values.ndim], values, units, long_name)


def _add_beam_parameters(ds: xr.Dataset, hyperbolas: list[Hyperbola], wavelength: float, is_stigmatic: bool) -> None:
    """Add `QUANTITIES` of each axis with standard errors to caustic.nc; those of the mean are NaN if astigmatic."""
    derived = [derive_beam_parameters(hyperbola, wavelength) for hyperbola in hyperbolas]
    # Values and standard errors [axis, quantity].
    values = np.array([axis_values for axis_values, _ in derived])
    stderr = np.sqrt([np.diag(covariance) for _, covariance in derived])
    if not is_stigmatic:
        values[list(AXES).index("mean")] = stderr[list(AXES).index("mean")] = np.nan
    for k, (name, (units, long_name)) in enumerate(QUANTITIES.items()):
        add_variable(ds, name, "axis", values[:, k], units, long_name)
        add_variable(ds, f"{name}_stderr", "axis", stderr[:, k], units, f"standard error of {long_name}")


def _add_position_counts(ds: xr.Dataset, positions: np.ndarray) -> None:
    """Add the numbers of positions to caustic.nc: all, near the waist, and far from it, as ISO 11146-1 asks for.

    `positions` [position] in m are the different distances with a usable spot.
    """
    rayleigh_length, waist = ds["rayleigh_length"].values[:, None], ds["waist_position"].values[:, None]
    distance = np.abs(positions - waist)
    near, far = np.sum(distance < rayleigh_length, axis=1), np.sum(distance > 2 * rayleigh_length, axis=1)
    long_name = "positions with a usable spot; ISO 11146-1 asks for 10 or more"
    add_variable(ds, "positions", (), len(positions), "1", long_name)
    add_variable(ds, "positions_near", "axis", near, "1", "positions within one Rayleigh length of the waist")
    add_variable(ds, "positions_far", "axis", far, "1", "positions beyond two Rayleigh lengths")
