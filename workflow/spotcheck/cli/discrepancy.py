"""`spotcheck discrepancy`: findings.json and discrepancy.nc."""

import argparse
import json
from pathlib import Path

from spotcheck import dataset, store
from spotcheck.cli import vocabulary
from spotcheck.cli.judged import open_set, tolerance_of
from spotcheck.discrepancy.calibration import stored
from spotcheck.discrepancy.extend import investigate
from spotcheck.discrepancy.saved import saved_of


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--calibrations", required=True, help="folder of null laws, kept from run to run")
    parser.add_argument("--simulations", type=int, default=1500, help="null sets of a new design (default 1500)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the null sets (default 1)")
    parser.add_argument("--workers", type=int, default=1, help="processes for the null sets (default 1)")
    parser.add_argument("--tolerance", default="{}", help="JSON: of_peak, of_noise, alpha")
    parser.add_argument("--output", required=True, help="findings.json to write")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Find where model and measurement disagree, and what explains it."""
    vocabulary.choose(args)
    found = dataset.load(args.dataset)
    tolerance = tolerance_of(args.tolerance)
    with store.read(args.crops) as crops, store.read(args.sensor) as sensor:
        ready = open_set(found, crops, sensor)
        if isinstance(ready, str):
            result: dict = {"status": "not_assessed", "why": ready}
        else:
            design, kind = ready.design, ready.kind
            null = stored(Path(args.calibrations), design, kind, args.simulations, args.seed, args.workers)
            result = saved_of(investigate(ready.chosen, design, ready.base, ready.setting, null, tolerance))
    result["tolerance"] = tolerance._asdict()
    result |= vocabulary.described()
    store.write_text(args.output, json.dumps(result, indent=1) + "\n")
    best = (result.get("explanations") or [result.get("freed") or {}])[0]
    print(f"{result['status']}: " + (", ".join(own["name"] for own in best.get("effects", [])) or "no effect"))
