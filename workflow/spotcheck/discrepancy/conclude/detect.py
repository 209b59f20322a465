"""Whether the frames agree with the baseline: one p-value, from laws of summaries alone.

Each frame's own brightness, width and centre are fitted under the declared shape. What is left of its readings is
summed in several ways, the frames' numbers are held against the baseline's law, and each sum has a p-value of its own.
The smallest counts, corrected for their number.
"""

from collections.abc import Callable, Hashable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.evidence import fields as spectra
from spotcheck.discrepancy.evidence.cells import (
    SQUARE,
    SQUARE_NORM,
    Cells,
    Readings,
    Standard,
    cells_of,
    coarser,
    place_of,
    pooled,
)
from spotcheck.discrepancy.evidence.hot import hot_pixels, largest_reading
from spotcheck.discrepancy.evidence.numbers import exposures_of, numbers_parts
from spotcheck.discrepancy.evidence.parts import (
    Part,
    Standing,
    Words,
    cauchy,
    evened,
    excess_part,
    form_of,
    largest,
    normal,
    sidak,
    standing,
    standing_squares,
    well_known,
)
from spotcheck.discrepancy.evidence.taken import drawn_readings, shapes_of
from spotcheck.discrepancy.nuisance.fit import Fitted
from spotcheck.discrepancy.nuisance.numbers import Numbered, fit_numbers
from spotcheck.discrepancy.observe.design import Design
from spotcheck.discrepancy.observe.pixels import Frame, Model
from spotcheck.model.light_shape import LightShape

# Crops that lie further apart than this [px] share no window of the sensor.
LARGEST_WINDOW = 2048


# Draws of the shape's coefficients by which it is told how much noise it takes, and their seed: many nodes share in
# each sum, so that few do.
DRAWS, SEED = 16, 1
# Kinds of cells, and which frames share them: from all to single ones.
CHAINS = {
    "block": ("all", "site", "frame"),
    "row": ("all", "frame"),
    "column": ("all", "frame"),
    "level": ("all", "condition"),
    "sector": ("all", "condition"),
}
# Sums of squares that are compared with each other: name, cells, and which frames share them.
SPREADS = (("levels", "level", "all"), ("coarse blocks", "coarse block", "all"), ("frames", "whole", "frame"))


class Detection(NamedTuple):
    """The p-value that the frames agree with the model, by the smallest part's (Šidák) and by Cauchy's combination; and
    every part, the oddest first."""

    p_value: float
    p_cauchy: float
    parts: tuple[Part, ...]

    @property
    def worst(self) -> Part:
        """The oddest part."""
        return self.parts[0]


class Looked(NamedTuple):
    """All sums over the frames: cells of each frame by kind, counted from a corner (row, column) of the sensor; fields
    of the frames and of the sites; and the readings as they were standardised."""

    cells: list[dict[str, Cells]]
    corner: tuple[int, int]
    powers: list[spectra.Power]
    fields: list[spectra.Field]
    seen: list[Standard]


def detect(frames: Sequence[Frame], model: Model | Numbered | Fitted, design: Design) -> Detection:
    """Test frames against a model. A `Model` has its frames' numbers fitted first. Of a `Fitted` what its learned shape
    takes counts as fitted, and its frames' numbers are not asked: laws on them are another question.

    # ASSUME: a fit of the shape takes as much noise as its information says. Its likelihood is that of normal readings
    # in mean and variance, so below 0.6 DN of noise it takes more, and p-values beside a shape are too small.
    """
    found: list[Part | None] = []
    if isinstance(model, Fitted):
        looked = look(frames, model.model, design, shapes_of(model, DRAWS, np.random.default_rng(SEED)))
        sensor = model.model.sensor
    else:
        numbered = model if isinstance(model, Numbered) else fit_numbers(frames, model)
        looked, sensor = look(frames, numbered.model, design), numbered.model.sensor
        found += numbers_parts(numbered, exposures_of(frames), np.asarray(design.site))
    pixels = [own.pixels for own in frames]
    found += [*cell_parts(looked, design), *field_parts(looked, design), largest_reading(looked.seen, pixels, sensor)]
    found.append(hot_pixels(looked.seen, pixels, sensor) if len(frames) > 1 else None)
    parts = sorted((own for own in found if own is not None), key=lambda own: (own.p_value, -abs(own.statistic)))
    values = [own.p_value for own in parts]
    return Detection(sidak(values[0], len(values)), cauchy(values), tuple(parts))


