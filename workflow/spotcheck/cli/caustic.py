"""`spotcheck caustic`: caustic.nc."""

import argparse

from spotcheck.dataset import folder as dataset
from spotcheck.fitting.caustic import compute_caustic, select_beam_rows
from spotcheck.io import provenance, store
from spotcheck.io.plus_minus import plus_minus

EXAMPLE = """Example:
  spotcheck caustic my-frames --fits out/my-frames/fits.nc --output out/my-frames/caustic.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--fits", required=True, help="fits.nc")
    parser.add_argument("--output", required=True, help="caustic.nc to write")


def run(args: argparse.Namespace) -> None:
    """Fit the hyperbola and say M², or why not."""
    instrument = dataset.load(args.dataset).instrument
    with store.read(args.fits) as fits:
        found = compute_caustic(fits, instrument)
    store.write(found, args.output, code=provenance.code_digest(__name__), inputs=[args.fits])
    if "skipped" in found.attrs:
        print(f"skipped: {found.attrs['skipped']}")
    else:
        for words, own in select_beam_rows(found).items():
            print(f"M² = {plus_minus(float(own['m2']), float(own['m2_stderr']))} ({words})")
    for remark in store.remarks_of(found):
        print(remark)
