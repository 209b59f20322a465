"""Fig. 13: Cramér–Rao bounds of the photons on the brightest pixel and of the width of the spot.

The Cramér–Rao bound is the smallest variance that an unbiased estimate can have. p1 and p2 are the parameters of the
law that gives the spot's width at an exposure (Eq. 8 of the paper).
"""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from spotcheck.io.number_text import two_digits
from spotcheck.paper.bright_pixel import PRINTED_PEAK_VARIANCE, PRINTED_SIGMA_VARIANCE, printed_curves
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

# Look of the bound by noise model, a coordinate `law` of bounds.nc; the label is that of the legend.
LOOKS: dict[str, dict[str, Any]] = {
    "poisson_gauss": {"color": "#000000", "linestyle": (0, ()), "label": "electrons, with read noise"},
    "poisson": {"color": "#0072B2", "linestyle": (0, (5, 2)), "label": "electrons, Poisson alone"},
    "dn": {"color": "#D55E00", "linestyle": (0, (1.2, 1.6)), "label": "mean in DN as Poisson"},
}
# Names of these line styles in the caption.
LINE_NAMES = {"poisson_gauss": "Solid", "poisson": "dashed", "dn": "dotted"}
# Dashes of the paper's curves.
PAPER_DASHES = (0, (6, 1.5, 1.2, 1.5))


# Exposure times [point] in the unit of the abscissa, and variances [point] as the paper seems to have computed them,
# scaled to its largest printed values: of the photons on the brightest pixel ("peak") in photons², and of the width
# ("sigma") in m².
PaperCurves = dict[str, np.ndarray]


class Abscissa(NamedTuple):
    """Abscissa of the bounds."""

    name: str  # end of the names of the variables in bounds.nc: "exposure" or "photons"
    values: np.ndarray  # values at which the bounds were computed [point], in the unit of the label
    marks: np.ndarray  # values at the exposures of the dataset [exposure], in the unit of the label
    label: str  # label of the axis with unit


def draw_over_exposure(results: Results) -> style.Drawing:
    """Draw Fig. 13a: bounds over the exposure time. Raises `Unavailable` if no bound is finite."""
    ds = results.get("bounds")
    factor, unit = style.choose_unit(results.exposures(), "s")
    label = style.axis_label("exposure time $t$", unit)
    x = Abscissa("exposure", ds["fine_exposure"].values * factor, results.exposures() * factor, label)
    paper = None
    if results.has_paper_design():
        times, peak, sigma = printed_curves(results.instrument)
        # The printed ranges are (smallest, largest) value.
        peak, sigma = peak / peak.max() * PRINTED_PEAK_VARIANCE[1], sigma / sigma.max() * PRINTED_SIGMA_VARIANCE[1]
        paper = {"times": times * factor, "peak": peak, "sigma": sigma}
    return _draw_bounds(results, ds, x, fixed="along the calibrated p1 and p2", marked="exposure times", paper=paper)


def draw_over_photons(results: Results) -> style.Drawing:
    """Draw Fig. 13b: bounds over the photons on the brightest pixel. Raises `Unavailable` if no bound is finite."""
    ds = results.get("bounds")
    log_exposure = np.log(ds["fine_exposure"].values)
    marks = np.interp(np.log(results.exposures()), log_exposure, ds["peak_photons"].values)
    x = Abscissa("photons", ds["photons"].values, marks, "photons on the brightest pixel $\\mu_{p,max}$")
    fixed, marked = "at the width of the middle exposure", "peaks at its exposure times"
    return _draw_bounds(results, ds, x, fixed=fixed, marked=marked)


def _draw_bounds(
    results: Results, ds: xr.Dataset, x: Abscissa, *, fixed: str, marked: str, paper: PaperCurves | None = None
) -> style.Drawing:
    """Draw the bounds of peak and width over `x`; `ds` is the content of bounds.nc.

    `fixed` and `marked` are parts of the caption: the law or width that is held fixed, and the meaning of the marks.
    """
    pitch = float(ds["pixel_pitch"])
    has_pitch = np.isfinite(pitch)
    unit = "m²" if has_pitch else "px²"
    laws = [str(name) for name in ds["law"].values]
    figure = style.new_figure(3.4)
    panels = figure.subplots(1, 2)
    handles: list = []
    ranges = []  # range of each bound as text
    for ax, parameter in zip(panels, ("peak", "sigma"), strict=True):
        values = ds[f"var_{parameter}_over_{x.name}"].transpose(..., "law").values
        if not np.isfinite(values).any():
            raise Unavailable("no bound is finite")
        if parameter == "sigma" and has_pitch:
            values = values * pitch**2
        electron_bounds = values[:, [law != "dn" for law in laws]]
        ranges.append(f"{two_digits(np.nanmin(electron_bounds))} to {two_digits(np.nanmax(electron_bounds))}")
        for mark in x.marks:
            ax.axvline(mark, color="0.75", linewidth=3.0, zorder=1)
        handles = [
            ax.plot(x.values, bound, linewidth=1.6, **LOOKS[law])[0] for law, bound in zip(laws, values.T, strict=True)
        ]
        if paper is not None:
            look = {"color": style.ACCENT, "linestyle": PAPER_DASHES, "linewidth": 1.6}
            handles += ax.plot(paper["times"], paper[parameter], **look)
            values = np.append(values.ravel(), paper[parameter])
        ax.set(xscale="log", yscale="log", xlabel=x.label)
        # Whole decades, since an axis of less than one has many long numbers: 2 · 10⁻¹⁶, 3 · 10⁻¹⁶, …
        finite = values[np.isfinite(values) & (values > 0)]
        ax.set_ylim(10 ** np.floor(np.log10(finite.min())), 10 ** np.ceil(np.log10(finite.max())))
    panels[0].set_ylabel("bound Var($\\mu_{p,max}$) / photons²")
    panels[1].set_ylabel(f"bound Var($\\sigma_g$) / {unit}")
    labels = [LOOKS[law]["label"] for law in laws] + (["the paper's, brightest pixel"] if paper is not None else [])
    style.add_legend(figure, handles, labels, min(len(labels), 2 if paper is not None else 3))
    law_text = "; ".join(f"{LINE_NAMES[law]}: {ds.attrs[f'law_{law}']}" for law in laws)
    caption = (
        f"Smallest variance that an unbiased estimate of one frame can have, {fixed}: photons on the brightest pixel"
        f" (left) and width σ_g on the sensor (right). Grey bars: the dataset's {marked}. {law_text}. In electrons the"
        f" left bound runs from {ranges[0]} photons², the right one from {ranges[1]} {unit}."
    )
    if paper is not None:
        caption += (
            " Green, dash-dotted: what the paper seems to have drawn, from its printed p1 and p2 in px: the information"
            " of the brightest pixel alone, for one parameter at a time, with a number of photons that follows p_b²"
            " (Eqs. 13, 28, 36). Between 1 µs and 1 s it spans factors of 8.5 · 10⁶ and 60.5, in print 8.8 · 10⁶ and"
            " 62.5; its scale, which does not follow from the print, is set to the printed largest values. It is no"
            " bound for both parameters: the bounds in electrons, of all pixels, are."
        )
    return style.Drawing(figure, caption)


FIGURES = (
    Entry("fig13a", "Bounds over exposure time", Category.BOUNDS, ("bounds",), draw_over_exposure, "Fig. 13a"),
    Entry("fig13b", "Bounds over photons", Category.BOUNDS, ("bounds",), draw_over_photons, "Fig. 13b"),
)
