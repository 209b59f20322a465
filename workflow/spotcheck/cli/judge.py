"""`spotcheck judge`: verdict.json, discrepancy.nc for the pictures, model.yaml and light.nc."""

import argparse

from spotcheck import dataset, progress, provenance, store
from spotcheck.cli import vocabulary
from spotcheck.cli.judged import open_set, tolerance_of
from spotcheck.old_engine.boundary import effects_to_search, remark_on_files
from spotcheck.old_engine.conclude.judge import judge
from spotcheck.old_engine.conclude.judgement import untested
from spotcheck.old_engine.conclude.light import attributes_of, described, described_by_pose
from spotcheck.old_engine.conclude.modes import modes_of
from spotcheck.old_engine.model.extended import no_model, text_of
from spotcheck.old_engine.model.light_file import no_light, written_light
from spotcheck.old_engine.verdict.document import document
from spotcheck.old_engine.verdict.extended import extended_of
from spotcheck.old_engine.verdict.pictures import pictures_of
from spotcheck.old_engine.verdict.sentence import sentence
from spotcheck.old_engine.verdict.written import write_verdict

EXAMPLE = """Example:
  spotcheck judge my-frames --crops out/my-frames/crops.nc --sensor out/my-frames/sensor.nc \\
      --pictures out/my-frames/discrepancy.nc --model out/my-frames/model.yaml --light out/my-frames/light.nc \\
      --output out/my-frames/verdict.json
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--tolerance", default="{}", help="JSON: of_peak, alpha")
    parser.add_argument("--pictures", required=True, help="discrepancy.nc to write")
    parser.add_argument("--model", required=True, help="model.yaml to write, which `spotcheck simulate` runs")
    parser.add_argument("--light", required=True, help="light.nc to write beside it: the light's learned shape")
    parser.add_argument("--output", required=True, help="verdict.json to write")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Find where model and measurement disagree and what is missing, and write it down."""
    vocabulary.choose(args)
    found, tolerance = dataset.load(args.dataset), tolerance_of(args.tolerance)
    known = effects_to_search()
    with store.read(args.crops) as crops, store.read(args.sensor) as sensor:
        ready = open_set(found, crops, sensor)
        with progress.steps("judging"):
            judgement = untested(ready) if isinstance(ready, str) else judge(ready.shots, ready.setting, known)
    light = judgement.light
    words = described(light, modes_of(light)) if light else ""
    if len(judgement.lights) > 1:
        words = described_by_pose(judgement.lights)
    remarks = ("",) if isinstance(ready, str) else (ready.beware, remark_on_files())
    beware = "; ".join(remark for remark in remarks if remark)
    verdict = document(judgement, found.name, alpha=tolerance.alpha, tolerance=tolerance.of_peak, light_words=words,
                       beware=beware)  # fmt: skip
    verdict |= {"sentence": sentence(verdict)} | vocabulary.described()
    code, inputs = provenance.code_digest(__name__), [args.crops, args.sensor, *args.effects]
    store.write(pictures_of(judgement, verdict, found), args.pictures, code=code, inputs=inputs)
    if isinstance(ready, str) or judgement.fits is None:
        store.write_text(args.model, no_model(found.name, judgement.why_not), code=code, inputs=inputs)
        extended = None
    else:
        extended = extended_of(judgement, ready.setting, found.instrument, known)
        store.write_text(args.model, text_of(extended, found.name, verdict["status"]), code=code, inputs=inputs)
    axes = [axis for axis in found.axes if axis.name not in ("exposure", "repeat")]
    seen = [] if judgement.fits is None else judgement.fits.poses()
    poses = {axis.name: (axis.units, [own[k] for own in seen]) for k, axis in enumerate(axes)} if seen else {}
    told = {"title": f"The light's shape, learned from {found.name}", "dataset": found.name, "code": code}
    if light is not None and extended is not None and extended.lights:
        written_light(extended.lights, args.light, **told, inputs=inputs, poses=poses,
                      attributes=attributes_of(light))  # fmt: skip
    else:
        no_light(args.light, "the declared shape of the light stands", **told, inputs=inputs)
    write_verdict(verdict, args.output, code=code, inputs=inputs)
    print(verdict["sentence"])
