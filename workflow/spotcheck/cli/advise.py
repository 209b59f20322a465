"""`spotcheck advise`: advice.json."""

import argparse
import json
from pathlib import Path

from spotcheck import dataset, store
from spotcheck.cli import vocabulary
from spotcheck.cli.judged import findings_of, open_set
from spotcheck.discrepancy.advise import advise


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--findings", required=True, help="findings.json")
    parser.add_argument("--output", required=True, help="advice.json to write")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Look for the measurement that would tell tied explanations apart."""
    vocabulary.choose(args)
    saved = json.loads(Path(args.findings).read_text(encoding="utf-8"))
    vocabulary.same(saved, args.findings)
    advice = []
    if len(saved.get("explanations", [])) > 1:
        with store.read(args.crops) as crops, store.read(args.sensor) as sensor:
            ready = open_set(dataset.load(args.dataset), crops, sensor)
            assert not isinstance(ready, str)  # the loop opened it before
            found = findings_of(saved, ready)
            advice = advise(found.look, found.explanations)
    plain = [own._asdict() | {"condition": own.condition._asdict()} for own in advice]
    store.write_text(args.output, json.dumps(plain, indent=1) + "\n")
    print(f"{len(advice)} pieces of advice")
