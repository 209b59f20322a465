"""`spotcheck flats`: verdict.json of a dataset without spots."""

import argparse

from spotcheck import dataset, provenance, seen, store
from spotcheck.cli import vocabulary
from spotcheck.cli.judged import tolerance_of
from spotcheck.crops import without_copies
from spotcheck.estimate.levels import levels_of, straightening
from spotcheck.estimate.photon_transfer import transfer_of
from spotcheck.old_engine.boundary import effects_to_search, remark_on_files
from spotcheck.old_engine.conclude.flats import judge_flats
from spotcheck.old_engine.verdict.document import document
from spotcheck.old_engine.verdict.sentence import sentence
from spotcheck.old_engine.verdict.written import write_verdict

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
    known = effects_to_search()
    found, tolerance = dataset.load(args.dataset), tolerance_of(args.tolerance)
    with store.read(args.frames) as table, seen.as_ingested(found, table):
        full_scale, found = float(table["full_scale"]), without_copies(found, table)
        transfer = transfer_of(levels_of(found, full_scale), full_scale)
        end = straightening(found, full_scale).without_curvature().full_scale_dn
    judgement = judge_flats(transfer, end, known)
    verdict = document(judgement, found.name, alpha=tolerance.alpha, tolerance=tolerance.of_peak,
                       beware=remark_on_files())  # fmt: skip
    verdict |= vocabulary.described()
    verdict["sentence"] = sentence(verdict)
    code, inputs = provenance.code_digest(__name__), [args.frames, *args.effects]
    write_verdict(verdict, args.output, code=code, inputs=inputs)
    print(verdict["sentence"])
