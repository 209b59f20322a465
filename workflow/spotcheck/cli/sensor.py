"""`spotcheck sensor`: sensor.nc."""

import argparse

from spotcheck import crops, dataset, provenance, store
from spotcheck.estimate import sensor


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc of the dataset")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--output", required=True, help="sensor.nc to write")


def run(args: argparse.Namespace) -> None:
    """Settle every sensor quantity and say where each comes from."""
    found = dataset.load(args.dataset)
    with store.read(args.crops) as images, store.read(args.frames) as table:
        own = images.sel(centring="light")
        usable = (
            own["image"].isel(index).values
            for index in crops.cells(own, store.grid_dims(images))
            if crops.usable(own["status"].isel(index))
        )
        darks = table["mean"].values[table["kind"].values == "dark"]
        settled = sensor.resolve(found, int(table["container_bits"]), usable, darks)
    inputs = [args.crops, args.frames, found.folder / "instrument.yaml"]
    store.write(settled, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    for name in sensor.QUANTITIES:
        print(f"{name} = {float(settled[name]):.4g} {settled[name].attrs['units']} ({settled[name].attrs['source']})")
