"""Command line: `rig expose` makes a dataset's frames, `rig search` repeats the search for its settings."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rig import expose, settings
from rig.errors import RigError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one subcommand; 0 when it went well, 1 with one line on stderr when not."""
    options = _parser().parse_args(arguments)
    try:
        return options.run(options)
    except RigError as error:
        print(f"rig: {error}", file=sys.stderr)
        return 1


def _expose(options: argparse.Namespace) -> int:
    truth = expose.expose_dataset(
        options.dataset, settings.load(options.settings), options.truth, options.workers
    )
    frames = sum(len(site["frames"]) for site in truth["sites"])
    print(f"{frames} frames of {len(truth['sites'])} sites in {options.dataset}")
    return 0


def _search(options: argparse.Namespace) -> int:
    from rig import search  # scipy's optimisers take a while to import; exposing does not need them

    return search.run(options)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="rig", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    command = commands.add_parser("expose", help="make the frames that a dataset's manifest plans")
    command.add_argument("dataset", type=Path, help="folder with manifest.csv; frames are written into it")
    command.add_argument("--settings", type=Path, required=True, help="the rig's true settings (rig.yaml)")
    command.add_argument("--truth", type=Path, required=True, help="where to write what was put in (JSON)")
    command.add_argument("--workers", type=int, default=1, help="processes; frames do not depend on it (default 1)")
    command.set_defaults(run=_expose)
    return parser


if __name__ == "__main__":
    sys.exit(main())
