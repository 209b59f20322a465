"""Findings put together by hand, one or more of every status, for tests of the verdict and of pages that show it."""

from dataclasses import replace
from typing import Any

import numpy as np

from spotcheck.discrepancy.findings import (
    Advice,
    Consistency,
    Detection,
    Findings,
    Gap,
    LawShift,
    LearnedLight,
    LevelFindings,
    NamedEffect,
    ParameterValue,
    Place,
    ResidualTest,
    SensorPull,
    Unexplained,
    UpperLimit,
)
from spotcheck.discrepancy.sentence import summarize_verdict
from spotcheck.discrepancy.verdict import compose_verdict
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.effects import built_in
from spotcheck.model.light_shape import LightShape

NAN = float("nan")


def named(name: str, *values: tuple[float, float], form: str | None = None, **changes: Any) -> NamedEffect:
    """Return a named effect with values and errors of its first parameters, z = 30, consistent over 24 cells."""
    effect = built_in()[name]
    variant = next(iter(effect.variants)) if form is None else effect.variant_named(form)
    assert variant is not None
    numbers = tuple(value for value, _ in values) + (NAN,) * (len(effect.parameters) - len(values))
    reported = {
        parameter.name: ParameterValue(*value, parameter.unit)
        for parameter, value in zip(effect.parameters, values, strict=False)
    }
    found = NamedEffect(AppliedEffect(effect, variant, numbers), reported, 900.0, 30.0, Consistency(27, 24, 77, True))
    return replace(found, **changes)


def detected(p: float) -> Detection:
    """Return a detection of two tests."""
    block = ResidualTest("blocks", "row 96, column 120", 40.0, p / 2, 39.0)
    return Detection(p, (ResidualTest("frames", "", 0.2, 0.4, 0.25), block))


def left(size: float, variance_error: float = 1e-7) -> Unexplained:
    """Return so much [peak] that is unexplained, with the error of its square."""
    return Unexplained(size, variance_error, size**2 / variance_error, NAN, 0.3)


def closed(share: float, before: float = 81.0) -> Gap:
    """Return a gap on held-out repeats of which a share is closed."""
    return Gap(before, before - share * (before - 1), 1.0, share, 3.0, 0.1, 5400.0, "held-out repeats")


def learned(words: str = "6 % of its power lies elsewhere, most of it in four lobes", **changes: Any) -> LearnedLight:
    """Return a learned light in four lobes."""
    shape = LightShape(0.5, np.zeros((5, 5)))
    light = LearnedLight(shape, 0.06, 0.002, (0.1, 0.05, 0.15, 0.05, 0.65), 1.21, 1.02, 395.0, -0.001, words)
    return replace(light, **changes)


def agree(**changes: Any) -> Findings:
    """Return findings in which nothing is missing, but for some fields."""
    limit = UpperLimit("smear", "fraction", "1", "not significant", high=0.0004, frames=54)
    findings = Findings(
        detection=detected(0.32),
        rms_of_peak=0.0003,
        law=LawShift((7.3931, 86.81), (7.3931, 86.81), (0.0034, 0.029)),
        unexplained=left(0.0),
        limits=(limit,),
    )
    return replace(findings, **changes)


def disagree(p: float = 1e-12, rms: float = 0.055, **changes: Any) -> Findings:
    """Return findings of frames that differ from the declared model."""
    places = (Place("row 96, column 120 at 0.4 ms", 85.0),)
    base = agree(detection=detected(p), rms_of_peak=rms, places=places, unexplained=left(0.0005), limits=())
    return replace(base, **changes)


CLIP = named("saturation", (520.7, 5.2), form="sharp with noise")
BEND = named("nonlinearity", (0.112, 0.0011))
ROWS = named("row_noise", (4.0, 0.04), consistency=None)
GRAINS = named("speckle", (0.25, 0.0025), (3.1, NAN), consistency=None)
GHOST = named(
    "ghost_reflection",
    (0.0239, 0.0004),
    (-29.2, 0.35),
    (4.1, 0.28),
    rivals={"super_gaussian": 9.1, "scatter_halo": 4.6},
)
PAIR = replace(GHOST, rivals={"scatter_halo": 4.6})
MOVED = LawShift((2.3039, 33.13), (0.003, 8.83), (0.0057, 0.36))
NO_LAW = LawShift()
GAIN = SensorPull("gain_dn_per_e", "DN/e-", 0.11, 0.0033, 0.1321, 0.001)
NOISE = SensorPull("read_noise_e", "e-", 12.0, 0.6, 12.7, 0.2)
BLACK = SensorPull("black_level_dn", "DN", 12.0, 0.3, 10.8, 0.02)
LEVELS = LevelFindings(
    20, ParameterValue(0.1234, 0.0005, "DN/e-"), ParameterValue(0.131, 0.002, "DN/e-"), light_scatter=0.004
)

