"""The option `--tolerance` of the subcommands that write a verdict on the agreement of model and measurement."""

import argparse
import json
from dataclasses import dataclass

from spotcheck.discrepancy.criteria import ALPHA, TOLERANCE
from spotcheck.errors import InputError


@dataclass(frozen=True)
class Tolerance:
    """Limits within which a residual is not called a disagreement."""

    of_peak: float = TOLERANCE  # largest rms residual of mean images, as a part of the spot's peak
    alpha: float = ALPHA  # p-value below which a residual counts as a disagreement: the rate of false alarms


def add_option(parser: argparse.ArgumentParser) -> None:
    """Add the option --tolerance to a parser; its value is the text for `parse_tolerance`."""
    parser.add_argument("--tolerance", default="{}", help="JSON: of_peak (rms/peak), alpha (rate of false alarms)")


def parse_tolerance(text: str) -> Tolerance:
    """Return the tolerance of a JSON object with the keys `of_peak` and `alpha`, which may both be missing.

    Raises `InputError` if the text is no such object.
    """
    try:
        return Tolerance(**json.loads(text))
    except (TypeError, ValueError):
        example = '{"of_peak": 0.002, "alpha": 0.01}'
        message = f"--tolerance: {text} is no JSON object of of_peak and alpha; write e.g. {example}"
        raise InputError(message) from None
