"""`spotcheck fit`: fits.nc."""

import argparse

from spotcheck.characterization.pixel_maps import maps_in
from spotcheck.characterization.sensor_choice import model_of
from spotcheck.dataset import folder as dataset
from spotcheck.fitting.crop_fits import count_failure_reasons, fit_crops, select_preferred_fits
from spotcheck.io import provenance, store

EXAMPLE = """Example:
  spotcheck fit my-frames --crops out/my-frames/crops.nc --sensor out/my-frames/sensor.nc --output out/my-frames/fits.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="folder of the dataset, whose instrument says what the spot is")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--maps", nargs="*", default=[], help="maps.nc, where the dataset has darks")
    parser.add_argument("--output", required=True, help="fits.nc to write")


def run(args: argparse.Namespace) -> None:
    """Fit every crop."""
    given = dataset.load(args.dataset).instrument
    maps = None
    for path in args.maps:
        with store.read(path) as found:
            maps = maps_in(found)
    with store.read(args.crops) as crops, store.read(args.sensor) as sensor:
        fits = fit_crops(crops, model_of(sensor), given.model.top_hat, given.optics.pixel_integration, maps)
    inputs = [args.crops, args.sensor, *args.maps]
    store.write(fits, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    there = (fits["status"] & store.flag("missing")) == 0
    for name in fits["fit"].values:
        own = fits["amplitude"].sel(fit=name)
        fitted, known = int(own.notnull().sum()), there.sel(fit=name)
        why = count_failure_reasons(fits["status"].sel(fit=name).where(own.isnull() & known, 0).values)
        print(
            f"{fitted} of {int(known.sum())} crops fitted by {str(name).replace('_', ' ')}{f': {why}' if why else ''}"
        )
    for sentence in dict.fromkeys(filter(None, select_preferred_fits(fits)["left_out"].values.ravel())):
        print(sentence)
    for remark in store.remarks_of(fits):
        print(remark)
