"""caustic.nc: the caustic of a beam from a scan along z, by second moments and by Gaussian fits.

A scan is a series of frames at several distances z. It has one hyperbola for each of the two axes of the beam, which
keep their direction (`beam_axes`), and one for the mean of both widths. A beam is stigmatic if both axes are equal and
astigmatic otherwise. The mean of an astigmatic beam is no hyperbola and has no M². A beam whose axes rotate along z has
no M² here; it needs the measurements of ISO 11146-2.

The estimator to quote comes first: second moments, which the standard takes, if the light is not Gaussian, and
otherwise the fit, whose errors are smaller.
"""

from dataclasses import fields

import numpy as np
import xarray as xr

from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting.beam_axes import BeamAxes, SpotWidths, fit_beam_axes, project_widths
from spotcheck.fitting.caustic import FEWEST_POSITIONS, Caustic, describe_impossible_m2, fit_caustic, list_low_axes
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.hyperbola import COEFFICIENTS, LEVEL, QUANTITIES, Hyperbola
from spotcheck.fitting.scan_widths import (
    MomentsByCell,
    ScanWidths,
    collect_fit_widths,
    collect_moment_widths,
    has_wings,
)
from spotcheck.fitting.variables import add_variable
from spotcheck.io import store

# Declared condition of a dataset that holds the distance along the beam [m].
CONDITION = "z_m"
# Estimators of the widths by their name in caustic.nc.
MOMENTS, FIT = "moments", "fit"
ESTIMATORS = {MOMENTS: "second moments", FIT: "Gaussian fit"}
# Axes of caustic.nc by name.
AXES = {
    "x": "axis of the beam nearer to +x",
    "y": "axis of the beam across it",
    "mean": "mean of the longer and the shorter width of each frame",
}


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


def explain_no_scan(fits: xr.Dataset, instrument: Instrument) -> str:
    """Return the reason why a dataset has no caustic, whatever its widths; "" if it may have one."""
    if CONDITION not in instrument.conditions or CONDITION not in fits.coords:
        return f"a caustic needs the declared condition {CONDITION}"
    return explain_missing_caustic(instrument)


def compute_caustic(fits: xr.Dataset, instrument: Instrument, moments: MomentsByCell | None = None) -> xr.Dataset:
    """Compute caustic.nc of a scan along z.

    Parameters
    ----------
    fits : fits.nc of the dataset, with the distance along the beam as the coordinate `CONDITION`.
    instrument : pixel pitch, wavelength and declared conditions.
    moments : second moments of the spots by index on the grid; None if they were not measured.

    Returns
    -------
    xr.Dataset
        Content of caustic.nc; without a caustic only the attribute `skipped` with the reason. The first entry of the
        dimension `estimator` is the one to quote. The variable `beam` is "stigmatic" (ratio of the axes at least 0.87
        in every frame) or "simple astigmatic". The attribute `missing` says which estimator gives no caustic, and why.
    """
    # `not_recorded` names the axes of the grid for which the manifest has no values.
    attributes = {name: fits.attrs[name] for name in ("title", "dataset", "not_recorded")}
    if reason := explain_no_scan(fits, instrument):
        return xr.Dataset(attrs=attributes | {"skipped": reason})
    pitch, wavelength = instrument.sensor.pixel_pitch_m, instrument.laser.wavelength_m
    assert pitch is not None and wavelength is not None
    status = select_preferred_fits(fits)["status"]
    z = fits[CONDITION].broadcast_like(status).transpose(*status.dims)
    widths = {FIT: collect_fit_widths(fits)}
    is_gaussian = True
    if moments is not None:
        widths[MOMENTS] = collect_moment_widths(moments, status.shape)
        is_gaussian = not has_wings(moments, widths[FIT], (status.values & store.flag("clipped")) != 0)
    tables, reasons = dict[str, xr.Dataset](), list[str]()
    # The estimator to quote comes first.
    for estimator in (FIT, MOMENTS) if is_gaussian else (MOMENTS, FIT):
        if estimator not in widths:
            continue
        table = _compute_table(estimator, z, widths[estimator], pitch, wavelength)
        if isinstance(table, str):
            reasons.append(f"{ESTIMATORS[estimator]}: {table}")
        else:
            tables[estimator] = table
    if not tables:
        return xr.Dataset(attrs=attributes | {"skipped": "; ".join(reasons)})
    ds = xr.concat(tables.values(), "estimator", data_vars="all", coords="minimal", join="exact")
    ds = ds.assign_coords({dim: fits[dim] for dim in status.dims if dim in fits.coords})
    long_name = "how the widths were measured; the first one is to be quoted"
    add_variable(ds, "estimator", "estimator", np.array([*tables], object), "1", long_name)
    ds.attrs = attributes | {
        "light": "Gaussian" if is_gaussian else "not Gaussian: D4σ exceeds 4σ of the fit",
        "missing": "; ".join(reasons),
        "level": f"intervals of {100 * LEVEL:.0f} %: standard error times Student's t at degrees_of_freedom",
    }
    return store.add_remarks(ds, _check_m2(ds, is_gaussian, pitch, wavelength))


