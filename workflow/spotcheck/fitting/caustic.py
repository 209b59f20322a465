"""The caustic of a beam: hyperbola through fitted widths at several distances, waist, divergence, M² (ISO 11146-1).

ISO 11146-1:2021, clause 9, fits d²(z) = a + b z + c z² to beam diameters; here w²(z) with the radius w = d/2 = 2σ of a
Gaussian (its 1/e² radius), so that every root of a coefficient is half of the standard's.

# ASSUME: the fitted Gaussian stands for the beam. The standard takes second moments, which see side lobes and halo that
# a Gaussian fit passes over: for a beam that is not Gaussian, M² from fits is too small.

A scan has a hyperbola for each of the two axes of the beam, which keep their direction (`beam_axes`), and one for the
mean of both widths. The mean of an astigmatic beam is no hyperbola, and has no M²; a beam whose axes turn has none at
all: that takes the measurements of ISO 11146-2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy import optimize, stats

from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting.beam_axes import Axes, Widths, along, axes_of
from spotcheck.fitting.fits import preferred
from spotcheck.io import store
from spotcheck.io.plus_minus import plus_minus

CONDITION = "z_m"
PARAMETERS = ("sigma_major", "sigma_minor", "orientation")
AXES = {
    "x": "axis of the beam nearer to +x",
    "y": "axis of the beam across it",
    "mean": "mean of the longer and the shorter width of each frame",
}
# Three coefficients, and one position more is the least that shows how the points scatter about the hyperbola.
FEWEST_POSITIONS = 4
LEVEL = 0.6827
# M² below 1 by this many standard errors is impossible, and no longer chance (1 of 700 scans of a perfect beam).
IMPOSSIBLE = 3.0
QUANTITIES = {
    "waist_radius": ("m", "1/e2 radius w0 at the waist"),
    "waist_position": ("m", "distance z0 of the waist"),
    "divergence": ("rad", "half-angle of divergence theta"),
    "rayleigh_length": ("m", "Rayleigh length z_R"),
    "m2": ("1", "beam propagation ratio M2"),
}


class Hyperbola(NamedTuple):
    """w²(z) = a + b (z − origin) + c (z − origin)²: coefficients, covariance, relative scatter of w, reduced χ².

    `covariance` holds the widths' own errors and the scatter; `chi2_reduced` is that of the own errors alone.
    """

    origin: float
    coefficients: np.ndarray
    covariance: np.ndarray
    scatter: float
    chi2_reduced: float
    degrees: int

    def radius(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """w and its standard error [m] at distances z [m]."""
        powers = np.vander(z - self.origin, 3, increasing=True)
        square = powers @ self.coefficients
        error = np.sqrt(np.einsum("ij,jk,ik->i", powers, self.covariance, powers))
        radius = np.sqrt(np.where(square > 0, square, np.nan))
        return radius, error / (2 * radius)


def fit_hyperbola(z: np.ndarray, radius: np.ndarray, stderr: np.ndarray) -> Hyperbola:
    """Weighted least squares of w² [m²] over z [m]; stderr is that of w [m].

    When the points scatter more than their errors allow, a relative scatter of w, one for all points, is added in
    quadrature so that χ² per degree of freedom becomes 1. Weights follow the fitted curve, not the points, since a
    point that fell low by chance must not pull harder.
    """
    origin = float(np.mean(z))
    powers = np.vander(z - origin, 3, increasing=True)
    degrees = len(z) - 3
    square = radius**2

    def solve(scatter: float) -> tuple[np.ndarray, np.ndarray, float]:
        model = square
        for _ in range(20):
            sd = 2 * np.sqrt(model) * np.hypot(stderr, scatter * np.sqrt(model))
            weighted = powers / sd[:, None]
            covariance = np.linalg.inv(weighted.T @ weighted)
            coefficients = covariance @ weighted.T @ (square / sd)
            before, model = model, np.maximum(powers @ coefficients, 1e-6 * square)
            if np.allclose(before, model, rtol=1e-12, atol=0):
                break
        return coefficients, covariance, float(np.sum(((square - powers @ coefficients) / sd) ** 2) / degrees)

    tiny = 1e-9
    own = solve(tiny)
    scatter = 0.0
    if own[2] > 1:
        scatter = float(np.exp(optimize.brentq(lambda s: np.log(solve(np.exp(s))[2]), np.log(tiny), np.log(10.0))))
    coefficients, covariance, _ = solve(max(scatter, tiny))
    return Hyperbola(origin, coefficients, covariance, scatter, own[2], degrees)


def beam(fit: Hyperbola, wavelength_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Values and covariance of `QUANTITIES` from a hyperbola; all NaN where it has no waist.

    With D = 4ac − b²: w0² = D/4c, z0 = −b/2c, θ = √c, z_R = √D/2c, M² = π w0 θ/λ = π √D/2λ.
    """
    a, b, c = fit.coefficients
    power = 4 * a * c - b * b
    if not (c > 0 and power > 0):
        return np.full(5, np.nan), np.full((5, 5), np.nan)
    root = np.sqrt(power)
    waist, theta, rayleigh = root / (2 * np.sqrt(c)), np.sqrt(c), root / (2 * c)
    quality = np.pi * root / (2 * wavelength_m)
    values = np.array([waist, fit.origin - b / (2 * c), theta, rayleigh, quality])
    of_root = np.array([2 * c, -b, 2 * a]) / root  # d√D / d(a, b, c)
    of_c = np.array([0.0, 0.0, 1.0])
    slopes = np.array(
        [
            of_root / (2 * np.sqrt(c)) - waist / (2 * c) * of_c,
            [0.0, -1 / (2 * c), b / (2 * c * c)],
            of_c / (2 * theta),
            of_root / (2 * c) - rayleigh / c * of_c,
            np.pi * of_root / (2 * wavelength_m),
        ]
    )
    return values, slopes @ fit.covariance @ slopes.T