def look(frames: Sequence[Frame], model: Model, design: Design, shapes: Sequence[LightShape] = ()) -> Looked:
    """One pass over all frames; `shapes` are draws of what a learned shape takes."""
    readings = Readings(frames, model)
    seen = [readings.of(k) for k in range(len(frames))]
    brightest = max(float(own.declared.max()) for own in seen)
    corner = min(int(own.row.min()) for own in seen), min(int(own.column.min()) for own in seen)
    peak = np.exp(model.numbers.log_peak)

    def drawn(k: int) -> np.ndarray:
        return drawn_readings(seen[k], float(peak[k]), shapes) if shapes else np.zeros((0, seen[k].z.size))

    cells = [cells_of(own, brightest, corner, drawn(k)) for k, own in enumerate(seen)]
    site, condition = np.asarray(design.site), np.asarray(design.condition)

    # Frames of one condition are so alike that what their numbers take of a spectrum is the same.
    def lost(k: int) -> tuple[np.ndarray, np.ndarray]:
        both = np.concatenate([seen[k].taken, drawn(k)])
        even = np.where(seen[k].spread > 0, 1.0, 0.0)
        shape = seen[k].shape
        return spectra.taken_power(both, shape, even), spectra.taken_power(both, shape, seen[k].relative)

    taken = _once([(int(c), own.shape) for c, own in zip(condition, seen, strict=True)], lost)
    alone = [spectra.field_of([own], [np.where(own.spread > 0, 1.0, 0.0)], [taken[k][0]])
             for k, own in enumerate(seen)]  # fmt: skip
    powers = [spectra.evened(spectra.power_of(own), own) for own in alone]
    fields = []
    for s in np.unique(site):
        own = np.flatnonzero(site == s)
        fields.append(spectra.field_of([seen[k] for k in own], [seen[k].relative for k in own],
                                       [taken[k][1] for k in own]))  # fmt: skip
    return Looked(cells, corner, powers, fields, seen)


def _once(keys: Sequence[Hashable], make: Callable) -> list:
    """What `make` gives for the first place of each key, for all places."""
    known: dict[Hashable, object] = {}
    for k, key in enumerate(keys):
        if key not in known:
            known[key] = make(k)
    return [known[key] for key in keys]


def cell_parts(looked: Looked, design: Design) -> list[Part | None]:
    """All parts from sums over cells: what all frames share, what those of a site or a condition share beyond that, and
    what is each frame's own."""
    count = len(looked.cells)
    keys = {"frame": np.arange(count), "site": np.asarray(design.site), "condition": np.asarray(design.condition),
            "all": np.zeros(count, int)}  # fmt: skip
    kinds = {kind: [own[kind] for own in looked.cells] for kind in looked.cells[0]}
    kinds["coarse block"] = [coarser(own) for own in kinds["block"]]
    kinds["whole"] = [pooled([own._replace(label=0 * own.label)]) for own in kinds["level"]]

    def stand(kind: str, shared: str, law=standing) -> tuple[list[Standing], Words]:
        values = np.unique(keys[shared])
        groups = [pooled([kinds[kind][int(k)] for k in np.flatnonzero(keys[shared] == v)]) for v in values]

        def words(group: int, label: tuple[int, int]) -> str:
            place = place_of(kind, label, looked.corner)
            return place if shared == "all" else f"{shared} {values[group]}, {place}".removesuffix(", ")

        return [law(own) for own in groups], words

    out: list[Part | None] = []
    for kind, chain in CHAINS.items():
        # What more frames share is asked first, and taken off what fewer share.
        distinct = [own for j, own in enumerate(chain) if not j or len(np.unique(keys[own])) > len(
            np.unique(keys[chain[j - 1]]))]  # fmt: skip
        within = None
        if kind == "block":
            stands, words = stand("coarse block", "all")
            within = form_of(stands, words)
            out.append(excess_part("mean: coarse blocks, all frames", form_of(well_known(stands), words)))
        for shared in distinct:
            stands, words = stand(kind, shared)
            form = form_of(stands, words)
            name = f"{kind}s, {'all frames' if shared == 'all' else 'each ' + shared}"
            # Of a difference the shape takes little, since it is the same in all frames.
            out.append(excess_part(f"mean: {name}", form if within else form_of(well_known(stands), words), within))
            if kind == "block":
                out.append(largest(f"mean: largest of {name}", well_known(stands), words))
            within = form
    total, variance = (sum(float(own.sums[0, at]) for own in kinds["whole"]) for at in (SQUARE, SQUARE_NORM))
    out.append(normal("variance: all readings", total, variance))
    for name, kind, shared in SPREADS:
        out.append(
            excess_part(f"variance: {name}", evened(form_of(*stand(kind, shared, standing_squares)), total, variance))
        )
    return out


def field_parts(looked: Looked, design: Design) -> list[Part | None]:
    """All parts from spectra."""
    out = [spectra.rings_part("spectrum: frames", looked.powers)]
    shared = [spectra.power_of(own) for own in looked.fields]
    # Fields of like weight each count as much as they tell.
    scaled = [_scaled(own) for own in shared]
    out.append(spectra.rings_part("spectrum: sites", scaled))
    shapes = {own.pull.shape for own in looked.fields}
    if len(shapes) == 1:
        out.append(spectra.peak_part("spectrum: peak of sites", looked.fields))
    if len(looked.fields) > 1:
        rows, columns = (np.concatenate([getattr(own, axis)[[0, -1]] for own in looked.seen]) for axis in
                         ("row", "column"))  # fmt: skip
        if max(np.ptp(rows), np.ptp(columns)) < LARGEST_WINDOW:
            every = spectra.field_of(looked.seen, [own.relative for own in looked.seen], [])
            out.append(spectra.peak_part("spectrum: peak of all frames", [every]))
    return out


def _scaled(power: spectra.Power) -> spectra.Power:
    """Powers in units of their mean."""
    unit = np.maximum(power.mean, 1e-300)
    return spectra.Power(power.value / unit, power.mean / unit, power.variance / unit**2)
