"""How far work is that takes more than some seconds, and how long it will take, on standard error.

The command line shows it, the library only where it is asked to:

    with progress.shown():
        spotcheck.judge_dataset("my-frames")

On a terminal it is a bar; elsewhere, as in a log file, a line now and then.
"""

import sys
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Event, Thread
from time import time
from typing import Any, TextIO, TypeVar

T = TypeVar("T")

# Work is shown once it takes so long; then the bar is drawn, or a line written, every so often, and a bar at which
# nothing happens all the same [s].
AFTER_S, DRAWN_S, EVERY_S, BEAT_S = 5.0, 0.2, 10.0, 1.0
# How far a step without a known end moves on towards that of its share, each time that something is done.
NEARER = 0.15

_asked: ContextVar[bool] = ContextVar("_asked", default=False)
_steps: ContextVar["_Steps | None"] = ContextVar("_steps", default=None)


@contextmanager
def shown() -> Iterator[None]:
    """Show the progress of what is done inside."""
    token = _asked.set(True)
    try:
        yield
    finally:
        _asked.reset(token)


def over(items: Collection[T] | Iterable[T], what: str, count: int | None = None) -> Iterable[T]:
    """The items, one by one; `what` is done with them, and `count` is their number where `len` does not tell it."""
    if not _asked.get():
        return items
    total = len(items) if isinstance(items, Collection) else count
    return _each(_bar("{n_fmt} of {total_fmt}", "", iterable=items, total=total, desc=what))


def _each(bar: Any) -> Iterator[Any]:
    """The items of a bar that is shown even while the first of them is not done."""
    with _beating(bar):
        yield from bar


@contextmanager
def steps(what: str) -> Iterator[None]:
    """Work whose steps are named inside by `step`. Nothing tells beforehand how long these take: shares, and with them
    the time to go, are those that such work takes on the whole."""
    if not _asked.get():
        yield
        return
    with _bar("{percentage:.0f} %", "about ", total=1.0, desc=what) as bar:
        token = _steps.set(_Steps(what, bar))
        try:
            with _beating(bar):
                yield
        finally:
            _steps.reset(token)


def step(name: str, start: float, end: float) -> None:
    """Say that a step begins, which takes the part of the whole from `start` to `end`."""
    if (own := _steps.get()) is not None:
        own.begin(name, start, end)


def nearer(more: str) -> None:
    """Say how far a step is whose number of parts nobody knows."""
    if (own := _steps.get()) is not None:
        own.nearer(more)


class _Steps:
    """Steps that are shown by one bar, which never goes back."""

    def __init__(self, what: str, bar: Any) -> None:
        self.what, self.bar, self.name, self.end = what, bar, "", 0.0

    def begin(self, name: str, start: float, end: float) -> None:
        self.name, self.end = name, end
        self._at(start, name)

    def nearer(self, more: str) -> None:
        text = f"{self.name}, {more}" if more else self.name
        self._at(self.bar.n + NEARER * (self.end - self.bar.n), text)

    def _at(self, part: float, text: str) -> None:
        self.bar.set_description_str(f"{self.what}, {text}", refresh=False)
        self.bar.update(max(part - self.bar.n, 0.0))


@contextmanager
def _beating(bar: Any) -> Iterator[None]:
    """Show a bar again and again while nothing happens: a step, or code that is compiled first, may take minutes."""
    done, every_s = Event(), BEAT_S if sys.stderr.isatty() else EVERY_S

    def beat() -> None:
        while not done.wait(every_s):
            if bar.format_dict["elapsed"] >= AFTER_S and time() - bar.last_print_t >= every_s:
                bar.refresh()

    beating = Thread(target=beat, daemon=True)
    beating.start()
    try:
        yield
    finally:
        done.set()
        beating.join()


class _Lines:
    """A file that gets a line where tqdm draws its one line anew."""

    def __init__(self, file: TextIO) -> None:
        self.file = file

    def write(self, text: str) -> None:
        """Write a line of what is not blank."""
        if line := text.strip():
            self.file.write(f"{line}\n")

    def flush(self) -> None:
        """Hand on what was written."""
        self.file.flush()


def _bar(counted: str, about: str, **options: Any) -> Any:
    """A bar of tqdm, or its numbers as lines; gone when the work is done."""
    from tqdm import tqdm

    class Meter(tqdm):
        """A bar whose time to go is that of its last step, and runs down until the next one is done."""

        counted_n, counted_s = 0.0, 0.0

        @property
        def format_dict(self) -> dict[str, Any]:
            """What a bar is formatted with, and `to_go`."""
            found: dict[str, Any] = super().format_dict
            done, elapsed, total = float(found["n"]), float(found["elapsed"]), float(found["total"] or 0.0)
            if done != self.counted_n:
                self.counted_n, self.counted_s = done, elapsed
            # Below 0: nothing is done yet, or the step lasts longer than those before let expect.
            left = self.counted_s * total / done - elapsed if 0 < done < total else done - total
            to_go = f"{about}{tqdm.format_interval(left)} to go" if left >= 0 else "time to go unknown"
            return found | {"to_go": to_go}

    # Its thread would look after bars that stand still; it also stands in the way of processes that fork.
    tqdm.monitor_interval = 0
    terminal = sys.stderr.isatty()
    meter = "{bar} " if terminal else ""
    return Meter(
        **options,
        file=sys.stderr if terminal else _Lines(sys.stderr),
        bar_format=f"{{desc}}: {meter}{counted}, {{elapsed}} so far, {{to_go}}",
        delay=AFTER_S,
        mininterval=DRAWN_S if terminal else EVERY_S,
        miniters=0,
        smoothing=0.0,
        leave=False,
        dynamic_ncols=terminal,
    )
