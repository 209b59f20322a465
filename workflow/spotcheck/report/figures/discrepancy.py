"""Residuals of the declared and of the extended model: maps, radial profiles, and the gap by condition.

The declared model is that of the instrument file. The extended model also has the effects and the light shape that the
verdict added; without additions there is none. All values are those of discrepancy.nc, which averages over blocks:
squares of pixels. The gap is the mean square of the residuals of blocks, in units of their noise variance. The spot's
width σ_g is the standard deviation of the Gaussian light.
"""

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

# Largest number of rows and columns of maps of a model.
MAX_ROWS, MAX_COLUMNS = 4, 3
# Largest height of all rows of maps, and largest side of a map [inch].
MAX_MAPS_HEIGHT, MAX_SIDE = 4.4, 2.2
# Percentile of the absolute residual at which the colours end.
COLOUR_PERCENTILE = 99.8
# A number in the table of the gap is bold if the gap exceeds that of noise by so many standard deviations.
BOLD_SIGMAS = 3.0
# The table of the gap has numbers up to this many conditions and columns, which leave space for the digits, and names
# at no more than this many rows.
MAX_NUMBERS, MAX_NUMBER_COLUMNS, MAX_NAMED_ROWS = 160, 8, 24
# Colour map of the gap, and position on it from which numbers are white.
GAP_MAP, WHITE_FROM = "magma_r", 0.55
# Largest number of profiles, one for each exposure.
MAX_PROFILES = 6
# Horizontal layout [inch]: margins, gap between maps and between models, gap between profiles, margin right of these.
LEFT, RIGHT, GAP, MODEL_GAP, PROFILE_GAP, PROFILE_RIGHT = 0.65, 0.95, 0.06, 0.25, 0.2, 0.75
# Vertical layout [inch]: margin above the maps, gap between maps and profiles, height of profiles, margin below.
TOP, MIDDLE, PROFILE_HEIGHT, BOTTOM = 0.55, 0.75, 1.75, 0.5
# Colour bar [inch]: distance from the maps, width, and largest height.
BAR_GAP, BAR_WIDTH, MAX_BAR_HEIGHT = 0.3, 0.1, 2.8
# Distances [inch]: titles from the upper edge of the figure, labels of abscissa and ordinate from the maps.
TITLE_OFFSET, LABEL_OFFSET, ORDINATE_OFFSET = 0.3, 0.22, 0.38


@dataclass(frozen=True)
class ConditionTable:
    """Conditions as a table: a row for each angle and declared conditions, a column for each exposure."""

    dims: tuple[str, ...]  # dimensions of discrepancy.nc that form the rows
    rows: list[str]  # angle and declared conditions of each row as text; "" if not recorded
    columns: list[str]  # exposure of each column as text; "" if not recorded

    def read(self, ds: xr.Dataset, name: str) -> np.ndarray:
        """Return a variable as an array [row, column, …], where … are its dimensions beyond the conditions."""
        values = ds[name].transpose(*self.dims, "exposure", ...).values
        return values.reshape(len(self.rows), len(self.columns), *values.shape[len(self.dims) + 1 :])


def tabulate_conditions(ds: xr.Dataset) -> ConditionTable:
    """Return the table of the conditions; `ds` is the content of discrepancy.nc."""
    dims = tuple(str(dim) for dim in ds["sigma"].dims if dim != "exposure")
    # A place is an index on each of the dimensions.
    rows = [series.condition_text(ds, place) for place in series.iterate_places(ds, dims)]
    return ConditionTable(dims, rows, [series.value_text(ds, "exposure", k) for k in range(ds.sizes["exposure"])])


def list_models(ds: xr.Dataset) -> list[str]:
    """Return the names of models in discrepancy.nc: "before" (declared), and "after" (extended) if there is one."""
    return [model for model in (BEFORE, AFTER) if f"residual_{model}" in ds]


