"""Sensor by flats and darks (EMVA 1288): photon transfer, linearity, signal-to-noise ratio, dark signal, patterns.

A level is a set of equal flats (or darks): frames of the same exposure and light. The signal of a level is its mean
less that of its dark; its excess is its variance in time less that of its dark, both at the same exposure. A dark
is a level without light. All values are those of transfer.nc.
"""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.colors import Normalize
from matplotlib.ticker import ScalarFormatter

from spotcheck.characterization.derived_quantities import LINEARITY_RANGE
from spotcheck.characterization.emva_quantities import Quantity
from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.io.number_text import quantity_text
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

SIGNAL = "signal $\\mu_y - \\mu_{y.dark}$ / DN"
# Looks of the levels that a fit uses, and of the other levels.
USED_LEVELS: dict[str, Any] = {"color": style.MEASURED, "markersize": 3}
OTHER_LEVELS: dict[str, Any] = {"color": "0.6", "markersize": 3}
# A level with at least this fraction of its pixels at full scale is not shown.
MAX_CLIPPED = 0.5
# Smallest number of levels to which a line is fitted: two always lie on one.
MIN_LEVELS = 3
# Quantiles of a pattern at which its colours end.
COLOUR_QUANTILES = (0.01, 0.99)
DASHED, DOTTED = (0, (4, 2)), (0, (1, 1.5))


def _read_quantities(results: Results, *required: str) -> tuple[xr.Dataset, dict[str, Quantity]]:
    """Return transfer.nc, and its quantities by name. Raises `Unavailable` if a `required` one is unknown."""
    ds = results.get("transfer")
    quantities = read_quantities(ds)
    for name in required:
        if not np.isfinite(quantities[name].value):
            raise Unavailable(f"{quantities[name].symbol} is unknown: {quantities[name].why}")
    return ds, quantities


def _quantity_text(quantity: Quantity) -> str:
    """Return a quantity with its standard error and unit as text."""
    return quantity_text(quantity.value, quantity.stderr, quantity.unit)


def _read_light(ds: xr.Dataset) -> tuple[np.ndarray, str]:
    """Return the light of each flat level of transfer.nc [flat], and the label of its axis.

    The light is the number of photons per pixel if all are known, else the exposure in the displayed unit.
    """
    photons = ds["flat_photons"].values
    if np.isfinite(photons).all() and (photons > 0).all():
        return photons, "photons per pixel $\\mu_p$"
    exposure = ds["flat_exposure"].values
    factor, unit = style.choose_unit(exposure, "s")
    return exposure * factor, style.axis_label("exposure time $t$", unit)


class ResponseLine(NamedTuple):
    """Straight line through the response of the sensor: signal = slope · light + offset."""

    light: np.ndarray  # light of each flat level [photons, or exposure in the displayed unit]
    is_used: np.ndarray  # whether the line is fitted to the level [flat]
    predict: np.poly1d  # signal [DN] of the line at any light; NaN if fewer than `MIN_LEVELS` levels are used
    deviation: np.ndarray  # relative deviation of the signal of each level from the line [%, flat]


def fit_response_line(ds: xr.Dataset) -> ResponseLine:
    """Fit a line by least squares of relative residuals to the levels that EMVA 1288 uses for linearity.

    These are the levels with a signal between the two fractions `LINEARITY_RANGE` of the signal at saturation. `ds` is
    the content of transfer.nc.
    """
    light, signal, saturated_level = _read_light(ds)[0], ds["signal"].values, int(ds["saturation"])
    # The level is -1 if no flat is saturated.
    saturation = signal[saturated_level] if saturated_level >= 0 else signal.max()
    is_used = (signal >= LINEARITY_RANGE[0] * saturation) & (signal <= LINEARITY_RANGE[1] * saturation)
    coefficients = np.full(2, np.nan)
    if is_used.sum() >= MIN_LEVELS:
        coefficients = np.polyfit(light[is_used], signal[is_used], 1, w=1 / signal[is_used])
    predict = np.poly1d(coefficients)
    return ResponseLine(light, is_used, predict, 100 * (signal / predict(light) - 1))


