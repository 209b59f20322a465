"""`spotcheck sensor`: sensor.nc."""

import argparse

from spotcheck.characterization import sensor_choice as sensor
from spotcheck.characterization.same_site import pairs_along
from spotcheck.characterization.transfer_data import quantities_of
from spotcheck.crops.cropping import is_usable, iterate_cells
from spotcheck.crops.ingest import read_full_scale
from spotcheck.dataset import file_cache, frames
from spotcheck.dataset import folder as dataset
from spotcheck.io import provenance, store

EXAMPLE = """Example:
  spotcheck sensor my-frames --crops out/my-frames/crops.nc --frames out/my-frames/frames.nc \\
      --output out/my-frames/sensor.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc of the dataset")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--transfer", nargs="*", default=[], help="transfer.nc, where the dataset has flats or darks")
    parser.add_argument("--output", required=True, help="sensor.nc to write")


def run(args: argparse.Namespace) -> None:
    """Settle every sensor quantity and say where each comes from."""
    found = dataset.load(args.dataset)
    with store.read(args.crops) as images, store.read(args.frames) as table, file_cache.verify_unchanged(found, table):
        own = images.sel(centring="light")
        usable = (
            own["image"].isel(index).values
            for index in iterate_cells(own, store.grid_dims(images))
            if is_usable(own["status"].isel(index))
        )
        darks = (
            frames.reduce_frame(frames.read_masked_image(found, own)) for own in found.frames if own.kind == "dark"
        )
        beside = (
            frames.ReducedFrame(*(images[name].isel(index).values for name in frames.ReducedFrame._fields))
            for index in iterate_cells(images, store.grid_dims(images))
        )
        dark = sensor.judge_darks(darks, beside, float(table["full_scale"]))
        measured = {}
        for path in args.transfer:
            with store.read(path) as transfer:
                measured = quantities_of(transfer)
        pairs = {"exposures of a site": pairs_along(own, "exposure"), "repeats": pairs_along(own, "repeat")}
        highest = float(table["maximum"].max())
        settled = sensor.resolve(found, read_full_scale(table), usable, dark, measured, pairs, highest)
    inputs = [args.crops, args.frames, *args.transfer, *found.instrument_files]
    store.write(settled, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    for name in sensor.QUANTITIES:
        print(f"{name} = {float(settled[name]):.4g} {settled[name].attrs['units']} ({settled[name].attrs['source']})")
    for remark in store.remarks_of(settled):
        print(remark)
