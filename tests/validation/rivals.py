"""Rival worlds of the paper's frames: fit, score, recovery and predictions, stored in data/rival_worlds.json.

`python -m tests.validation.rivals [--realisations 200] [--sets 20] [--seed 1]`, about an hour and a half of one core
in all. A call that was stopped continues. The seed is that of all random numbers and is not searched. Table and figures
go to results/rivals; `--draw` writes only these.
"""

import argparse
import json
import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from spotcheck.io.provenance import code_digest, file_digest
from spotcheck.paper.rivals import inference, predictions, summaries, worlds
from spotcheck.report.figures import rivals, style
from tests.samples.small_datasets import ROOT

STORED = ROOT / "data" / "rival_worlds.json"
FOLDER = ROOT / "results" / "rivals"
# Keys of the random numbers of realisations, predictions and of the sets for the recovery.
REALISATIONS, PREDICTIONS, SETS = 100, 101, 102


def main() -> None:
    """Fit every world, then classify simulated sets of each."""
    parser = argparse.ArgumentParser(prog="python -m tests.validation.rivals", description=__doc__)
    parser.add_argument("--realisations", type=int, default=200, help="of each world at its best parameters")
    parser.add_argument("--sets", type=int, default=20, help="simulated sets of each world for the recovery")
    parser.add_argument("--seed", type=int, default=1, help="of all random numbers")
    parser.add_argument("--draw", action="store_true", help="write table and figures of the stored result only")
    args = parser.parse_args()
    if not args.draw:
        STORED.write_text(json.dumps(compute(args), indent=1) + "\n", encoding="utf-8")
    publish(json.loads(STORED.read_text(encoding="utf-8")))


def compute(args: argparse.Namespace) -> dict[str, Any]:
    """Return the content of rival_worlds.json."""
    emulators, fitted = {}, {}
    with ProcessPoolExecutor(2) as pool:
        for world in worlds.WORLDS:
            emulators[world.name], fitted[world.name] = load_or_fit(world, args, pool)
            print(f"{world.name}: log score {fitted[world.name]['log_score']:.1f}", flush=True)
        sets = {world.name: draw_sets(world, fitted[world.name]["point"], args, pool) for world in worlds.WORLDS}
    recovery = {name: classify(drawn, emulators) for name, drawn in sets.items()}
    predicted = [
        [predictions.Prediction(**row) for row in fitted[world.name]["predictions"]] for world in worlds.WORLDS
    ]
    scores = {name: result["log_score"] for name, result in fitted.items()}
    return {
        "seed": args.seed,
        "summaries": [asdict(summary) for summary in summaries.SUMMARIES],
        "worlds": fitted,
        "preferred": inference.choose_world(scores),
        "recovery": recovery,
        "frames_to_separate": predictions.list_separations(predicted),
    }


def publish(record: dict[str, Any]) -> None:
    """Write figures and table of a stored result."""
    for name, draw in rivals.DRAWINGS:
        with style.house_style():
            style.save_drawing(draw(record), FOLDER, name)
    (FOLDER / "worlds.md").write_text(format_table(record), encoding="utf-8")


