"""`spotcheck maps`: maps.nc."""

import argparse

from spotcheck.characterization.pixel_maps import build_maps_dataset, measure_maps
from spotcheck.crops.stages import without_copies
from spotcheck.dataset import folder as dataset
from spotcheck.dataset import ingested as seen
from spotcheck.io import provenance, store


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("dataset", help="dataset folder, with two darks or more")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--output", required=True, help="maps.nc to write")
    parser.epilog = "Example:\n  spotcheck maps my-flats --frames out/my-flats/frames.nc --output maps.nc\n"


def run(args: argparse.Namespace) -> None:
    """Map offsets and gains of the sensor's pixels."""
    found = dataset.load(args.dataset)
    with store.read(args.frames) as table, seen.as_ingested(found, table):
        maps = measure_maps(without_copies(found, table), float(table["full_scale"]))
    written = build_maps_dataset(maps, found.title, found.name)
    store.write(written, args.output, code=provenance.code_digest(__name__), inputs=[args.frames])
    if isinstance(maps, str):
        print(f"no maps of pixels: {maps}")
        return
    for name in ("offset", "gain"):
        if name in written:
            own = written[f"{name}_rms"]
            print(f"{name} of pixels: {float(own):.3g} {own.attrs['units']} rms, known to"
                  f" {float(written[f'{name}_stderr']):.2g}")  # fmt: skip
