"""The sensor by its flats and darks: photon transfer, response, signal-to-noise ratio, and what darks read."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import ScalarFormatter

from spotcheck.characterization.derived_quantities import LINEARITY_RANGE
from spotcheck.characterization.emva_quantities import Quantity
from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.io.plus_minus import plus_minus
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results, Unavailable


def _open(results: Results, *needed: str) -> tuple[xr.Dataset, dict[str, Quantity]]:
    """Levels and quantities; `Unavailable` where one that a figure lives on is unknown."""
    ds = results.get("transfer")
    found = read_quantities(ds)
    for name in needed:
        if not np.isfinite(found[name].value):
            raise Unavailable(f"{found[name].symbol} is unknown: {found[name].why}")
    return ds, found


def _light(ds: xr.Dataset) -> tuple[np.ndarray, str]:
    """Light of every flat and what it is called: photons where all are given, else exposure."""
    photons = ds["flat_photons"].values
    if np.isfinite(photons).all() and (photons > 0).all():
        return photons, "photons per pixel $\\mu_p$"
    factor, unit = style.scale(ds["flat_exposure"].values, "s")
    return ds["flat_exposure"].values * factor, style.label("exposure time $t$", unit)


class Response(NamedTuple):
    """Light of every flat, which levels the straight line of the response is fitted to, its slope and offset [DN]."""

    light: np.ndarray
    used: np.ndarray
    slope: float
    offset: float

    def of(self, light: np.ndarray) -> np.ndarray:
        """Signal [DN] of the straight line."""
        return self.slope * light + self.offset


def response_line(ds: xr.Dataset) -> Response:
    """The line of least relative squares through the levels that EMVA 1288 takes for linearity."""
    light, signal, top = _light(ds)[0], ds["signal"].values, int(ds["saturation"])
    end = signal[top] if top >= 0 else signal.max()
    use = (signal >= LINEARITY_RANGE[0] * end) & (signal <= LINEARITY_RANGE[1] * end)
    # Two levels lie on any straight line.
    known = use.sum() > 2
    slope, intercept = np.polyfit(light[use], signal[use], 1, w=1 / signal[use]) if known else (np.nan, np.nan)
    return Response(light, use, float(slope), float(intercept))


def transfer(results: Results) -> style.Drawing:
    """Variance against signal, with the line of the gain; and noise against signal by regime."""
    ds, found = _open(results, "gain")
    signal, excess, error = (ds[name].values for name in ("signal", "excess", "excess_stderr"))
    used = ds["fitted"].values > 0
    gain, dark = found["gain"].value, found["dark_noise_dn"].value
    figure = style.new(3.3)
    left, right = figure.subplots(1, 2)
    bars = left.errorbar(signal, excess, error, fmt="o", color="0.6", markersize=3, capsize=0, zorder=2)
    own = left.plot(signal[used], excess[used], "o", color=style.MEASURED, markersize=3, zorder=3)[0]
    reach = np.array([0.0, signal[used].max()])
    law = left.plot(reach, gain * reach, color=style.SIMULATED, zorder=4)[0]
    left.set_xlabel("signal $\\mu_y - \\mu_{y.dark}$ / DN")
    left.set_ylabel("variance $\\sigma_y^2 - \\sigma_{y.dark}^2$ / DN²")
    positive = signal > 0
    noise = np.sqrt(np.maximum(excess + dark**2, 0.0))
    right.plot(signal[positive], noise[positive], "o", color="0.6", markersize=3)
    right.plot(signal[used], noise[used], "o", color=style.MEASURED, markersize=3)
    x = np.geomspace(max(signal[positive].min() / 3, 1e-2), signal.max(), 200)
    right.plot(x, np.sqrt(dark**2 + gain * x), color=style.SIMULATED)
    floor = right.axhline(dark, color=style.ACCENT, linestyle=(0, (4, 2)))
    shot = right.plot(x, np.sqrt(gain * x), color=style.ACCENT, linestyle=(0, (1, 1.5)))[0]
    right.set_xscale("log")
    right.set_yscale("log")
    right.set_ylim(max(0.3 * dark, 1e-2), None)
    right.set_xlabel("signal $\\mu_y - \\mu_{y.dark}$ / DN")
    right.set_ylabel("noise $\\sigma_y$ / DN")
    handles = [own, bars, law, floor, shot]
    names = ["levels fitted", "other levels", "$K$ and noise of the dark", "dark noise alone", "shot noise alone"]
    style.legend_above(figure, handles, names, 3)
    text = (
        f"Photon transfer: K = {_said(found['gain'])}, from {int(used.sum())} levels up to {signal[used].max():.4g} DN"
        f" (70 % of saturation); noise without light {_said(found['dark_noise'])}. Variances are those of differences"
        " of two frames. Left: their rise with the signal, whose slope is K, until the well is full or the converter"
        " at its end. Right: the same as noise, with its two regimes."
    )
    return style.Drawing(figure, text)


def response(results: Results) -> style.Drawing:
    """Signal against light, and its deviation from the line of the linearity error."""
    ds, found = _open(results, "linearity_error")
    name, line = _light(ds)[1], response_line(ds)
    signal, error, light, use = ds["signal"].values, ds["flat_mean_stderr"].values, line.light, line.used
    figure = style.new(3.0)
    left, right = figure.subplots(1, 2)
    for ax, values, bars in (
        (left, signal, error),
        (right, 100 * (signal / line.of(light) - 1), 100 * error / np.abs(signal)),
    ):
        ax.errorbar(light[~use], values[~use], bars[~use], fmt="o", color="0.6", markersize=3, capsize=0)
        ax.errorbar(light[use], values[use], bars[use], fmt="o", color=style.MEASURED, markersize=3, capsize=0)
        ax.set_xlabel(name)
    reach = np.array([0.0, light[use].max()])
    left.plot(reach, line.of(reach), color=style.SIMULATED)
    right.axhline(0, color=style.SIMULATED)
    most = 1.6 * max(abs(found["linearity_lowest"].value), abs(found["linearity_highest"].value))
    right.set_ylim(-most, most)
    left.set_ylabel("signal $\\mu_y - \\mu_{y.dark}$ / DN")
    right.set_ylabel("deviation from the line / %")
    text = (
        f"Response and linearity: LE = {_said(found['linearity_error'])} on average, from"
        f" {_said(found['linearity_lowest'])} to {_said(found['linearity_highest'])}, about the line of least relative"
        " squares through the levels between 5 and 95 % of saturation (blue). Levels whose deviation lies beyond the"
        " right panel are not shown."
    )
    return style.Drawing(figure, text)


def ratio(results: Results) -> style.Drawing:
    """Signal-to-noise ratio against light, beside the sensor's model and the ideal camera."""
    ds, found = _open(results, "gain")
    signal = ds["signal"].values
    total = ds["excess"].values + found["dark_noise_dn"].value ** 2
    good = (signal > 0) & (total > 0) & (ds["flat_at_full"].values < 0.5)
    gain, dark = found["gain"].value, found["dark_noise_dn"].value
    eta = found["quantum_efficiency"].value
    known = np.isfinite(eta)
    # Without photons the abscissa is electrons, of which the ideal camera loses none either.
    scale = gain * eta if known else gain
    figure = style.new(3.4)
    ax = figure.subplots()
    own = ax.plot(signal[good] / scale, signal[good] / np.sqrt(total[good]), "o", color=style.MEASURED, markersize=3)[0]
    x = np.geomspace(0.5, 1.3 * signal[good].max() / scale, 300)
    model = ax.plot(x, scale * x / np.sqrt(dark**2 + gain * scale * x), color=style.SIMULATED)[0]
    ideal = ax.plot(x, np.sqrt(x), color="black", linestyle=(0, (4, 2)))[0]
    least = found["threshold_photons" if known else "threshold"].value
    ax.axvline(least, color=style.ACCENT, linewidth=1)
    handles, names = [own, model, ideal], ["levels", "model of the sensor", "ideal camera"]
    if np.isfinite(found["full_well"].value):
        ax.axvline(found["full_well"].value / (eta if known else 1), color=style.ACCENT, linewidth=1)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("photons per pixel $\\mu_p$" if known else "electrons $\\mu_e$")
    ax.set_ylabel("signal-to-noise ratio")
    style.legend_above(figure, handles, names, 3)
    text = f"Signal-to-noise ratio. Green lines: the sensitivity threshold, {_said(found['threshold'])}"
    if np.isfinite(found["full_well"].value):
        text += f", and the saturation capacity, {_said(found['full_well'])}; between them lie"
        text += f" {20 * np.log10(found['dynamic_range'].value):.1f} dB"
    return style.Drawing(figure, text + ". The ideal camera has shot noise alone and loses no photon.")


