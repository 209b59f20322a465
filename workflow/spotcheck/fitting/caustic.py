"""The caustic of a beam from its radii along z: waist, divergence, Rayleigh length and M² with errors (ISO 11146-1).

# ASSUME: the radii stand for the beam. The standard takes second moments, which include side lobes and halo that a
# Gaussian fit leaves out: for a beam that is not Gaussian, M² from fits is too small.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from spotcheck.fitting.hyperbola import QUANTITIES, Hyperbola, derive_beam_parameters, fit_hyperbola
from spotcheck.io.number_text import quantity_text

# Different distances that a fit needs: one more than coefficients, to estimate the scatter about the hyperbola.
FEWEST_POSITIONS = 4
# M² below 1 by this many standard errors means a wrong input: a perfect beam gives it in 1 of 700 scans.
IMPOSSIBLE_SIGMAS = 3.0


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


def describe_impossible_m2(m2_by_axis: Mapping[str, tuple[float, float]], pitch: str, wavelength: str, z: str) -> str:
    """Return a remark if M² is significantly below 1, which no beam can have; "" otherwise.

    Parameters
    ----------
    m2_by_axis : M² and its standard error, by the name of the axis; NaN if unknown.
    pitch, wavelength : pixel pitch and wavelength, by the name that the user knows, with their values.
    z : name of the positions along the beam.
    """
    low = list_low_axes(m2_by_axis, IMPOSSIBLE_SIGMAS)
    return low and (
        f"M² is below 1 ({low}), which no beam can have; it grows with {pitch} squared and falls with {wavelength} and"
        f" with the unit of {z}: correct the wrong one, unless the camera sees an image of the beam and not the beam;"
        " the pitch of binned frames is that of the sensor times the binning"
    )


def list_low_axes(m2_by_axis: Mapping[str, tuple[float, float]], sigmas: float) -> str:
    """Return the axes whose M² is below 1 by more than `sigmas` standard errors, with M²; "" if there are none."""
    return ", ".join(
        f"{name} {quantity_text(m2, stderr)}" for name, (m2, stderr) in m2_by_axis.items() if m2 + sigmas * stderr < 1
    )
