"""Residuals of the declared and of the extended model: maps, radial profiles, and the gap by condition."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from spotcheck.discrepancy.pictures import AFTER, BEFORE
from spotcheck.io.number_text import two_digits
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import VERDICT, Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

# Largest number of rows and columns of maps, and total height of the maps [inch].
MAX_ROWS, MAX_COLUMNS = 4, 3
MAX_MAPS_HEIGHT = 4.4
# Percentile of the absolute residual at which the colours end.
COLOUR_PERCENTILE = 99.8
# A cell of the gap is bold if it exceeds the noise by this number of standard deviations.
BOLD_SIGMAS = 3.0
# Cells, columns and named rows of the gap above which numbers are too small to read.
MAX_NUMBERS, MAX_NUMBER_COLUMNS, MAX_NAMED_ROWS = 160, 8, 24
# Lines of the profiles.
MAX_PROFILES = 6
# Margins of the maps and gaps between them [inch].
LEFT, RIGHT, GAP, STAGE_GAP = 0.65, 0.95, 0.06, 0.25
TOP, MIDDLE, PROFILE_HEIGHT, BOTTOM = 0.55, 0.75, 1.75, 0.5


@dataclass(frozen=True)
class ConditionTable:
    """Conditions as a table: rows over angle and declared conditions, columns over exposure."""

    dims: tuple[str, ...]  # dimensions of the rows
    rows: list[str]  # names of the rows
    columns: list[str]  # names of the columns

    def read(self, ds: xr.Dataset, name: str) -> np.ndarray:
        """Return the values of a variable [row, column, …]."""
        values = ds[name].transpose(*self.dims, "exposure", ...).values
        return values.reshape(len(self.rows), len(self.columns), *values.shape[len(self.dims) + 1 :])


def tabulate_conditions(ds: xr.Dataset) -> ConditionTable:
    """Return the table of the conditions of discrepancy.nc."""
    dims = tuple(str(dim) for dim in ds["sigma"].dims if dim != "exposure")
    indices = np.ndindex(*(ds.sizes[dim] for dim in dims))
    rows = [series.condition_text(ds, dict(zip(dims, index, strict=True))) for index in indices]
    return ConditionTable(dims, rows, [series.value_text(ds, "exposure", k) for k in range(ds.sizes["exposure"])])


def list_models(ds: xr.Dataset) -> list[str]:
    """Return "before" for the declared model, and "after" for the extended model if there is one."""
    return [model for model in (BEFORE, AFTER) if f"residual_{model}" in ds]


def draw_residuals(results: Results) -> style.Drawing:
    """Draw residual maps and radial profiles of the declared and of the extended model on one scale."""
    ds = results.get("discrepancy")
    table, models = tabulate_conditions(ds), list_models(ds)
    # With a single exposure, the other conditions become columns.
    shown = table if len(table.columns) > 1 else replace(table, rows=table.columns, columns=table.rows)
    rows = series.pick_evenly(len(shown.rows), MAX_ROWS)
    columns = series.pick_evenly(len(shown.columns), MAX_COLUMNS)
    maps = {model: shown.read(ds, f"residual_{model}") for model in models}
    values = np.concatenate([residual[np.ix_(rows, columns)].ravel() for residual in maps.values()])
    if not np.isfinite(values).any():
        raise Unavailable("no condition has a residual")
    end = max(float(np.nanpercentile(np.abs(values), COLOUR_PERCENTILE)), 1e-6)
    norm = Normalize(-end, end)
    figure = style.new_figure(1.0)
    sheet = _lay_out(figure, len(rows), len(columns), len(models))
    for axes, model in zip(sheet.maps, models, strict=True):
        _draw_maps(axes, ds, shown, maps[model], rows, columns, norm)
        first, last = (axes[0, k].get_position() for k in (0, -1))
        middle = (first.x0 + first.x1 + last.x0 + last.x1) / 4
        figure.text(middle, sheet.title_y, _map_title(model, models), ha="center", va="bottom", fontsize=9)
        figure.text(middle, sheet.label_y, "x from the centre / px", ha="center", va="top", fontsize=9)
    _label_rows(figure, sheet.maps, [shown.rows[row] for row in rows])
    figure.colorbar(ScalarMappable(norm, style.DIVERGING_MAP), cax=sheet.bar, label="residual / DN", extend="both")
    _draw_profiles(sheet.profiles, ds, table, models)
    has_left_out = len(rows) < len(shown.rows) or len(columns) < len(shown.columns)
    caption = (
        "Measured less model, mean over the frames that were searched"
        f"{', some of the conditions' if has_left_out else ''}; blocks of {_block_text(ds)} px. Red: brighter than the"
        f" model. One scale for all panels, its colours ending at ±{two_digits(end)} DN. Circles: 1 σ_g and 2 σ_g."
        " Below: mean over rings around the spot's centre and over all conditions of an exposure, with its standard"
        " error."
    )
    if len(models) == 1:
        caption += " Nothing was added to the model, so there is no after."
    return style.Drawing(figure, caption)


def _map_title(model: str, models: list[str]) -> str:
    """Return the title of the maps of a model."""
    name = "declared" if model == BEFORE else "extended"
    return f"{f'{model}: ' if len(models) > 1 else ''}measured − {name} model"


def _block_text(ds: xr.Dataset) -> str:
    """Return the size of a block [px] as text."""
    y = ds["block_y"].values
    side = y[1] - y[0] if len(y) > 1 else 2 * y[0] + 1
    return f"{side:.0f} × {side:.0f}"


def _label_rows(figure: Figure, maps: list[np.ndarray], names: list[str]) -> None:
    """Write the label of the ordinate on the left, and the names of the rows on the right of the maps."""
    rows, columns = maps[0].shape
    lowest, highest = maps[0][-1, 0].get_position(), maps[0][0, 0].get_position()
    label = "y from the centre / px" if rows > 1 or columns * len(maps) < 4 else "y / px"
    place = (lowest.x0 - 0.38 / style.WIDTH, (lowest.y0 + highest.y1) / 2)
    figure.text(*place, label, ha="right", va="center", rotation=90, fontsize=9)
    for ax, name in zip(maps[-1][:, -1], names, strict=True):
        ax.text(1.05, 0.5, name, transform=ax.transAxes, rotation=-90, ha="left", va="center", fontsize=8.5)


@dataclass(frozen=True)
class _Sheet:
    """Axes of the figure of residuals."""

    maps: list[np.ndarray]  # axes of the maps of each model [row, column]
    bar: Axes  # axes of the colour bar
    profiles: list[Axes]  # axes of the profiles of each model
    title_y: float  # height of the titles of the maps [figure]
    label_y: float  # height of the labels below the maps [figure]


def _lay_out(figure: Figure, rows: int, columns: int, models: int) -> _Sheet:
    """Place the axes in inches, so that all maps have one size whatever is beside them."""
    model_gaps = (models - 1) * STAGE_GAP
    widest = (style.WIDTH - LEFT - RIGHT - model_gaps) / (models * columns)
    side = min(widest - GAP, MAX_MAPS_HEIGHT / rows - GAP, 2.2)
    pitch = side + GAP
    maps_width, maps_height = columns * pitch - GAP, rows * pitch - GAP
    height = TOP + maps_height + MIDDLE + PROFILE_HEIGHT + BOTTOM
    figure.set_layout_engine("none")
    figure.set_size_inches(style.WIDTH, height)

    def add_axes(x: float, y: float, width: float, tall: float, **shared) -> Axes:
        return figure.add_axes((x / style.WIDTH, y / height, width / style.WIDTH, tall / height), **shared)

    floor = height - TOP - maps_height
    start = LEFT + (style.WIDTH - LEFT - RIGHT - models * maps_width - model_gaps) / 2
    maps = [np.empty((rows, columns), object) for _ in range(models)]
    for k, i, j in np.ndindex(models, rows, columns):
        left = start + k * (maps_width + STAGE_GAP) + j * pitch
        ax = add_axes(left, floor + (rows - 1 - i) * pitch, side, side)
        ax.tick_params(labelleft=j == 0 and k == 0, labelbottom=i == rows - 1)
        maps[k][i, j] = ax
    bar_height = min(maps_height, 2.8)
    bar_left = start + models * maps_width + model_gaps + 0.3
    bar = add_axes(bar_left, floor + (maps_height - bar_height) / 2, 0.1, bar_height)
    width = (style.WIDTH - LEFT - 0.75 - 0.2 * (models - 1)) / models
    profiles = [add_axes(LEFT, BOTTOM, width, PROFILE_HEIGHT)]
    for k in range(1, models):
        profiles.append(add_axes(LEFT + k * (width + 0.2), BOTTOM, width, PROFILE_HEIGHT, sharey=profiles[0]))
        profiles[k].tick_params(labelleft=False)
    return _Sheet(maps, bar, profiles, (height - 0.3) / height, (floor - 0.22) / height)


def _draw_maps(
    axes: np.ndarray,
    ds: xr.Dataset,
    table: ConditionTable,
    maps: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    norm: Normalize,
) -> None:
    """Draw residual maps [row, column, y, x] at some rows and columns of the table, with 1 σ and 2 σ circles."""
    x0, y0, sigma = (table.read(ds, name) for name in ("spot_x", "spot_y", "sigma"))
    x, y = ds["block_x"].values, ds["block_y"].values
    half = (x[1] - x[0]) / 2 if len(x) > 1 else 0.5
    limit = max(np.ptp(x), np.ptp(y)) / 2 + half
    # Ticks inside the panel, since those at its edge would collide with the neighbour's.
    coarse = max(1, limit // 150)
    step = coarse * next(size for size in (50, 20, 10, 5, 2, 1, 0.5) if size < 0.7 * limit / coarse)
    for (i, j), ax in np.ndenumerate(axes):
        at = rows[i], columns[j]
        ax.grid(False)
        ax.set(aspect="equal", facecolor="0.85")
        if np.isfinite(x0[at]):
            extent = (x[0] - half - x0[at], x[-1] + half - x0[at], y[-1] + half - y0[at], y[0] - half - y0[at])
            style.show_image(ax, maps[at], style.DIVERGING_MAP, norm, extent)
            for factor, dashes in ((1, "solid"), (2, (0, (4, 2)))):
                look = {"fill": False, "edgecolor": "0.3", "linewidth": 0.6, "linestyle": dashes}
                ax.add_patch(Circle((0, 0), factor * sigma[at], **look))
        ax.set(xlim=(-limit, limit), ylim=(limit, -limit))
        ax.set_xticks([-step, step] if len(columns) > 2 else [-step, 0, step])
        ax.set_yticks([-step, 0, step])
        ax.tick_params(labelsize=7.5, length=2)
        if i == 0:
            ax.set_title(table.columns[columns[j]], fontsize=8.5, pad=3)


def _draw_profiles(axes: list[Axes], ds: xr.Dataset, table: ConditionTable, models: list[str]) -> None:
    """Draw the mean residual over the distance from the centre, one line per exposure."""
    radius = ds["radius"].values
    columns = series.pick_evenly(len(table.columns), MAX_PROFILES)
    handles = []
    for ax, model in zip(axes, models, strict=True):
        value, stderr = table.read(ds, f"profile_{model}"), table.read(ds, f"profile_{model}_stderr")
        is_known = np.isfinite(value)
        count = np.where(is_known.any(axis=0), is_known.sum(axis=0), np.nan)
        mean = np.nansum(np.where(is_known, value, 0.0), axis=0) / count
        mean_stderr = np.sqrt(np.nansum(np.where(is_known, stderr, 0.0) ** 2, axis=0)) / count
        ax.axhline(0, color="0.3", linewidth=0.8)
        look: dict[str, Any] = {"markersize": 3.5, "linewidth": 0.9, "elinewidth": 0.9, "capsize": 2}
        handles = [
            ax.errorbar(radius, mean[j], yerr=mean_stderr[j], color=line.colour, marker=line.marker, **look)
            for j, line in zip(columns, style.line_styles(len(columns)), strict=True)
        ]
        ax.set_xlabel("distance from the spot's centre / px")
        ax.set_xlim(0, None)
    axes[0].set_ylabel("residual / DN")
    peak = float(ds["peak"])
    if peak > 0:
        to_percent = (lambda values: np.multiply(values, 100 / peak), lambda values: np.multiply(values, peak / 100))
        axes[-1].secondary_yaxis("right", functions=to_percent).set_ylabel("% of the peak")
    names = [table.columns[j] for j in columns]
    if any(names):
        axes[0].legend(handles, names, fontsize=8, handlelength=2)


def draw_gap(results: Results) -> style.Drawing:
    """Draw the rms of the standardized residuals of blocks by condition, relative to the noise."""
    ds = results.get("discrepancy")
    table, models = tabulate_conditions(ds), list_models(ds)
    noise_square, stderr = float(ds["gap_floor"]), table.read(ds, "gap_stderr")
    noise, bold_limit = noise_square**0.5, np.sqrt(noise_square + BOLD_SIGMAS * stderr)
    rms = {model: np.sqrt(table.read(ds, f"gap_{model}")) for model in models}
    if not np.isfinite(rms[BEFORE]).any():
        raise Unavailable("no condition has a residual")
    highest = max(float(np.nanmax(values)) for values in rms.values())
    norm = LogNorm(noise * 0.95, max(highest, noise * 4) * 1.05)
    figure = style.new_figure(min(1.5 + 0.34 * len(table.rows), 8.0))
    axes = figure.subplots(1, len(models), squeeze=False, sharey=True)[0]
    for ax, model in zip(axes, models, strict=True):
        _draw_cells(ax, table, rms[model], bold_limit, norm)
        ax.set_title(model if len(models) > 1 else "declared model")
        if any(table.columns):
            ax.set_xlabel(style.axis_name("exposure"))
    if any(table.rows):
        axes[0].set_ylabel(" and ".join(style.axis_name(dim) for dim in table.dims if dim in ds.coords))
    label = "rms of block\nresiduals / noise"
    bar = figure.colorbar(ScalarMappable(norm, "magma_r"), ax=list(axes), aspect=20, label=label)
    for colour, width in (("white", 2.2), ("black", 1.0)):
        bar.ax.axhline(noise, color=colour, linewidth=width)
    scatter = float(np.nanmedian(stderr)) / (2 * noise)
    caption = (
        "Root mean square of the residual block means, relative to the declared model's noise, on"
        f" {ds.attrs['gap_on']}. Noise alone leaves {noise:.3g} ± {scatter:.2g} (line on the colour bar); bold: more"
        f" than {BOLD_SIGMAS:.0f} standard deviations above. The gap of the verdict is that of larger blocks near the"
        " spot, on held-out data."
    )
    if len(models) == 1:
        caption += " Nothing was added to the model, so there is no after."
    return style.Drawing(figure, caption)


def _draw_cells(ax: Axes, table: ConditionTable, values: np.ndarray, bold_limit: np.ndarray, norm: LogNorm) -> None:
    """Draw a table of values as colours, and as numbers if there are few; bold above a limit."""
    style.show_image(ax, values, "magma_r", norm, facecolor="0.85", aspect="auto")
    ax.set_xticks(range(len(table.columns)), table.columns)
    named = series.pick_evenly(len(table.rows), MAX_NAMED_ROWS)
    ax.set_yticks(named, [table.rows[k] for k in named])
    ax.tick_params(length=0)
    for spine in ax.spines.values():
        spine.set_visible(False)
    if values.size > MAX_NUMBERS or len(table.columns) > MAX_NUMBER_COLUMNS:
        return
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            text = f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 100 else two_digits(value)
            weight = "bold" if value > bold_limit[i, j] else "normal"
            colour = "white" if norm(value) > 0.55 else "black"
            ax.text(j, i, text, ha="center", va="center", fontsize=8, color=colour, weight=weight)


FIGURES = (
    Entry("missing-residuals", "Residual before and after", Category.MISSING, VERDICT, draw_residuals),
    Entry("missing-gap", "The gap by condition", Category.MISSING, VERDICT, draw_gap),
)
