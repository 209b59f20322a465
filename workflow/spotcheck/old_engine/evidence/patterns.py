"""What pixels share beside the model: fields of a site, gains of the sensor's pixels, and offsets of a frame's rows.

A field δ on the light moves a reading by a δ, a its slope. With weights 1/V a member (a frame, or a site of a sensor)
has s = a r/V and n = a²/V of each pixel; what members share has S = Σ s and N = Σ n, and S the variance N + θ N² where
the field's is θ. Products of different members have the mean θ n n' whatever the noise is; one alone has its square.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence.grain import completed, neighbours
from spotcheck.old_engine.evidence.pixels import CELLS, Ready
from spotcheck.old_engine.evidence.windows import Site, whole_of, windows_of
from spotcheck.old_engine.model.effect import Context, Effect, Present
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Frame

# Rounds in which a variance and the weights that depend on it are found.
ROUNDS = 8
# Rows are told beyond this distance from the spot [σ]: nearer, fields on the light pass for them.
BESIDE = 3.0
# Places of less than this part of the greatest n² bring nothing to sums.
FAINT = 1e-14
# Fewer places than this tell no variance.
FEWEST = 30


class Places(NamedTuple):
    """Of every place (a pixel of a window, or a row) [place]: what the squared sum exceeds its noise by; what it would
    for a variance of 1, and the part of that which the fit leaves; the variance of the excess without any field; and
    its cell and cluster: places of different clusters know nothing of each other."""

    excess: np.ndarray
    unit: np.ndarray
    kept: np.ndarray
    noise: np.ndarray
    cell: np.ndarray
    cluster: np.ndarray


class Variance(NamedTuple):
    """Variance of a pattern and its standard error, what −2 ln L gains with it, Q over so many cells, and as how many
    equal squares it is told."""

    value: float
    error: float
    gain: float
    q: float
    cells: int
    freedom: float

    @property
    def sure(self) -> bool:
        """Whether there is such a pattern beyond chance."""
        # The likelihood, which takes pixels for independent, gains by what neighbours share: it does not tell.
        return self.value > criteria.SURE.value * self.error


class Pattern(NamedTuple):
    """An effect that scatters pixels or rows, its strength's standard error, and what tells it."""

    own: Present
    error: float
    told: Variance


def variances_of(sites: Sequence[Site], rows: Places) -> dict[tuple[str, str], Variance | None]:
    """Of what is shared (see `Scatter`) its variance, whether there is any or not; None where too little tells it."""
    sensor = of_sensor(sites)
    known = sensor.value if sensor is not None else 0.0
    return {
        ("field", "sensor"): sensor,
        ("field", "site"): variance_of(shared(sites), known, neighbours(sites[0].grain / sites[0].step)),
        ("row", "frame"): variance_of(rows),
    }


def patterns_of(sites: Sequence[Site], rows: Places, effects: Sequence[Effect], context: Context) -> Iterator[Pattern]:
    """What sums over frames (`gathered`) tell of effects that scatter pixels or rows, beside a fit without them."""
    kinds = {(e.scatter.of, e.scatter.shared): e for e in effects if e.scatter and e.scatter.of in ("field", "row")}
    alone = len(sites) == 1 and sites[0].single
    for kind, told in variances_of(sites, rows).items():
        if kind in kinds and told is not None and told.sure:
            effect, root = kinds[kind], float(np.sqrt(told.value))
            if alone and kind == ("field", "site") and root < criteria.FIELD_ALONE.value:
                continue
            values = (root, *map(float, effect.starts(context)[0][1:]))
            if kind == ("field", "site"):
                values = grained(effect, values, sites[0].grain, context)
            yield Pattern(Present(effect, effect.forms[0], values), told.error / (2 * root), told)


def grained(effect: Effect, values: tuple[float, ...], grain: float, context: Context) -> tuple[float, ...]:
    """Values of a field's effect, the length among its parameters as the grain [px] that was found."""
    bounds = effect.bounds(context)
    return tuple(
        float(np.clip(grain, *bounds[p])) if parameter.unit == "px" and grain > 0 else value
        for p, (parameter, value) in enumerate(zip(effect.parameters, values, strict=True))
    )