def draw_photon_transfer(results: Results) -> style.Drawing:
    """Draw variance against signal with the line of the gain, and noise against signal with its regimes.

    Raises `Unavailable` if the gain is unknown.
    """
    ds, quantities = _read_quantities(results, "gain")
    signal, excess, stderr = (ds[name].values for name in ("signal", "excess", "excess_stderr"))
    is_used, is_positive = ds["fitted"].values > 0, signal > 0
    gain, dark_noise = quantities["gain"].value, quantities["dark_noise_dn"].value
    figure = style.new_figure(3.3)
    left, right = figure.subplots(1, 2)
    other_levels = left.errorbar(signal, excess, stderr, fmt="o", capsize=0, zorder=2, **OTHER_LEVELS)
    used_levels = left.plot(signal[is_used], excess[is_used], "o", zorder=3, **USED_LEVELS)[0]
    ends = np.array([0.0, signal[is_used].max()])
    model = left.plot(ends, gain * ends, color=style.SIMULATED, zorder=4)[0]
    left.set(xlabel=SIGNAL, ylabel="variance $\\sigma_y^2 - \\sigma_{y.dark}^2$ / DN²")
    noise = np.sqrt(np.maximum(excess + dark_noise**2, 0.0))
    right.plot(signal[is_positive], noise[is_positive], "o", **OTHER_LEVELS)
    right.plot(signal[is_used], noise[is_used], "o", **USED_LEVELS)
    x = np.geomspace(max(signal[is_positive].min() / 3, 1e-2), signal.max(), 200)
    right.plot(x, np.sqrt(dark_noise**2 + gain * x), color=style.SIMULATED)
    # The two regimes: read noise at small signals, shot noise at large ones.
    dark_line = right.axhline(dark_noise, color=style.ACCENT, linestyle=DASHED)
    shot_line = right.plot(x, np.sqrt(gain * x), color=style.ACCENT, linestyle=DOTTED)[0]
    right.set(xscale="log", yscale="log", xlabel=SIGNAL, ylabel="noise $\\sigma_y$ / DN")
    right.set_ylim(max(0.3 * dark_noise, 1e-2), None)
    handles = [used_levels, other_levels, model, dark_line, shot_line]
    names = ["levels fitted", "other levels", "$K$ and noise of the dark", "dark noise alone", "shot noise alone"]
    style.add_legend(figure, handles, names, 3)
    caption = (
        f"Photon transfer: K = {_quantity_text(quantities['gain'])}, from {int(is_used.sum())} levels up to"
        f" {signal[is_used].max():.4g} DN (70 % of saturation); noise without light"
        f" {_quantity_text(quantities['dark_noise'])}. Variances are those of differences of two frames. Left: their"
        " rise with the signal, whose slope is K, until the well is full or the converter at its end. Right: the same"
        " as noise, with its two regimes."
    )
    return style.Drawing(figure, caption)


def draw_response(results: Results) -> style.Drawing:
    """Draw signal against light, and its relative deviation from the line that defines the linearity error.

    Raises `Unavailable` if the linearity error is unknown.
    """
    ds, quantities = _read_quantities(results, "linearity_error")
    line, signal, stderr = fit_response_line(ds), ds["signal"].values, ds["flat_mean_stderr"].values
    light, is_used = line.light, line.is_used
    figure = style.new_figure(3.0)
    left, right = figure.subplots(1, 2)
    for ax, values, errors in ((left, signal, stderr), (right, line.deviation, 100 * stderr / np.abs(signal))):
        for levels, look in ((~is_used, OTHER_LEVELS), (is_used, USED_LEVELS)):
            ax.errorbar(light[levels], values[levels], errors[levels], fmt="o", capsize=0, **look)
        ax.set_xlabel(_read_light(ds)[1])
    ends = np.array([0.0, light[is_used].max()])
    left.plot(ends, line.predict(ends), color=style.SIMULATED)
    right.axhline(0, color=style.SIMULATED)
    lowest, highest = quantities["linearity_lowest"], quantities["linearity_highest"]
    limit = 1.6 * max(abs(lowest.value), abs(highest.value))
    right.set(ylim=(-limit, limit), ylabel="deviation from the line / %")
    left.set_ylabel(SIGNAL)
    caption = (
        f"Response and linearity: LE = {_quantity_text(quantities['linearity_error'])} on average, from"
        f" {_quantity_text(lowest)} to {_quantity_text(highest)}, about the line of least relative squares through the"
        " levels between 5 and 95 % of saturation (blue). Levels whose deviation lies beyond the right panel are not"
        " shown."
    )
    return style.Drawing(figure, caption)


