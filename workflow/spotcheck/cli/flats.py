"""`spotcheck flats`: verdict.json of a dataset without spots."""

import argparse

from spotcheck.cli import tolerance, vocabulary
from spotcheck.dataset import file_cache, folder
from spotcheck.discrepancy.flats import analyse_flats
from spotcheck.discrepancy.sentence import summarize_verdict
from spotcheck.discrepancy.verdict import compose_verdict
from spotcheck.discrepancy.written import write_verdict
from spotcheck.io import provenance, store
from spotcheck.model import effects

EXAMPLES = "spotcheck flats my-flats --frames out/my-flats/frames.nc --output out/my-flats/verdict.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    tolerance.add_option(parser)
    parser.add_argument("--output", required=True, help="verdict.json to write")
    vocabulary.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Compare the flats with a linear sensor, write the verdict and print its sentence."""
    vocabulary.apply_options(args)
    dataset, limits = folder.load(args.dataset), tolerance.parse_tolerance(args.tolerance)
    with store.read(args.frames) as table, file_cache.verify_unchanged(dataset, table):
        findings = analyse_flats(dataset, table, list(effects.vocabulary().values()))
    verdict = compose_verdict(findings, dataset.name, alpha=limits.alpha, tolerance=limits.of_peak)
    verdict |= vocabulary.describe_difference()
    verdict["sentence"] = summarize_verdict(verdict)
    inputs = [args.frames, *args.effects]
    write_verdict(verdict, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    print(verdict["sentence"])
