"""What is said of a number: its value, what it is, and what it was made from."""

from collections.abc import Iterator
from typing import NamedTuple


class Input(NamedTuple):
    """A file that a result was made from, by its name, and the first 16 hex digits of its SHA-256 then."""

    name: str
    digest: str


class Source(NamedTuple):
    """How a file of results came about: its path in the folder of results, the rule and the subcommand that write it,
    its inputs, the version of the code, and when it was written (UTC); "" where no note tells. What the user gave has
    its own path, and no rule."""

    file: str
    rule: str
    command: str
    inputs: tuple[Input, ...] = ()
    code: str = ""
    written: str = ""


class Number(NamedTuple):
    """A number of the results.

    - `key`: what to ask for to get it again.
    - `value` and its standard error `stderr` in `unit`; None where there is none. `words`: what it is.
    - `file` in the folder of results, and `variable` in it with what was selected.
    - `rule` that wrote the file, and its `inputs`; `source` has both, with the code's version and the time.
    - `short`: the shortest name that means it.
    - `method`: how it was found, where the file says so.
    """

    key: str
    value: float | None
    stderr: float | None
    unit: str
    words: str
    file: str
    variable: str
    rule: str
    inputs: tuple[Input, ...]
    source: Source
    short: str
    method: str = ""


class Entry(NamedTuple):
    """A number, or a table of numbers, that can be asked for.

    `path` are the words of its key; `short`, other last words by which a person may call it; `least`, how many words
    name it at least. `behind`: a name that another has as well is the other's. `free` are the dimensions that a
    question must select, `dims` those that it may.
    """

    path: tuple[str, ...]
    short: frozenset[str] = frozenset()
    least: int = 1
    dims: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    behind: bool = False

    @property
    def key(self) -> str:
        """The whole name."""
        return ".".join(self.path)

    def names(self) -> Iterator[str]:
        """All names by which it may be called, short ones first: ends of the path."""
        for count in range(self.least, len(self.path) + 1):
            *before, last = self.path[-count:]
            # A number in a list is no name.
            if before and before[0].isdigit():
                continue
            yield from (".".join([*before, word]) for word in sorted({last, *self.short}, key=lambda w: (len(w), w)))
