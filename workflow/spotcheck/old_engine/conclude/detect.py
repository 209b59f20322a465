"""Whether frames agree with a model: one p-value, from laws of summaries alone, and where they do not.

Each frame's own brightness, width and centre are fitted. What is left of its readings is summed in several ways, the
frames' numbers are held against the baseline's law, and each sum of squares has a p-value of its own. The smallest
counts, corrected for their number.
"""

from collections.abc import Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from spotcheck.old_engine.conclude.places import Scene, cell_words, number_words, scene_of
from spotcheck.old_engine.evidence import fields as spectra
from spotcheck.old_engine.evidence.cells import Cells, Readings, cells_of, pooled, shapes_of
from spotcheck.old_engine.evidence.hot import odd_pixels, oddest
from spotcheck.old_engine.evidence.numbers import numbers_of
from spotcheck.old_engine.evidence.parts import Part, Standing, form_of, part_of, smallest_of, standing, standing_of
from spotcheck.old_engine.evidence.windows import Window, placed, windows_of
from spotcheck.old_engine.nuisance.fit import Fitted
from spotcheck.old_engine.nuisance.numbers import Numbered, fit_numbers
from spotcheck.old_engine.nuisance.taken import DRAWS
from spotcheck.old_engine.nuisance.threads import shared
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Frame, Model

# Crops that lie further apart than this [px] share no window of the sensor.
LARGEST_WINDOW = 2048
# All that is summed over cells: the mean (or the variance) of which cells, over which frames.
SUMMARIES = (
    ("mean", "patch", "all"), ("mean", "block", "frame"), ("mean", "row", "all"),
    ("mean", "row", "frame"), ("mean", "column", "all"), ("mean", "level", "all"), ("mean", "level", "exposure"),
    ("mean", "sector", "all"), ("variance", "frame", "all"), ("variance", "frame", "frame"),
    ("variance", "level", "all"),
)  # fmt: skip


class Detection(NamedTuple):
    """The p-value that the frames agree with the model, and every part, the oddest first."""

    p_value: float
    parts: tuple[Part, ...]

    @property
    def worst(self) -> Part:
        """The oddest part."""
        return self.parts[0]


class Looked(NamedTuple):
    """All sums over the frames of a model: where these are, cells of each frame by kind, and the parts that are no sums
    over cells."""

    model: Model
    scene: Scene
    cells: list[dict[str, Cells]]
    parts: list[Part | None]


def detect(frames: Sequence[Frame], model: Model | Numbered | Fitted, design: Design) -> Detection:
    """Test frames against a model. A `Model` has its frames' numbers fitted first. Of a `Fitted` what its learned shape
    takes counts as fitted, and its frames' numbers are not asked: laws on them are another question."""
    return looked_at(frames, model, design)[1]


def looked_at(frames: Sequence[Frame], model: Model | Numbered | Fitted, design: Design) -> tuple[Looked, Detection]:
    """All sums over frames, and the test by them.

    # ASSUME: a fit of the shape takes as much noise as its information says. Its likelihood is that of normal readings
    # in mean and variance, so below 0.6 DN of noise it takes more, and p-values beside a shape are too small.
    """
    if isinstance(model, Model):
        model = fit_numbers(frames, model)
    looked = look(frames, model if isinstance(model, Fitted) else model.model, design)
    found = [*cell_parts(looked), *looked.parts]
    if isinstance(model, Numbered):
        numbers = numbers_of(model, looked.scene.exposure_s, np.asarray(design.site))
        found += number_parts(looked.scene, numbers)
    parts = sorted((own for own in found if own is not None), key=lambda own: (own.p_value, -abs(own.statistic)))
    return looked, Detection(smallest_of(parts[0].p_value, len(parts)) if parts else 1.0, tuple(parts))