def _compute_table(
    estimator: str, z: xr.DataArray, widths: ScanWidths, pitch: float, wavelength: float
) -> xr.Dataset | str:
    """Return the part of caustic.nc of one estimator, or the reason why there is none.

    `z` is the distance of each spot over the grid [m], `pitch` and `wavelength` are in m.
    """
    is_usable, places = widths.is_usable, z.values
    positions = np.unique(places[is_usable])
    if len(positions) < FEWEST_POSITIONS:
        return (
            f"a caustic needs usable spots at {FEWEST_POSITIONS} positions or more, and {len(positions)} have one"
            + ("; D4σ needs frames that contain its area of integration" if estimator == MOMENTS else "")
        )
    all_spots = widths.axes
    axes = fit_beam_axes(SpotWidths(*(getattr(all_spots, field.name)[is_usable] for field in fields(SpotWidths))))
    if axes.rotated_spot is not None:
        return describe_axis_rotation(axes, places[is_usable])
    mean = widths.mean, widths.mean_stderr
    # Width σ and its standard error [axis, 2, *grid] in px, in the order of `AXES`.
    projected = np.array([project_widths(all_spots, axes.azimuth), project_widths(all_spots, axes.azimuth + 90), mean])
    # From σ [px] to the 1/e² radius 2σ [m].
    radius, stderr = (np.where(is_usable, projected[:, k], np.nan) * 2 * pitch for k in (0, 1))
    caustics = [
        fit_caustic(places[is_usable], axis_radius[is_usable], axis_stderr[is_usable], wavelength_m=wavelength)
        for axis_radius, axis_stderr in zip(radius, stderr, strict=True)
    ]
    ds = xr.Dataset()
    kind = "stigmatic" if axes.is_stigmatic else "simple astigmatic"
    add_variable(ds, "beam", (), kind, "1", "stigmatic if the ratio of the axes is at least 0.87 in every frame")
    _add_axes(ds, axes)
    _add_hyperbolas(ds, [caustic.hyperbola for caustic in caustics])
    _add_beam_parameters(ds, caustics, axes.is_stigmatic)
    add_variable(ds, "beam_radius", ("axis", *z.dims), radius, "m", "1/e2 beam radius, twice the standard deviation")
    add_variable(ds, "beam_radius_stderr", ("axis", *z.dims), stderr, "m", "standard error of the beam radius")
    _add_position_counts(ds, positions)
    return ds


def describe_axis_rotation(axes: BeamAxes, z: np.ndarray) -> str:
    """Return the reason why a beam whose axes rotate along z has no M², as a clause.

    Parameters
    ----------
    axes : axes of the beam, with the most rotated spot in `rotated_spot`: its index and its angle [deg].
    z : distances of the spots from which `axes` was computed [spot] in m.
    """
    assert axes.rotated_spot is not None
    spot, angle = axes.rotated_spot
    return (
        f"the axes of the beam turn along z: those at {CONDITION} = {z[spot]:.4g} lie {angle:.0f}° from those of the"
        " whole scan; such a beam is generally astigmatic, and its M² needs the measurements of ISO 11146-2"
    )


