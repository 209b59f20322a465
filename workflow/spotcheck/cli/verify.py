"""`spotcheck verify`: gap.nc."""

import argparse
import json
from pathlib import Path

from spotcheck import dataset, provenance, store
from spotcheck.cli import vocabulary
from spotcheck.cli.judged import findings_of, open_set
from spotcheck.discrepancy.verdict import gap_of
from spotcheck.discrepancy.verify import dataset_of_gap


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--findings", required=True, help="findings.json")
    parser.add_argument("--output", required=True, help="gap.nc to write")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Predict unseen data with and without the effects."""
    vocabulary.choose(args)
    found = dataset.load(args.dataset)
    saved = json.loads(Path(args.findings).read_text(encoding="utf-8"))
    vocabulary.same(saved, args.findings)
    gap = None
    if saved.get("explanations") or saved.get("freed"):
        with store.read(args.crops) as crops, store.read(args.sensor) as sensor:
            ready = open_set(found, crops, sensor)
            assert not isinstance(ready, str)  # the loop opened it before
            gap = gap_of(findings_of(saved, ready), ready.shots)
    inputs = [args.crops, args.sensor, args.findings, *args.effects]
    store.write(
        dataset_of_gap(gap, found.title, found.name), args.output, code=provenance.code_digest(__name__), inputs=inputs
    )
    print(f"{gap.closed:.3f} of the gap closed on {gap.on}" if gap else "nothing was added to the model")
