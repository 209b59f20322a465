"""`spotcheck flats`: verdict.json of a dataset without spots."""

import argparse

from spotcheck.cli import vocabulary
from spotcheck.cli.judged import tolerance_of
from spotcheck.dataset import file_cache
from spotcheck.dataset import folder as dataset
from spotcheck.discrepancy.flats import analyse_flats
from spotcheck.discrepancy.sentence import summarize_verdict
from spotcheck.discrepancy.verdict import compose_verdict
from spotcheck.discrepancy.written import write_verdict
from spotcheck.io import provenance, store
from spotcheck.model import effects

EXAMPLE = """Example:
  spotcheck flats my-flats --frames out/my-flats/frames.nc --output out/my-flats/verdict.json
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--tolerance", default="{}", help="JSON: of_peak, alpha")
    parser.add_argument("--output", required=True, help="verdict.json to write")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Say where flats depart from a linear sensor, and what explains it."""
    vocabulary.choose(args)
    found, tolerance = dataset.load(args.dataset), tolerance_of(args.tolerance)
    with store.read(args.frames) as table, file_cache.verify_unchanged(found, table):
        findings = analyse_flats(found, table, list(effects.vocabulary().values()))
    verdict = compose_verdict(findings, found.name, alpha=tolerance.alpha, tolerance=tolerance.of_peak)
    verdict |= vocabulary.described()
    verdict["sentence"] = summarize_verdict(verdict)
    code, inputs = provenance.code_digest(__name__), [args.frames, *args.effects]
    write_verdict(verdict, args.output, code=code, inputs=inputs)
    print(verdict["sentence"])
