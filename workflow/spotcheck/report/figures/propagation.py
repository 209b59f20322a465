"""Fig. 7: the beam propagation parameters p1 and p2 of every fibre orientation."""

import numpy as np
import xarray as xr

from spotcheck.io.plus_minus import plus_minus
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results


def draw(results: Results) -> style.Drawing:
    """p1 (left ordinate) and p2 (right ordinate) over the angle, by the estimator that the simulation runs on."""
    calibration = results.get("calibration")
    used = str(calibration.attrs["used"])
    own = calibration.sel(estimator=used)
    site_dims = tuple(str(d) for d in own["p1"].dims)
    # Exposure is what p1 and p2 are regressed on: the axes left are the sites'.
    across = next((d for d in ("angle", *site_dims) if own.sizes[d] > 1), "repeat")
    design = series.Design(across, None, tuple(d for d in site_dims if d != across))
    figure = style.new(3.4)
    left = figure.add_subplot()
    right = left.twinx()
    right.grid(False)
    right.spines["right"].set_visible(True)
    looks = (style.Line(style.MEASURED, "o", ()), style.Line(style.SIMULATED, "s", ()))
    handles, labels, counted = [], [], None
    for k, (name, ax, look) in enumerate(zip(("p1", "p2"), (left, right), looks, strict=True)):
        found = series.need_values(series.points(own[name], design), name)
        counted = counted or found
        x = series.abscissa(left, own, design)
        shift = series.offsets(x, 2)[k]
        handles.append(series.bars(ax, x + shift, found.mean[0], found.sd[0], look, filled=k == 0))
        mean, sd = float(own[f"{name}_mean"]), float(own[f"{name}_sd_all"])
        symbol = f"$p_{name[1]}$"
        labels.append(f"{symbol} = {plus_minus(mean, sd)} px")
        ax.set_ylabel(f"{symbol} / px", color=look.colour)
        ax.tick_params(axis="y", colors=look.colour)
    assert counted is not None
    style.legend_above(figure, handles, labels, 2)
    others = [str(name) for name in calibration["estimator"].values if name != used]
    others = [name for name in others if np.isfinite(calibration["p1_mean"].sel(estimator=name))]
    rest = "; ".join(_other(calibration, name) for name in others)
    caption = (
        "Beam propagation parameters p1 and p2 (Eq. 8) of every site, averaged at each"
        f" {style.axis_name(across)}; crops centred on the light. {series.frames_text(counted, design)}"
        f" (a point being the fit over all exposures of a site). Legend: mean ± standard deviation over all"
        f" {int(counted.frames.sum())} sites. Estimator: {calibration.attrs[f'estimator_{used}']} ({used})."
        f" Others: {rest}."
    )
    clause = "In print p1 = 2.48 ± 0.32 and p2 = 34.55 ± 1.20; called metres there, they close only as pixels."
    return style.Drawing(figure, caption.replace("frames a point", "sites a point") + results.beside_paper(clause))


def _other(calibration: xr.Dataset, name: str) -> str:
    own = calibration.sel(estimator=name)
    values = (f"{p} = {float(own[f'{p}_mean']):.2f} px" for p in ("p1", "p2"))
    return f"{calibration.attrs[f'estimator_{name}']}: {', '.join(values)}"


FIGURES = (Entry("fig07", "Beam propagation parameters", Category.CALIBRATION, ("calibration",), draw, "Fig. 7"),)