def gathered(frames: Sequence[Frame], design: Design, ready: Ready) -> tuple[list[Site], Places]:
    """The sums of every site, and the places of all rows; where sites share a field, with its grain and the part of it
    that shape and numbers leave."""
    sites, lines = [], []
    for window, own in windows_of(frames, design):
        for k in own:
            frame = frames[k]
            seen, tells = ready.of(frame, k)
            window.add(frame, seen, tells)
            far = np.hypot(seen.u, seen.v) > BESIDE
            row = np.broadcast_to(np.rint(seen.v * np.exp(ready.plain.model.numbers.log_width[k])), far.shape)[:, 0]
            lines.append((k, row, (tells.mean * far).sum(axis=1), (tells.sure * far).sum(axis=1)))
        sites.append(window.site())
    sensor = of_sensor(sites)
    by_sensor = sensor.value if sensor is not None and sensor.sure else 0.0
    by_site = variance_of(shared(sites), by_sensor)
    if by_site is not None and (by_sensor > 0 or by_site.sure):
        sites = completed(frames, design, ready, sites, by_site.value, by_sensor)
    return sites, _rows(lines, design)


def _rows(lines, design: Design) -> Places:
    """Rows of all frames, beside what frames of one condition have in common at the same distance from the spot."""
    which, row, pull, weight = (
        np.concatenate([np.broadcast_to(own[j], own[1].shape) for own in lines]) for j in range(4)
    )
    _, group = np.unique(np.stack([design.condition[which], row.astype(int)]), axis=1, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group)[group]
    common, total = np.bincount(group, pull)[group], np.bincount(group, weight)[group]
    # A frame alone has nothing in common with others, and is told beside the spot alone.
    part = np.where(count > 1, weight / np.maximum(total, 1e-300), 0.0)
    rest = pull - np.where(count > 1, part * common, 0.0)
    left = weight * (1 - part)
    good = left > 0
    # What the n frames of a condition leave beside each other is alike: their squares tell as much as those of n − 1.
    return Places((rest**2 - left)[good], (weight * left)[good], np.ones(good.sum()), (2 * left * weight)[good],
                  which[good] % CELLS, which[good])  # fmt: skip


def shared(sites: Sequence[Site]) -> Places:
    """The fields that frames of a site share: products of different frames, or the square of one alone."""
    parts = []
    for k, own in enumerate(sites):
        unit = own.unit
        # Where one frame alone sees a pixel that others of its site do not, nothing is shared; and next to nothing
        # where there is hardly any light.
        good = unit > FAINT * unit.max()
        cell, unit, beside = own.cell[good], unit[good], (own.weight if own.single else own.square)[good]
        parts.append((own.pull[good] ** 2 - beside, unit, own.kept[cell], 2 * unit, cell, k * CELLS + cell))
    return Places(*(np.concatenate(own) for own in zip(*parts, strict=True)))


def of_sensor(sites: Sequence[Site]) -> Variance | None:
    """The field that all sites share where their windows lie on the same pixels: products of different sites."""
    whole = whole_of(sites)
    return None if whole is None else variance_of(shared([whole]))


def variance_of(places: Places, known: float = 0.0, together: float = 1.0) -> Variance | None:
    """Variance of what places share, beside a part of it that is known; None where too few tell it. So many neighbours
    of a field count `together` as one."""
    if len(places.unit) < FEWEST:
        return None
    unit, weight = places.unit * places.kept, np.sqrt(places.unit)
    excess = places.excess - known * unit
    value, light = 0.0, np.ones_like(unit)
    for _ in range(ROUNDS):
        # The weight of a place beside the field itself.
        light = (1 + (value + known) * weight) ** -2.0
        value = max(float(light @ excess) / float(light @ unit), 0.0)
    rest, total = light * (excess - value * unit), float(light @ unit)
    spread = light * places.noise
    clusters = np.bincount(places.cluster, rest)
    own = float(spread.sum())
    # Neighbours share a field: at least as their correlation says, and by what clusters scatter.
    x = value * weight * places.kept
    shared = float(spread @ (1 + (together - 1) * (x / (1 + x)) ** 2))
    inflated = max(float(clusters @ clusters), shared, own) / own
    error = float(np.sqrt(own * inflated)) / total
    # S² over its noise, of a normal S: its mean beside a field is 1 + x.
    gain = float(np.sum((1 + excess / weight) * x / (1 + x) - np.log1p(x))) / inflated
    by_cell, noise = np.bincount(places.cell, rest, CELLS), np.bincount(places.cell, spread, CELLS) * inflated
    told = noise > 1e-4 * noise.max()
    return Variance(value, error, gain, float(np.sum(by_cell[told] ** 2 / noise[told])), int(told.sum()),
                    total**2 / float(((light * unit) ** 2).sum()) / inflated)  # fmt: skip
