"""Judgement on the spot frames of a dataset: the findings, and the files with pictures and the extended model.

The declared model is that of instrument.yaml. The extended model has all effects that the frames show as well. Pictures
are images of what each of both models leaves unexplained. Every third repeat is held out: the searched frames are the
others.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.discrepancy.analysis import Analysis, analyse_frames
from spotcheck.discrepancy.conclude import conclude
from spotcheck.discrepancy.deviating_frames import describe_deviating_frames
from spotcheck.discrepancy.extended_model import FinalModel, build_extended_model, fit_final_model
from spotcheck.discrepancy.findings import Findings
from spotcheck.discrepancy.learned_light import summarize_shape
from spotcheck.discrepancy.pictures import AFTER, BEFORE, draw_pictures, skipped_pictures
from spotcheck.discrepancy.ready_frames import ReadyFrames, prepare_dataset
from spotcheck.discrepancy.verdict import drop_fitted_values
from spotcheck.io import progress, store
from spotcheck.model import effects
from spotcheck.model.light_shape import LightShape
from spotcheck.model.model_writer import LightFile, model_text, no_model_text, write_light, write_no_light

DECLARED_LIGHT = "the declared shape of the light stands"


@dataclass(frozen=True)
class Judgement:
    """Findings about a dataset, and the fits behind them if the frames could be assessed."""

    findings: Findings
    ready: ReadyFrames | None = None  # the frames; None if they could not be assessed
    analysis: Analysis | None = None  # their analysis; None if they could not be assessed
    final: FinalModel | None = None  # the extended model; None if they could not be assessed


@dataclass(frozen=True)
class ModelFiles:
    """Paths of the files that a judgement is written to, in addition to verdict.json, and their provenance."""

    pictures: str | Path  # path of discrepancy.nc
    model: str | Path  # path of model.yaml
    light: str | Path  # path of light.nc
    code: str  # digest of the code, which is written into each file
    inputs: Sequence[str | Path]  # files that the judgement is made from, whose digests are written into each file


def judge_spots(dataset: Dataset, crops: xr.Dataset, sensor: xr.Dataset, fits: xr.Dataset | None) -> Judgement:
    """Assess the spot frames of a dataset: search for effects, fit the extended model and list the findings.

    Parameters
    ----------
    dataset : Dataset
        Manifest and instrument.
    crops, sensor : xr.Dataset
        Content of crops.nc and sensor.nc.
    fits : xr.Dataset or None
        Content of fits.nc, from which fits start; None to fit each frame alone first.

    Returns
    -------
    Judgement
        With nothing but a reason in its findings if the frames cannot be assessed.
    """
    ready = prepare_dataset(dataset, crops, sensor, fits)
    # A text is the reason why the frames cannot be assessed.
    if isinstance(ready, str):
        return Judgement(Findings(reason=ready))
    with progress.track_steps("judging"):
        vocabulary = list(effects.vocabulary().values())
        analysis = analyse_frames(ready.frames, ready.spots, ready.setting, vocabulary)
        findings = conclude(analysis, vocabulary, ready.remarks)
        final = fit_final_model(analysis, _select_reliable(findings), ready.frames)
        findings = replace(findings, deviating_frames=describe_deviating_frames(analysis, final, ready))
        return Judgement(findings, ready, analysis, final)


def write_model_files(dataset: Dataset, judgement: Judgement, status: str, alpha: float, files: ModelFiles) -> None:
    """Write discrepancy.nc, model.yaml and light.nc; without an assessment they contain the reason alone.

    Parameters
    ----------
    dataset : Dataset
        Manifest and instrument.
    judgement : Judgement
        Judgement on its spot frames.
    status : str
        Status of the verdict, as in verdict.json.
    alpha : float
        Largest p-value of the detection at which model and frames disagree.
    files : ModelFiles
        Paths and provenance.
    """
    findings, ready, analysis, final = judgement.findings, judgement.ready, judgement.analysis, judgement.final
    code, inputs = files.code, files.inputs
    light = LightFile(files.light, dataset.name, code=code, inputs=inputs)
    lights: tuple[LightShape, ...] = ()
    if ready is None or analysis is None or final is None:
        pictures = skipped_pictures(dataset, status, alpha, findings.reason)
        text = no_model_text(dataset.name, findings.reason)
    else:
        findings = _select_reliable(findings)
        prepared, searched = analysis.prepared, np.flatnonzero(~ready.frames.held_out())
        # Both models get the sensor of the extended model, since the read noise that the declared model fits is
        # increased by its misfit.
        models = {BEFORE: final.with_its_sensor(prepared.declared.model)}
        if findings.effects or findings.light is not None:
            models[AFTER] = final.of_frames(searched, analysis.selected.fit.model.design)
        cells = [ready.indices[frame] for frame in searched]
        pictures = draw_pictures(
            dataset, cells, prepared.frames, models, findings.detection, status=status, alpha=alpha
        )
        extended = build_extended_model(final, findings, ready, dataset)
        text, lights = model_text(extended, dataset.name, status), extended.lights
    store.write(pictures, files.pictures, code=code, inputs=inputs)
    store.write_text(files.model, text, code=code, inputs=inputs)
    if lights and findings.light is not None:
        write_light(lights, replace(light, attributes=summarize_shape(findings.light)))
    else:
        write_no_light(DECLARED_LIGHT, light)


def _select_reliable(findings: Findings) -> Findings:
    """Return the findings; if a fit has not converged, without those that go beyond the declared model."""
    return findings if findings.has_converged else drop_fitted_values(findings)