def draw_residuals(results: Results) -> style.Drawing:
    """Draw residual maps and radial profiles of the declared and of the extended model on one scale.

    Raises `Unavailable` if no condition has a residual.
    """
    ds = results.get("discrepancy")
    table, models = tabulate_conditions(ds), list_models(ds)
    # With a single exposure, the other conditions become columns; their values keep their order.
    map_table = table if len(table.columns) > 1 else replace(table, rows=table.columns, columns=table.rows)
    rows = series.pick_evenly(len(map_table.rows), MAX_ROWS)
    columns = series.pick_evenly(len(map_table.columns), MAX_COLUMNS)
    maps = {model: map_table.read(ds, f"residual_{model}") for model in models}
    values = np.concatenate([residual[np.ix_(rows, columns)].ravel() for residual in maps.values()])
    if not np.isfinite(values).any():
        raise Unavailable("no condition has a residual")
    # At least a small range: the colours need one even if all residuals are zero.
    limit = max(float(np.nanpercentile(np.abs(values), COLOUR_PERCENTILE)), 1e-6)
    norm = Normalize(-limit, limit)
    figure = style.new_figure(1.0)  # `_lay_out` sets its height
    sheet = _lay_out(figure, len(rows), len(columns), len(models))
    for axes, model in zip(sheet.maps, models, strict=True):
        _draw_maps(axes, ds, map_table, maps[model], rows, columns, norm)
        first, last = (axes[0, k].get_position() for k in (0, -1))
        middle = (first.x0 + first.x1 + last.x0 + last.x1) / 4
        figure.text(middle, sheet.title_y, _map_title(model, models), ha="center", va="bottom", fontsize=9)
        figure.text(middle, sheet.label_y, "x from the centre / px", ha="center", va="top", fontsize=9)
    _label_rows(figure, sheet.maps, [map_table.rows[row] for row in rows])
    figure.colorbar(ScalarMappable(norm, style.DIVERGING_MAP), cax=sheet.bar, label="residual / DN", extend="both")
    _draw_profiles(sheet.profiles, ds, table, models)
    is_selection = len(rows) < len(map_table.rows) or len(columns) < len(map_table.columns)
    caption = (
        "Measured less model, mean over the frames that were searched"
        f"{', some of the conditions' if is_selection else ''}; blocks of {_block_text(ds)} px. Red: brighter than the"
        f" model. One scale for all panels, its colours ending at ±{two_digits(limit)} DN. Circles: 1 σ_g and 2 σ_g."
        " Below: mean over rings around the spot's centre and over all conditions of an exposure, with its standard"
        " error."
    )
    if len(models) == 1:
        caption += " Nothing was added to the model, so there is no after."
    return style.Drawing(figure, caption)


def _map_title(model: str, models: list[str]) -> str:
    """Return the title of the maps of `model`; it begins with "before" or "after" if there are two `models`."""
    name = "declared" if model == BEFORE else "extended"
    return f"{f'{model}: ' if len(models) > 1 else ''}measured − {name} model"


def _block_text(ds: xr.Dataset) -> str:
    """Return the size of a block [px] as text: `3 × 3`."""
    y = ds["block_y"].values
    # The centre of a single block lies in the middle of its pixels, which count from 0.
    side = y[1] - y[0] if len(y) > 1 else 2 * y[0] + 1
    return f"{side:.0f} × {side:.0f}"


def _label_rows(figure: Figure, maps: list[np.ndarray], names: list[str]) -> None:
    """Write the label of the ordinate left of the maps, and the names of the rows right of them.

    `maps` are the axes of each model [row, column], `names` those of the rows.
    """
    rows, columns = maps[0].shape
    lowest, highest = maps[0][-1, 0].get_position(), maps[0][0, 0].get_position()
    # A single row of four or more maps is too low for the long label.
    label = "y from the centre / px" if rows > 1 or columns * len(maps) < 4 else "y / px"
    x, y = lowest.x0 - ORDINATE_OFFSET / style.WIDTH, (lowest.y0 + highest.y1) / 2
    figure.text(x, y, label, ha="right", va="center", rotation=90, fontsize=9)
    for ax, name in zip(maps[-1][:, -1], names, strict=True):
        ax.text(1.05, 0.5, name, transform=ax.transAxes, rotation=-90, ha="left", va="center", fontsize=8.5)


@dataclass(frozen=True)
class _Sheet:
    """Axes of the figure of residuals."""

    maps: list[np.ndarray]  # axes of the maps of each model [row, column]
    bar: Axes  # axes of the colour bar
    profiles: list[Axes]  # axes of the profiles of each model
    title_y: float  # ordinate of the titles of the maps [1 / height of the figure]
    label_y: float  # ordinate of the labels below the maps [1 / height of the figure]


