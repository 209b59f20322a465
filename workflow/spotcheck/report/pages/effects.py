"""The page of effects, written from the effects' own files."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path

from spotcheck.model.effect import Effect, EffectScales, Parameter, RandomStep
from spotcheck.model.effects import built_in, vocabulary
from spotcheck.model.stage import Stage

# What a bound may depend on, in the order of `EffectScales`.
SCALES = (
    "σ_g",
    "peak",
    "full scale",
    "crop",
    "shortest exposure",
    "read noise",
    "K",
    "power of t nearest to p1, p2",
    "longest exposure",
)

INTRODUCTION = """# The vocabulary of effects

Written by `spotcheck effects --output workflow/docs/effects.md` from the files in
[model/effects](../spotcheck/model/effects): do not edit. The file of an effect says exactly what it does.
[model/stage.py](../spotcheck/model/stage.py) says what the functions of each stage get and return.

Some bounds derive from the data: from σ_g at the longest exposure [px], the brightest light (peak) and full scale [DN],
the side of the crops [px], the shortest and the longest exposure [s], and the read noise [e-]. Directions are in
degrees from +x towards +y. A parameter of the *variant* is a constant of it: it is fitted, and reported with it.
"""

ADDING = """## Adding an effect

### In a file of your own

An effect is one Python file, wherever it lies, with functions and an `EFFECT`. Name it to a run:

    snakemake --cores 2 --config effects="[lab/vignetting.py]"

or under `effects:` in `config/config.yaml`. The verdict then searches for it as for the others, and says in
`vocabulary` which file it came from. `spotcheck simulate` draws it where `model.yaml` names it.
`vocabulary: {without: [names]}` leaves effects out, `{only: [names]}` all others. Every subcommand that
knows effects takes `--effects FILE …`, `--only NAME …` and `--without NAME …` to the same end;
`spotcheck effects --effects lab/vignetting.py --output page.md` writes this page with your effect on it. A fault in a
file is reported in one sentence before anything is computed.

1. Choose the stage of the chain. The table above says what a function gets there and what it returns. Means go in and
   means come out; functions of the sensor's stages never decrease.
2. Write the function on arrays that broadcast over rows and columns. Parameters come by name, in the units that they
   declare; what the stage hands in is in px, DN, e- and s, and `frame.angle` in rad. `FrameConditions` in
   [model/conditions.py](../spotcheck/model/conditions.py) says what a frame holds.
3. List the parameters, strength first, each with unit, lowest and highest value (numbers, functions of the
   `EffectScales`, or -np.inf and np.inf for a direction) and the `negligible` size. `vanishes_at` is the strength at
   which the effect vanishes, 0 unless stated; `starts` gives starting values for a fit.
4. State the attributes that other code needs: `needs` says what a design must vary, `law_of` whether it is a law of
   brightness or width, `is_static_shape` and `acts_on_noise` what it changes, `special_cases` which effects are special
   cases of it. If keys of instrument.yaml can describe the effect, `instrument_keys` gives their values, which
   `spotcheck adopt` writes. `Effect` in [model/effect.py](../spotcheck/model/effect.py) explains every attribute.

This file is complete:
"""

RANDOM = """### An effect that is random

A `RandomStep` draws a number or a field anew for every frame or site, or once for the sensor, and hands it to its
function as the last argument. `draw` gives what `spotcheck simulate` uses. `quadrature` gives values and weights that
average over it, from which the model computes mean and variance of readings. A file whose draws and quadrature disagree
is refused.
"""

IN_LIBRARY = """### In the library

The same file in `workflow/spotcheck/model/effects/`, with the next free `number`, is part of the vocabulary; no list
names it. Write this page anew with the command at its top, and add the effect to the cases of
`tests/library/effect_cases.py`, which hold every effect against the dataset contract.
"""

MEAN_EXAMPLE = '''"""Vignetting: the light falls off from the frame's centre."""

import numpy as np

from spotcheck.model.effect import Effect, Only, Parameter, Stage, Step


