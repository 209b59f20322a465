"""`spotcheck fit`: fits.nc."""

import argparse

from spotcheck.characterization.pixel_maps import read_maps
from spotcheck.characterization.sensor_choice import read_sensor_model
from spotcheck.dataset import folder
from spotcheck.fitting.crop_fits import count_failure_reasons, fit_crops, select_preferred_fits
from spotcheck.io import provenance, store

EXAMPLES = """spotcheck fit my-frames --crops out/my-frames/crops.nc --sensor out/my-frames/sensor.nc \\
    --output out/my-frames/fits.nc"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="folder of the dataset, whose instrument says what the spot is")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--maps", nargs="*", default=[], help="maps.nc, where the dataset has darks")
    parser.add_argument("--output", required=True, help="fits.nc to write")


def run(args: argparse.Namespace) -> None:
    """Fit every crop, and print how many fits succeeded and why others failed."""
    instrument = folder.load(args.dataset).instrument
    maps = None
    for path in args.maps:
        with store.read(path) as content:
            maps = read_maps(content)
    with store.read(args.crops) as crops, store.read(args.sensor) as sensor:
        fits = fit_crops(
            crops, read_sensor_model(sensor), instrument.model.top_hat, instrument.optics.pixel_integration, maps
        )
    inputs = [args.crops, args.sensor, *args.maps]
    store.write(fits, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    is_present = (fits["status"] & store.flag("missing")) == 0
    for name in fits["fit"].values:
        amplitude, present = fits["amplitude"].sel(fit=name), is_present.sel(fit=name)
        failed = fits["status"].sel(fit=name).where(amplitude.isnull() & present, 0).values
        reasons = f": {text}" if (text := count_failure_reasons(failed)) else ""
        fitted = f"{int(amplitude.notnull().sum())} of {int(present.sum())} crops"
        print(f"{fitted} fitted by {str(name).replace('_', ' ')}{reasons}")
    for sentence in dict.fromkeys(filter(None, select_preferred_fits(fits)["left_out"].values.ravel())):
        print(sentence)
    for remark in store.remarks_of(fits):
        print(remark)
