"""The command: sets of the second generator through folder, TIFF and command line, and what became of them.

`make second`, or `python -m tests.second.judge [--sets N] [--first SEED] [--workers N]`. A later call at one commit
goes on where the last one stopped; null laws are those of the blind suite.
"""

import argparse
import json
import multiprocessing
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.blind import records
from tests.blind.by_command import by_subcommands
from tests.blind.judge_case import NULL_SEED
from tests.second.case import DESIGNS
from tests.second.draw import write_case
from tests.second.effects import VOCABULARY
from tests.second.outside import MECHANISMS

# ASSUME: seeds below were used while the library was mended.
FIRST = 9_000_000
NULL_COUNT = 400
# Designs in which every effect can show.
FULL = ("default", "default", "default", "three_repeats", "eight_angles")
OUTCOMES = ("right", "tied", "unseen", "unknown", "wrong")


class Job(NamedTuple):
    """A set to be judged: its seed, what is hidden in it, its design."""

    seed: int
    effects: tuple[str, ...]
    design: str


def plan(first: int) -> Iterator[Job]:
    """Sets without end; of ten, six hide one effect, two a pair, one a mechanism outside the vocabulary, one none."""
    names, outside, designs = list(VOCABULARY), list(MECHANISMS), list(DESIGNS)
    for k in count():
        turn, place = divmod(k, 10)
        rng = np.random.default_rng([first, k])
        if place < 6:
            at = 6 * turn + place
            yield Job(first + k, (names[at % len(names)],), FULL[at // len(names) % len(FULL)])
        elif place < 8:
            yield Job(first + k, tuple(rng.choice(names, 2, replace=False).tolist()), "default")
        elif place == 8:
            yield Job(first + k, (f"outside:{outside[turn % len(outside)]}",), "default")
        else:
            yield Job(first + k, (), designs[turn % len(designs)])


def outcome(effects: tuple[str, ...], verdict: dict[str, Any]) -> str:
    """One of `OUTCOMES`; `tied` where the truth is one of several answers, `unseen` where nothing was to be seen."""
    names = sorted(own["name"] for own in verdict["effects"])
    if not effects:
        return {"consistent": "right", "unknown": "unknown"}.get(verdict["status"], "wrong")
    if effects[0].startswith("outside:"):
        return "wrong" if names else {"unknown": "right", "consistent": "unseen"}.get(verdict["status"], "wrong")
    if not names:
        return {"consistent": "unseen"}.get(verdict["status"], "unknown")
    if verdict["status"] == "named":
        return "right" if names == sorted(effects) else "wrong"
    truth = sorted(effects) in [sorted(own) for own in verdict["explanations"]]
    return "tied" if verdict["status"] == "ambiguous" and truth else "wrong"


def judged(job: Job, calibrations: Path) -> dict[str, Any]:
    """Draw and judge one set; an exception is an outcome like others."""
    with tempfile.TemporaryDirectory(prefix="spotcheck-second-") as base:
        folder, out = Path(base, f"set{job.seed}"), Path(base, "results")
        truth = write_case(job.seed, list(job.effects), job.design, folder)
        try:
            by_subcommands(folder, out, calibrations, NULL_COUNT, NULL_SEED)
        except Exception as error:
            return {"job": job._asdict(), "truth": truth, "verdict": None, "outcome": "wrong", "error": str(error)}
        verdict = json.loads((out / "verdict.json").read_text(encoding="utf-8"))
    kept = {key: verdict[key] for key in ("status", "detection", "effects", "explanations", "unexplained", "gap")}
    return {"job": job._asdict(), "truth": truth, "verdict": kept, "outcome": outcome(job.effects, verdict)}


def table(done: list[dict[str, Any]]) -> str:
    """Sets by what was hidden and what became of them, and a line for each that is not right."""
    kinds: dict[str, Counter[str]] = {}
    for record in done:
        effects = record["job"]["effects"]
        kind = {0: "none", 1: "one effect", 2: "two effects"}[len(effects)]
        kind = "outside the vocabulary" if effects and effects[0].startswith("outside:") else kind
        kinds.setdefault(kind, Counter())[record["outcome"]] += 1
    head = f"| hidden | sets | {' | '.join(OUTCOMES)} |\n| --- |{' ---: |' * (len(OUTCOMES) + 1)}\n"
    rows = [
        f"| {kind} | {sum(own.values())} | {' | '.join(str(own[name]) for name in OUTCOMES)} |"
        for kind, own in sorted(kinds.items())
    ]
    return head + "\n".join(rows) + "\n\n" + "\n".join(filter(None, map(said, done))) + "\n"


def said(record: dict[str, Any]) -> str:
    """One line on a set that is not right; empty for others."""
    if record["outcome"] == "right":
        return ""
    job, verdict = record["job"], record["verdict"] or {"status": record.get("error"), "effects": []}
    names = ", ".join(own["name"] for own in verdict["effects"]) or "nothing"
    return f"- {job['seed']} {job['design']}: {', '.join(job['effects']) or 'none'}: {verdict['status']}, {names}"


def main() -> None:
    """Judge, write, print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.second.judge", description=__doc__)
    parser.add_argument("--sets", type=int, default=100, help="look no further than the first so many (default 100)")
    parser.add_argument("--first", type=int, default=FIRST, help=f"seed of the first (default {FIRST})")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    args = parser.parse_args()
    folder = records.RESULTS / records.commit()
    laws = records.begin(folder).parent / records.LAWS
    path = folder / "second.jsonl"
    done = records.read(path)
    seen = {record["job"]["seed"] for record in done}
    jobs = [job for job, _ in zip(plan(args.first), range(args.sets), strict=False) if job.seed not in seen]
    writer = records.Writer(path)
    # Fresh processes: no threads of the parent, no half-filled caches.
    try:
        with ProcessPoolExecutor(args.workers, multiprocessing.get_context("spawn")) as pool:
            for number, record in enumerate(pool.map(partial(judged, calibrations=laws), jobs), 1):
                writer.add(record)
                done.append(record)
                print(f"{number} of {len(jobs)}: {said(record) or record['job']['effects']}", flush=True)
    finally:
        writer.close()
    text = table(done)
    (folder / "second.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
