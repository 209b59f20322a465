"""`spotcheck fit`: writes fits.nc, the 2D Gaussian fits to every crop (the image around a spot).

Each crop is fitted by least squares and by maximum likelihood.

Examples
--------
spotcheck fit my-frames --crops out/my-frames/crops.nc --sensor out/my-frames/sensor.nc \\
    --output out/my-frames/fits.nc
"""

import argparse

from spotcheck.characterization.pixel_maps import read_maps
from spotcheck.characterization.sensor_choice import read_sensor_model
from spotcheck.dataset import folder
from spotcheck.fitting.crop_fits import count_failure_reasons, fit_crops, select_preferred_fits
from spotcheck.io import provenance, store


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="folder of the dataset, whose instrument says what the spot is")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--maps", nargs="*", default=[], help="maps.nc, if the dataset has darks")
    parser.add_argument("--output", required=True, help="fits.nc to write")


def run(args: argparse.Namespace) -> None:
    """Fit every crop, and print for each kind of fit how many succeeded and why others failed."""
    instrument = folder.load(args.dataset).instrument
    # Offset and gain of each pixel; --maps has one path or none.
    maps = None
    for path in args.maps:
        with store.read(path) as maps_file:
            maps = read_maps(maps_file)
    with store.read(args.crops) as crops, store.read(args.sensor) as sensor:
        pixel_integration = instrument.optics.pixel_integration
        fits = fit_crops(crops, read_sensor_model(sensor), instrument.model.top_hat, pixel_integration, maps)
    inputs = [args.crops, args.sensor, *args.maps]
    store.write(fits, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    # The status of a fit is a set of bits. A failed fit has no amplitude (NaN).
    has_frame = (fits["status"] & store.flag("missing")) == 0
    for fit_name in fits["fit"].values:
        amplitude, is_present = fits["amplitude"].sel(fit=fit_name), has_frame.sel(fit=fit_name)
        failed_status = fits["status"].sel(fit=fit_name).where(amplitude.isnull() & is_present, 0).values
        reasons = f": {text}" if (text := count_failure_reasons(failed_status)) else ""
        counts = f"{int(amplitude.notnull().sum())} of {int(is_present.sum())} crops"
        print(f"{counts} fitted by {str(fit_name).replace('_', ' ')}{reasons}")
    # Sentences on pixels that were left out of fits, each once.
    for sentence in dict.fromkeys(filter(None, select_preferred_fits(fits)["left_out"].values.ravel())):
        print(sentence)
    for remark in store.remarks_of(fits):
        print(remark)