def dark(results: Results) -> style.Drawing:
    """Mean and variance without light against exposure."""
    ds, found = _open(results, "dark_current")
    factor, unit = style.scale(ds["dark_exposure"].values, "s")
    x = ds["dark_exposure"].values
    gain, offset = found["gain"].value, found["dark_offset"].value
    current = found["dark_current"].value
    figure = style.new(2.8)
    panels = figure.subplots(1, 2)
    noise = found["dark_noise_dn"].value ** 2
    by_noise = found["dark_current_by_variance"].value
    for ax, name, label, line in (
        (panels[0], "mean", "mean $\\mu_{y.dark}$ / DN", offset + gain * current * x),
        (panels[1], "variance", "variance $\\sigma_{y.dark}^2$ / DN²", noise + gain**2 * by_noise * x),
    ):
        values, error = ds[f"dark_{name}"].values, ds[f"dark_{name}_stderr"].values
        ax.errorbar(x * factor, values, error, fmt="o", color=style.MEASURED, markersize=3, capsize=0)
        ax.plot(x * factor, line, color=style.SIMULATED)
        _plain(ax)
        ax.set_xlabel(style.label("exposure time $t$", unit))
        ax.set_ylabel(label)
    text = (
        f"Without light: offset {_said(found['dark_offset'])}, dark current {_said(found['dark_current'])} by the mean"
        f" and {_said(found['dark_current_by_variance'])} by the noise."
    )
    return style.Drawing(figure, text)


