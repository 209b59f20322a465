"""Blind test cases: a kind, a design and a seed give a world, its data sheet, its manifest and its truth."""

from __future__ import annotations

import csv
import io
import json
import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rig.errors import RigError
from rig.hidden.base import Base, draw_base
from rig.hidden.chain import expose
from rig.hidden.designs import DESIGNS, Design, Shot, draw_shots
from rig.hidden.effect import Effect
from rig.hidden.registry import VOCABULARY, shows
from rig.hidden.strength import Judge, solve
from rig.hidden.world import NO_EFFECT, World
from rig.imagefile import write_frame, write_whole

COLUMNS = ("file", "kind", "angle_deg", "exposure_s", "repeat")
_RANGES = {"faint": (5.0, 15.0), "mid": (15.0, 100.0), "strong": (100.0, 1000.0)}  # signal-to-noise


@dataclass(frozen=True)
class Case:
    """One blind test: data that an analysis may see, and the truth that it must not see."""

    seed: int  # seed of all random numbers
    kind: str  # `none`, or `one:<effect>:<level>`
    design: str  # name of the design in `DESIGNS`
    instrument: dict[str, Any]  # content of instrument.yaml
    manifest: list[dict[str, Any]]  # rows of manifest.csv
    truth: dict[str, Any]  # content of the truth file, which an analysis must not see
    world: World  # baseline and effect
    shots: tuple[Shot, ...]  # frames in order of acquisition


def draw_case(seed: int, kind: str, design: str = "default") -> Case:
    """Draw a case.

    Parameters
    ----------
    seed : seed of all random numbers.
    kind : `none`, or `one:<effect>:<level>` with an effect of `EFFECTS` and a level faint, mid or strong.
    design : name of a design in `DESIGNS`.

    Raises
    ------
    ValueError
        If there is no such kind or design, or if the frames of the design cannot show the effect.
    """
    if design not in DESIGNS:
        raise ValueError(f"no design {design!r}; there are {', '.join(DESIGNS)}")
    grid = DESIGNS[design]
    name, level = _read_kind(kind, grid)
    rng = _generator(seed, kind, design, 0, 0)
    shots = draw_shots(rng, grid)
    budget = "linear" if name == "shutter_offset" and len(grid.exposures_s) == 2 else None
    base, instrument = draw_base(rng, grid, f"Blind test {seed}", budget, can_have_black=name != "black_clipping")
    effect, entries = NO_EFFECT, []
    if name:
        judge, effect = Judge(grid, shots), VOCABULARY[name].draw(rng, base, shots)
        effect = _solved(judge, base, effect, _target(rng, level))
        entries = [{"name": name, "parameters": effect.parameters(), "form": effect.form(),
                    "snr": judge.snr(base, effect)}]  # fmt: skip
        base = effect.rebased(base)
    truth = {"seed": seed, "kind": kind, "design": design, "effects": entries, "base": base.truth()}
    manifest = [shot.row() for shot in shots]
    return Case(seed, kind, design, instrument, manifest, truth, World(base, effect), shots)


def frames(case: Case) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Manifest row and frame [DN], uint16 [rows, columns], in order of acquisition; each has its own generator."""
    for row, shot in zip(case.manifest, case.shots, strict=True):
        yield row, expose(case.world, shot, _generator(case.seed, case.kind, case.design, 1, shot.index))


def write(case: Case, folder: Path, truth: Path) -> None:
    """Write manifest.csv, instrument.yaml and frames into `folder`, and the truth to a file that is not inside it."""
    folder, truth = Path(folder), Path(truth)
    if truth.resolve().is_relative_to(folder.resolve()):
        raise RigError(f"{truth}: the truth must not lie in the dataset folder {folder}")
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(case.manifest)
    write_whole(folder / "manifest.csv", table.getvalue().encode())
    write_whole(folder / "instrument.yaml", yaml.safe_dump(case.instrument, sort_keys=False).encode())
    for row, frame in frames(case):
        write_frame(folder / row["file"], frame, case.instrument["sensor"]["bit_depth"])
    write_whole(truth, (json.dumps(case.truth, indent=2, allow_nan=False) + "\n").encode())


def _generator(seed: int, kind: str, design: str, *key: int) -> np.random.Generator:
    """Return the generator of random numbers for one purpose, which `key` numbers."""
    root = [seed, zlib.crc32(kind.encode()), zlib.crc32(design.encode())]
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(root, spawn_key=key)))


def _read_kind(kind: str, design: Design) -> tuple[str, str]:
    """Return name and level of the effect of a kind; both are "" for `none`."""
    if kind == "none":
        return "", ""
    count, name, level, *_ = [*kind.split(":"), "", ""]
    if count != "one" or name not in VOCABULARY or level not in _RANGES:
        raise ValueError(f"{kind!r} is no kind: none, or one:<effect>:<level> with levels {', '.join(_RANGES)} "
                         f"and effects {', '.join(VOCABULARY)}")  # fmt: skip
    if not shows(name, design):
        raise ValueError(f"{name} is not possible in this design: nothing in its frames would show it")
    return name, level


def _solved(judge: Judge, base: Base, effect: Effect, target: float) -> Effect:
    """Return the effect with the strength that reaches a target signal-to-noise."""
    strength = solve(lambda s: judge.snr(base, effect.at(s)), target, effect.span(base))
    # Six digits, so that the last bit of a sum (which may depend on the number of threads) decides nothing.
    return effect.at(float(f"{strength:.6g}"))


def _target(rng: np.random.Generator, level: str) -> float:
    """Draw a signal-to-noise in the range of a level."""
    low, high = _RANGES[level]
    if level == "faint":
        return rng.uniform(low, high)
    return math.exp(rng.uniform(math.log(low), math.log(high)))
