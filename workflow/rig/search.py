"""The search for the default rig's settings: screen many, try the best in full, then refine the winner.

Deterministic for a seed. Every full trial is a row of the table, so that the choice can be checked.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rig import imagefile, plan, scores, screen, settings, trial
from rig.errors import RigError
from rig.plan import Site
from rig.settings import Settings

# Gain over a Lambertian surface with which the lens collects 1/f_a² of the light, (2 d_w/f)².
PAPER_GAIN = (2 * 0.25 / 0.0502) ** 2
# Searched keys: dotted key -> lowest value, highest value, step. All other settings come from the settings file.
SPACE: dict[str, tuple[float, float, float]] = {
    "seed": (1, 100_000, 1),
    "sensor.clip_level_e": (6650, 7050, 10),
    "sensor.clip_pixel_scatter": (0.008, 0.016, 0.0005),
    "sensor.clip_row_scatter": (0.0, 0.003, 0.0005),
    "sensor.clip_row_step": (0.02, 0.045, 0.001),
    "sensor.clip_row_period_px": (3, 8, 1),
    "sensor.clip_screen_sigma": (1.5, 2.2, 0.1),
    "speckle.patterns": (2, 3, 1),
    "laser.polarisation_deg": (0, 175, 5),
    # In units of the gain that the paper's factor 1/f_a² stands for.
    "material.specular_gain": (0.4 * PAPER_GAIN, 1.5 * PAPER_GAIN, 0.01 * PAPER_GAIN),
    "material.spread_along_m": (270e-6, 350e-6, 2e-6),
    "material.spread_across_m": (230e-6, 290e-6, 2e-6),
    "material.spread_polarisation": (0.0, 0.25, 0.01),
    "material.reflectance_polarisation": (0.0, 0.5, 0.01),
    "material.site_reflectance_scatter": (0.2, 1.2, 0.01),
    "material.site_spread_scatter": (0.0, 0.15, 0.01),
    "material.site_spread_exponent": (-0.3, 0.2, 0.01),
}
POLISHING_STEPS = 300
# The simulation's noise decides where its maximum lies, and with it the PSNR: one draw would be chosen for its luck.
SIMULATIONS = 3


@dataclass(frozen=True)
class Trial:
    """A point of the space and its scores in several draws of the paper's simulation."""

    stage: str
    point: dict[str, Any]
    draws: list[list[scores.Score]]

    @property
    def rank(self) -> tuple[float, float]:
        """Mean number of met numbers, then minus the mean of the summed misses: larger is better."""
        if not self.draws:
            return 0.0, -math.inf
        met_counts = [sum(score.is_met for score in draw) for draw in self.draws]
        misses = [sum(score.miss for score in draw) for draw in self.draws]
        return float(np.mean(met_counts)), -float(np.mean(misses))


def search(base: Settings, sites: list[Site], seed: int, draws: int, trials: int, refinements: int) -> list[Trial]:
    """All full trials in order; the best is `max(..., key=rank)`."""
    rng = np.random.default_rng(seed)
    points = [{key: _draw(rng, *SPACE[key]) for key in SPACE} for _ in range(draws)]
    forecasts = [screen.forecast(settings.replace(base, point), sites) for point in points]
    order = np.argsort(forecasts, kind="stable")[:trials]
    done = []
    for index in order:
        point = _polish(rng, base, sites, points[index], forecasts[index])
        done.append(_try("screened", base, sites, point))
    for _ in range(refinements):
        best = max(done, key=lambda trial: trial.rank)
        done.append(_try("refined", base, sites, _neighbour(rng, best.point)))
    return done


def _polish(
    rng: np.random.Generator, base: Settings, sites: list[Site], point: dict[str, Any], forecast: float
) -> dict[str, Any]:
    """Walk downhill on the forecast, which costs a thousandth of a trial."""
    for _ in range(POLISHING_STEPS):
        moved = _neighbour(rng, point)
        if rng.random() < 0.2:
            moved["seed"] = _draw(rng, *SPACE["seed"])
        tried = screen.forecast(settings.replace(base, moved), sites)
        if tried <= forecast:
            point, forecast = moved, tried
    return point


def run(folder: Path, base: Settings, table: Path, best: Path, **effort: int) -> Trial:
    """Search for a dataset's plan; writes the table of trials (CSV) and the best settings (YAML)."""
    sites = plan.sites(plan.read_plan(folder))
    if base.source != "fibres" or base.sensor.clip_level_e is None:
        raise RigError("the search is for a rig with source: fibres and a sensor.clip_level_e")
    done = search(base, sites, **effort)
    winner = max(done, key=lambda trial: trial.rank)
    imagefile.write_whole(table, _csv(done).encode())
    tree = settings.to_dict(settings.replace(base, winner.point))
    imagefile.write_whole(best, yaml.safe_dump(tree, sort_keys=False).encode())
    return winner


def score_settings(folder: Path, rig: Settings, draws: int) -> tuple[list[list[scores.Score]], dict[str, float]]:
    """Scores of one rig in `draws` draws of the paper's simulation, and the clues that are not counted."""
    sites = plan.sites(plan.read_plan(folder))
    measured = trial.measured(rig, sites)
    return _draws(rig, measured, draws), scores.extras(measured)


def _try(stage: str, base: Settings, sites: list[Site], point: dict[str, Any]) -> Trial:
    rig = settings.replace(base, point)
    try:
        return Trial(stage, point, _draws(rig, trial.measured(rig, sites), SIMULATIONS))
    except ValueError:  # a maximum so far from its spot that no crop fits: worth nothing
        return Trial(stage, point, [])


def _draws(rig: Settings, measured: scores.Measured, draws: int) -> list[list[scores.Score]]:
    return [scores.score(measured, scores.simulate_set(rig, measured, seed)) for seed in range(draws)]


def _draw(rng: np.random.Generator, low: float, high: float, step: float) -> float:
    return _on_grid(rng.uniform(low, high), low, high, step)


def _neighbour(rng: np.random.Generator, point: dict[str, Any]) -> dict[str, Any]:
    """Two keys moved by about a tenth of their range. The seed stays: another one is another material."""
    keys = [key for key in SPACE if key != "seed"]
    moved = dict(point)
    for index in rng.choice(len(keys), size=2, replace=False):
        low, high, step = SPACE[keys[index]]
        shift = max(0.1 * (high - low), step) * rng.standard_normal()
        moved[keys[index]] = _on_grid(point[keys[index]] + shift, low, high, step)
    return moved


def _on_grid(value: float, low: float, high: float, step: float) -> float:
    # Rounded, so that the winner can be written down with few digits and is the same rig.
    value = min(max(low + step * round((value - low) / step), low), high)
    digits = max(0, 1 - math.floor(math.log10(step)))
    rounded = round(value, digits)
    return int(rounded) if step >= 1 else rounded


def _csv(done: list[Trial]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    names = [score.name for score in max(done, key=lambda trial: trial.rank).draws[0]]
    writer.writerow(["stage", "held", "miss", *SPACE, *names])
    for result in done:
        met_count, negative_miss = result.rank
        values = [f"{score.value:.5g}" for score in result.draws[0]] if result.draws else []
        point = (result.point[key] for key in SPACE)
        writer.writerow([result.stage, f"{met_count:.2f}", f"{-negative_miss:.4f}", *point, *values])
    return stream.getvalue()
