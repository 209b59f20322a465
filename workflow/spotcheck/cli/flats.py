"""`spotcheck flats`: verdict.json of a dataset without spots."""

import argparse

from spotcheck import dataset, frames, store
from spotcheck.cli import vocabulary
from spotcheck.cli.judged import tolerance_of
from spotcheck.discrepancy.flats import series_of
from spotcheck.discrepancy.flats_verdict import verdict_of
from spotcheck.discrepancy.verdict import Judgement, verdict_json
from spotcheck.discrepancy.written import write_verdict
from spotcheck.estimate.levels import levels_of
from spotcheck.estimate.photon_transfer import transfer_of

TOO_FEW = "fewer than six levels of different light below saturation, in pairs of frames"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--simulations", type=int, default=1500, help="null sets (default 1500)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the null sets (default 1)")
    parser.add_argument("--tolerance", default="{}", help="JSON: of_peak, of_noise, alpha")
    parser.add_argument("--output", required=True, help="verdict.json to write")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Say where flats depart from a linear sensor, and what explains it."""
    vocabulary.choose(args)
    found, tolerance = dataset.load(args.dataset), tolerance_of(args.tolerance)
    with store.read(args.frames) as table:
        bits = int(table["container_bits"])
    full_scale = float(frames.full_scale(found.instrument, bits))
    transfer = transfer_of(levels_of(found, bits), full_scale)
    series = series_of(transfer, full_scale)
    if series is None:
        why = f"the manifest names no frame of kind spot; {transfer.quantities['gain'].why or TOO_FEW}"
        verdict = verdict_json(Judgement(None, None, [], why), found.name, tolerance)
        verdict["sentence"] = f"Nothing could be tested: {why}."
    else:
        verdict = verdict_of(series, found.name, tolerance, transfer.quantities["gain"], args.simulations, args.seed)
    verdict |= vocabulary.described()
    write_verdict(verdict, args.output)
    print(verdict["sentence"])