class Caustic(NamedTuple):
    """A beam along its axis, each number with a standard error (`m2_stderr`); NaN where the radii have no waist.

    Attributes
    ----------
    waist_radius : 1/e² radius of the waist, w0 [m].
    waist_position : where it is, z0 [m].
    divergence : half-angle of divergence, θ [rad].
    rayleigh_length : z_R [m].
    m2 : beam propagation ratio M² [1].
    chi2_reduced : χ² per degree of freedom of the hyperbola, by the radii's own errors.
    scatter : relative scatter of the radii, which is added to their errors where these alone are too small.
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
        """1/e² radius of the fitted beam at distances `z_m`, and its standard error [m]."""
        z = np.asarray(z_m, dtype=float)
        radius, stderr = self.hyperbola.radius(z.ravel())
        return radius.reshape(z.shape)[()], stderr.reshape(z.shape)[()]

    def __repr__(self) -> str:
        lines = [f"caustic: χ² per degree of freedom {self.chi2_reduced:.3g}, scatter {100 * self.scatter:.2g} %"]
        for name, (unit, _) in QUANTITIES.items():
            text = plus_minus(getattr(self, name), getattr(self, f"{name}_stderr"), "" if unit == "1" else unit)
            lines.append(f"{name:<15} {text}")
        return "\n".join(lines)


def fit_caustic(z_m: ArrayLike, radius_m: ArrayLike, stderr_m: ArrayLike, *, wavelength_m: float) -> Caustic:
    """Waist, divergence, Rayleigh length and M² of a beam from its radii along z (ISO 11146-1:2021, clause 9).

    The radius is the 1/e² radius of the intensity: twice the standard deviation of a Gaussian, half the diameter d of
    the standard. A fitted `sigma_mean` in pixels is thus a radius of 2 σ times the pixel pitch. The standard takes
    second moments; for a beam that is not Gaussian, M² from fits of a Gaussian is too small.

    Parameters
    ----------
    z_m : distances along the beam [m], at least four different ones. The standard asks for ten, half of them within a
        Rayleigh length of the waist and half beyond two.
    radius_m : 1/e² radius at each distance [m].
    stderr_m : its standard error [m], or one for all. Where the radii scatter by more, or with 0, the relative scatter
        about the hyperbola is found from the radii themselves.
    wavelength_m : wavelength in the medium [m].

    Returns
    -------
    Caustic
        Numbers by name with their standard errors.

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
    waist_radius    1.504e-04 ± 1.1e-06 m
    waist_position  0.02008 ± 0.00044 m
    divergence      1.6134e-03 ± 3.9e-06 rad
    rayleigh_length 0.09325 ± 0.00083 m
    m2              1.2050 ± 0.0076
    """
    z, radius = (np.atleast_1d(np.asarray(v, dtype=float)) for v in (z_m, radius_m))
    stderr = np.asarray(stderr_m, dtype=float)
    if z.ndim != 1 or radius.shape != z.shape or stderr.shape not in ((), z.shape):
        raise ValueError(
            f"z_m, radius_m, stderr_m: have the shapes {z.shape}, {radius.shape} and {stderr.shape};"
            " give a radius and an error for every distance"
        )
    stderr = np.broadcast_to(stderr, z.shape)
    for name, good, wanted in (
        ("z_m", np.isfinite(z), "finite"),
        ("radius_m", np.isfinite(radius) & (radius > 0), "above 0"),
        ("stderr_m", np.isfinite(stderr) & (stderr >= 0), "0 or above"),
        ("wavelength_m", np.isfinite(wavelength_m) & (wavelength_m > 0), "above 0"),
    ):
        if not np.all(good):
            raise ValueError(f"{name}: every number must be {wanted}, in metres")
    if len(np.unique(z)) < FEWEST_POSITIONS:
        raise ValueError(
            f"z_m: has {len(np.unique(z))} different distances; a caustic needs {FEWEST_POSITIONS} or more"
        )
    fit = fit_hyperbola(z, radius, stderr)
    values, covariance = beam(fit, wavelength_m)
    numbers = np.column_stack([values, np.sqrt(np.diag(covariance))]).ravel()
    chi2 = fit.chi2_reduced if stderr.all() else np.nan
    return Caustic._make([*numbers.tolist(), chi2, fit.scatter, fit.degrees, fit])


def half_width(stderr: np.ndarray, degrees: int) -> np.ndarray:
    """Half of the 68 % interval: a standard error times Student's t, since the scatter is estimated from few points."""
    return stderr * stats.t.ppf((1 + LEVEL) / 2, degrees)


