"""The option `--tolerance` of the subcommands that write a verdict."""

import argparse
import json
from dataclasses import dataclass

from spotcheck.discrepancy.criteria import ALPHA, TOLERANCE
from spotcheck.errors import InputError


@dataclass(frozen=True)
class Tolerance:
    """Limits below which a residual is not called a disagreement."""

    of_peak: float = TOLERANCE  # rms residual of mean images, in parts of the peak
    alpha: float = ALPHA  # rate of false alarms


def add_option(parser: argparse.ArgumentParser) -> None:
    """Add the option to a parser."""
    parser.add_argument("--tolerance", default="{}", help="JSON: of_peak, alpha")


def parse_tolerance(text: str) -> Tolerance:
    """Return the tolerance of a JSON object. Raises `InputError` if it is none."""
    try:
        return Tolerance(**json.loads(text))
    except (TypeError, ValueError):
        raise InputError(
            f"--tolerance: {text} is no JSON object of of_peak and alpha; write e.g. "
            '{"of_peak": 0.002, "alpha": 0.01}'
        ) from None
