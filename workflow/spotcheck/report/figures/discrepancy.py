"""The residual before and after what was missing was added: maps, radial profiles, and the gap by condition."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from spotcheck.io.plus_minus import two_digits
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import VERDICT, Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

STAGES = ("before", "after")
MOST_ROWS, MOST_COLUMNS = 4, 3
TALLEST = 4.4  # inch, of all rows of maps
COLOUR_ENDS = 99.8  # percentile of the absolute residual at which the colours end
# Above noise by so many of its standard deviations a cell of the gap is printed bold.
STANDS_OUT = 3.0
MOST_NUMBERS = 160


class Plan(NamedTuple):
    """Conditions as a table: rows over angle and declared conditions, columns over exposure, each with its name."""

    dims: tuple[str, ...]
    rows: list[str]
    columns: list[str]

    def table(self, ds: xr.Dataset, name: str) -> np.ndarray:
        """Values of a variable [row, column, …]."""
        rest = [d for d in ds[name].dims if d not in self.dims and d != "exposure"]
        values = ds[name].transpose(*self.dims, "exposure", *rest).values
        return values.reshape(len(self.rows), len(self.columns), *values.shape[len(self.dims) + 1 :])


def plan_of(ds: xr.Dataset) -> Plan:
    """The table of a file's conditions."""
    dims = tuple(str(d) for d in ds["sigma"].dims if d != "exposure")
    places = np.ndindex(*(ds.sizes[d] for d in dims))
    rows = [
        ", ".join(filter(None, (series.value_text(ds, d, k) for d, k in zip(dims, at, strict=True)))) for at in places
    ]
    columns = [series.value_text(ds, "exposure", k) for k in range(ds.sizes["exposure"])]
    return Plan(dims, rows, columns)