def caustic_of(fits: xr.Dataset, instrument: Instrument) -> xr.Dataset:
    """Caustic file of a scan along z; `skipped` with its reason where there is none.

    `beam` says whether the beam is stigmatic (both axes alike to 0.87 in every frame) or simple astigmatic.
    """
    ds = xr.Dataset(attrs={name: fits.attrs[name] for name in ("title", "dataset", "not_recorded")})
    if CONDITION not in instrument.conditions or CONDITION not in fits.coords:
        return ds.assign_attrs(skipped=f"a caustic needs the declared condition {CONDITION}")
    pitch, wavelength = instrument.sensor.pixel_pitch_m, instrument.laser.wavelength_m
    for key, value in (("sensor.pixel_pitch_m", pitch), ("laser.wavelength_m", wavelength)):
        if value is None:
            return ds.assign_attrs(skipped=f"a caustic needs {key}, which instrument.yaml does not give")
    assert pitch is not None and wavelength is not None
    own = preferred(fits)
    grid = tuple(str(d) for d in own["status"].dims)
    own = own.transpose(*grid).where((own["status"] & store.UNTRUSTED) == 0)
    z = own[CONDITION].broadcast_like(own["status"]).transpose(*grid).values
    spots = Widths(*(own[f"{name}{suffix}"].values for suffix in ("", "_stderr") for name in PARAMETERS))
    mean, mean_stderr = own["sigma_mean"].values, own["sigma_mean_stderr"].values
    usable = np.isfinite(np.stack([*spots[:5], mean, mean_stderr])).all(axis=0)
    positions = len(np.unique(z[usable]))
    if positions < FEWEST_POSITIONS:
        return ds.assign_attrs(
            skipped=f"a caustic needs usable spots at {FEWEST_POSITIONS} positions or more, and {positions} have one"
        )
    axes = axes_of(Widths(*(value[usable] for value in spots)))
    if axes.turned is not None:
        return ds.assign_attrs(skipped=turned_text(axes, z[usable]))
    projected = (along(spots, axes.azimuth), along(spots, axes.azimuth + 90), (mean, mean_stderr))
    radius, stderr = (np.where(usable, [own[k] for own in projected], np.nan) * 2 * pitch for k in (0, 1))
    found = [fit_hyperbola(z[usable], r[usable], s[usable]) for r, s in zip(radius, stderr, strict=True)]
    ds = ds.assign_coords({d: fits[d] for d in grid if d in fits.coords})
    _fill(ds, found, wavelength, axes)
    for name, values, long_name in (
        ("beam_radius", radius, "1/e2 beam radius, twice the fitted standard deviation"),
        ("beam_radius_stderr", stderr, "standard error of the beam radius"),
    ):
        ds[name] = (("axis", *grid), values, {"units": "m", "long_name": long_name})
    length, waist = ds["rayleigh_length"].values[:, None], ds["waist_position"].values[:, None]
    distance = np.abs(np.unique(z[usable]) - waist)
    for name, dims, count, long_name in (
        ("positions", (), positions, "positions with a usable spot; ISO 11146-1 asks for 10 or more"),
        (
            "positions_near",
            "axis",
            np.sum(distance < length, axis=1),
            "positions within one Rayleigh length of the waist",
        ),
        ("positions_far", "axis", np.sum(distance > 2 * length, axis=1), "positions beyond two Rayleigh lengths"),
    ):
        ds[name] = (dims, count, {"units": "1", "long_name": long_name})
    ds = store.add_remarks(ds, _on_quality(ds, pitch, wavelength))
    return ds.assign_attrs(
        beam="stigmatic" if axes.stigmatic else "simple astigmatic",
        width="twice the standard deviation of the fitted Gaussian, not the second moment of ISO 11146-1",
        level=f"intervals of {100 * LEVEL:.0f} %: standard error times Student's t at degrees_of_freedom",
    )


