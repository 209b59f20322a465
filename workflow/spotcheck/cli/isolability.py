"""`spotcheck isolability`: a table of what a design can tell apart."""

import argparse

import numpy as np

from spotcheck import dataset, store
from spotcheck.cli import vocabulary
from spotcheck.discrepancy.asimov import APART
from spotcheck.discrepancy.assess import assessable
from spotcheck.discrepancy.calibration import Kind, null_look
from spotcheck.discrepancy.isolability import isolability
from spotcheck.discrepancy.shots import Shot
from spotcheck.discrepancy.verdict import discovery_design
from spotcheck.manifest import number_in
from spotcheck.model.baseline import of_instrument


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("dataset", help="dataset folder; only manifest.csv and instrument.yaml are read")
    parser.add_argument("--snr", type=float, default=100.0, help="signal-to-noise of each effect (default 100)")
    parser.add_argument("--output", help="file for the table (default: standard output alone)")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Every effect at a given signal-to-noise against its nearest rival."""
    vocabulary.choose(args)
    found = dataset.load(args.dataset)
    shots = [
        Shot(f.angle_deg, f.exposure_s, f.repeat or 0, k if found.instrument.order_known else None,
             tuple(number_in(f.extra[name]) for name in found.instrument.conditions), 0, 0, lambda: np.zeros((1, 1)))
        for k, f in enumerate(found.spots)
    ]  # fmt: skip
    design, _ = discovery_design(shots)
    baseline = of_instrument(found.instrument, found.exposures)
    kind = Kind(
        found.instrument.crop_px, found.instrument.sensor.bit_depth or 10, baseline.photon_budget, baseline.top_hat
    )
    look = null_look(design, kind, 0, 0)
    effects, why = assessable(look)
    rows = ["| effect | SNR | nearest rival | SNR of the difference | can be told apart |", "|---|---|---|---|---|"]
    print("\n".join(rows), flush=True)
    for effect in effects:
        own = isolability(look, effect, effects, args.snr)
        answer = "yes" if own.apart >= APART else "no"
        rival = f"`{own.rival}`" if own.rival else "none"
        rows.append(f"| `{own.effect}` | {own.snr:.0f} | {rival} | {own.apart:.1f} | {answer} |")
        print(rows[-1], flush=True)
    for name, reason in why.items():
        rows.append(f"| `{name}` | | | | not assessed: {reason} |")
        print(rows[-1], flush=True)
    if args.output:
        store.write_text(args.output, "\n".join(rows) + "\n")
