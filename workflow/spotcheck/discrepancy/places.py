"""Places in the images where residuals disagree with a model most, in words.

A cell is a part of the images over which residuals are summed: a block of the sensor, a sector of a ring about the
spot, a row, a column, a range of light ("grey level"), or the crop. A kind is a division of the images into cells. Each
kind is tested for several divisions of the frames into groups. Frames of a condition have the same exposure and
declared conditions. Frames of a site have the same angle, declared conditions and repeat. A `FieldEstimate` has the
relative `variance` of a random field that multiplies the light; its Gaussian correlation has the standard deviation
`grain_px` [px], NaN if pixels are independent.
"""

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

# Kinds of cells that divide the spot: they find the same misfit, and only the strongest of their places is reported.
SPOT_KINDS = ("blocks", "rings and sectors", "rings")
# A cell is tested if it has so many pixels, the fit has absorbed at most this part of its variance, and the skewness of
# its sum is at most this.
FEWEST_PIXELS, MOST_ABSORBED, MOST_SKEWED = 16, 0.9, 0.5
# Length [px] of a line beside which any grain of granular light is small.
FAR_PX = 1000
# Lags [grains] up to which the correlation exp(−lag²/2 grain²) is summed: it is 1e-14 there.
FARTHEST_LAG = 8
# Skewness below which that of `to_normal` is replaced: its formula divides by the skewness.
LEAST_SKEWNESS = 1e-3


@dataclass(frozen=True)
class KnownScatter:
    """Scatter with a name in the verdict that the model's variance does not contain: it widens sums of residuals."""

    fields: tuple[FieldEstimate, ...] = ()  # fields that multiply the light: granular light, gains of pixels
    row_variance: float = 0.0  # variance of an offset that the pixels of a row of a frame share [DN²]

    @property
    def is_empty(self) -> bool:
        """Whether there is no such scatter."""
        return not self.fields and self.row_variance == 0


NO_SCATTER = KnownScatter()


@dataclass(frozen=True)
class StrongestCell:
    """The cell that disagrees most among all groups of one division of the frames; and the χ² of all these cells."""

    z: float  # its sum in standard errors, corrected for skewness
    cell: int  # its number within its kind
    frames: np.ndarray  # numbers of the frames of its group
    count: int  # number of tested cells in all groups
    squares: float  # Σ (sum of a cell)²/(its variance before the fit) over the tested cells
    mean: float  # expectation of `squares`
    variance: float  # variance of `squares`


def find_places(
    images: ResidualImages, black_level_dn: float = 0.0, sums: ResidualSums | None = None
) -> tuple[Place, ...]:
    """Return the places that disagree with the model most, the strongest first.

    There is at most one place of each kind of cells, and one of all kinds that divide the spot. A place counts if its
    p-value, corrected for the number of all cells, divisions and kinds, is below `PLACE_ALPHA`.

    Parameters
    ----------
    images : ResidualImages
        Residuals of a fit.
    black_level_dn : float
        Black level [DN], which is added to the light where grey levels are given as readings.
    sums : ResidualSums or None
        Result of `sum_residuals` for the images; None to compute it.
    """
    sums = sum_residuals(images) if sums is None else sums
    places: dict[str, Place] = {}
    for cells in sums.means:
        family = "spot" if cells.kind.name in SPOT_KINDS else cells.kind.name
        strongest_of_divisions = list(strongest_cells(cells, images.design))
        for strongest in strongest_of_divisions:
            tests = strongest.count * len(strongest_of_divisions) * len(sums.means)
            p_value = correct_for_number(two_sided(strongest.z), tests)
            if p_value < PLACE_ALPHA and (family not in places or abs(strongest.z) > abs(places[family].z)):
                words = describe_cell(cells.kind, strongest.cell, strongest.frames, images, black_level_dn)
                places[family] = Place(words, strongest.z)
    return tuple(sorted(places.values(), key=lambda place: -abs(place.z))[:MOST_PLACES])


