"""`spotcheck judge`: compares spots with the model, and writes verdict.json and the files of the improved model.

The verdict names the physical effects that the model is missing. discrepancy.nc holds images of the residuals for the
report, model.yaml the extended model with these effects, and light.nc the shape of the light if it was learned.

Examples
--------
spotcheck judge my-frames --crops out/my-frames/crops.nc --sensor out/my-frames/sensor.nc \\
    --fits out/my-frames/fits.nc --pictures out/my-frames/discrepancy.nc --model out/my-frames/model.yaml \\
    --light out/my-frames/light.nc --output out/my-frames/verdict.json
"""

import argparse
import ctypes
import sys

from spotcheck.cli import effect_options, tolerance
from spotcheck.dataset import folder
from spotcheck.discrepancy.judgement import ModelFiles, judge_spots, write_model_files
from spotcheck.discrepancy.sentence import summarize_verdict
from spotcheck.discrepancy.verdict import compose_verdict
from spotcheck.discrepancy.written import write_verdict
from spotcheck.io import provenance, store

# Option M_ARENA_MAX of glibc's `mallopt` (malloc.h): the largest number of heaps.
M_ARENA_MAX = -8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser.

    `tolerance` adds --tolerance, `effect_options` adds --effects, --only and --without.
    """
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument(
        "--fits", help="fits.nc with starting values of the model (default: each frame is first fitted)"
    )
    tolerance.add_option(parser)
    parser.add_argument("--pictures", required=True, help="discrepancy.nc to write")
    parser.add_argument("--model", required=True, help="model.yaml to write, which `spotcheck simulate` runs")
    parser.add_argument("--light", required=True, help="light.nc to write, beside model.yaml: the learned light shape")
    parser.add_argument("--output", required=True, help="verdict.json to write")
    effect_options.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Judge the dataset, write the verdict and the other files, and print the summary of the verdict.

    A judgement has the findings, from which the verdict is composed, and the content of the other files.
    """
    effect_options.apply_options(args)
    use_single_heap()
    dataset, limits = folder.load(args.dataset), tolerance.parse_tolerance(args.tolerance)
    paths = {name: path for name in ("crops", "sensor", "fits") if (path := getattr(args, name))}
    with store.read_files(paths) as files:
        judgement = judge_spots(dataset, files["crops"], files["sensor"], files.get("fits"))
    verdict = compose_verdict(judgement.findings, dataset.name, alpha=limits.alpha, tolerance=limits.of_peak)
    verdict |= {"sentence": summarize_verdict(verdict)} | effect_options.describe_difference()
    code = provenance.code_digest(__name__)
    inputs = [*paths.values(), *args.effects]
    model_files = ModelFiles(args.pictures, args.model, args.light, code, inputs)
    write_model_files(dataset, judgement, verdict["status"], verdict["detection"]["alpha"], model_files)
    write_verdict(verdict, args.output, code=code, inputs=inputs)
    print(verdict["sentence"])


def use_single_heap() -> None:
    """Let all threads of this process use one heap, so that memory freed by one can be used by the others.

    Does nothing without glibc.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(M_ARENA_MAX, 1)
