"""`spotcheck caustic`: writes caustic.nc, the hyperbolas of the beam's width along z, with waist, divergence and M².

z is the position along the beam. The beam quality M² is 1 for an ideal Gaussian beam and larger for others.

Examples
--------
spotcheck caustic my-frames --fits out/my-frames/fits.nc --output out/my-frames/caustic.nc
"""

import argparse

from spotcheck.dataset import folder
from spotcheck.fitting.scan_caustic import ESTIMATORS, compute_caustic, explain_no_scan, select_beam_axes
from spotcheck.fitting.scan_widths import measure_scan_moments
from spotcheck.io import provenance, store
from spotcheck.io.number_text import quantity_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--fits", required=True, help="fits.nc")
    parser.add_argument("--output", required=True, help="caustic.nc to write")


def run(args: argparse.Namespace) -> None:
    """Write caustic.nc, and print M² by each estimator for each axis of the beam, or why there is no caustic."""
    dataset = folder.load(args.dataset)
    with store.read(args.fits) as fits:
        # Frames are read only if there can be a caustic.
        has_scan = not explain_no_scan(fits, dataset.instrument)
        moments = measure_scan_moments(dataset, fits) if has_scan else None
        caustic = compute_caustic(fits, dataset.instrument, moments)
    store.write(caustic, args.output, code=provenance.code_digest(__name__), inputs=[args.fits])
    if "skipped" in caustic.attrs:
        print(f"skipped: {caustic.attrs['skipped']}")
    else:
        for estimator in map(str, caustic["estimator"].values):
            # Axis of the beam in words → its row of caustic.nc.
            for axis, row in select_beam_axes(caustic.sel(estimator=estimator)).items():
                print(
                    f"M² = {quantity_text(float(row['m2']), float(row['m2_stderr']))} ({ESTIMATORS[estimator]}, {axis})"
                )
    for remark in store.remarks_of(caustic):
        print(remark)