def draw_signal_to_noise(results: Results) -> style.Drawing:
    """Draw the signal-to-noise ratio against light, with the model of the sensor and the ideal camera.

    Light is in photons, or in electrons if the quantum efficiency is unknown. Raises `Unavailable` if the gain is
    unknown.
    """
    ds, quantities = _read_quantities(results, "gain")
    signal, variance = ds["signal"].values, ds["excess"].values + quantities["dark_noise_dn"].value ** 2
    is_shown = (signal > 0) & (variance > 0) & (ds["flat_at_full"].values < MAX_CLIPPED)
    signal, variance = signal[is_shown], variance[is_shown]
    gain, dark_noise = quantities["gain"].value, quantities["dark_noise_dn"].value
    efficiency, full_well = quantities["quantum_efficiency"].value, quantities["full_well"]
    has_photons = np.isfinite(efficiency)
    # Signal [DN] per photon, or per electron.
    scale = gain * efficiency if has_photons else gain
    figure = style.new_figure(3.4)
    ax = figure.subplots()
    levels = ax.plot(signal / scale, signal / np.sqrt(variance), "o", **USED_LEVELS)[0]
    x = np.geomspace(0.5, 1.3 * signal.max() / scale, 300)
    model = ax.plot(x, scale * x / np.sqrt(dark_noise**2 + gain * scale * x), color=style.SIMULATED)[0]
    ideal = ax.plot(x, np.sqrt(x), color="black", linestyle=DASHED)[0]
    limits = [quantities["threshold_photons" if has_photons else "threshold"].value]
    if np.isfinite(full_well.value):
        limits.append(full_well.value / (efficiency if has_photons else 1))
    for limit in limits:
        ax.axvline(limit, color=style.ACCENT, linewidth=1)
    ax.set(xscale="log", yscale="log", ylabel="signal-to-noise ratio")
    ax.set_xlabel("photons per pixel $\\mu_p$" if has_photons else "electrons $\\mu_e$")
    style.add_legend(figure, [levels, model, ideal], ["levels", "model of the sensor", "ideal camera"], 3)
    threshold = _quantity_text(quantities["threshold"])
    caption = f"Signal-to-noise ratio. Green lines: the sensitivity threshold, {threshold}"
    if np.isfinite(full_well.value):
        caption += f", and the saturation capacity, {_quantity_text(full_well)}; between them lie"
        caption += f" {20 * np.log10(quantities['dynamic_range'].value):.1f} dB"
    return style.Drawing(figure, caption + ". The ideal camera has only shot noise and detects every photon.")


def draw_dark_signal(results: Results) -> style.Drawing:
    """Draw mean and variance without light against exposure, with the lines that the dark current gives.

    Raises `Unavailable` if the dark current is unknown.
    """
    ds, quantities = _read_quantities(results, "dark_current")
    exposure = ds["dark_exposure"].values
    factor, unit = style.choose_unit(exposure, "s")
    gain, offset, current, noise, current_by_variance = (
        quantities[name].value
        for name in ("gain", "dark_offset", "dark_current", "dark_noise_dn", "dark_current_by_variance")
    )
    figure = style.new_figure(2.8)
    for ax, name, label, line in zip(
        figure.subplots(1, 2),
        ("mean", "variance"),
        ("mean $\\mu_{y.dark}$ / DN", "variance $\\sigma_{y.dark}^2$ / DN²"),
        (offset + gain * current * exposure, noise**2 + gain**2 * current_by_variance * exposure),
        strict=True,
    ):
        values, stderr = ds[f"dark_{name}"].values, ds[f"dark_{name}_stderr"].values
        ax.errorbar(exposure * factor, values, stderr, fmt="o", capsize=0, **USED_LEVELS)
        ax.plot(exposure * factor, line, color=style.SIMULATED)
        # Full numbers at the ticks, since the steps are small beside the offset.
        ax.ticklabel_format(axis="y", useOffset=False)
        ax.set(xlabel=style.axis_label("exposure time $t$", unit), ylabel=label)
    caption = (
        f"Without light: offset {_quantity_text(quantities['dark_offset'])}, dark current"
        f" {_quantity_text(quantities['dark_current'])} by the mean and"
        f" {_quantity_text(quantities['dark_current_by_variance'])} by the noise."
    )
    return style.Drawing(figure, caption)


