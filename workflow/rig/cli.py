"""The virtual rig: makes a dataset's frames, counts the paper's numbers they meet, repeats the search for settings."""

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
    truth = expose.expose_dataset(options.dataset, settings.load(options.settings), options.truth, options.workers)
    frames = sum(len(site["frames"]) for site in truth["sites"])
    print(f"{frames} frames of {len(truth['sites'])} sites in {options.dataset}")
    return 0


def _search(options: argparse.Namespace) -> int:
    from rig import search  # scipy's special functions take a while to import; exposing does with fewer

    effort = {name: getattr(options, name) for name in ("seed", "draws", "trials", "refinements")}
    winner = search.run(options.dataset, settings.load(options.settings), options.table, options.best, **effort)
    print(f"{winner.rank[0]:.2f} of {len(winner.draws[0])} numbers held; best settings in {options.best}")
    return 0


def _score(options: argparse.Namespace) -> int:
    from rig import search

    draws, extras = search.score_settings(options.dataset, settings.load(options.settings), options.draws)
    print("| number | here | counts as met | held |\n|---|---|---|---|")
    for scores in zip(*draws, strict=True):  # scores of one printed number, one of each draw
        values = [score.value for score in scores]
        low, high, met_count = min(values), max(values), sum(score.is_met for score in scores)
        here = f"{low:.4g}" if low == high else f"{low:.4g} … {high:.4g}"
        print(f"| {scores[0].name} | {here} | {scores[0].low:g} … {scores[0].high:g} | {met_count} of {len(draws)} |")
    for name, value in extras.items():
        print(f"| {name} | {value:.4g} | not counted | |")
    totals = ", ".join(str(sum(score.is_met for score in draw)) for draw in draws)
    print(f"\nHeld of {len(draws[0])}, draw by draw: {totals}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="rig", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    command = commands.add_parser("expose", help="make the frames that a dataset's manifest plans")
    command.add_argument("dataset", type=Path, help="folder with manifest.csv; frames are written into it")
    command.add_argument("--settings", type=Path, required=True, help="the rig's true settings (rig.yaml)")
    command.add_argument("--truth", type=Path, required=True, help="where to write what was put in (JSON)")
    command.add_argument("--workers", type=int, default=1, help="processes; frames do not depend on it (default 1)")
    command.set_defaults(run=_expose)
    command = commands.add_parser("search", help="search settings that meet the paper's printed numbers")
    command.add_argument("dataset", type=Path, help="folder with manifest.csv: angle x exposure x repeat")
    command.add_argument("--settings", type=Path, required=True, help="all that is not searched (rig.yaml)")
    command.add_argument("--table", type=Path, required=True, help="where to write every full trial (CSV)")
    command.add_argument("--best", type=Path, required=True, help="where to write the best settings (YAML)")
    command.add_argument("--seed", type=int, default=1, help="seed of the search (default 1)")
    command.add_argument("--draws", type=_count, default=8000, help="random points to screen (default 8000)")
    command.add_argument("--trials", type=_count, default=40, help="screened points to try in full (default 40)")
    command.add_argument("--refinements", type=int, default=120, help="steps around the best (default 120)")
    command.set_defaults(run=_search)
    command = commands.add_parser("score", help="how many of the paper's numbers a settings file meets")
    command.add_argument("dataset", type=Path, help="folder with manifest.csv: angle x exposure x repeat")
    command.add_argument("--settings", type=Path, required=True, help="the rig's settings (rig.yaml)")
    command.add_argument("--draws", type=_count, default=5, help="simulations to compare with (default 5)")
    command.set_defaults(run=_score)
    return parser


def _count(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, not {text}")
    return number


if __name__ == "__main__":
    sys.exit(main())