def fall_off(frame, light_dn, *, a):
    """Return the light [DN] times 1 − a (r/100 px)², r from the frame's centre; never below 0."""
    pixels = frame.pixels
    r2 = (pixels.x - pixels.centre_x) ** 2 + (pixels.y - pixels.centre_y) ** 2
    return light_dn * np.maximum(1 - a * r2 / 100**2, 0.0)


EFFECT = Effect(
    name="vignetting",
    sentence="the light falls off from the frame's centre",
    parameters=(Parameter("a", "1", 0.0, 1.0),),
    variants={Only.ONLY: (Step(Stage.MODULATION, fall_off),)},
    starts=lambda scales: [(0.01,)],
)
'''
RANDOM_EXAMPLE = '''"""Mode hopping: the laser jumps between two modes of different power."""

import numpy as np

from spotcheck.model.effect import Effect, Need, Only, Parameter, RandomStep, Scope, Stage


def multiply(frame, peak_dn, factor):
    """Return the peak [DN] times a factor."""
    return peak_dn * factor


def draw_mode(rng, shape, *, rms):
    """Return the factor of one frame: 1 − rms or 1 + rms, with equal probability."""
    return 1 + rms * rng.choice((-1.0, 1.0))


def average_modes(*, rms):
    """Return both factors and their weights."""
    return np.array([1 - rms, 1 + rms]), np.array([0.5, 0.5])