def _plain(ax: Axes) -> None:
    """Ticks in full: small steps upon a large offset."""
    ax.ticklabel_format(axis="y", useOffset=False)


def _said(own: Quantity) -> str:
    return plus_minus(own.value, own.stderr, "" if own.unit == "1" else own.unit).replace("-", "−", 1)


def pattern(results: Results) -> style.Drawing:
    """Pictures of the pattern without light and at half of saturation, and their spectra."""
    ds, found = _open(results)
    kinds = [kind for kind in ("dark", "flat") if f"{kind}_picture" in ds]
    if not kinds:
        raise Unavailable("no level has a pattern to show")
    figure = style.new(2.6 * len(kinds))
    axes = figure.subplots(len(kinds), 2, squeeze=False, width_ratios=(1, 1.25))
    titles = {"dark": "without light", "flat": "at half of saturation"}
    for (left, right), kind in zip(axes, kinds, strict=True):
        picture, side = ds[f"{kind}_picture"].values, int(ds[f"{kind}_shown_side"])
        low, high = np.quantile(picture, (0.01, 0.99))
        rows, columns = (n * side for n in picture.shape)
        shown = left.imshow(picture, cmap=style.IMAGE_MAP, vmin=low, vmax=high, extent=(0, columns, rows, 0))
        left.grid(False)
        left.set_title(titles[kind])
        left.set_xlabel("column / px")
        left.set_ylabel("row / px")
        figure.colorbar(shown, ax=left, shrink=0.85, label="off the mean / DN")
        for axis, colour in (("rows", style.MEASURED), ("columns", style.SIMULATED)):
            frequency = ds[f"{kind}_{axis}_frequency"].values[1:]
            right.plot(
                frequency, ds[f"{kind}_along_{axis}"].values[1:], color=colour, linewidth=0.9, label=f"along {axis}"
            )
        right.axhline(float(ds[f"{kind}_shown_noise"]), color="black", linestyle=(0, (4, 2)), label="noise in time")
        right.set_yscale("log")
        # Plain numbers: an axis of less than a decade has no power of ten of its own.
        right.yaxis.set_major_formatter(ScalarFormatter())
        right.yaxis.set_minor_formatter(ScalarFormatter())
        right.set_xlabel("spatial frequency / cycles per px")
        right.set_ylabel("rms spectrum / DN")
    handles, names = axes[0][1].get_legend_handles_labels()
    style.legend_above(figure, handles, names, 3)
    text = (
        f"What stays from frame to frame: DSNU {_said(found['dsnu'])}, PRNU {_said(found['prnu'])}. Left: mean images"
        " less their means, cut at the first and last hundredth. Right: their spectra; white non-uniformity lies flat"
        " above the dashed line of the noise that is left in the mean, stripes and hum stand out as peaks."
    )
    return style.Drawing(figure, text)


FIGURES = (
    Entry("photon-transfer", "Photon transfer", Category.SENSOR, ("transfer",), transfer),
    Entry("response", "Response and linearity", Category.SENSOR, ("transfer",), response),
    Entry("signal-to-noise", "Signal-to-noise ratio", Category.SENSOR, ("transfer",), ratio),
    Entry("dark", "Without light", Category.SENSOR, ("transfer",), dark),
    Entry("pattern", "Pattern of the sensor", Category.SENSOR, ("transfer",), pattern),
)
