"""The vocabulary of effects as subcommands and rules choose it: the same options for all, and what files hold of it."""

import argparse
from collections.abc import Mapping
from typing import Any

from spotcheck.errors import InputError
from spotcheck.model import effects
from spotcheck.model.effects import Choice


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options."""
    group = parser.add_argument_group("vocabulary of effects (default: the library's)")
    group.add_argument("--effects", nargs="+", default=[], metavar="FILE", help="Python files that each add an effect")
    group.add_argument("--only", nargs="+", default=[], metavar="NAME", help="the only effects to know")
    group.add_argument("--without", nargs="+", default=[], metavar="NAME", help="effects to leave out")


def choose(args: argparse.Namespace) -> None:
    """Set the vocabulary of this process to that of the options."""
    effects.choose(Choice(tuple(args.effects), tuple(args.only), tuple(args.without)))


def of_config(config: Mapping[str, Any]) -> Choice:
    """What the keys `effects` and `vocabulary` of the workflow's configuration choose."""
    own = config.get("vocabulary", {})
    return Choice(tuple(config.get("effects", ())), tuple(own.get("only", ())), tuple(own.get("without", ())))


def options(choice: Choice) -> list[str]:
    """The words of the command line that stand for a choice; none for the library's vocabulary."""
    words = []
    for flag, values in (("--effects", choice.files), ("--only", choice.only), ("--without", choice.without)):
        words += [flag, *values] if values else []
    return words


def described() -> dict[str, Any]:
    """What a file of results says of the vocabulary: nothing where it is the library's."""
    difference = effects.record()
    return {"vocabulary": difference} if difference else {}


def same(saved: Mapping[str, Any], name: str) -> None:
    """Raise `InputError` unless what an earlier stage saved in the file `name` was found with this vocabulary."""
    if saved.get("vocabulary", {}) != effects.record():
        raise InputError(
            f"{name}: was found with {_text(saved.get('vocabulary', {}))}, but this is {_text(effects.record())}; give"
            " every stage the same --effects, --only and --without"
        )


def _text(difference: Mapping[str, Any]) -> str:
    """A vocabulary in words."""
    own = [f"{effect['name']} of {effect['file']} ({effect['sha256'][:8]})" for effect in difference.get("own", ())]
    parts = [f"with {', '.join(own)}"] if own else []
    parts += [f"without {', '.join(difference['left_out'])}"] if difference.get("left_out") else []
    return " ".join(["the library's vocabulary", *parts])