DISAGREE = "Model and measurement disagree by 5.5 % of the spot's peak (rms, p < 0.0001)."
STOPS = "The signal stops at a level, below the converter's full scale (saturation, level 521 ± 5 DN)."
BENDS = "The sensor's response bends below saturation (nonlinearity, q 0.1120 ± 0.0011)."
LOBES = "The light does not have the declared shape: 6 % of its power lies elsewhere, most of it in four lobes."
LITTLE = "less than 0.2 % of the peak remains."
AS_WELL = "No other effect does as well."
LIMITS = "This does not prove the model: `spotcheck limits` lists how large each effect could still be."
GHOSTLY = (
    "Either a faint displaced copy of the spot lies beside it (ghost_reflection, fraction 0.0239 ± 0.0004,"
    " dx −29.20 ± 0.35 px, dy 4.10 ± 0.28 px), or a broad faint halo of scattered light surrounds the spot"
    " (scatter_halo)"
)
HARDLY = "Model and measurement disagree, but hardly in the mean images (p < 0.0001)."
SEPARATES = Advice({"exposure_s": 1.8e-3, "angle_deg": 22.5}, ("ghost_reflection", "scatter_halo"), 12)

# Findings of every kind with the status and the summary.
KINDS: dict[str, tuple[Findings, str, list[str]]] = {
    "agree": (agree(), "consistent", [
        "Model and measurement agree within the noise (p = 0.32).",
        "The fit gives p1 = 7.3931 ± 0.0034 px and p2 = 86.810 ± 0.029 px.",
        LIMITS,
    ]),
    "one frame": (agree(law=NO_LAW, limits=(), unexplained=None), "consistent", [
        "Model and measurement agree within the noise (p = 0.32)."
    ]),
    "one": (disagree(effects=(CLIP,), law=MOVED, gap=closed(0.9997)), "named", [
        DISAGREE,
        STOPS,
        f"This effect closes 99.9 % of the gap on held-out repeats; {LITTLE} {AS_WELL}"
        " The fitted p1 changes from 2.304 to 0.003 ± 0.006 px and p2 from 33.1 to 8.8 ± 0.4 px.",
    ]),
    "one, nothing held out": (disagree(effects=(BEND,), law=NO_LAW, unexplained=None), "named", [
        DISAGREE, BENDS, f"This effect was not tested on held-out frames. {AS_WELL}",
    ]),
    "one that scatters": (disagree(rms=0.0004, effects=(ROWS,), law=NO_LAW, gap=closed(NAN, 1.01)), "named", [
        HARDLY,
        "Whole rows scatter together, anew in every frame (row_noise, rms 4.00 ± 0.04 DN).",
        f"The declared model has no significant gap on held-out repeats that this effect could close. {AS_WELL}",
    ]),
    "one, weak": (disagree(p=0.2, rms=0.0004, effects=(BEND,), gap=closed(0.8)), "named", [
        "The overall test finds no disagreement (p = 0.2), but tests of single effects do.",
        BENDS,
        f"This effect closes 80 % of the gap on held-out repeats; {LITTLE} {AS_WELL}",
    ]),
    "four": (disagree(effects=(CLIP, BEND, ROWS, GRAINS), gap=closed(0.8), unexplained=left(0.006)),
             "named_more_remains", [
        DISAGREE,
        f"{STOPS} {BENDS} Further effects: row_noise (rms 4.00 ± 0.04 DN) and speckle (contrast 0.2500 ± 0.0025).",
        f"These effects close 80 % of the gap on held-out repeats; 0.6 % of the peak remains unexplained. {AS_WELL}",
    ]),
    "light": (disagree(light=learned(), law=NO_LAW, gap=closed(0.97)), "named", [
        DISAGREE,
        LOBES,
        f"The learned shape closes 97 % of the gap on held-out repeats; {LITTLE} No other effect is significant.",
    ]),
    "light and one": (disagree(light=learned(), effects=(BEND,), gap=closed(0.99)), "named", [
        DISAGREE,
        f"{LOBES} {BENDS}",
        f"These effects close 99 % of the gap on held-out repeats; {LITTLE} {AS_WELL}",
    ]),
    "pair": (disagree(effects=(PAIR,), gap=closed(0.98), advice=(SEPARATES,)), "ambiguous", [
        DISAGREE,
        f"{GHOSTLY}: these frames cannot separate them; the first is 10 times as likely.",
        f"The first closes 98 % of the gap on held-out repeats; {LITTLE}"
        " 12 frames at an exposure of 1.8 ms and 22.5° would separate them.",
    ]),
    "three": (disagree(effects=(CLIP, GHOST), gap=closed(0.9), advice=(SEPARATES,)), "ambiguous", [
        DISAGREE,
        f"{STOPS} {GHOSTLY}, or the spot's flanks are steeper (n > 1) or flatter (n < 1) than a Gaussian's"
        " (super_gaussian): these frames cannot separate them; the first is 10 times as likely.",
        f"These effects close 90 % of the gap on held-out repeats; {LITTLE}"
        " 12 frames at an exposure of 1.8 ms and 22.5° would separate ghost_reflection from scatter_halo.",
    ]),
    "unknown": (disagree(rms=0.021, unexplained=left(0.019)), "unknown", [
        "Model and measurement disagree by 2.1 % of the spot's peak (rms, p < 0.0001).",
        "No effect of the vocabulary explains it; p1 and p2 may be biased.",
        "The most significant residual is in row 96, column 120 at 0.4 ms. 1.9 % of the peak remains unexplained.",
    ]),
    "unknown noise": (disagree(rms=0.0004, law=NO_LAW, unexplained=left(0.0004)), "unknown", [
        HARDLY,
        "No effect of the vocabulary explains it.",
        "The most significant residual is in row 96, column 120 at 0.4 ms. Less than 0.2 % of the peak remains.",
    ]),
    "unknown, no test": (agree(unexplained=left(0.01), limits=()), "unknown", [
        "The overall test finds no disagreement (p = 0.32), but the residual exceeds the tolerance.",
        "No effect of the vocabulary explains it; p1 and p2 may be biased.",
        "1 % of the peak remains unexplained.",
    ]),
    "sheet": (disagree(effects=(CLIP,), gap=closed(0.98), law=NO_LAW, sensor=(GAIN, NOISE)), "named", [
        "The frames contradict the data sheet: the gain is 0.1321 ± 0.0010 DN/e-, not 0.1100 ± 0.0033 DN/e-."
        f" {DISAGREE}",
        STOPS,
        f"This effect closes 98 % of the gap on held-out repeats; {LITTLE} {AS_WELL}",
    ]),
    "sheet alone": (agree(limits=(), law=NO_LAW, sensor=(BLACK,)), "consistent", [
        "The frames contradict the data sheet: the black level is 10.800 ± 0.020 DN, not 12.00 ± 0.30 DN."
        " Otherwise, model and measurement agree within the noise (p = 0.32).",
    ]),
    "not assessed": (Findings(reason="there is no usable spot frame"), "not_assessed", [
        "Nothing could be tested: there is no usable spot frame."
    ]),
    "not converged": (disagree(has_converged=False, effects=(CLIP,), law=MOVED, gap=closed(0.9)), "not_converged", [
        DISAGREE,
        "No effect is named: the fits behind the effects did not converge.",
        "Exclude damaged frames (no in column keep of manifest.csv), and check gain, read noise and black level in"
        " instrument.yaml; then run the verdict again.",
    ]),
    "flats": (disagree(effects=(CLIP,), law=NO_LAW, levels=LEVELS, places=()), "named", [
        "The linear sensor model and the flats disagree by 5.5 % of the highest signal (rms, p < 0.0001).",
        STOPS,
        f"This effect was not tested on held-out frames. {AS_WELL} The gain K is 0.1234 ± 0.0005 DN/e- with this"
        " effect; a straight line up to 70 % of saturation gives 0.1310 ± 0.0020 DN/e-. The light scatters by 0.4 %"
        " from level to level.",
    ]),
}  # fmt: skip


def whole(kind: str) -> dict:
    """Return a verdict with its sentence."""
    document = compose_verdict(KINDS[kind][0], "small")
    return document | {"sentence": summarize_verdict(document)}


def summary(findings: Findings, **options: float) -> str:
    """Return the summary of findings."""
    return summarize_verdict(compose_verdict(findings, "small", **options))
