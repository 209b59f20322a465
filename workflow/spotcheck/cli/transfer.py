"""`spotcheck transfer`: writes transfer.nc, the quantities of EMVA 1288 of the sensor.

They come from flats (frames of uniform light) and darks (frames without light).

Examples
--------
spotcheck transfer my-flats --frames out/my-flats/frames.nc --output out/my-flats/transfer.nc
"""

import argparse

from spotcheck.characterization.characterise import analyse_ingested_frames
from spotcheck.characterization.fixed_pattern import add_patterns
from spotcheck.characterization.transfer_data import build_transfer_dataset, read_quantities
from spotcheck.crops.ingest import exclude_copies
from spotcheck.dataset import file_cache, folder
from spotcheck.io import provenance, store


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--output", required=True, help="transfer.nc to write")


def run(args: argparse.Namespace) -> None:
    """Characterise the sensor by its flats and darks, and print all quantities and remarks."""
    dataset = folder.load(args.dataset)
    with store.read(args.frames) as table, file_cache.verify_unchanged(dataset, table):
        dataset = exclude_copies(dataset, table)
        transfer = analyse_ingested_frames(dataset, float(table["full_scale"]))
        # Content of transfer.nc, with images and spectra of the fixed pattern of the sensor.
        content = add_patterns(build_transfer_dataset(transfer, dataset.title, dataset.name), dataset, transfer)
        # The response curvature of the data sheet, which was corrected.
        content.attrs["response_bend"] = dataset.instrument.sensor.response_bend
    store.write(content, args.output, code=provenance.code_digest(__name__), inputs=[args.frames])
    for quantity in read_quantities(content).values():
        print(quantity)
    for remark in store.remarks_of(content):
        print(remark)
