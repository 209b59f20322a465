"""`spotcheck verdict`: verdict.json, discrepancy.nc for the pictures, and model.yaml, the extended model."""

import argparse
import json
from pathlib import Path

from spotcheck import dataset, provenance, store
from spotcheck.cli import vocabulary
from spotcheck.cli.judged import findings_of, open_set
from spotcheck.discrepancy.advise import Advice, Condition
from spotcheck.discrepancy.extend import Tolerance
from spotcheck.discrepancy.extension import extended_of
from spotcheck.discrepancy.locate import where
from spotcheck.discrepancy.picture_data import dataset_of
from spotcheck.discrepancy.sentence import sentence
from spotcheck.discrepancy.verdict import Judgement, verdict_json
from spotcheck.discrepancy.verify import gap_from
from spotcheck.discrepancy.written import write_verdict
from spotcheck.model.extended import no_model, text_of


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--findings", required=True, help="findings.json")
    parser.add_argument("--gap", required=True, help="gap.nc")
    parser.add_argument("--advice", required=True, help="advice.json")
    parser.add_argument("--pictures", required=True, help="discrepancy.nc to write")
    parser.add_argument("--model", help="model.yaml to write, which `spotcheck simulate` runs (default: none)")
    parser.add_argument("--output", required=True, help="verdict.json to write")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Write down what was found."""
    vocabulary.choose(args)
    found = dataset.load(args.dataset)
    saved = json.loads(Path(args.findings).read_text(encoding="utf-8"))
    vocabulary.same(saved, args.findings)
    tolerance = Tolerance(**saved["tolerance"])
    advice = [
        Advice(Condition(**own.pop("condition")), tuple(own.pop("pair")), **own)
        for own in json.loads(Path(args.advice).read_text(encoding="utf-8"))
    ]
    if "why" in saved:
        judgement = Judgement(None, None, [], saved["why"])
        verdict = verdict_json(judgement, found.name, tolerance)
        model = no_model(found.name, saved["why"])
    else:
        with (
            store.read(args.crops) as crops,
            store.read(args.sensor) as sensor,
            store.read(args.gap) as gap,
        ):
            ready = open_set(found, crops, sensor)
            assert not isinstance(ready, str)  # the loop opened it before
            findings = findings_of(saved, ready)
            judgement = Judgement(findings, gap_from(gap), advice, "")
            verdict = verdict_json(judgement, found.name, tolerance)
            names = [own["name"] for own in verdict["effects"]]
            extended = extended_of(findings, names, ready.shots, ready.setting, found.instrument)
            model = text_of(extended, found.name, verdict["status"])
    if judgement.findings is not None:
        verdict["where"] = where(
            judgement.findings.look,
            judgement.findings.base,
            tolerance.alpha,
            judgement.findings.detection,
            judgement.findings.around,
        )
    verdict["sentence"] = sentence(verdict, tolerance)
    verdict |= vocabulary.described()
    inputs = [args.crops, args.sensor, args.findings, args.gap, args.advice, *args.effects]
    pictures = dataset_of(judgement, verdict, found)
    store.write(pictures, args.pictures, code=provenance.code_digest(__name__), inputs=inputs)
    if args.model:
        store.write_text(args.model, model)
    write_verdict(verdict, args.output)
    print(verdict["sentence"])
