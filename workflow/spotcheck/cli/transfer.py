"""`spotcheck transfer`: transfer.nc."""

import argparse

from spotcheck.characterization.fixed_pattern import add_patterns
from spotcheck.characterization.levels import list_response_remarks, measure_levels
from spotcheck.characterization.photon_transfer import analyse_photon_transfer
from spotcheck.characterization.transfer_data import build_transfer_dataset, read_quantities
from spotcheck.crops.stages import without_copies
from spotcheck.dataset import folder as dataset
from spotcheck.dataset import ingested as seen
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
    with store.read(args.frames) as table, seen.as_ingested(found, table):
        full_scale, found = float(table["full_scale"]), without_copies(found, table)
        transfer = analyse_photon_transfer(measure_levels(found, full_scale), full_scale)
        transfer.remarks.extend(list_response_remarks(found))
        measured = add_patterns(build_transfer_dataset(transfer, found.title, found.name), found, transfer)
        measured.attrs["response_bend"] = found.instrument.sensor.response_bend
    store.write(measured, args.output, code=provenance.code_digest(__name__), inputs=[args.frames])
    for own in read_quantities(measured).values():
        print(own)
    for remark in store.remarks_of(measured):
        print(remark)
