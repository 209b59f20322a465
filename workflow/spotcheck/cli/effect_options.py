"""Options --effects, --only and --without of subcommands, and the record of their values in files of results.

The vocabulary is the list of physical effects that a verdict can name. A choice is the files that add effects to it,
and the names of the only effects to know or of those to leave out.
"""

import argparse
from collections.abc import Mapping
from typing import Any

from spotcheck.errors import InputError
from spotcheck.model import effects
from spotcheck.model.effects import Choice


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options --effects, --only and --without to a parser."""
    group = parser.add_argument_group("vocabulary of effects (default: the library's)")
    group.add_argument("--effects", nargs="+", default=[], metavar="FILE", help="Python files that each add an effect")
    group.add_argument("--only", nargs="+", default=[], metavar="NAME", help="the only effects to know")
    group.add_argument("--without", nargs="+", default=[], metavar="NAME", help="effects to leave out")


def apply_options(args: argparse.Namespace) -> None:
    """Set the vocabulary of this process to that of the parsed options."""
    effects.choose(make_choice(args))


def make_choice(args: argparse.Namespace) -> Choice:
    """Return the choice that the parsed options of `add_options` make."""
    return Choice(tuple(args.effects), tuple(args.only), tuple(args.without))


def read_choice(config: Mapping[str, Any]) -> Choice:
    """Return the choice of the keys `effects`, `vocabulary.only` and `vocabulary.without` of the workflow's config."""
    names = config.get("vocabulary", {})
    return Choice(tuple(config.get("effects", ())), tuple(names.get("only", ())), tuple(names.get("without", ())))


def list_options(choice: Choice) -> list[str]:
    """Return the words of a command line that give a choice, such as ["--only", "defocus"]; [] for the default."""
    words = []
    for option, values in (("--effects", choice.files), ("--only", choice.only), ("--without", choice.without)):
        words += [option, *values] if values else []
    return words


def describe_difference() -> dict[str, Any]:
    """Return how the vocabulary of this process differs from the library's, under the key "vocabulary".

    The result is merged into files of results; it is {} for the library's vocabulary.
    """
    difference = effects.describe_vocabulary()
    return {"vocabulary": difference} if difference else {}


def check_same_vocabulary(saved: Mapping[str, Any], name: str) -> None:
    """Raise `InputError` if an earlier stage wrote a file of results with another vocabulary than that of this process.

    `saved` is the content of the file, `name` its path for the message. Vocabularies are described by their differences
    from the library's.
    """
    earlier, present = saved.get("vocabulary", {}), effects.describe_vocabulary()
    if earlier != present:
        raise InputError(
            f"{name}: was found with {_format(earlier)}, but this is {_format(present)}; give every stage the same"
            " --effects, --only and --without"
        )


def _format(difference: Mapping[str, Any]) -> str:
    """Return a vocabulary in words, from its `difference` to the library's as `effects.describe_vocabulary` gives it.

    The key `own` has the name, file and digest of each added effect, `left_out` the names of missing ones.
    """
    added = [f"{effect['name']} of {effect['file']} ({effect['sha256'][:8]})" for effect in difference.get("own", ())]
    phrases = [f"with {', '.join(added)}"] if added else []
    phrases += [f"without {', '.join(difference['left_out'])}"] if difference.get("left_out") else []
    return " ".join(["the library's vocabulary", *phrases])
