"""`spotcheck fit`: fits.nc."""

import argparse

from spotcheck import provenance, store
from spotcheck.estimate.fits import fit_crops
from spotcheck.estimate.sensor import model_of


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("crops", help="crops.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--output", required=True, help="fits.nc to write")


def run(args: argparse.Namespace) -> None:
    """Fit every crop."""
    with store.read(args.crops) as crops, store.read(args.sensor) as sensor:
        fits = fit_crops(crops, model_of(sensor))
    store.write(fits, args.output, code=provenance.code_digest(__name__), inputs=[args.crops, args.sensor])
    print(f"{int(fits['amplitude'].notnull().sum())} of {fits['amplitude'].size} crops fitted")