def _lay_out(figure: Figure, rows: int, columns: int, models: int) -> _Sheet:
    """Set the height of the figure and add the axes of `rows` × `columns` maps and a profile for each of `models`.

    Positions are computed in inches, so that all maps have the same size whatever labels are beside them.
    """
    model_gaps = (models - 1) * MODEL_GAP
    available = (style.WIDTH - LEFT - RIGHT - model_gaps) / (models * columns)
    side = min(available - GAP, MAX_MAPS_HEIGHT / rows - GAP, MAX_SIDE)
    pitch = side + GAP
    maps_width, maps_height = columns * pitch - GAP, rows * pitch - GAP
    height = TOP + maps_height + MIDDLE + PROFILE_HEIGHT + BOTTOM
    figure.set_layout_engine("none")
    figure.set_size_inches(style.WIDTH, height)

    def add_axes(x: float, y: float, axes_width: float, axes_height: float, **properties: Any) -> Axes:
        """Add axes with their lower left corner at (x, y); all lengths are in inches."""
        box = (x / style.WIDTH, y / height, axes_width / style.WIDTH, axes_height / height)
        return figure.add_axes(box, **properties)

    maps_bottom = height - TOP - maps_height
    # The maps are centred between the margins.
    maps_left = LEFT + (style.WIDTH - LEFT - RIGHT - models * maps_width - model_gaps) / 2
    maps = [np.empty((rows, columns), object) for _ in range(models)]
    for k, i, j in np.ndindex(models, rows, columns):
        left = maps_left + k * (maps_width + MODEL_GAP) + j * pitch
        ax = add_axes(left, maps_bottom + (rows - 1 - i) * pitch, side, side)
        ax.tick_params(labelleft=j == 0 and k == 0, labelbottom=i == rows - 1)
        maps[k][i, j] = ax
    bar_height = min(maps_height, MAX_BAR_HEIGHT)
    bar_left = maps_left + models * maps_width + model_gaps + BAR_GAP
    bar = add_axes(bar_left, maps_bottom + (maps_height - bar_height) / 2, BAR_WIDTH, bar_height)
    width = (style.WIDTH - LEFT - PROFILE_RIGHT - PROFILE_GAP * (models - 1)) / models
    profiles = [add_axes(LEFT, BOTTOM, width, PROFILE_HEIGHT)]
    for k in range(1, models):
        left = LEFT + k * (width + PROFILE_GAP)
        profiles.append(add_axes(left, BOTTOM, width, PROFILE_HEIGHT, sharey=profiles[0]))
        profiles[k].tick_params(labelleft=False)
    return _Sheet(maps, bar, profiles, (height - TITLE_OFFSET) / height, (maps_bottom - LABEL_OFFSET) / height)