def select_beam_axes(ds: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return the content of caustic.nc along the axes of the beam, by a label for tables and figures.

    For a beam that is round within its noise it is that of the mean of both axes alone.

    Parameters
    ----------
    ds : content of caustic.nc for one estimator.
    """
    # The direction of the axes of a round beam has an infinite error.
    if not np.isfinite(float(ds["azimuth_stderr"])):
        return {"mean of both axes": ds.sel(axis="mean")}
    azimuth_deg = float(ds["azimuth"])
    return {f"axis at {azimuth_deg + shift:.1f}°": ds.sel(axis=name) for name, shift in (("x", 0), ("y", 90))}


def _check_m2(ds: xr.Dataset, is_gaussian: bool, pitch: float, wavelength: float) -> list[str]:
    """Return a remark if M² of an axis is below 1, which no beam can have; otherwise an empty list.

    The remark asks to correct the input if M² is below 1 significantly, and otherwise not to quote M². Fits of light
    that is not Gaussian (`is_gaussian`) do not make it doubt the input if second moments are known. `pitch` [m] and
    `wavelength` [m] are those of the instrument file.
    """
    # M² and its standard error [estimator, axis, 2].
    values = np.stack([ds["m2"], ds["m2_stderr"]], axis=-1).tolist()
    m2_by_estimator = {
        str(estimator): dict(zip(AXES, m2_of_axes, strict=True))
        for estimator, m2_of_axes in zip(ds["estimator"].values, values, strict=True)
    }
    factors = f"sensor.pixel_pitch_m ({pitch:g})", f"laser.wavelength_m ({wavelength:g})"
    tested = [MOMENTS] if MOMENTS in m2_by_estimator and not is_gaussian else m2_by_estimator
    for m2_by_axis in (m2_by_estimator[estimator] for estimator in tested):
        if remark := describe_impossible_m2(m2_by_axis, *factors, CONDITION):
            return [remark]
    if low := list_low_axes(m2_by_estimator.get(FIT, {}), 1.0):
        reason = "" if MOMENTS in m2_by_estimator else f" ({ds.attrs['missing']})" if ds.attrs["missing"] else ""
        return [
            f"M² by the Gaussian fit is below 1 ({low}), so do not quote it: a fit leaves out light outside the"
            f" Gaussian, which M² after ISO 11146 includes; take M² by second moments{reason}"
        ]
    return []


def _add_axes(ds: xr.Dataset, axes: BeamAxes) -> None:
    """Add the names of the axes and the direction of the first to caustic.nc."""
    long_name = "; ".join(f"{name}: {text}" for name, text in AXES.items())
    add_variable(ds, "axis", "axis", np.array(list(AXES), dtype=object), "1", long_name)
    direction = "direction of the beam's x axis from +x (right) towards +y (down)"
    add_variable(ds, "azimuth", (), axes.azimuth, "degree", direction)
    add_variable(ds, "azimuth_stderr", (), axes.azimuth_stderr, "degree", f"standard error of the {direction}")
    ds["azimuth_stderr"].attrs["infinite"] = "the beam is round within its noise"


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


def _add_beam_parameters(ds: xr.Dataset, caustics: list[Caustic], is_stigmatic: bool) -> None:
    """Add `QUANTITIES` of each axis with standard errors to caustic.nc; those of the mean are NaN if astigmatic."""
    for quantity, (units, description) in QUANTITIES.items():
        for name, long_name in ((quantity, description), (f"{quantity}_stderr", f"standard error of {description}")):
            values = np.array([getattr(caustic, name) for caustic in caustics])
            if not is_stigmatic:
                values[list(AXES).index("mean")] = np.nan
            add_variable(ds, name, "axis", values, units, long_name)


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
