"""The command: as many jobs of a generator as the time allows, then its report.

`python -m tests.validation.run light|real [--hours 2] [--workers 2] [--jobs N] [--first SEED] [--kinds nothing,real]
[--report] [--publish]`. A later call at the same commit goes on where the last one
stopped.
"""

import argparse
import multiprocessing
import sys
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from functools import partial
from itertools import islice

from tests.validation import judge, records
from tests.validation.protocol import Generator, Job, Record, generator


def main() -> None:
    """Run, report, print."""
    args = arguments()
    own, name = generator(args.generator), records.commit(args.generator)
    first = records.draw_first_seed(own.FIRST, name) if args.first is None else args.first
    folder = records.RESULTS / args.generator / (name if first >= own.FIRST else f"{name}-tuning")
    path = folder / "records.jsonl"
    done = records.read(path)
    if not args.report:
        deadline = time.time() + 3600 * args.hours
        jobs = todo(own, first, args, {record["job"]["seed"] for record in done})
        work = partial(judge.record_of, args.generator)
        for number, record in enumerate(run(jobs, work, args.workers, deadline), 1):
            records.add(path, record)
            done.append(record)
            progress(number, deadline)
    if not done:
        sys.exit(f"nothing was judged at {name}, so there is nothing to report")
    print(own.report(sorted(done, key=lambda record: record["job"]["number"]), folder, name, args.publish))


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.validation.run", description=__doc__)
    parser.add_argument("generator", choices=("light", "real"), help="what makes the data sets")
    parser.add_argument("--hours", type=float, default=2.0, help="begin nothing after this time (default 2)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--jobs", type=int, help="look no further than the first so many jobs")
    parser.add_argument("--first", type=int, help="seed of the first job; drawn from the commit's hash if not given")
    parser.add_argument("--kinds", default="", help="only kinds with all these words, such as nothing,real")
    parser.add_argument("--report", action="store_true", help="report on what is there, run nothing")
    parser.add_argument("--publish", action="store_true", help="write the report into the repository too")
    return parser.parse_args()


def todo(own: Generator, first: int, args: argparse.Namespace, seen: set[int]) -> list[Job]:
    """Jobs of the plan that no earlier call has done."""
    wanted = {word for word in args.kinds.split(",") if word}
    jobs = islice(own.jobs(first), args.jobs or own.JOBS)
    return [job for job in jobs if job.seed not in seen and wanted <= set(job.kind.split(":"))]


def run(jobs: list[Job], work: partial, workers: int, deadline: float) -> Iterator[Record]:
    """Records as they come."""
    queue = deque(jobs)
    # Fresh processes: no threads of the parent, no half-filled caches.
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        running: set[Future] = set()
        while True:
            while queue and len(running) < 2 * workers and time.time() < deadline:
                running.add(pool.submit(work, queue.popleft()))
            if not running:
                return
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in finished)


def progress(number: int, deadline: float) -> None:
    """Where the run is, on stderr."""
    if number % 20 == 0:
        left = max(deadline - time.time(), 0) / 60
        print(f"{number} jobs done, {left:.0f} min left", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