def _draw_maps(
    axes: np.ndarray,
    ds: xr.Dataset,
    table: ConditionTable,
    maps: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    norm: Normalize,
) -> None:
    """Draw maps of the residual with circles of one and two widths σ_g of the spot.

    Parameters
    ----------
    axes : ndarray
        Axes of the maps [shown row, shown column].
    ds : Dataset
        Content of discrepancy.nc.
    table : ConditionTable
        All conditions.
    maps : ndarray
        Residuals [row of the table, column of the table, block row, block column] in DN.
    rows, columns : ndarray
        Indices of the shown rows and columns of the table.
    norm : Normalize
        Scale of the colours [DN].
    """
    x0, y0, sigma = (table.read(ds, name) for name in ("spot_x", "spot_y", "sigma"))
    x, y = ds["block_x"].values, ds["block_y"].values
    half = (x[1] - x[0]) / 2 if len(x) > 1 else 0.5  # half the side of a block [px]
    limit = max(np.ptp(x), np.ptp(y)) / 2 + half  # half the longer side of the crop [px]
    # The largest round step that keeps ticks inside the panel; at its edge they would collide with the neighbour's.
    scale = max(1, limit // 150)
    step = scale * next(size for size in (50, 20, 10, 5, 2, 1, 0.5) if size < 0.7 * limit / scale)
    for (i, j), ax in np.ndenumerate(axes):
        cell = rows[i], columns[j]
        ax.grid(False)
        ax.set(aspect="equal", facecolor="0.85")
        # A condition without frames has no spot.
        if np.isfinite(x0[cell]):
            left, top = x[0] - half - x0[cell], y[0] - half - y0[cell]
            extent = (left, x[-1] + half - x0[cell], y[-1] + half - y0[cell], top)
            style.show_image(ax, maps[cell], style.DIVERGING_MAP, norm, extent)
            for factor, dashes in ((1, "solid"), (2, (0, (4, 2)))):
                look = {"fill": False, "edgecolor": "0.3", "linewidth": 0.6, "linestyle": dashes}
                ax.add_patch(Circle((0, 0), factor * sigma[cell], **look))
        ax.set(xlim=(-limit, limit), ylim=(limit, -limit))
        ax.set_xticks([-step, step] if len(columns) > 2 else [-step, 0, step])
        ax.set_yticks([-step, 0, step])
        ax.tick_params(labelsize=7.5, length=2)
        if i == 0:
            ax.set_title(table.columns[columns[j]], fontsize=8.5, pad=3)


def _draw_profiles(axes: list[Axes], ds: xr.Dataset, table: ConditionTable, models: list[str]) -> None:
    """Draw the mean residual over the distance from the spot's centre, one line per exposure, in axes per model.

    `ds` is the content of discrepancy.nc, and `table` has exposures as columns.
    """
    radius = ds["radius"].values
    columns = series.pick_evenly(len(table.columns), MAX_PROFILES)
    handles = []
    for ax, model in zip(axes, models, strict=True):
        profile, stderr = table.read(ds, f"profile_{model}"), table.read(ds, f"profile_{model}_stderr")
        # Mean over the rows of the table with a value, all with the same weight [exposure, ring].
        is_known = np.isfinite(profile)
        count = np.where(is_known.any(axis=0), is_known.sum(axis=0), np.nan)
        mean = np.nansum(np.where(is_known, profile, 0.0), axis=0) / count
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
        # Functions from DN to percent of the peak, and back.
        to_percent = (lambda values: np.multiply(values, 100 / peak), lambda values: np.multiply(values, peak / 100))
        axes[-1].secondary_yaxis("right", functions=to_percent).set_ylabel("% of the peak")
    names = [table.columns[j] for j in columns]
    if any(names):
        axes[0].legend(handles, names, fontsize=8, handlelength=2)


def draw_gap(results: Results) -> style.Drawing:
    """Draw the root of the gap by condition: the rms of the residuals of blocks over their noise.

    Raises `Unavailable` if no condition has a residual.
    """
    ds = results.get("discrepancy")
    table, models = tabulate_conditions(ds), list_models(ds)
    # The gap that noise alone leaves, and its standard deviation [row, column]; both are mean squares.
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
    bar = figure.colorbar(ScalarMappable(norm, GAP_MAP), ax=list(axes), aspect=20, label=label)
    for colour, width in (("white", 2.2), ("black", 1.0)):
        bar.ax.axhline(noise, color=colour, linewidth=width)
    # Standard deviation of the root of a mean square: that of the mean square divided by twice the root.
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
    """Draw `values` [row, column] as colours, and as numbers if there are few; those above `bold_limit` are bold."""
    style.show_image(ax, values, GAP_MAP, norm, facecolor="0.85", aspect="auto")
    ax.set_xticks(range(len(table.columns)), table.columns)
    named_rows = series.pick_evenly(len(table.rows), MAX_NAMED_ROWS)
    ax.set_yticks(named_rows, [table.rows[k] for k in named_rows])
    ax.tick_params(length=0)
    for spine in ax.spines.values():
        spine.set_visible(False)
    if values.size > MAX_NUMBERS or len(table.columns) > MAX_NUMBER_COLUMNS:
        return
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            text = f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 100 else two_digits(value)
            weight = "bold" if value > bold_limit[i, j] else "normal"
            colour = "white" if norm(value) > WHITE_FROM else "black"
            ax.text(j, i, text, ha="center", va="center", fontsize=8, color=colour, weight=weight)


FIGURES = (
    Entry("missing-residuals", "Residual before and after", Category.MISSING, VERDICT, draw_residuals),
    Entry("missing-gap", "The gap by condition", Category.MISSING, VERDICT, draw_gap),
)
