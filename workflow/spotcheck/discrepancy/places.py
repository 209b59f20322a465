"""Places in the images where residuals disagree with a model most, in words."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import special

from spotcheck.discrepancy.criteria import MOST_PLACES, PLACE_ALPHA
from spotcheck.discrepancy.fields import FieldEstimate
from spotcheck.discrepancy.findings import Place
from spotcheck.discrepancy.frames import Design
from spotcheck.discrepancy.residual_sums import (
    BLOCK_PX,
    LEVELS,
    RING_BOUNDS,
    SECTORS,
    CellKind,
    CellSums,
    ResidualSums,
    sum_residuals,
)
from spotcheck.discrepancy.residuals import ResidualImages

# Kinds of cells that divide the spot: only the strongest of their places is reported.
SPOT_KINDS = ("blocks", "rings and sectors", "rings")
# Fewest pixels of a cell, the part of its variance that the fit may have absorbed, and the largest skewness of its sum.
FEWEST_PIXELS, MOST_ABSORBED, MOST_SKEWED = 16, 0.9, 0.5
# Length that is large for any grain [px].
FAR_PX = 1000


@dataclass(frozen=True)
class KnownScatter:
    """Named scatter in the images that the variance of the model lacks."""

    fields: tuple[FieldEstimate, ...] = ()  # relative fields: granular light, gains of pixels
    row_variance: float = 0.0  # variance of an offset common to a row of a frame [DN²]

    @property
    def is_empty(self) -> bool:
        """Whether there is none."""
        return not self.fields and self.row_variance == 0


NO_SCATTER = KnownScatter()


@dataclass(frozen=True)
class StrongestCell:
    """The cell that disagrees most among all groups of frames of one division, and all these cells together."""

    z: float  # its sum in standard errors, as the normal deviate of the same probability
    cell: int  # its number
    frames: np.ndarray  # numbers of the frames of its group
    count: int  # number of cells in all groups
    squares: float  # sum of the squares of all cells' sums, each over its variance before the fit
    mean: float  # expectation of that sum
    variance: float  # its variance


def find_places(
    images: ResidualImages,
    black_level_dn: float = 0.0,
    scatter: KnownScatter = NO_SCATTER,
    sums: ResidualSums | None = None,
) -> tuple[Place, ...]:
    """Return the places that disagree with the model most, the strongest first; at most one of each kind.

    Parameters
    ----------
    images : ResidualImages
        Residuals of a fit.
    black_level_dn : float
        Black level [DN], from which grey levels are counted.
    scatter : KnownScatter
        Scatter that the weights of the images lack.
    sums : ResidualSums, optional
        Result of `sum_residuals`, if it is known.
    """
    sums = sum_residuals(images) if sums is None else sums
    places: dict[str, Place] = {}
    for cells in sums.means:
        family = "spot" if cells.kind.name in SPOT_KINDS else cells.kind.name
        divisions = list(strongest_cells(cells, images.design, scatter))
        for strongest in divisions:
            number = strongest.count * len(divisions) * len(sums.means)
            p_value = correct_for_number(two_sided(strongest.z), number)
            if p_value < PLACE_ALPHA and (family not in places or abs(strongest.z) > abs(places[family].z)):
                words = describe_cell(cells.kind, strongest.cell, strongest.frames, images, black_level_dn)
                places[family] = Place(words, strongest.z)
    return tuple(sorted(places.values(), key=lambda place: -abs(place.z))[:MOST_PLACES])


def strongest_cells(cells: CellSums, design: Design, scatter: KnownScatter = NO_SCATTER) -> Iterator[StrongestCell]:
    """Yield the strongest cell of each division of the frames: all together, by condition, by angle, by frame."""
    for groups in divide_frames(design):
        member = (np.arange(groups.max() + 1)[:, None] == groups).astype(float)
        norms = member @ cells.norms + _known_variance(cells, design, member, scatter)
        # Read noise is common to all frames, a spot is that of one frame.
        absorbed = member @ np.sum(cells.absorbed**2, axis=2) + (member @ cells.common) ** 2
        usable = (member @ cells.pixels >= FEWEST_PIXELS) & (norms > 0) & (absorbed < MOST_ABSORBED * norms)
        norms = np.where(usable, norms, 1.0)
        variance = np.where(usable, norms - absorbed, 1.0)
        skewness = (member @ cells.third) / variance**1.5
        usable &= np.abs(skewness) < MOST_SKEWED
        if not usable.any():
            continue
        total = member @ cells.sums
        z = np.where(usable, to_normal(total / np.sqrt(variance), skewness), 0.0)
        group, cell = np.unravel_index(np.argmax(np.abs(z)), z.shape)
        mean = float((variance / norms)[usable].sum())
        yield StrongestCell(
            z=float(z[group, cell]),
            cell=int(cell),
            frames=np.flatnonzero(member[group]),
            count=int(usable.sum()),
            squares=float((total**2 / norms)[usable].sum()),
            mean=mean,
            variance=2 * mean + float(((member @ cells.fourth) / norms**2)[usable].sum()),
        )


def divide_frames(design: Design) -> list[np.ndarray]:
    """Return the number of the group of each frame [frame] for each division of the frames, none of them twice."""
    count = len(design.site)
    distinct: dict[tuple[int, ...], None] = {}
    for values in (np.zeros(count, int), design.condition, design.angle, np.arange(count)):
        _, first, groups = np.unique(values, return_index=True, return_inverse=True)
        # Groups are numbered by their first frame, so that equal divisions have equal numbers.
        distinct[tuple(np.argsort(np.argsort(first))[groups].tolist())] = None
    return [np.array(groups) for groups in distinct]


def _known_variance(cells: CellSums, design: Design, member: np.ndarray, scatter: KnownScatter) -> np.ndarray:
    """Return at most how much known scatter adds to the variance of the cells [group, cell]."""
    out = np.zeros((len(member), cells.kind.count))
    for field in scatter.fields:
        # Grains are common to the frames of a site, gains of pixels to all frames: their sums add up.
        sites = np.zeros_like(design.site) if np.isnan(field.grain_px) else design.site
        area = np.prod([correlated_length(field.grain_px, length) for length in cells.kind.size])
        power = area * cells.light + correlated_length(field.grain_px, FAR_PX) ** 2 * cells.shift
        for site in np.unique(sites):
            coherent = member[:, sites == site] @ np.sqrt(power[sites == site])
            out += max(field.variance, 0.0) * coherent**2
    # Pixels of a row add up: (Σ a²)² over a row is at most its number of pixels times Σ a⁴.
    in_row = np.minimum(cells.kind.size[1], cells.pixels)
    return out + scatter.row_variance * (member @ (in_row * cells.fourth_powers))


def correlated_length(grain_px: float, length: int) -> float:
    """Return (1/n) Σᵢ Σⱼ exp(−(i − j)²/2 grain²) over n = `length` pixels of a line; 1 for pixels by themselves."""
    if np.isnan(grain_px):
        return 1.0
    lag = np.arange(1, min(length, 8 * grain_px + 2))
    return float(1 + 2 * np.sum((1 - lag / length) * np.exp(-(lag**2) / (2 * grain_px**2))))


# Probabilities


def two_sided(z: float) -> float:
    """Return the two-sided p-value of a normal deviate."""
    return float(2 * special.ndtr(-abs(z)))


def correct_for_number(p_value: float, number: int) -> float:
    """Return the p-value of the smallest of a number of independent p-values (Šidák)."""
    return float(-np.expm1(number * np.log1p(-min(p_value, 1 - 1e-16))))


def to_normal(z: np.ndarray, skewness: np.ndarray) -> np.ndarray:
    """Return the normal deviates of the same probability as sums of mean 0, variance 1 and some skewness.

    References
    ----------
    Wilson & Hilferty (1931), doi:10.1073/pnas.17.12.684.
    """
    skewed = np.where(np.abs(skewness) < 1e-3, 1e-3, skewness)
    return (6 / skewed) * (np.cbrt(np.maximum(skewed * z / 2 + 1, 0.0)) - 1) + skewed / 6


# Words


def describe_cell(kind: CellKind, cell: int, frames: np.ndarray, images: ResidualImages, black_level_dn: float) -> str:
    """Return where a cell of some frames lies, in words."""
    first, second = divmod(cell, kind.width)
    row, column = kind.corner
    match kind.name:
        case "blocks":
            row, column = row + BLOCK_PX * first, column + BLOCK_PX * second
            place = f"columns {column} to {column + BLOCK_PX - 1}, rows {row} to {row + BLOCK_PX - 1}"
        case "rings and sectors":
            place = f"{_describe_ring(first)} (towards {(second + 0.5) * 360 / SECTORS - 180:.0f}°)"
        case "rings":
            place = _describe_ring(cell)
        case "rows":
            place = f"row {row + cell}"
        case "columns":
            place = f"column {column + cell}"
        case "frames":
            place = "the whole crop"
        case _:
            level = _describe_level(cell, float(np.exp(np.max(images.spots.log_peak))), black_level_dn)
            place = f"the noise of {level}" if kind.name == "noise" else level
    return place + _describe_frames(images.design, frames)


def _describe_ring(ring: int) -> str:
    """Return a ring about the spot in words; a width is the fitted σ."""
    if ring == len(RING_BOUNDS):
        return f"pixels beyond {RING_BOUNDS[-1]:.1f} widths from the centre"
    return f"pixels {(0.0, *RING_BOUNDS)[ring]:.1f} to {RING_BOUNDS[ring]:.1f} widths from the centre"


def _describe_level(level: int, brightest_dn: float, black_level_dn: float) -> str:
    """Return a range of light as readings; `brightest_dn` is the light of the brightest peak [DN]."""
    if level == LEVELS:
        return "dark pixels"
    bounds = (black_level_dn + brightest_dn * (k / LEVELS) ** 2 for k in (level, level + 1))
    low, high = (f"{bound:,.{0 if bound >= 10 else 1}f}" for bound in bounds)
    if level == 0:
        return f"grey levels below {high} DN"
    return f"grey levels above {low} DN" if level == LEVELS - 1 else f"grey levels of {low} to {high} DN"


def _describe_frames(design: Design, frames: np.ndarray) -> str:
    """Return what some frames have in common that not all have, in words; "" for all frames."""
    if len(frames) == len(design.site):
        return ""
    exposures, angles = np.unique(design.exposure_s[frames]), np.unique(design.angle[frames])
    words = []
    if len(exposures) == 1 < len(np.unique(design.exposure_s)):
        words.append(f"{1e3 * exposures[0]:.3g} ms")
    if len(angles) == 1 < len(np.unique(design.angle)):
        words.append(f"{np.rad2deg(angles[0]):.3g}°")
    at = f" at {' and '.join(words)}" if words else ""
    if len(frames) == 1:
        return f" of the frame{at}, repeat {design.repeat[frames[0]]}"
    return f" of frames{at}" if words else f" of frames of condition {design.condition[frames[0]] + 1}"