def turned_text(axes: Axes, z: np.ndarray) -> str:
    """Why a beam whose axes turn has no M²."""
    assert axes.turned is not None
    spot, angle = axes.turned
    return (
        f"the axes of the beam turn along z: those at {CONDITION} = {z[spot]:.4g} lie {angle:.0f}° from those of the"
        " whole scan; such a beam is generally astigmatic, and its M² needs the measurements of ISO 11146-2"
    )


def beam_rows(ds: xr.Dataset) -> dict[str, xr.Dataset]:
    """The rows of a caustic file that stand for the beam, by the words for them: each axis where the frames tell axes,
    else the mean of both."""
    if not np.isfinite(float(ds["azimuth_stderr"])):
        return {"mean of both axes": ds.sel(axis="mean")}
    azimuth = float(ds["azimuth"])
    return {f"axis at {azimuth + turn:.1f}°": ds.sel(axis=name) for name, turn in (("x", 0), ("y", 90))}


def _on_quality(ds: xr.Dataset, pitch: float, wavelength: float) -> list[str]:
    """A sentence on axes whose M² is below 1: no beam is better than a Gaussian one. Far beyond its error a number that
    M² rests on must be wrong."""

    def below(errors: float) -> str:
        rows = zip(AXES, ds["m2"].values, ds["m2_stderr"].values, strict=True)
        return ", ".join(f"{name} {plus_minus(m2, error)}" for name, m2, error in rows if m2 + errors * error < 1)

    if low := below(IMPOSSIBLE):
        return [
            f"M² is below 1 ({low}), and no beam's is; it grows with sensor.pixel_pitch_m ({pitch:g}) squared"
            f" and falls with laser.wavelength_m ({wavelength:g}) and with the unit of {CONDITION}: one of them is off,"
            " or the camera sees an image of the beam and not the beam"
        ]
    if low := below(1.0):
        return [
            f"M² is below 1 ({low}), so do not quote it: fits pass over light beside the Gaussian, which M² after ISO"
            " 11146 counts; take that by second moments, which `spotcheck look` gives"
        ]
    return []


def _fill(ds: xr.Dataset, found: list[Hyperbola], wavelength: float, axes: Axes) -> None:
    """Coefficients, their covariance and what follows from them, one row an axis of the beam."""
    ds["axis"] = (
        "axis",
        np.array(list(AXES), dtype=object),
        {"units": "1", "long_name": "; ".join(f"{name}: {text}" for name, text in AXES.items())},
    )
    direction = "direction of the beam's x axis from +x (right) towards +y (down)"
    ds["azimuth"] = ((), axes.azimuth, {"units": "degree", "long_name": direction})
    long_name = f"standard error of the {direction}; infinite for a round beam"
    ds["azimuth_stderr"] = ((), axes.azimuth_stderr, {"units": "degree", "long_name": long_name})
    ds["power"] = ("power", np.arange(3), {"units": "1", "long_name": "power of z less the origin"})
    ds["other_power"] = ("other_power", np.arange(3), {"units": "1", "long_name": "power of z less the origin"})
    ds["coefficient"] = (
        ("axis", "power"),
        np.array([f.coefficients for f in found]),
        {"units": "m2, m, 1", "long_name": "coefficients a, b, c of the squared radius over z less the origin"},
    )
    ds["coefficient_covariance"] = (
        ("axis", "power", "other_power"),
        np.array([f.covariance for f in found]),
        {"units": "products of those of coefficient", "long_name": "covariance of the coefficients"},
    )
    for name, values, units, long_name in (
        ("origin", [f.origin for f in found], "m", "distance that the coefficients count from"),
        ("scatter", [f.scatter for f in found], "1", "relative scatter of the radius added to its standard error"),
        ("chi2_reduced", [f.chi2_reduced for f in found], "1", "chi-square per degree of freedom without the scatter"),
        ("degrees_of_freedom", [f.degrees for f in found], "1", "points less three"),
    ):
        ds[name] = ("axis", np.array(values), {"units": units, "long_name": long_name})
    derived = [beam(f, wavelength) for f in found]
    if not axes.stigmatic:
        derived[list(AXES).index("mean")] = np.full(5, np.nan), np.full((5, 5), np.nan)
    for k, (name, (units, long_name)) in enumerate(QUANTITIES.items()):
        ds[name] = ("axis", np.array([v[k] for v, _ in derived]), {"units": units, "long_name": long_name})
        error = np.sqrt([c[k, k] for _, c in derived])
        ds[f"{name}_stderr"] = ("axis", error, {"units": units, "long_name": f"standard error of {long_name}"})
