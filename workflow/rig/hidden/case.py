"""Blind test cases: a kind, a design and a seed give a world, its data sheet, its manifest and its truth."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rig.hidden import registry
from rig.hidden.base import Base, draw_base
from rig.hidden.designs import FRAME_PX, WANDER_PX, Shot, draw_shots
from rig.hidden.effect import Effect
from rig.hidden.expose import expose
from rig.hidden.kinds import Kind, choose, read_kind
from rig.hidden.strength import Judge, solve
from rig.hidden.world import World

_ROUNDS = 4  # of strengthening effects that others hide
_ATTEMPTS = 12  # at a set of effects that all reach their level beside each other
_RANGES = {"faint": (5.0, 15.0), "mid": (15.0, 100.0), "strong": (100.0, 1000.0)}  # signal-to-noise


@dataclass(frozen=True)
class Case:
    """One blind test. `instrument` and `manifest` are what an analysis may see, `truth` is what it must not."""

    seed: int
    kind: str
    design: str
    instrument: dict[str, Any]
    manifest: list[dict[str, Any]]
    truth: dict[str, Any]
    world: World
    shots: tuple[Shot, ...]


def draw_case(seed: int, kind: str, design: str = "default") -> Case:
    """A case: `none`, `one:<effect>:<level>`, `two:strong` (three, four), `two:<a>+<b>:strong`, `outside:<x>:…`."""
    grid = registry.design(design)
    wanted = read_kind(kind, grid)
    root = np.random.SeedSequence([seed, zlib.crc32(kind.encode()), zlib.crc32(design.encode())])
    for attempt in range(_ATTEMPTS):
        rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(root.entropy, spawn_key=(0, attempt))))
        names = choose(rng, wanted, grid)
        shots = draw_shots(rng, grid)
        classes = [registry.find(name) for name in names]
        budget = next((b for b in (registry.needed_budget(name, grid) for name in names) if b), None)
        black = next((cls.black for cls in classes if cls.black is not None), None)
        base, instrument = draw_base(rng, grid, f"Blind test {seed}", budget, black)
        judge = Judge(grid, shots)
        effects = _strengthened(rng, judge, base, [cls.draw(rng, base, shots) for cls in classes], wanted)
        snrs = [judge.snr(base, [e], [o for o in effects if o is not e]) for e in effects]
        if len(effects) < 2 or min(snrs) >= 0.9 * _RANGES[wanted.level][0] or attempt == _ATTEMPTS - 1:
            break
    for effect in effects:
        base = effect.rebased(base)
    return Case(
        seed=seed,
        kind=kind,
        design=design,
        instrument=instrument,
        manifest=[shot.row() for shot in shots],
        truth=_truth(seed, kind, design, judge, base, effects, snrs),
        world=World(base, tuple(effects)),
        shots=shots,
    )


def frames(case: Case) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Manifest row and frame [DN], uint16 [rows, columns], in order of acquisition; each has its own generator."""
    root = [case.seed, zlib.crc32(case.kind.encode()), zlib.crc32(case.design.encode())]
    for row, shot in zip(case.manifest, case.shots, strict=True):
        seed = np.random.SeedSequence(root, spawn_key=(1, shot.index))
        yield row, expose(case.world, shot, np.random.Generator(np.random.SFC64(seed)))


def with_more(case: Case, angle_deg: float, exposure_s: float, number: int) -> Case:
    """The same world with frames of one more condition, taken after the others: at sites of that angle that have no
    such frame yet, then at new ones. ValueError where an effect drew one number a frame beforehand."""
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence([case.seed, 2])))
    shots = list(case.shots)
    exposed = {s.repeat for s in shots if (s.angle_deg, s.exposure_s) == (angle_deg, exposure_s)}
    sites = {s.repeat: s for s in shots if s.angle_deg == angle_deg}
    repeats = [r for r in sorted(sites) if r not in exposed]
    fresh = max(sites, default=-1) + 1
    repeats += range(fresh, fresh + number)
    for repeat in repeats[:number]:
        site = sites[repeat].site if repeat in sites else 1 + max(s.site for s in shots)
        x, y = (
            (sites[repeat].x_px, sites[repeat].y_px)
            if repeat in sites
            else (FRAME_PX - 1) / 2 + rng.uniform(-WANDER_PX, WANDER_PX, 2)
        )
        shots.append(Shot(len(shots), site, angle_deg, exposure_s, repeat, float(x), float(y)))
    if any(hasattr(effect, "frames") for effect in case.world.effects):
        raise ValueError(f"seed {case.seed}: an effect of {case.kind} is drawn for {len(case.shots)} frames, no more")
    return replace(case, shots=tuple(shots), manifest=[shot.row() for shot in shots])


def blocked(case: Case, exposure_s: float, number: int) -> list[np.ndarray]:
    """Frames [DN] of the same camera in the same room with the beam blocked, taken after the others."""
    dark = replace(case.world, base=replace(case.world.base, peak_dn=0.0))
    shot = replace(case.shots[-1], exposure_s=exposure_s)
    seeds = np.random.SeedSequence([case.seed, 3]).spawn(number)
    return [expose(dark, shot, np.random.Generator(np.random.SFC64(seed))) for seed in seeds]


def _strengthened(
    rng: np.random.Generator, judge: Judge, base: Base, effects: list[Effect], wanted: Kind
) -> list[Effect]:
    """Effects with strengths that reach drawn targets, alone and then, where need be, beside each other."""
    targets = [_target(rng, wanted.level) for _ in effects]
    solved = [_solved(judge, base, effect, target, []) for effect, target in zip(effects, targets, strict=True)]
    if len(solved) < 2:
        return solved
    least = _RANGES[wanted.level][0]
    for _ in range(_ROUNDS):
        settled = True
        for k, target in enumerate(targets):
            others = solved[:k] + solved[k + 1 :]
            if judge.snr(base, [solved[k]], others) < least:
                solved[k] = _solved(judge, base, solved[k], max(target, 1.2 * least), others)
                settled = False
        if settled:
            break
    return solved


def _solved(judge: Judge, base: Base, effect: Effect, target: float, others: Sequence[Effect]) -> Effect:
    strength = solve(lambda s: judge.snr(base, [effect.at(s)], others), target, effect.span(base))
    # Six digits, so that the last bit of a sum (which may depend on the number of threads) decides nothing.
    return effect.at(float(f"{strength:.6g}"))


def _target(rng: np.random.Generator, level: str) -> float:
    low, high = _RANGES[level]
    if level == "faint":
        return rng.uniform(low, high)
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _truth(
    seed: int, kind: str, design: str, judge: Judge, base: Base, effects: Sequence[Effect], snrs: Sequence[float]
) -> dict[str, Any]:
    """What was put in, as plain JSON."""
    known: list[dict[str, Any]] = []
    outside = None
    for effect, snr in zip(effects, snrs, strict=True):
        if registry.is_outside(effect.name):
            outside = {"mechanism": effect.name, "settings": effect.parameters() | effect.form(), "snr": snr}
        else:
            entry = {"name": effect.name, "parameters": effect.parameters(), "form": effect.form(), "snr": snr}
            simpler = effect.simpler()
            if simpler is not None:
                others = [other for other in effects if other is not effect]
                entry["snr_beyond"] = {simpler.name: judge.snr(base, [effect], [*others, simpler])}
            known.append(entry)
    known.sort(key=lambda entry: -entry["snr"])
    return {
        "seed": seed,
        "kind": kind,
        "design": design,
        "effects": known,
        "outside": outside,
        "base": base.truth(),
        "snr": judge.snr(base, effects) if effects else 0.0,
    }
