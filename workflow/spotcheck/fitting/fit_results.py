"""Results of spot fits: values, standard errors and covariance by name, χ², and the status of each fit."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import xarray as xr

from spotcheck.fitting.variables import add_variable
from spotcheck.io import store
from spotcheck.io.number_text import quantity_text

# Parameters of a fit: name, unit and description. The first seven are fitted; the last follows from two of them.
PARAMETERS = {
    "amplitude": ("DN", "peak of the fitted Gaussian above its offset"),
    "x_centre": ("pixel", "column of the fitted centre"),
    "y_centre": ("pixel", "row of the fitted centre"),
    "sigma_major": ("pixel", "fitted standard deviation along the long axis"),
    "sigma_minor": ("pixel", "fitted standard deviation along the short axis"),
    "orientation": ("degree", "direction of the long axis from +x (right) towards +y (down)"),
    "offset": ("DN", "fitted offset under the Gaussian"),
    "sigma_mean": ("pixel", "direction-averaged width, mean of the long and the short axis"),
}
NAMES = tuple(PARAMETERS)
# Names of the parameters that have a covariance.
FITTED_NAMES = NAMES[:7]
# Most spots that `repr` lists one by one.
LISTED_SPOTS = 10


@dataclass(frozen=True, eq=False, repr=False)
class SpotFits:
    """Fitted spots. Every parameter and its standard error is an attribute:

    ===============  ======  ====================================================
    attribute        unit    meaning
    ===============  ======  ====================================================
    amplitude        DN      peak of the Gaussian above its offset
    x_centre         px      column of the centre; the first pixel's is 0
    y_centre         px      row of the centre, downwards
    sigma_major      px      standard deviation along the long axis
    sigma_minor      px      standard deviation along the short axis
    orientation      degree  long axis, from +x (right) towards +y (down), 0 … 180
    offset           DN      reading under the Gaussian
    sigma_mean       px      mean of both widths
    …_stderr                 standard error of each, such as `sigma_mean_stderr`
    ===============  ======  ====================================================

    All are arrays over the spots, or plain numbers for a single spot. `fits[k]` is one spot, `fits[mask]` some of
    them; `len(fits)` counts them, and a loop goes through them one by one.

    Attributes
    ----------
    value, stderr : values and standard errors [spot, 8] in one array each, columns in the order of `parameters`.
    covariance : covariance [spot, 7, 7] of the first seven `parameters`, in products of their units.
    chi2_reduced : χ² per degree of freedom [spot] under the sensor's noise; NaN without a sensor.
    flags : status as bits [spot], as in the variable `status` of fits.nc; 0 is a fit that can be trusted.

    Examples
    --------
    >>> import numpy as np, spotcheck
    >>> sensor = spotcheck.SensorModel(gain_dn_per_e=0.5, read_noise_e=5, black_level_dn=20, full_scale_dn=1023)
    >>> y, x = np.mgrid[:48, :48]
    >>> photons = 900 * np.exp(-((x - 23) ** 2 + (y - 25) ** 2) / (2 * 5.0**2))
    >>> fits = spotcheck.fit_spots([sensor.draw(photons, rng=seed) for seed in (1, 2, 3)], sensor)
    >>> fits.sigma_mean.shape
    (3,)
    >>> fits[fits.status == "ok"].sigma_mean.round(1)
    array([5., 5., 5.])
    """

    value: np.ndarray
    stderr: np.ndarray
    covariance: np.ndarray
    chi2_reduced: np.ndarray
    flags: np.ndarray

    def __getattr__(self, name: str) -> np.ndarray:
        """Return a parameter [spot] or its standard error by name: a column of `value` or `stderr`."""
        parameter = name.removesuffix("_stderr")
        if parameter not in PARAMETERS:
            raise AttributeError(f"SpotFits has no attribute {name!r}; the parameters are {', '.join(NAMES)}")
        return (self.value if parameter == name else self.stderr)[..., NAMES.index(parameter)]

    def __dir__(self) -> list[str]:
        """Return the names of all attributes, for completion in an editor."""
        return [*super().__dir__(), *NAMES, *(f"{name}_stderr" for name in NAMES)]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the eight parameters, in the order of the columns of `value` and `stderr`."""
        return NAMES

    @property
    def status(self) -> np.ndarray:
        """Status of each fit [spot]: "ok", "not_converged" (no values) or "at_limit" (the image does not determine the
        amplitude, a width or the centre)."""
        return store.status_names(self.flags)

    def covariance_of(self, first: str, second: str) -> np.ndarray:
        """Return the covariance [spot] of two of the first seven `parameters`, in the product of their units."""
        return self.covariance[..., NAMES.index(first), NAMES.index(second)]

    def __len__(self) -> int:
        """Return the number of spots; a single spot raises TypeError."""
        if not np.ndim(self.flags):
            raise TypeError("a single spot has no length")
        return len(self.flags)

    def __bool__(self) -> bool:
        """Return whether there is a spot; a single spot is true."""
        return np.size(self.flags) > 0

    def __getitem__(self, index: Any) -> "SpotFits":
        """Return the spots that an index, slice or mask selects; a single spot raises TypeError."""
        if not np.ndim(self.flags):
            raise TypeError("a single spot has no index; its parameters are attributes")
        return SpotFits(*(getattr(self, field.name)[index] for field in fields(self)))

    def to_dataset(self) -> xr.Dataset:
        """Return all results as an `xarray.Dataset` with units and long names; `status` holds `flags`.

        The variables have the dimension `spot`, or none for a single spot.
        """
        dims = ("spot",)[: np.ndim(self.flags)]
        ds = xr.Dataset(attrs={"title": "fits of single spots", "dataset": "images in memory"})
        add_parameters(ds, dims, self.value, self.stderr)
        for name in ("parameter", "other_parameter"):
            add_variable(ds, name, name, np.array(FITTED_NAMES, dtype=object), "1", "name of a fitted parameter")
        units, long_name = "products of those of the parameters", "covariance of the fitted parameters"
        add_variable(ds, "covariance", (*dims, "parameter", "other_parameter"), self.covariance, units, long_name)
        long_name = "chi-square per degree of freedom under sensor noise"
        add_variable(ds, "chi2_reduced", dims, self.chi2_reduced, "1", long_name)
        ds["status"] = (dims, np.asarray(self.flags, "i4"), store.status_attributes())
        return ds

    def __repr__(self) -> str:
        """Return one line for each parameter of a single spot, or a table with one row for each spot."""
        return "\n".join(self._format_many() if np.ndim(self.flags) else self._format_single())

    def _format_single(self) -> list[str]:
        """Return the lines of a single spot, one for each parameter."""
        lines = [f"fitted spot: {self.status}, χ² per degree of freedom {self.chi2_reduced:.3g}"]
        for k, (name, (unit, _)) in enumerate(PARAMETERS.items()):
            lines.append(f"{name:<12} {quantity_text(self.value[k], self.stderr[k]):>18} {unit}")
        return lines

    def _format_many(self) -> list[str]:
        """Return a line with the number of spots by status, and a table of at most `LISTED_SPOTS` spots."""
        names, counts = np.unique(self.status, return_counts=True)
        summary = ", ".join(f"{count} {name}" for name, count in zip(names, counts, strict=True))
        lines = [f"{len(self)} fitted spots" + (f": {summary}" if summary else "")]
        rows = [["", *FITTED_NAMES, "status"], ["", *(f"[{PARAMETERS[name][0]}]" for name in FITTED_NAMES), ""]]
        for k in range(min(len(self), LISTED_SPOTS)):
            cells = [quantity_text(self.value[k, j], self.stderr[k, j]) for j in range(len(FITTED_NAMES))]
            rows.append([str(k), *cells, str(self.status[k])])
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        if len(self):
            lines += ["  ".join(map(str.rjust, row, widths)).rstrip() for row in rows]
        return lines + (["…"] if len(self) > LISTED_SPOTS else [])


def add_parameters(
    ds: xr.Dataset, dims: tuple[str, ...], value: np.ndarray, stderr: np.ndarray, origin: str = ""
) -> None:
    """Add the variables of all parameters and their standard errors to a dataset, in place.

    Parameters
    ----------
    ds : dataset to extend.
    dims : names of the dimensions of the variables.
    value, stderr : values and standard errors [*dims, 8] in the order of `PARAMETERS`.
    origin : end of the long names of x_centre and y_centre, with a leading blank, such as " on the sensor".
    """
    for k, (name, (units, long_name)) in enumerate(PARAMETERS.items()):
        long_name += origin if name.endswith("_centre") else ""
        add_variable(ds, name, dims, value[..., k], units, long_name)
        add_variable(ds, f"{name}_stderr", dims, stderr[..., k], units, f"standard error of {long_name}")
