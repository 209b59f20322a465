"""`spotcheck maps`: maps.nc."""

import argparse

from spotcheck.characterization.pixel_maps import build_maps_dataset, measure_maps
from spotcheck.crops.ingest import exclude_copies
from spotcheck.dataset import file_cache, folder
from spotcheck.io import provenance, store

EXAMPLES = "spotcheck maps my-flats --frames out/my-flats/frames.nc --output maps.nc"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder, with two darks or more")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--output", required=True, help="maps.nc to write")


def run(args: argparse.Namespace) -> None:
    """Map offsets and gains of the sensor's pixels."""
    dataset = folder.load(args.dataset)
    with store.read(args.frames) as table, file_cache.verify_unchanged(dataset, table):
        maps = measure_maps(exclude_copies(dataset, table), float(table["full_scale"]))
    content = build_maps_dataset(maps, dataset.title, dataset.name)
    store.write(content, args.output, code=provenance.code_digest(__name__), inputs=[args.frames])
    if isinstance(maps, str):
        print(f"no maps of pixels: {maps}")
        return
    for name in ("offset", "gain"):
        if name in content:
            rms = content[f"{name}_rms"]
            print(f"{name} of pixels: {float(rms):.3g} {rms.attrs['units']} rms, known to"
                  f" {float(content[f'{name}_stderr']):.2g}")  # fmt: skip
