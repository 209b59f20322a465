"""`spotcheck flats`: writes verdict.json of a dataset without spots, from its flats and darks.

Flats are frames of uniform light, darks are frames without light. The verdict says whether a linear sensor explains
them, and which physical effects it is missing. The vocabulary is the list of the effects that are tested.

Examples
--------
spotcheck flats my-flats --frames out/my-flats/frames.nc --output out/my-flats/verdict.json
"""

import argparse

from spotcheck.cli import effect_options, tolerance
from spotcheck.dataset import file_cache, folder
from spotcheck.discrepancy.flats import analyse_flats
from spotcheck.discrepancy.sentence import summarize_verdict
from spotcheck.discrepancy.verdict import compose_verdict
from spotcheck.discrepancy.written import write_verdict
from spotcheck.io import provenance, store
from spotcheck.model import effects


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser.

    `tolerance` adds --tolerance, `effect_options` adds --effects, --only and --without.
    """
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    tolerance.add_option(parser)
    parser.add_argument("--output", required=True, help="verdict.json to write")
    effect_options.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Compare the flats with a linear sensor, write the verdict and print its summary.

    The verdict is composed from the findings of the comparison, and records how the vocabulary differs from the
    library's.
    """
    effect_options.apply_options(args)
    dataset, limits = folder.load(args.dataset), tolerance.parse_tolerance(args.tolerance)
    with store.read(args.frames) as frame_table, file_cache.verify_unchanged(dataset, frame_table):
        findings = analyse_flats(dataset, frame_table, list(effects.vocabulary().values()))
    verdict = compose_verdict(findings, dataset.name, alpha=limits.alpha, tolerance=limits.of_peak)
    verdict |= effect_options.describe_difference()
    verdict["sentence"] = summarize_verdict(verdict)
    inputs = [args.frames, *args.effects]
    write_verdict(verdict, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    print(verdict["sentence"])
