"""`spotcheck maps`: writes maps.nc, offset [DN] and relative gain of each pixel of the sensor.

They come from flats (frames of uniform light) and darks (frames without light).

Examples
--------
spotcheck maps my-flats --frames out/my-flats/frames.nc --output maps.nc
"""

import argparse

from spotcheck.characterization.pixel_maps import build_maps_dataset, measure_maps
from spotcheck.crops.ingest import exclude_copies
from spotcheck.dataset import file_cache, folder
from spotcheck.io import provenance, store


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder, with two darks or more")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--output", required=True, help="maps.nc to write")


def run(args: argparse.Namespace) -> None:
    """Map offsets and gains of the sensor's pixels, and print their rms with its error, or why there are no maps."""
    dataset = folder.load(args.dataset)
    with store.read(args.frames) as frame_table, file_cache.verify_unchanged(dataset, frame_table):
        maps = measure_maps(exclude_copies(dataset, frame_table), float(frame_table["full_scale"]))
    maps_dataset = build_maps_dataset(maps, dataset.title, dataset.name)
    store.write(maps_dataset, args.output, code=provenance.code_digest(__name__), inputs=[args.frames])
    if isinstance(maps, str):
        print(f"no maps of pixels: {maps}")
        return
    for name in ("offset", "gain"):
        if name in maps_dataset:
            rms, stderr = maps_dataset[f"{name}_rms"], float(maps_dataset[f"{name}_stderr"])
            print(f"{name} of pixels: {float(rms):.3g} {rms.attrs['units']} rms, known to {stderr:.2g}")
