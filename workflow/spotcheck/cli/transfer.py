"""`spotcheck transfer`: transfer.nc."""

import argparse

from spotcheck.characterization.levels import levels_of, on_response
from spotcheck.characterization.pattern import add_patterns
from spotcheck.characterization.photon_transfer import transfer_of
from spotcheck.characterization.transfer_data import dataset_of, quantities_of
from spotcheck.crops.ingest import exclude_copies
from spotcheck.dataset import file_cache
from spotcheck.dataset import folder as dataset
from spotcheck.io import provenance, store

EXAMPLE = """Example:
  spotcheck transfer my-flats --frames out/my-flats/frames.nc --output out/my-flats/transfer.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--output", required=True, help="transfer.nc to write")


def run(args: argparse.Namespace) -> None:
    """Characterise the sensor by its flats and darks."""
    found = dataset.load(args.dataset)
    with store.read(args.frames) as table, file_cache.verify_unchanged(found, table):
        full_scale, found = float(table["full_scale"]), exclude_copies(found, table)
        transfer = transfer_of(levels_of(found, full_scale), full_scale)
        transfer.remarks.extend(on_response(found))
        measured = add_patterns(dataset_of(transfer, found.title, found.name), found, transfer)
        measured.attrs["response_bend"] = found.instrument.sensor.response_bend
    store.write(measured, args.output, code=provenance.code_digest(__name__), inputs=[args.frames])
    for own in quantities_of(measured).values():
        print(own)
    for remark in store.remarks_of(measured):
        print(remark)
