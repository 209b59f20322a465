"""`spotcheck fit`: fits.nc."""

import argparse

from spotcheck import dataset, provenance, store
from spotcheck.estimate.fits import fit_crops, preferred
from spotcheck.estimate.sensor import model_of


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("dataset", help="folder of the dataset, whose instrument says if the spot is a top hat")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--output", required=True, help="fits.nc to write")


def run(args: argparse.Namespace) -> None:
    """Fit every crop."""
    with store.read(args.crops) as crops, store.read(args.sensor) as sensor:
        fits = fit_crops(crops, model_of(sensor), dataset.load(args.dataset).instrument.model.top_hat)
    store.write(fits, args.output, code=provenance.code_digest(__name__), inputs=[args.crops, args.sensor])
    for name in fits["fit"].values:
        own = fits["amplitude"].sel(fit=name)
        print(f"{int(own.notnull().sum())} of {own.size} crops fitted by {str(name).replace('_', ' ')}")
    for sentence in dict.fromkeys(filter(None, preferred(fits)["left_out"].values.ravel())):
        print(sentence)
