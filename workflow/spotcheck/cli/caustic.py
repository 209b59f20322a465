"""`spotcheck caustic`: writes caustic.nc, the hyperbolas of the beam's width along z, with waist, divergence and M².

z is the position along the beam. The beam quality M² is 1 for an ideal Gaussian beam and larger for others.
"""

import argparse

from spotcheck.dataset import folder
from spotcheck.fitting.caustic import compute_caustic, select_beam_rows
from spotcheck.io import provenance, store
from spotcheck.io.number_text import quantity_text

EXAMPLES = "spotcheck caustic my-frames --fits out/my-frames/fits.nc --output out/my-frames/caustic.nc"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--fits", required=True, help="fits.nc")
    parser.add_argument("--output", required=True, help="caustic.nc to write")


def run(args: argparse.Namespace) -> None:
    """Write caustic.nc, and print M² of each axis of the beam or why there is no caustic."""
    instrument = folder.load(args.dataset).instrument
    with store.read(args.fits) as fits:
        caustic = compute_caustic(fits, instrument)
    store.write(caustic, args.output, code=provenance.code_digest(__name__), inputs=[args.fits])
    if "skipped" in caustic.attrs:
        print(f"skipped: {caustic.attrs['skipped']}")
    else:
        # Axis of the beam in words → its row of caustic.nc.
        for axis, row in select_beam_rows(caustic).items():
            print(f"M² = {quantity_text(float(row['m2']), float(row['m2_stderr']))} ({axis})")
    for remark in store.remarks_of(caustic):
        print(remark)