def format_table(record: dict[str, Any]) -> str:
    """Return the table of the worlds in Markdown."""
    fitted = sum(summary["is_fitted"] for summary in record["summaries"])
    held_out = len(record["summaries"]) - fitted
    lines = [
        f"| world | χ² of the {fitted} fitted numbers | log score of held-out numbers | missed of {held_out} (p < 0.05)"
        " | light / Lambertian | simulated sets: named, wrong, cannot tell |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for name, world in record["worlds"].items():
        p_values = [p for p, row in zip(world["p_values"], record["summaries"], strict=True) if not row["is_fitted"]]
        counts = dict(record["recovery"][name])
        named, unknown = counts.pop(name), counts.pop("cannot tell")
        lines.append(
            f"| {name}: {world['title']} | {world['chi2_fitted']:.0f} | {world['log_score']:.0f}"
            f" | {sum(p < rivals.MISSED_P for p in p_values)} | {world['photon_gain']:.3g}"
            f" | {named}, {sum(counts.values())}, {unknown} |"
        )
    return "\n".join(lines) + "\n"


def simulate(world: worlds.World, point: np.ndarray, seed: tuple[int, ...]) -> np.ndarray:
    """Return the summaries of one realisation of a world at a point of the unit cube."""
    readings = world.draw(world.values(point), np.random.default_rng(seed))
    return summaries.summarise_readings(readings)


def load_or_fit(
    world: worlds.World, args: argparse.Namespace, pool: ProcessPoolExecutor
) -> tuple[inference.Emulator, dict[str, Any]]:
    """Return the result of `fit_world`, from an earlier call of the same code and options if there is one.

    It is stored in results/rivals, so that a run that was stopped continues.
    """
    library = code_digest("spotcheck.paper.rivals.predictions", "spotcheck.paper.rivals.inference")
    code = f"{library} {file_digest(__file__)[: len(library)]}"
    path = FOLDER / f"{world.name} {code} {args.realisations} {args.seed}.pickle"
    if path.is_file():
        return pickle.loads(path.read_bytes())
    result = fit_world(world, args, pool)
    FOLDER.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(result))
    return result


def fit_world(
    world: worlds.World, args: argparse.Namespace, pool: ProcessPoolExecutor
) -> tuple[inference.Emulator, dict[str, Any]]:
    """Return the emulator of a world, and its record: parameters, score, p-values and predictions."""
    number = worlds.WORLDS.index(world)

    def draw(points: np.ndarray, key: int) -> np.ndarray:
        """Return the summaries of one realisation at each point [point, summary]."""
        seeds = [(args.seed, number, key, k) for k in range(len(points))]
        return np.array(list(pool.map(partial(simulate, world), points, seeds, chunksize=4)))

    emulator = inference.build_emulator(world, draw, summaries.PRINTED, (args.seed, number))
    best = inference.fit_world(emulator, summaries.PRINTED)
    realisations = draw(np.tile(best.point, (args.realisations, 1)), REALISATIONS)
    realisations = realisations[np.isfinite(realisations).all(axis=1)]
    at_best = inference.describe_at_point(emulator, best.point, realisations)
    values = world.values(best.point)
    rows = predictions.predict(world, values, np.random.default_rng((args.seed, number, PREDICTIONS)))
    record = {
        "title": world.title,
        "point": best.point.tolist(),
        "values": values,
        "units": {parameter.name: parameter.unit for parameter in world.parameters},
        "has_converged": emulator.has_converged,
        "chi2_fitted": inference.chi2_of_fitted(at_best, summaries.PRINTED, best.point),
        "log_score": inference.score_held_out(at_best, summaries.PRINTED, best.point),
        "mean": realisations.mean(axis=0).tolist(),
        "sd": realisations.std(axis=0, ddof=1).tolist(),
        "p_values": inference.p_values(realisations, summaries.PRINTED).tolist(),
        "photon_gain": worlds.photon_gain(world, values),
        "predictions": [asdict(row) for row in rows],
    }
    return emulator, record


def draw_sets(
    world: worlds.World, point: list[float], args: argparse.Namespace, pool: ProcessPoolExecutor
) -> np.ndarray:
    """Return the summaries of simulated sets of a world at its best parameters [set, summary]."""
    number = worlds.WORLDS.index(world)
    seeds = [(args.seed, number, SETS, k) for k in range(args.sets)]
    return np.array(list(pool.map(partial(simulate, world), [np.array(point)] * args.sets, seeds)))


def classify(sets: np.ndarray, emulators: dict[str, inference.Emulator]) -> dict[str, int]:
    """Return how many sets each world is chosen for, and for how many none is ("cannot tell")."""
    counts = dict.fromkeys([*emulators, "cannot tell"], 0)
    for observed in sets:
        scores = {name: inference.fit_world(emulator, observed).log_score for name, emulator in emulators.items()}
        counts[inference.choose_world(scores) or "cannot tell"] += 1
    return counts


if __name__ == "__main__":
    main()
