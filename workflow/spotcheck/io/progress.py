"""Progress of work that takes more than some seconds, on standard error; with its remaining time where items are alike.

The command line shows it; the library does so only on request:

    with progress.shown():
        spotcheck.judge_dataset("my-frames")

On a terminal progress is shown by a bar. Elsewhere, as in a log file, a line is written every `LINE_S` seconds. A bar
is a `tqdm` object in both cases.
"""

import sys
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Event, Thread
from time import time
from typing import Any, TextIO, TypeVar

T = TypeVar("T")

# Work is shown once it takes this long [s].
SHOW_AFTER_S = 5.0
# Shortest time between two updates of a bar, and between two lines [s].
REDRAW_S, LINE_S = 0.2, 10.0
# Longest time without an update of a bar [s]; for lines it is `LINE_S`.
BEAT_S = 1.0
# Fraction of the rest of a step by which each call of `advance` moves the bar, so that it never reaches the end.
ADVANCE = 0.15

# Whether progress is shown.
_is_shown: ContextVar[bool] = ContextVar("_is_shown", default=False)
# Bar of the work of `track_steps`; None outside it.
_steps_bar: ContextVar[Any] = ContextVar("_steps_bar", default=None)


@contextmanager
def shown() -> Iterator[None]:
    """Show the progress of the work in a `with` block."""
    token = _is_shown.set(True)
    try:
        yield
    finally:
        _is_shown.reset(token)


def track(items: Collection[T] | Iterable[T], work: str, count: int | None = None) -> Iterable[T]:
    """Return items to iterate over, with progress if it is shown.

    Parameters
    ----------
    items : iterable
        Items of the work.
    work : str
        Description of the work, such as "fitting spots".
    count : int, optional
        Number of items, for an iterable without `len`; None if unknown.
    """
    if not _is_shown.get():
        return items
    total = len(items) if isinstance(items, Collection) else count
    return _iterate(
        _make_bar("{n_fmt} of {total_fmt}", "{elapsed} so far, {to_go}", iterable=items, total=total, desc=work)
    )


def _iterate(bar: Any) -> Iterator[Any]:
    """Yield the items of a bar, which is updated even while an item takes long."""
    with _beating(bar):
        yield from bar


@contextmanager
def track_steps(work: str) -> Iterator[None]:
    """Show the progress of work whose steps are announced by `begin_step`.

    The share of each step in the work is that of typical runs. A dataset can take several times longer in one step, so
    that no remaining time is shown.

    Parameters
    ----------
    work : str
        Description of the work, such as "analysing frames".
    """
    if not _is_shown.get():
        yield
        return
    with _make_bar("{percentage:.0f} %", "{elapsed} so far", total=1.0, desc=work) as bar:
        bar.work, bar.step, bar.step_end = work, "", 0.0
        token = _steps_bar.set(bar)
        try:
            with _beating(bar):
                yield
        finally:
            _steps_bar.reset(token)


def begin_step(name: str, start: float, end: float) -> None:
    """Announce a step of `track_steps`, which takes the part of the work from `start` to `end` (0 to 1).

    Nothing happens if no progress is shown.
    """
    if (bar := _steps_bar.get()) is not None:
        bar.step, bar.step_end = name, end
        _move(bar, start, name)


def advance(detail: str) -> None:
    """Report progress within a step whose number of parts is unknown; `detail`, unless it is "", follows its name."""
    if (bar := _steps_bar.get()) is not None:
        text = f"{bar.step}, {detail}" if detail else bar.step
        _move(bar, bar.n + ADVANCE * (bar.step_end - bar.n), text)


def _move(bar: Any, share: float, text: str) -> None:
    """Move a bar of steps to a share of the work (0 to 1), but never back, and show a text behind its work."""
    bar.set_description_str(f"{bar.work}, {text}", refresh=False)
    bar.update(max(share - bar.n, 0.0))


@contextmanager
def _beating(bar: Any) -> Iterator[None]:
    """Update a bar regularly in a `with` block: a step, or the compilation of code, may take minutes."""
    is_done, interval_s = Event(), BEAT_S if sys.stderr.isatty() else LINE_S

    def beat() -> None:
        """Update the bar whenever it was not updated for the interval, until the block ends."""
        while not is_done.wait(interval_s):
            if bar.format_dict["elapsed"] >= SHOW_AFTER_S and time() - bar.last_print_t >= interval_s:
                bar.refresh()

    thread = Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_done.set()
        thread.join()


class _LineWriter:
    """File for tqdm that writes a line wherever tqdm redraws its bar."""

    def __init__(self, file: TextIO) -> None:
        """Write to an open text file."""
        self.flush = file.flush
        self._file = file

    def write(self, text: str) -> None:
        """Write a text as a line unless it is blank."""
        if line := text.strip():
            self._file.write(f"{line}\n")


def _make_bar(count_format: str, time_format: str, **options: Any) -> Any:
    """Return a tqdm bar, which vanishes at the end, or one that writes lines if there is no terminal.

    Parameters
    ----------
    count_format : format of the finished part of the work, with fields of tqdm such as `{n_fmt} of {total_fmt}`.
    time_format : format of the times, with the fields `{elapsed}` and `{to_go}`, the remaining time.
    options : arguments of tqdm for this work.
    """
    from tqdm import tqdm

    class Meter(tqdm):
        """Bar whose remaining time counts down between two updates."""

        # Finished items and elapsed time [s] at the last progress.
        last_n, last_s = 0.0, 0.0

        @property
        def format_dict(self) -> dict[str, Any]:
            """Fields of the text of the bar; `to_go` is the remaining time."""
            fields: dict[str, Any] = super().format_dict
            n, elapsed_s, total = float(fields["n"]), float(fields["elapsed"]), float(fields["total"] or 0.0)
            if n != self.last_n:
                self.last_n, self.last_s = n, elapsed_s
            # In proportion to the time at the last progress; 0 at the end. It is negative, which means unknown, if
            # nothing is done yet or the current item takes longer than those before.
            remaining_s = self.last_s * total / n - elapsed_s if 0 < n < total else n - total
            to_go = f"{tqdm.format_interval(remaining_s)} to go" if remaining_s >= 0 else "time to go unknown"
            return fields | {"to_go": to_go}

    # The monitoring thread of tqdm is not needed, and hinders processes that fork.
    tqdm.monitor_interval = 0
    is_terminal = sys.stderr.isatty()
    return Meter(
        **options,
        file=sys.stderr if is_terminal else _LineWriter(sys.stderr),
        bar_format=f"{{desc}}: {'{bar} ' if is_terminal else ''}{count_format}, {time_format}",
        delay=SHOW_AFTER_S,
        mininterval=REDRAW_S if is_terminal else LINE_S,
        miniters=0,
        smoothing=0.0,
        leave=False,
        dynamic_ncols=is_terminal,
    )