def strongest_cells(cells: CellSums, design: Design, scatter: KnownScatter = NO_SCATTER) -> Iterator[StrongestCell]:
    """Yield the strongest cell of each division of the frames: all together, by condition, by angle, by frame.

    Parameters
    ----------
    cells : CellSums
        Sums over the cells of one kind in each frame: of residuals (`sums`), with their variance before the fit
        (`norms`) and their `third` and `fourth` cumulant. The fit takes the squares of `absorbed` (spot of the frame)
        and `common` (read noise) off the variance.
    design : Design
        Conditions of the frames.
    scatter : KnownScatter
        Scatter that the weights of the sums do not contain.

    Yields
    ------
    StrongestCell
        Divisions without a cell that can be tested are left out.
    """
    for groups in divide_frames(design):
        # Sums over the frames of a group are products with `member` [group, frame], which is 1 for its frames.
        member = (np.arange(groups.max() + 1)[:, None] == groups).astype(float)
        norms = member @ cells.norms + _known_variance(cells, design, member, scatter)
        # The fit of a spot absorbs residuals of its frame only; the read noise is common to all frames.
        absorbed = member @ np.sum(cells.absorbed**2, axis=2) + (member @ cells.common) ** 2
        is_tested = (member @ cells.pixels >= FEWEST_PIXELS) & (norms > 0) & (absorbed < MOST_ABSORBED * norms)
        norms = np.where(is_tested, norms, 1.0)
        variance = np.where(is_tested, norms - absorbed, 1.0)
        skewness = (member @ cells.third) / variance**1.5
        is_tested &= np.abs(skewness) < MOST_SKEWED
        if not is_tested.any():
            continue
        total = member @ cells.sums
        z = np.where(is_tested, to_normal(total / np.sqrt(variance), skewness), 0.0)
        group, cell = np.unravel_index(np.argmax(np.abs(z)), z.shape)
        # Each term of `squares` has an expectation m ≤ 1. Normal terms have the variance 2 m², which is at most 2 m.
        mean = float((variance / norms)[is_tested].sum())
        yield StrongestCell(
            z=float(z[group, cell]),
            cell=int(cell),
            frames=np.flatnonzero(member[group]),
            count=int(is_tested.sum()),
            squares=float((total**2 / norms)[is_tested].sum()),
            mean=mean,
            variance=2 * mean + float(((member @ cells.fourth) / norms**2)[is_tested].sum()),
        )


def divide_frames(design: Design) -> list[np.ndarray]:
    """Return each division of the frames as the number of the group of each frame [frame]; equal ones only once."""
    count = len(design.site)
    distinct: dict[tuple[int, ...], None] = {}
    for labels in (np.zeros(count, int), design.condition, design.angle, np.arange(count)):
        _, first_frames, groups = np.unique(labels, return_index=True, return_inverse=True)
        # Groups are numbered by their first frame, so that equal divisions have equal numbers.
        distinct[tuple(np.argsort(np.argsort(first_frames))[groups].tolist())] = None
    return [np.array(groups) for groups in distinct]


def _known_variance(cells: CellSums, design: Design, member: np.ndarray, scatter: KnownScatter) -> np.ndarray:
    """Return an upper bound of what known scatter adds to the variances of sums [group, cell].

    `member` [group, frame] is 1 for the frames of a group, else 0.
    """
    added = np.zeros((len(member), cells.kind.count))
    for field in scatter.fields:
        # The frames of a site share grains, and all frames share gains of pixels, which have no grain (NaN).
        sites = np.zeros_like(design.site) if np.isnan(field.grain_px) else design.site
        area = np.prod([correlated_length(field.grain_px, length) for length in cells.kind.size])
        power = area * cells.light + correlated_length(field.grain_px, FAR_PX) ** 2 * cells.shift
        for site in np.unique(sites):
            # Amplitudes of frames with the same field add up, not their variances.
            amplitude = member[:, sites == site] @ np.sqrt(power[sites == site])
            added += max(field.variance, 0.0) * amplitude**2
    # Offsets of a row add up over its n pixels: (Σ a²)² is at most n Σ a⁴.
    pixels_in_row = np.minimum(cells.kind.size[1], cells.pixels)
    return added + scatter.row_variance * (member @ (pixels_in_row * cells.fourth_powers))