def chosen(count: int, most: int) -> np.ndarray:
    """At most so many of the indices, evenly, both ends among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def stages_in(ds: xr.Dataset) -> list[str]:
    """`before`, and `after` where something was added to the model."""
    return [stage for stage in STAGES if f"residual_{stage}" in ds]


def _heading(ds: xr.Dataset, stage: str) -> str:
    if stage == "after":
        return "after: measured − extended model"
    return "before: measured − declared model" if "residual_after" in ds else "measured − declared model"


def residuals(results: Results) -> style.Drawing:
    """Residual maps and radial profiles before and after, on one scale."""
    ds = results.get("discrepancy")
    plan, stages = plan_of(ds), stages_in(ds)
    # One exposure: its places side by side.
    upright = plan if len(plan.columns) > 1 else plan._replace(rows=plan.columns, columns=plan.rows)
    rows, columns = chosen(len(upright.rows), MOST_ROWS), chosen(len(upright.columns), MOST_COLUMNS)
    maps = {stage: upright.table(ds, f"residual_{stage}") for stage in stages}
    shown = np.concatenate([own[np.ix_(rows, columns)].ravel() for own in maps.values()])
    if not np.isfinite(shown).any():
        raise Unavailable("no condition has a residual")
    end = max(float(np.nanpercentile(np.abs(shown), COLOUR_ENDS)), 1e-6)
    figure = style.new(1.0)
    sheet = _sheet(figure, len(rows), len(columns), len(stages))
    for k, stage in enumerate(stages):
        _maps(sheet.maps[k], ds, upright, maps[stage], rows, columns, end)
        middle = sum(sheet.maps[k][0, j].get_position().x0 + sheet.maps[k][0, j].get_position().x1 for j in (0, -1)) / 4
        figure.text(middle, sheet.heading, _heading(ds, stage), ha="center", va="bottom", fontsize=9)
        figure.text(middle, sheet.foot, "x from the centre / px", ha="center", va="top", fontsize=9)
    corner = sheet.maps[0][-1, 0].get_position()
    half = (corner.y0 + sheet.maps[0][0, 0].get_position().y1) / 2
    words = "y from the centre / px" if len(rows) > 1 or len(columns) * len(stages) < 4 else "y / px"
    figure.text(corner.x0 - 0.38 / style.WIDTH, half, words, ha="right", va="center", rotation=90, fontsize=9)
    for j, row in enumerate(rows):
        ax = sheet.maps[-1][j, -1]
        place = {"transform": ax.transAxes, "rotation": -90, "ha": "left", "va": "center", "fontsize": 8.5}
        ax.text(1.05, 0.5, upright.rows[row], **place)
    mapped = ScalarMappable(Normalize(-end, end), style.DIVERGING_MAP)
    figure.colorbar(mapped, cax=sheet.bar, label="residual / DN", extend="both")
    _profiles(sheet.profiles, ds, plan, stages)
    left_out = len(rows) < len(upright.rows) or len(columns) < len(upright.columns)
    caption = (
        "Measured less model, mean over the frames that were searched"
        f"{', some of the conditions' if left_out else ''}; blocks of {_block(ds)} px. Red: brighter than the model."
        f" One scale for all panels, its colours ending at ±{two_digits(end)} DN. Circles: 1 σ_g and 2 σ_g. Beneath:"
        " mean over rings around the spot's centre and over all conditions of an exposure, with its standard error."
    )
    if len(stages) == 1:
        caption += " Nothing was added to the model, so there is no after."
    return style.Drawing(figure, caption)


def _block(ds: xr.Dataset) -> str:
    y = ds["block_y"].values
    side = y[1] - y[0] if len(y) > 1 else 2 * y[0] + 1
    return f"{side:.0f} × {side:.0f}"


class _Sheet(NamedTuple):
    """Axes of the maps [stage][row, column], of the colour bar and of the profiles; heights of the text over and under
    the maps."""

    maps: list[np.ndarray]
    bar: Axes
    profiles: list[Axes]
    heading: float
    foot: float


def _sheet(figure: Figure, rows: int, columns: int, stages: int) -> _Sheet:
    """Lay out a figure in inches: every map of one size, whatever stands beside it."""
    left, right, gap, between = 0.65, 0.95, 0.06, 0.25
    side = min(
        (style.WIDTH - left - right - (stages - 1) * between) / (stages * columns) - gap, TALLEST / rows - gap, 2.2
    )
    wide, high = columns * (side + gap) - gap, rows * (side + gap) - gap
    height = 0.55 + high + 0.75 + 1.75 + 0.5
    figure.set_layout_engine("none")
    figure.set_size_inches(style.WIDTH, height)

    def axes(x: float, y: float, width: float, tall: float, **shared) -> Axes:
        return figure.add_axes((x / style.WIDTH, y / height, width / style.WIDTH, tall / height), **shared)

    floor = height - 0.55 - high
    start = left + (style.WIDTH - left - right - stages * wide - (stages - 1) * between) / 2
    maps = []
    for k in range(stages):
        corner = start + k * (wide + between)
        own = [
            [axes(corner + j * (side + gap), floor + (rows - 1 - i) * (side + gap), side, side) for j in range(columns)]
            for i in range(rows)
        ]
        maps.append(np.array(own))
    for (_, i, j), ax in np.ndenumerate(np.array(maps)):
        ax.tick_params(labelleft=j == 0 and ax in maps[0], labelbottom=i == rows - 1)
    tall = min(high, 2.8)
    bar = axes(start + stages * wide + (stages - 1) * between + 0.3, floor + (high - tall) / 2, 0.1, tall)
    width = (style.WIDTH - left - 0.75 - 0.2 * (stages - 1)) / stages
    first = axes(left, 0.5, width, 1.75)
    profiles = [first, *(axes(left + k * (width + 0.2), 0.5, width, 1.75, sharey=first) for k in range(1, stages))]
    for ax in profiles[1:]:
        ax.tick_params(labelleft=False)
    return _Sheet(maps, bar, profiles, (height - 0.3) / height, (floor - 0.22) / height)


def _maps(
    axes: np.ndarray, ds: xr.Dataset, plan: Plan, maps: np.ndarray, rows: np.ndarray, columns: np.ndarray, end: float
) -> None:
    x0, y0, sigma = (plan.table(ds, name) for name in ("spot_x", "spot_y", "sigma"))
    x, y = ds["block_x"].values, ds["block_y"].values
    half = (x[1] - x[0]) / 2 if len(x) > 1 else 0.5
    reach = max(np.ptp(x), np.ptp(y)) / 2 + half
    for (i, j), ax in np.ndenumerate(axes):
        at = rows[i], columns[j]
        ax.grid(False)
        ax.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal", facecolor="0.85")
        if np.isfinite(x0[at]):
            extent = (x[0] - half - x0[at], x[-1] + half - x0[at], y[-1] + half - y0[at], y[0] - half - y0[at])
            ax.imshow(maps[at], cmap=style.DIVERGING_MAP, vmin=-end, vmax=end, extent=extent)
            for n, dashes in ((1, "solid"), (2, (0, (4, 2)))):
                ax.add_patch(
                    Circle((0, 0), n * sigma[at], fill=False, edgecolor="0.3", linewidth=0.6, linestyle=dashes)
                )
            ax.set(xlim=(-reach, reach), ylim=(reach, -reach))
        # Not at the panel's edge, where numbers of neighbours would meet.
        step = next(s for s in (50, 20, 10, 5, 2, 1, 0.5) if s < 0.7 * reach / max(1, reach // 150))
        step *= max(1, reach // 150)
        ax.set_xticks([-step, step] if len(columns) > 2 else [-step, 0, step])
        ax.set_yticks([-step, 0, step])
        ax.tick_params(labelsize=7.5, length=2)
        if i == 0:
            ax.set_title(plan.columns[columns[j]], fontsize=8.5, pad=3)


def _profiles(axes: list[Axes], ds: xr.Dataset, plan: Plan, stages: list[str]) -> None:
    radius = ds["radius"].values
    columns = chosen(len(plan.columns), 6)
    looks = style.lines(len(columns))
    handles = []
    for ax, stage in zip(axes, stages, strict=True):
        value, error = plan.table(ds, f"profile_{stage}"), plan.table(ds, f"profile_{stage}_stderr")
        known = np.isfinite(value)
        number = np.where(known.any(axis=0), known.sum(axis=0), np.nan)
        mean = np.nansum(np.where(known, value, 0.0), axis=0) / number
        spread = np.sqrt(np.nansum(np.where(known, error, 0.0) ** 2, axis=0)) / number
        ax.axhline(0, color="0.3", linewidth=0.8)
        handles = [
            ax.errorbar(radius, mean[j], yerr=spread[j], color=look.colour, marker=look.marker, markersize=3.5,
                        linewidth=0.9, elinewidth=0.9, capsize=2)
            for j, look in zip(columns, looks, strict=True)
        ]  # fmt: skip
        ax.set_xlabel("distance from the spot's centre / px")
        ax.set_xlim(0, None)
    axes[0].set_ylabel("residual / DN")
    peak = float(ds["peak"])
    if peak > 0:
        right = axes[-1].secondary_yaxis(
            "right", functions=(lambda v: np.multiply(v, 100 / peak), lambda v: np.multiply(v, peak / 100))
        )
        right.set_ylabel("% of the peak")
    names = [plan.columns[j] for j in columns]
    if any(names):
        axes[0].legend(handles, names, fontsize=8, handlelength=2)


def gap(results: Results) -> style.Drawing:
    """Rms of the standardised residuals of blocks by angle and exposure, before and after, against the noise."""
    ds = results.get("discrepancy")
    plan, stages = plan_of(ds), stages_in(ds)
    square, error = float(ds["gap_floor"]), plan.table(ds, "gap_stderr")
    floor, clear = square**0.5, np.sqrt(square + STANDS_OUT * error)
    tables = {stage: np.sqrt(plan.table(ds, f"gap_{stage}")) for stage in stages}
    if not np.isfinite(tables["before"]).any():
        raise Unavailable("no condition has a residual")
    highest = max(float(np.nanmax(own)) for own in tables.values())
    norm = LogNorm(floor * 0.95, max(highest, floor * 4) * 1.05)
    figure = style.new(min(1.5 + 0.34 * len(plan.rows), 8.0))
    axes = figure.subplots(1, len(stages), squeeze=False, sharey=True)[0]
    for ax, stage in zip(axes, stages, strict=True):
        _cells(ax, plan, tables[stage], clear, norm)
        ax.set_title({"before": "before", "after": "after"}[stage] if len(stages) > 1 else "declared model")
        if any(plan.columns):
            ax.set_xlabel(style.axis_name("exposure"))
    if any(plan.rows):
        axes[0].set_ylabel(" and ".join(style.axis_name(d) for d in plan.dims if d in ds.coords))
    bar = figure.colorbar(
        ScalarMappable(norm, "magma_r"), ax=list(axes), aspect=20, label="rms of block\nresiduals / noise"
    )
    bar.ax.axhline(floor, color="white", linewidth=2.2)
    bar.ax.axhline(floor, color="black", linewidth=1.0)
    scatter = float(np.nanmedian(error)) / (2 * floor)
    caption = (
        f"Root mean square of what is left of block means, over the declared model's noise, on {ds.attrs['gap_on']}."
        f" Noise alone leaves {floor:.3g} ± {scatter:.2g} (line on the colour bar); bold: more than"
        f" {STANDS_OUT:.0f} standard deviations above. The gap of the verdict is that of larger blocks near the"
        " spot, on held-out data."
    )
    if len(stages) == 1:
        caption += " Nothing was added to the model, so there is no after."
    return style.Drawing(figure, caption)


def _cells(ax: Axes, plan: Plan, values: np.ndarray, clear: np.ndarray, norm: LogNorm) -> None:
    ax.grid(False)
    ax.set_facecolor("0.85")
    ax.imshow(values, cmap="magma_r", norm=norm, aspect="auto")
    ax.set_xticks(range(len(plan.columns)), plan.columns)
    few = chosen(len(plan.rows), 24)
    ax.set_yticks(few, [plan.rows[k] for k in few])
    ax.tick_params(length=0)
    for side in ax.spines.values():
        side.set_visible(False)
    if values.size > MOST_NUMBERS or len(plan.columns) > 8:
        return
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            dark = norm(value) > 0.55
            weight = "bold" if value > clear[i, j] else "normal"
            ax.text(
                j,
                i,
                _digits(value),
                ha="center",
                va="center",
                fontsize=8,
                color="white" if dark else "black",
                weight=weight,
            )


def _digits(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 100 else two_digits(value)


FIGURES = (
    Entry("missing-residuals", "Residual before and after", Category.MISSING, VERDICT, residuals),
    Entry("missing-gap", "The gap by condition", Category.MISSING, VERDICT, gap),
)
