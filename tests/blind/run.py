"""The command: as many jobs as the time allows, then one table.

`make blind`, or `python -m tests.blind.run --hours 2 --workers 2 [--limit N] [--base SEED] [--tuning] [--score]`.
A later call at the same commit goes on where the last one stopped.
"""

import argparse
import multiprocessing
import shutil
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from itertools import islice
from pathlib import Path
from typing import Any

from tests.blind import judge_case, picture, records, score, table, times
from tests.blind.plan import PUBLISHED, Job, plan

# A job that has to wait lets so many others pass.
LATER = 40
_nulls: judge_case.Nulls
_patience: float


def main() -> None:
    """Run, score, write, print one line."""
    args = arguments()
    if args.write and (args.tuning or args.base is not None):
        sys.exit("--write publishes: not with --tuning, nor with a base of one's own")
    name = "tuning" if args.tuning else records.commit()
    folder = records.RESULTS / name
    path = records.begin(folder)
    done = records.read(path)
    if args.write and args.score and not done:
        sys.exit(f"nothing was judged at {name}, so there is nothing to publish")
    if not args.score:
        deadline = time.time() + 3600 * args.hours
        jobs = todo(args, {record["job"]["seed"] for record in done})
        writer = records.Writer(path)
        try:
            for number, record in enumerate(run(jobs, folder, args, deadline), 1):
                writer.add(record)
                done.append(record)
                progress(number, record, deadline, args.verbose)
        finally:
            writer.close()
    base = args.base if args.base is not None else PUBLISHED
    print(finish(done, folder, name, base, args.write))


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.blind.run", description=__doc__)
    parser.add_argument("--hours", type=float, default=2.0, help="stop after this time (default 2)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--limit", type=int, help="look no further than the first so many jobs of the plan")
    parser.add_argument("--base", type=int, help=f"base seed (default {PUBLISHED}, the published one)")
    parser.add_argument("--kinds", default="", help="only kinds with all these words, such as one,strong")
    parser.add_argument("--nulls", type=int, default=judge_case.NULL_COUNT, help="null sets of a null law")
    parser.add_argument("--patience", type=float, default=judge_case.PATIENCE, help="longest verdict [s of a core]")
    parser.add_argument(
        "--tuning", action="store_true", help="allow small seeds; results/blind/tuning, nothing published"
    )
    parser.add_argument("--score", action="store_true", help="score what is there, run nothing")
    parser.add_argument("--verbose", action="store_true", help="a line for every wrong verdict")
    parser.add_argument("--write", action="store_true", help="also into workflow/docs, and what is quoted of it")
    return parser.parse_args()


def todo(args: argparse.Namespace, seen: set[int]) -> list[Job]:
    """Jobs of the plan that no earlier call has done."""
    base = args.base if args.base is not None else PUBLISHED
    wanted = [own for own in args.kinds.split(",") if own]
    jobs = islice(plan(base, args.tuning), args.limit or 20_000)
    return [j for j in jobs if j.seed not in seen and (not wanted or set(wanted) <= set(j.kind.split(":")))]


def run(jobs: list[Job], folder: Path, args: argparse.Namespace, deadline: float) -> Iterator[records.Record]:
    """Records as they come. Jobs whose null law another process is making come again a little later."""
    queue = deque(jobs)
    start = (args.patience, folder / records.LAWS, args.nulls, args.tuning, deadline)
    # Fresh processes: no threads of the parent, no half-filled caches.
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(args.workers, fresh, ready, start) as pool:
        running: set[Future] = set()
        while True:
            while queue and len(running) < 2 * args.workers and time.time() < deadline:
                running.add(pool.submit(work, queue.popleft()))
            if not running:
                return
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for job, record in (future.result() for future in finished):
                if record is None:
                    queue.insert(min(len(queue), LATER), job)
                else:
                    yield record


def ready(patience: float, *start: Any) -> None:
    """Set up a process."""
    global _nulls, _patience
    _nulls, _patience = judge_case.Nulls(*start), patience


def work(job: Job) -> tuple[Job, records.Record | None]:
    """One job; None where its null law is not to be had now."""
    try:
        record = judge_case.record_of(job, _nulls.null_for, patience=_patience)
        return job, judge_case.compared(record, _nulls)
    except judge_case.Busy:
        time.sleep(2)
        return job, None


def progress(number: int, record: records.Record, deadline: float, verbose: bool) -> None:
    """Where the run is, on stderr."""
    if verbose and (said := score.wrong(record)):
        print(said, file=sys.stderr, flush=True)
    if number % 20 == 0:
        left = max(deadline - time.time(), 0) / 60
        print(f"{number} jobs done, {left:.0f} min left", file=sys.stderr, flush=True)


def finish(done: list[records.Record], folder: Path, name: str, base: int, write: bool) -> str:
    """Write tables and picture, with `write` also where they are published; return the summary line."""
    figures = [*score.figures(done), *times.figures(folder)]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "blind.md").write_text(table.as_markdown(figures, done, name, base), encoding="utf-8")
    picture.draw(score.confusion(done), folder / "blind.png")
    if write:
        publish(folder)
    return f"{table.summary(figures, done)}; {folder.relative_to(records.ROOT)}/blind.md"


def publish(folder: Path) -> None:
    """Scores into the pages, the numbers that others quote of them, and what they rest on beside the suite."""
    records.keep(folder)
    for file in ("blind.md", "blind.png"):
        shutil.copyfile(folder / file, records.ROOT / "workflow" / "docs" / file)
    for page in ("README.md", "workflow/docs/verdict.md"):
        subprocess.run([sys.executable, "tests/check_readme.py", page, "--write"], cwd=records.ROOT, check=True)


if __name__ == "__main__":
    main()
