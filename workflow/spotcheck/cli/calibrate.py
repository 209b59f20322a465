"""`spotcheck calibrate`: writes calibration.nc, the law of the spot's width over exposure time.

The law is σ_g = σ_laser + p1 ln(t / 1 s) + p2 [px] at the exposure time t, where σ_laser is the laser's own width on
the sensor. p1 [px] is the slope, p2 [px] the width at 1 s without the laser's own. calibration.nc holds both by three
estimators, two regressions of fitted widths and maximum likelihood of all frames. A site is a place on the sample.

Examples
--------
spotcheck calibrate my-frames --crops out/my-frames/crops.nc --fits out/my-frames/fits.nc \\
    --sensor out/my-frames/sensor.nc --output out/my-frames/calibration.nc
"""

import argparse
import math

from spotcheck.characterization.sensor_choice import read_sensor_model
from spotcheck.dataset import folder
from spotcheck.fitting.calibration import SIMULATION_ESTIMATOR, calibrate
from spotcheck.io import provenance, store


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--fits", required=True, help="fits.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--output", required=True, help="calibration.nc to write")


def run(args: argparse.Namespace) -> None:
    """Write calibration.nc, and print p1 and p2 [px] by the estimator that the simulation uses.

    They are means over the sites, with their standard deviation over the sites. If there is no calibration, the reason
    is printed.
    """
    instrument = folder.load(args.dataset).instrument
    with store.read(args.crops) as crops, store.read(args.fits) as fits, store.read(args.sensor) as sensor:
        # Without a sensor model (None) there is no estimate by maximum likelihood.
        calibration = calibrate(crops, fits, instrument, read_sensor_model(sensor))
    inputs = [args.crops, args.fits, args.sensor]
    store.write(calibration, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    if "skipped" in calibration.attrs:
        print(f"skipped: {calibration.attrs['skipped']}")
    else:
        # SIMULATION_ESTIMATOR is the name of the estimator that the simulation uses.
        estimate = calibration.sel(estimator=SIMULATION_ESTIMATOR)
        for name in ("p1", "p2"):
            # The variables `_mean` and `_sd_all` are the mean and the standard deviation over all sites.
            site_deviation = float(estimate[f"{name}_sd_all"])
            # A single site has no standard deviation.
            ending = " px (one site)" if math.isnan(site_deviation) else f" ± {site_deviation:.3f} px"
            print(f"{name} = {float(estimate[f'{name}_mean']):.3f}{ending}")