EFFECT = Effect(
    name="mode_hopping",
    sentence="the laser jumps between two modes of different power",
    parameters=(Parameter("rms", "1", 0.0, 1.0),),
    variants={Only.ONLY: (RandomStep(Stage.BRIGHTNESS, multiply, Scope.FRAME, draw_mode, average_modes),)},
    starts=lambda scales: [(0.02,)],
    needs=(Need.FRAMES, Need.LAW),
)
'''


class _Words:
    """A quantity that is not known yet: arithmetic on it writes itself down."""

    def __init__(self, text: str, is_sum: bool = False):
        self.text, self.is_sum = text, is_sum

    def _join(self, sign: str, other, swapped: bool = False) -> "_Words":
        left, right = (other, self) if swapped else (self, other)
        tight = sign in "×/"
        return _Words(f"{_text(left, tight)} {sign} {_text(right, tight or sign == '−')}", not tight)

    def __mul__(self, other):
        return self._join("×", other)

    def __rmul__(self, other):
        return self._join("×", other, swapped=True)

    def __truediv__(self, other):
        return self._join("/", other)

    def __rtruediv__(self, other):
        return self._join("/", other, swapped=True)

    def __add__(self, other):
        return self._join("+", other)

    def __radd__(self, other):
        return self._join("+", other, swapped=True)

    def __sub__(self, other):
        return self._join("−", other)

    def __rsub__(self, other):
        return self._join("−", other, swapped=True)

    def __neg__(self):
        return _Words(f"−{_text(self, True)}")


def _text(value, in_product: bool = False) -> str:
    if isinstance(value, _Words):
        return f"({value.text})" if value.is_sum and in_product else value.text
    if math.isinf(value):
        return "any"
    return f"{value:.12g}".replace("-", "−")


def bound(end: float | Callable[[EffectScales], float]) -> str:
    """A bound as a number, or in words where the data set it."""
    if not callable(end):
        return _text(end)
    try:
        return _text(end(EffectScales(*map(_Words, SCALES))))  # type: ignore[arg-type]
    except TypeError:  # more than arithmetic
        return "set by the data"


def _row(parameter: Parameter, vanishes_at: float | None) -> str:
    notes = ["of the variant"] if parameter.is_variant_specific else []
    if vanishes_at is not None and not math.isnan(vanishes_at):
        notes.append("vanishes at " + ("∞" if math.isinf(vanishes_at) else _text(vanishes_at)))
    if parameter.negligible:
        notes.append(f"negligible if nearer than {bound(parameter.negligible)}")
    cells = (f"`{parameter.name}`", parameter.unit, bound(parameter.low), bound(parameter.high), "; ".join(notes))
    return "| " + " | ".join(cells) + " |"


def _stages(effect: Effect) -> str:
    """Return the stages at which an effect acts, and what it draws there."""
    if not effect.stages:
        return "Stage: profile (the baseline holds the learned shape)."
    texts = {}
    for stage in effect.stages:
        steps = [step for variant in effect.variants.values() for step in variant if step.stage is stage]
        scopes = {step.scope.value for step in steps if isinstance(step, RandomStep)}
        drawn = f", drawn for each {' and '.join(sorted(scopes))}" if scopes else ""
        some = " in some variants" if drawn and not all(isinstance(step, RandomStep) for step in steps) else ""
        texts[stage] = f"{stage.title} ({stage.value.action}{drawn}{some})"
    return "Stage: " + "; ".join(texts[stage] for stage in effect.stages) + "."


def section(effect: Effect) -> str:
    """Return the section of one effect: its sentence, stages, parameters and variants."""
    notes = [_stages(effect)]
    if effect.needs:
        notes.append(f"Shows only where there are: {', '.join(need.value for need in effect.needs)}.")
    if effect.replaces:
        notes.append(f"Takes the place of {', '.join(effect.replaces)}.")
    if effect.special_cases:
        notes.append(f"Special cases: {', '.join(map(_special_case, effect.special_cases))}.")
    if not effect.hidden_in_flats:
        notes.append("Shows in levels of flats and darks too.")
    if len(effect.variants) > 1:
        texts = []
        for variant in effect.variants:
            present = effect.parameters_of(variant)
            unused = [parameter.name for parameter in effect.parameters if parameter not in present]
            texts.append(f"`{variant.value}`" + (f" (without {', '.join(unused)})" if unused else ""))
        notes.append(f"Variants: {', '.join(texts)}.")
    if effect.reference:
        notes.append(f"Reference: {effect.reference}.")
    rows = [_row(parameter, None if k else effect.vanishes_at) for k, parameter in enumerate(effect.parameters)]
    title = (
        f"[{effect.name}](../spotcheck/model/effects/{effect.name}.py)" if effect.name in built_in() else effect.name
    )
    return "\n".join(
        [
            f"## {effect.number}. {title}",
            "",
            f"{effect.sentence[0].upper()}{effect.sentence[1:]}.",
            "",
            "  \n".join(notes),
            "",
            "| parameter | unit | lowest | highest | |",
            "|---|---|---|---|---|",
            *rows,
            "",
        ]
    )


def _special_case(name: str) -> str:
    return name if name in vocabulary() else f"every law of the {name}"


def _chain(effects: Iterable[Effect]) -> str:
    """Return the table of stages: what functions get and return, and which effects act there."""
    known = list(effects)
    rows = []
    for stage in Stage:
        description = stage.value
        names = ", ".join(effect.name for effect in known if stage in effect.stages)
        arguments = ", ".join(f"`{argument}`" for argument in description.arguments.split(", "))
        rows.append(f"| {stage.title} | {arguments} | {description.returns} | {names or '–'} |")
    head = "| stage, in the order of the chain | a function gets | and returns | effects |"
    return "\n".join([head, "|---|---|---|---|", *rows, ""])


def page(effects: Iterable[Effect]) -> str:
    """Return the whole page in Markdown."""
    known = sorted(effects, key=lambda effect: effect.number)
    sections = [section(effect) for effect in known]
    mean, random = (f"```python\n{file}```\n" for file in (MEAN_EXAMPLE, RANDOM_EXAMPLE))
    return "\n".join([INTRODUCTION, _chain(known), *sections, ADDING, mean, RANDOM, random, IN_LIBRARY])


def write(path: Path) -> int:
    """Write the page of the vocabulary and return the number of effects."""
    effects = vocabulary()
    # A page of the repository, not a result: without a sidecar of the run that wrote it.
    path.write_text(page(effects.values()), encoding="utf-8")
    return len(effects)