def look(frames: Sequence[Frame], model: Model | Fitted, design: Design) -> Looked:
    """One pass over all frames, of which cells, fields of the sites and what single pixels tell remain."""
    shapes = shapes_of(model, DRAWS, np.random.default_rng(0)) if isinstance(model, Fitted) else []
    plain = model.model if isinstance(model, Fitted) else model
    readings, scene, sensor = Readings(frames, plain, shapes), scene_of(frames, plain), plain.sensor
    sites, whole = list(windows_of(frames, design)), Window(frames)
    site_of = {k: j for j, (_, own) in enumerate(sites) for k in own}
    conditions = [np.flatnonzero(design.condition == own) for own in np.unique(design.condition)]

    def part(which: np.ndarray) -> list[Any]:
        total, *fields = (spectra.empty(window.shape) for window in (whole, *(own for own, _ in sites)))
        seen = []
        for k in np.concatenate([conditions[c] for c in which]).tolist():
            own, frame, window = readings.of(k), frames[k], sites[site_of[k]][0]
            even = np.where(own.spread > 0, 1.0, 0.0)
            # Frames of one condition are so alike that what their numbers take of a spectrum is the same.
            key = int(design.condition[k]), own.shape
            if key not in taken:
                taken[key] = [spectra.taken_of(own.taken, own.shape, weight) for weight in (even, own.relative)]
            pairs = spectra.pairs_of(spectra.field_of(own.z, even, own.shape, taken[key][0]))
            fields[site_of[k]].add(window.at(frame), spectra.field_of(own.z, own.relative, own.shape, taken[key][1]))
            alone = spectra.field_of(own.z, own.spread, own.shape)
            total.add(whole.at(frame), alone)
            electrons = np.where(own.spread > 0, own.electrons, np.nan).astype(np.float32).reshape(own.shape)
            odd = oddest(alone, Window([frame]), [frame], [electrons], sensor)
            seen.append((k, cells_of(own, scene.brightest, scene.corner), pairs, electrons, odd))
        return [seen, *(sums for own in (total, *fields) for sums in own)]

    taken: dict[Hashable, list[np.ndarray]] = {}
    seen, *sums = shared(part, len(conditions))
    total, *fields = (spectra.Field(*sums[j : j + 3]) for j in range(0, len(sums), 3))
    _, cells, pairs, electrons, odd = zip(*sorted(seen, key=lambda own: own[0]), strict=True)
    parts = [
        spectra.grain_part("grain: frame", pairs, whole.step),
        spectra.grain_part("grain: site", [spectra.pairs_of(own) for own in fields], whole.step),
        peak_of(whole, [window for window, _ in sites], fields),
        odd_pixels("readings: one frame", odd, electrons, sensor),
    ]
    if len(frames) > 1:
        one = [oddest(total, whole, frames, electrons, sensor)]
        parts.append(odd_pixels("readings: all frames", one, electrons, sensor))
    return Looked(plain, scene, list(cells), parts)


def peak_of(whole: Window, windows: Sequence[Window], fields: Sequence[spectra.Field]) -> Part | None:
    """The highest peak in the spectrum of all that the sites' fields add up to on the sensor; of crops far apart, of
    their powers."""
    if max(whole.shape) < LARGEST_WINDOW and len(fields) > 1:
        every = spectra.empty(whole.shape)
        for own, window in zip(fields, windows, strict=True):
            every.add(placed(window.corner, window.shape, whole.corner), own)
        fields = [every]
    alike = len({own.pull.shape for own in fields}) == 1
    return spectra.peak_part("spectrum: peak", fields, whole.step) if alike else None


def groups_of(scene: Scene) -> dict[str, list[np.ndarray]]:
    """Frames that share something, by what it is; nothing where all share it or none."""
    count = len(scene.exposure_s)
    keys = {"all": np.zeros(count), "exposure": scene.exposure_s, "angle": scene.angle_deg, "frame": np.arange(count)}
    out = {name: [np.flatnonzero(key == own) for own in np.unique(key)] for name, key in keys.items()}
    last = {"all": 1, "frame": count}
    return {name: own for name, own in out.items() if name == "all" or 1 < len(own) <= last.get(name, count - 1)}


def cell_parts(looked: Looked) -> list[Part | None]:
    """All parts from sums over cells."""
    out, groups = [], groups_of(looked.scene)
    for what, kind, by in SUMMARIES:
        if by in groups:
            own = [pooled([looked.cells[int(k)][kind] for k in at]) for at in groups[by]]
            form = form_of([standing(one, squares=what == "variance") for one in own])
            _, group, label = form.worst
            where = cell_words(what, kind, label, groups[by][group], looked.scene)
            part = part_of(f"{what}: {kind}, {by}", form, where)
            # A sum of squares over readings is itself an excess in its own errors: it is not squared again.
            out.append(part._replace(statistic=part.z) if part and what == "variance" else part)
    return out


def number_parts(scene: Scene, numbers: Mapping[str, Standing]) -> list[Part | None]:
    """All parts from the frames' numbers: each frame by itself, and brightness and width of each exposure and angle."""
    out, groups = [], groups_of(scene)
    for name, own in numbers.items():
        shared = ("frame",) if name == "centre" else ("frame", "exposure", "angle")
        for by in (by for by in shared if by in groups):
            every, told = groups[by], own
            if by != "frame":
                member = np.array([np.isin(own.label[:, 0], at) for at in every], float)
                member /= np.sqrt(np.maximum(member.sum(axis=1, keepdims=True), 1.0))
                told = standing_of(member @ own.z, member @ own.taken, np.arange(len(every)))
            form = form_of([told])
            where = number_words(name, every[form.worst[2][0]], scene)
            out.append(part_of(f"numbers: {name}, {by}", form, where))
    return out
