"""`spotcheck judge`: verdict.json, discrepancy.nc for the pictures, model.yaml and light.nc."""

import argparse
import ctypes
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np

from spotcheck.cli import vocabulary
from spotcheck.cli.judged import ReadyFrames, Tolerance, prepare_dataset, tolerance_of
from spotcheck.dataset import folder as dataset
from spotcheck.dataset.folder import Dataset
from spotcheck.discrepancy.analysis import Analysis, analyse_frames
from spotcheck.discrepancy.conclude import conclude
from spotcheck.discrepancy.extended_model import FinalModel, build_extended_model, fit_final_model
from spotcheck.discrepancy.findings import Findings
from spotcheck.discrepancy.learned_light import summarize_shape
from spotcheck.discrepancy.pictures import AFTER, BEFORE, draw_pictures, skipped_pictures
from spotcheck.discrepancy.sentence import summarize_verdict
from spotcheck.discrepancy.verdict import compose_verdict, drop_fitted_values
from spotcheck.discrepancy.written import write_verdict
from spotcheck.io import progress, provenance, store
from spotcheck.model import effects
from spotcheck.model.model_writer import LightFile, model_text, no_model_text, write_light, write_no_light

EXAMPLE = """Example:
  spotcheck judge my-frames --crops out/my-frames/crops.nc --sensor out/my-frames/sensor.nc \\
      --fits out/my-frames/fits.nc --pictures out/my-frames/discrepancy.nc --model out/my-frames/model.yaml \\
      --light out/my-frames/light.nc --output out/my-frames/verdict.json
"""
# `mallopt` option of glibc for the number of heaps (malloc.h).
M_ARENA_MAX = -8
DECLARED_LIGHT = "the declared shape of the light stands"


@dataclass(frozen=True)
class Judgement:
    """A verdict's findings, and the fits behind them if the frames could be assessed."""

    findings: Findings
    ready: ReadyFrames | None  # the frames; None if they could not be assessed
    analysis: Analysis | None  # their analysis
    final: FinalModel | None  # the model with all that is named


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--fits", help="fits.nc, from which the fits start (default: a fit of each frame alone)")
    parser.add_argument("--tolerance", default="{}", help="JSON: of_peak, alpha")
    parser.add_argument("--pictures", required=True, help="discrepancy.nc to write")
    parser.add_argument("--model", required=True, help="model.yaml to write, which `spotcheck simulate` runs")
    parser.add_argument("--light", required=True, help="light.nc to write beside it: the light's learned shape")
    parser.add_argument("--output", required=True, help="verdict.json to write")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Find where model and measurement disagree and what is missing, and write it down."""
    vocabulary.choose(args)
    share_heap()
    found, tolerance = dataset.load(args.dataset), tolerance_of(args.tolerance)
    judgement = judge(found, args, tolerance)
    verdict = compose_verdict(judgement.findings, found.name, alpha=tolerance.alpha, tolerance=tolerance.of_peak)
    verdict |= {"sentence": summarize_verdict(verdict)} | vocabulary.described()
    paths = [args.crops, args.sensor, *([args.fits] if args.fits else []), *args.effects]
    origin: dict[str, Any] = {"code": provenance.code_digest(__name__), "inputs": paths}
    write_beside(found, judgement, verdict, args, origin)
    write_verdict(verdict, args.output, **origin)
    print(verdict["sentence"])


def share_heap() -> None:
    """Let threads share one heap: memory that one of them frees serves the others. Elsewhere than on glibc nothing
    happens."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(M_ARENA_MAX, 1)


def judge(found: Dataset, args: argparse.Namespace, tolerance: Tolerance) -> Judgement:
    """Return what is concluded of the frames of a dataset, and the fits behind it."""
    with ExitStack() as stack:
        crops, sensor = (stack.enter_context(store.read(path)) for path in (args.crops, args.sensor))
        fits = stack.enter_context(store.read(args.fits)) if args.fits else None
        ready = prepare_dataset(found, crops, sensor, fits)
        if isinstance(ready, str):
            return Judgement(Findings(reason=ready), None, None, None)
        with progress.track_steps("judging"):
            known = list(effects.vocabulary().values())
            analysis = analyse_frames(
                ready.frames, ready.spots, ready.setting, known, log=lambda text: progress.advance("")
            )
            findings = conclude(analysis, known, ready.remarks)
            if findings.reason:
                return Judgement(findings, None, None, None)
            # Without a converged fit only the declared model is written.
            stands = findings if findings.has_converged else drop_fitted_values(findings)
            return Judgement(findings, ready, analysis, fit_final_model(analysis, stands, ready.frames))


def write_beside(
    found: Dataset, judgement: Judgement, verdict: dict[str, Any], args: argparse.Namespace, origin: dict[str, Any]
) -> None:
    """Write discrepancy.nc, model.yaml and light.nc; `origin` is their provenance."""
    findings, ready, analysis, final = judgement.findings, judgement.ready, judgement.analysis, judgement.final
    status, alpha = verdict["status"], verdict["detection"]["alpha"]
    light = LightFile(args.light, found.name, **origin)
    if ready is None or analysis is None or final is None:
        store.write(skipped_pictures(found, status, alpha, findings.reason), args.pictures, **origin)
        store.write_text(args.model, no_model_text(found.name, findings.reason), **origin)
        write_no_light(DECLARED_LIGHT, light)
        return
    if not findings.has_converged:
        findings = drop_fitted_values(findings)
    prepared, searched = analysis.prepared, np.flatnonzero(~ready.frames.held_out())
    # Both models with the noise of the last fit: that of the declared one takes what the model misses for noise.
    models = {BEFORE: final.with_its_sensor(prepared.declared.model)}
    if findings.effects or findings.light is not None:
        models[AFTER] = final.of_frames(searched, prepared.frames.design)
    cells = [ready.indices[k] for k in searched]
    pictures = draw_pictures(found, cells, prepared.frames, models, findings.detection, status=status, alpha=alpha)
    store.write(pictures, args.pictures, **origin)
    extended = build_extended_model(final, findings, ready.frames, ready.rows, ready.setting, found)
    store.write_text(args.model, model_text(extended, found.name, status), **origin)
    if extended.lights and findings.light is not None:
        write_light(
            extended.lights, LightFile(args.light, found.name, **origin, attributes=summarize_shape(findings.light))
        )
    else:
        write_no_light(DECLARED_LIGHT, light)