def correlated_length(grain_px: float, length: int) -> float:
    """Return the sum of a field's correlation over the pairs of pixels of a line, for each of its pixels [px].

    This is (1/n) Σᵢ Σⱼ exp(−(i − j)²/2 grain²) with n = `length` pixels. It is 1 without correlation (NaN).
    """
    if np.isnan(grain_px):
        return 1.0
    lag = np.arange(1, min(length, FARTHEST_LAG * grain_px + 2))
    return float(1 + 2 * np.sum((1 - lag / length) * np.exp(-(lag**2) / (2 * grain_px**2))))


# Probabilities


def two_sided(z: float) -> float:
    """Return the two-sided p-value of a normal deviate."""
    return float(2 * special.ndtr(-abs(z)))


def correct_for_number(p_value: float, number: int) -> float:
    """Return the probability that the smallest of `number` independent p-values is at most `p_value` (Šidák)."""
    return float(-np.expm1(number * np.log1p(-min(p_value, 1 - 1e-16))))


def to_normal(z: np.ndarray, skewness: np.ndarray) -> np.ndarray:
    """Return normal deviates with the same probability as sums with mean 0, variance 1 and a skewness.

    A sum is taken for a scaled and shifted χ², whose cube root is nearly normal. `z` and `skewness` broadcast.

    References
    ----------
    Wilson & Hilferty (1931), doi:10.1073/pnas.17.12.684.
    """
    gamma = np.where(np.abs(skewness) < LEAST_SKEWNESS, LEAST_SKEWNESS, skewness)
    return (6 / gamma) * (np.cbrt(np.maximum(gamma * z / 2 + 1, 0.0)) - 1) + gamma / 6


# Words


def describe_cell(kind: CellKind, cell: int, frames: np.ndarray, images: ResidualImages, black_level_dn: float) -> str:
    """Return where a cell of some frames lies, in words.

    Parameters
    ----------
    kind : CellKind
        Division of the images to which the cell belongs.
    cell : int
        Its number within the kind.
    frames : array of int
        Numbers of the frames whose residuals were summed.
    images : ResidualImages
        Residuals of all frames.
    black_level_dn : float
        Black level [DN], which is added to the light where grey levels are given as readings.
    """
    # Row and column of a block, or ring and sector.
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
    """Return a ring about the spot in words, in widths σ of the fitted spot; ring k ends at `RING_BOUNDS[k]`."""
    if ring == len(RING_BOUNDS):
        return f"pixels beyond {RING_BOUNDS[-1]:.1f} widths from the centre"
    return f"pixels {(0.0, *RING_BOUNDS)[ring]:.1f} to {RING_BOUNDS[ring]:.1f} widths from the centre"


def _describe_level(level: int, brightest_dn: float, black_level_dn: float) -> str:
    """Return a range of light as readings; `brightest_dn` is the light of the brightest peak [DN].

    Ranges have equal widths in the root of the light; number `LEVELS` stands for dark pixels.
    """
    if level == LEVELS:
        return "dark pixels"
    bounds = (black_level_dn + brightest_dn * (k / LEVELS) ** 2 for k in (level, level + 1))
    low, high = (f"{bound:,.{0 if bound >= 10 else 1}f}" for bound in bounds)
    if level == 0:
        return f"grey levels below {high} DN"
    return f"grey levels above {low} DN" if level == LEVELS - 1 else f"grey levels of {low} to {high} DN"


def _describe_frames(design: Design, frames: np.ndarray) -> str:
    """Return which frames of the design these are, in words from a space on; "" for all frames.

    They are described by the exposure and the angle that they share, if these vary among all frames.
    """
    if len(frames) == len(design.site):
        return ""
    exposures, angles = np.unique(design.exposure_s[frames]), np.unique(design.angle[frames])
    words = []
    if len(exposures) == 1 < len(np.unique(design.exposure_s)):
        words.append(f"{1e3 * exposures[0]:.3g} ms")
    if len(angles) == 1 < len(np.unique(design.angle)):
        words.append(f"{np.rad2deg(angles[0]):.3g}°")
    setting = f" at {' and '.join(words)}" if words else ""
    if len(frames) == 1:
        return f" of the frame{setting}, repeat {design.repeat[frames[0]]}"
    return f" of frames{setting}" if words else f" of frames of condition {design.condition[frames[0]] + 1}"
