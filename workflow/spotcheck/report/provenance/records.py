"""Records of the lookup: catalogue entries, numbers, and the provenance of result files.

A rule is a step of the workflow (Snakefile), which calls a subcommand of `spotcheck` to write result files. A key is
the full name of a number: the file without suffix and the variable, joined by dots, such as `fits.sigma_mean`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple


class Input(NamedTuple):
    """An input file of a result."""

    name: str  # file name without folder
    digest: str  # first 16 hex digits of the SHA-256 that the file had when it was read


@dataclass(frozen=True)
class Source:
    """Provenance of a result file, or of the instrument file of the user, which no rule writes."""

    file: str  # path in the results folder; full path of a file of the user
    rule: str  # workflow rule that writes the file; "" for a file of the user
    command: str  # subcommand that the rule calls; "" for a file of the user
    inputs: tuple[Input, ...] = ()  # inputs of the file
    code: str = ""  # version of the code that wrote the file; "" if it was not recorded
    written: str = ""  # time of writing, UTC, ISO 8601; "" if it was not recorded


@dataclass(frozen=True, kw_only=True)
class StoredNumber:
    """A number as a file stores it, with what the file says about it."""

    value: float | None  # value [unit]; None if it is not finite
    stderr: float | None  # standard error [unit]; None if there is none
    unit: str  # unit; "1" for a pure number
    description: str  # meaning of the number
    variable: str  # variable or key in the file, with the selected labels
    method: str = ""  # how the number was obtained, or why it is unknown; "" if the file does not say
    labels: Mapping[str, str] = field(default_factory=dict)  # selected label of each dimension, without default labels


@dataclass(frozen=True, kw_only=True)
class Number(StoredNumber):
    """A number of the results with its provenance."""

    key: str  # full name with labels, by which the number can be looked up again
    short_key: str  # shortest unique name, with the same labels
    source: Source  # provenance of the file that stores the number


@dataclass(frozen=True)
class CatalogEntry:
    """A number, or a table of numbers, that can be looked up.

    A question is the name of an entry with labels of its dimensions in brackets.
    """

    path: tuple[str, ...]  # words of the full key; the first is the file name without suffix
    aliases: frozenset[str] = frozenset()  # other names for the last word of the path
    min_words: int = 1  # smallest number of words of the path that make a name
    dims: tuple[str, ...] = ()  # dimensions for which a question may give a label
    required_dims: tuple[str, ...] = ()  # dimensions for which a question must give a label
    is_secondary: bool = False  # whether a name that this entry shares with another one means the other one

    @property
    def key(self) -> str:
        """Full name: the words of the path, joined by dots."""
        return ".".join(self.path)

    def names(self) -> Iterator[str]:
        """Yield all names of the entry, from short to long: the last words of its path, joined by dots.

        An alias may replace the last word.
        """
        last_words = sorted({self.path[-1], *self.aliases}, key=lambda word: (len(word), word))
        for count in range(self.min_words, len(self.path) + 1):
            first_words = self.path[len(self.path) - count : -1]
            # A name does not start with the index of a list item.
            if not (first_words and first_words[0].isdigit()):
                yield from (".".join([*first_words, word]) for word in last_words)
