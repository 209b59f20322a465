"""Fig. 13: Cramér–Rao bounds of the peak's photons and of the spot's width."""

import numpy as np
import xarray as xr

from spotcheck.io.plus_minus import two_digits
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

LOOKS = {
    "poisson_gauss": ("#000000", (0, ()), "Solid"),
    "poisson": ("#0072B2", (0, (5, 2)), "dashed"),
    "dn": ("#D55E00", (0, (1.2, 1.6)), "dotted"),
}
NAMES = {
    "poisson_gauss": "electrons, with read noise",
    "poisson": "electrons, Poisson alone",
    "dn": "mean in DN as Poisson",
}


def over_exposure(results: Results) -> style.Drawing:
    """Fig. 13a: bounds over the exposure time."""
    ds = results.get("bounds")
    factor, unit = style.scale(results.exposures(), "s")
    x = ds["fine_exposure"].values * factor
    marks = results.exposures() * factor
    return _draw(results, ds, "exposure", x, marks, style.label("exposure time $t$", unit), "exposure times")


def over_photons(results: Results) -> style.Drawing:
    """Fig. 13b: bounds over the photons on the brightest pixel."""
    ds = results.get("bounds")
    fine = ds["fine_exposure"].values
    marks = np.interp(np.log(results.exposures()), np.log(fine), ds["peak_photons"].values)
    label = "photons on the brightest pixel $\\mu_{p,max}$"
    return _draw(results, ds, "photons", ds["photons"].values, marks, label, "peaks at its exposure times")


def _draw(
    results: Results, ds: xr.Dataset, over: str, x: np.ndarray, marks: np.ndarray, xlabel: str, marked: str
) -> style.Drawing:
    pitch = float(ds["pixel_pitch"])
    metres = np.isfinite(pitch)
    figure = style.new(3.4)
    panels = figure.subplots(1, 2)
    handles: list = []
    ranges = []
    for ax, parameter in zip(panels, ("peak", "sigma"), strict=True):
        values = ds[f"var_{parameter}_over_{over}"].transpose(..., "law").values
        if not np.isfinite(values).any():
            raise Unavailable("no bound is finite")
        if parameter == "sigma" and metres:
            values = values * pitch**2
        in_electrons = values[:, [str(name) != "dn" for name in ds["law"].values]]
        ranges.append((np.nanmin(in_electrons), np.nanmax(in_electrons)))
        for mark in marks:
            ax.axvline(mark, color="0.75", linewidth=3.0, zorder=1)
        handles = [
            ax.plot(x, values[:, k], color=LOOKS[law][0], linestyle=LOOKS[law][1], linewidth=1.6)[0]
            for k, law in enumerate(str(name) for name in ds["law"].values)
        ]
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_xlabel(xlabel)
        # Whole decades: an axis of less than one would be numbered at 2 · 10⁻¹⁶, 3 · 10⁻¹⁶, …
        finite = values[np.isfinite(values) & (values > 0)]
        ax.set_ylim(10 ** np.floor(np.log10(finite.min())), 10 ** np.ceil(np.log10(finite.max())))
    panels[0].set_ylabel("bound Var($\\mu_{p,max}$) / photons²")
    panels[1].set_ylabel(f"bound Var($\\sigma_g$) / {'m²' if metres else 'px²'}")
    style.legend_above(figure, handles, [NAMES[str(name)] for name in ds["law"].values], 3)
    laws = "; ".join(f"{LOOKS[str(n)][2]}: {ds.attrs[f'law_{n}']}" for n in ds["law"].values)
    fixed = "along the calibrated p1 and p2" if over == "exposure" else "at the width of the middle exposure"
    (low, high), (narrow, wide) = ((two_digits(v) for v in pair) for pair in ranges)
    caption = (
        f"Smallest variance that an unbiased estimate of one frame can have, {fixed}: photons on the brightest pixel"
        f" (left) and width σ_g on the sensor (right). Grey bars: the dataset's {marked}. {laws}. In electrons the left"
        f" bound runs from {low} to {high} photons², the right one from {narrow} to {wide} {'m²' if metres else 'px²'}."
    )
    clause = "In print: 3 · 10⁷ to 2.65 · 10¹⁴ for the photons, 2 · 10⁻¹⁸ to 1.25 · 10⁻¹⁶ m² for the width."
    return style.Drawing(figure, caption + results.beside_paper(clause))


FIGURES = (
    Entry("fig13a", "Bounds over exposure time", Category.BOUNDS, ("bounds",), over_exposure, "Fig. 13a"),
    Entry("fig13b", "Bounds over photons", Category.BOUNDS, ("bounds",), over_photons, "Fig. 13b"),
)
