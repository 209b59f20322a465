"""`spotcheck sensor`: writes sensor.nc, the parameters of the sensor that the analysis uses.

A value comes from the data sheet (instrument.yaml) if that gives it, otherwise from flats (frames of uniform light) and
darks (frames without light), otherwise from the noise of spots.

Examples
--------
spotcheck sensor my-frames --crops out/my-frames/crops.nc --frames out/my-frames/frames.nc \\
    --output out/my-frames/sensor.nc
"""

import argparse

from spotcheck.characterization.dataset_sensor import choose_dataset_sensor
from spotcheck.characterization.sensor_choice import QUANTITIES
from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.dataset import file_cache, folder
from spotcheck.io import provenance, store


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc of the dataset")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--transfer", nargs="*", default=[], help="transfer.nc, if the dataset has flats or darks")
    parser.add_argument("--output", required=True, help="sensor.nc to write")


def run(args: argparse.Namespace) -> None:
    """Choose every parameter of the sensor, and print each with its unit and source, and all remarks."""
    dataset = folder.load(args.dataset)
    # EMVA 1288 quantities of flats and darks by name; --transfer has one path or none.
    measured = {}
    for path in args.transfer:
        with store.read(path) as transfer:
            measured = read_quantities(transfer)
    with store.read(args.crops) as crops, store.read(args.frames) as table, file_cache.verify_unchanged(dataset, table):
        sensor = choose_dataset_sensor(dataset, crops, table, measured)
    inputs = [args.crops, args.frames, *args.transfer, *dataset.instrument_files]
    store.write(sensor, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    for name in QUANTITIES:
        print(f"{name} = {float(sensor[name]):.4g} {sensor[name].attrs['units']} ({sensor[name].attrs['source']})")
    for remark in store.remarks_of(sensor):
        print(remark)