def draw_patterns(results: Results) -> style.Drawing:
    """Draw the fixed pattern without light and at half of saturation, and their spectra.

    Raises `Unavailable` if transfer.nc has no pattern.
    """
    ds, quantities = _read_quantities(results)
    titles = {"dark": "without light", "flat": "at half of saturation"}
    kinds = [kind for kind in titles if f"{kind}_picture" in ds]
    if not kinds:
        raise Unavailable("no level has a pattern to show")
    figure = style.new_figure(2.6 * len(kinds))
    axes = figure.subplots(len(kinds), 2, squeeze=False, width_ratios=(1, 1.25))
    for (left, right), kind in zip(axes, kinds, strict=True):
        # Deviation from the mean [block row, block column] in DN, averaged over square blocks of pixels.
        pattern, block_side = ds[f"{kind}_picture"].values, int(ds[f"{kind}_shown_side"])
        norm = Normalize(*np.quantile(pattern, COLOUR_QUANTILES))
        rows, columns = (count * block_side for count in pattern.shape)
        labels = {"title": titles[kind], "xlabel": "column / px", "ylabel": "row / px"}
        artist = style.show_image(left, pattern, style.IMAGE_MAP, norm, (0, columns, rows, 0), **labels)
        figure.colorbar(artist, ax=left, shrink=0.85, label="off the mean / DN")
        for axis, colour in (("rows", style.MEASURED), ("columns", style.SIMULATED)):
            # The first frequency is 0, where the mean was subtracted.
            frequency, spectrum = (ds[f"{kind}_{name}"].values[1:] for name in (f"{axis}_frequency", f"along_{axis}"))
            right.plot(frequency, spectrum, color=colour, linewidth=0.9, label=f"along {axis}")
        right.axhline(float(ds[f"{kind}_shown_noise"]), color="black", linestyle=DASHED, label="noise in time")
        right.set_yscale("log")
        # Plain numbers, since an axis of less than a decade contains no power of ten.
        right.yaxis.set_major_formatter(ScalarFormatter())
        right.yaxis.set_minor_formatter(ScalarFormatter())
        right.set(xlabel="spatial frequency / cycles per px", ylabel="rms spectrum / DN")
    handles, names = axes[0][1].get_legend_handles_labels()
    style.add_legend(figure, handles, names, 3)
    caption = (
        f"Fixed pattern: DSNU {_quantity_text(quantities['dsnu'])}, PRNU {_quantity_text(quantities['prnu'])}. Left:"
        " mean images less their means, cut at the first and last hundredth. Right: their spectra; white"
        " non-uniformity lies flat above the dashed line of the noise that is left in the mean, stripes and hum stand"
        " out as peaks."
    )
    return style.Drawing(figure, caption)


FIGURES = tuple(
    Entry(name, title, Category.SENSOR, ("transfer",), draw)
    for name, title, draw in (
        ("photon-transfer", "Photon transfer", draw_photon_transfer),
        ("response", "Response and linearity", draw_response),
        ("signal-to-noise", "Signal-to-noise ratio", draw_signal_to_noise),
        ("dark", "Dark signal", draw_dark_signal),
        ("pattern", "Fixed pattern of the sensor", draw_patterns),
    )
)
