"""The page of effects, written from the effects' own files."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path

from spotcheck.model.effect import NEEDS, Context, Effect, Parameter, Place
from spotcheck.model.effects import built_in, vocabulary

# What happens at each place of the chain, in words.
PLACES = {
    Place.EXPOSURE: "sets the true exposure",
    Place.WIDTH: "sets the width p_b",
    Place.BRIGHTNESS: "multiplies the spot's light",
    Place.METRIC: "squeezes the coordinates of the shape",
    Place.PROFILE: "changes the exponent of the shape",
    Place.SHAPE: "adds a surface that is learned from frames, after the top hat",
    Place.BLUR: "averages shifted spots, after the top hat",
    Place.ADDED: "adds light to the blurred spot",
    Place.MODULATION: "multiplies all light so far",
    Place.PEDESTAL: "adds a pedestal: light, or DN beside the black level",
    Place.CHARGE: "adds electrons after the Poisson draw",
    Place.WELL: "limits the charge",
    Place.NOISE: "replaces the read noise",
    Place.RESPONSE: "bends the signal without black level",
    Place.DIGITAL: "cuts the faint end, before rounding",
    Place.SCATTER: "draws a random number or field of its own",
}
# What a bound may depend on, in the order of `Context`.
CONTEXT = (
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
[model/effects](../spotcheck/model/effects): do not edit. What each effect means exactly is told in its
file; how the places follow each other is in [model/chain.py](../spotcheck/model/chain.py).

A bound in words is set by the data: σ_g at the longest exposure [px], the brightest light (peak) and full scale [DN],
the crop's side [px], the shortest and the longest exposure [s], read noise [e-]. Directions are in degrees from +x
towards +y. A parameter marked *inner* is a constant of the form: it is fitted, and reported as part of the form.
"""

ADDING = """## Adding an effect

### In a file of your own

An effect is one Python file, wherever it lies, with a function and an `EFFECT`. Name it to a run:

    snakemake --cores 2 --config effects="[lab/vignetting.py]"

or under `effects:` in `config/config.yaml`. `spotcheck simulate` then draws it where `model.yaml` names it. In this
version effects from files are simulated, but the verdict does not search for them, and says so.
`vocabulary: {without: [names]}` leaves effects out, `{only: [names]}` all others. Every subcommand that
knows effects takes `--effects FILE …`, `--only NAME …` and `--without NAME …` to the same end;
`spotcheck effects --effects lab/vignetting.py --output page.md` writes this page with your effect on it. What is wrong
with a file is said in one sentence before anything is computed.

1. Choose the place in the chain; the comments of `Place` in [model/effect.py](../spotcheck/model/effect.py) say what
   the function gets and returns there. Parameters come by name, and `form` too where there are several forms.
2. Write the function on arrays that broadcast over views and points. Parameters come in the units that they declare;
   what the place hands in is in px, DN or e- and s, and `view.angle` in rad. `View` in
   [model/chain.py](../spotcheck/model/chain.py) says what it can look at.
3. List the parameters, strength first, each with unit, lowest and highest value (numbers, functions of the `Context`,
   or -np.inf and np.inf for a direction); `neutral` is the strength at which the effect vanishes, 0 unless said, and
   `negligible` how near to it a user would call it nothing;
   `starts` is where its fit begins.
4. Say in `needs` what a design must vary for it to show, in `contains` which effects are a special case of it, and in
   `always` whether a search tries it even where its starts promise nothing. Where keys of instrument.yaml can say the
   same, as the read noise can, `adopts` gives their values, which `spotcheck adopt` writes. `Effect` in
   [model/effect.py](../spotcheck/model/effect.py) explains every field.

This file is complete:
"""

SCATTERING = """### An effect that scatters

What has no mean of its own, but draws a number or a field anew for every frame or site, or once for the sensor, is at
`Place.SCATTER` and says in `Scatter(of, shared, component)` what it draws. `spotcheck simulate` draws it with the
function: factors have the mean 1, offsets and places the mean 0, and the first parameter is their rms. A fit does not
use the function: it tells the strength as the root of a variance component, and effects of one component look alike to
it. If two of them are in the vocabulary, both are answers; leave out what you know not to be there. For a laser that is
known to hop between modes:

    snakemake --cores 2 --config effects="[lab/mode_hopping.py]" vocabulary="{without: [power_fluctuation]}"
"""

IN_LIBRARY = """### In the library

The same file in `workflow/spotcheck/model/effects/`, with the next free `number`, is part of the vocabulary; no list
names it. Write this page anew with the command at its top, and add the effect to the cases of
`tests/library/effect_cases.py`, which hold every effect against the chain.
"""

MEAN = '''"""Vignetting: the light falls off from the frame's centre."""

import numpy as np

from spotcheck.model.effect import Effect, Parameter, Place


def falloff(view, *, a):
    """Factor 1 − a (r/100 px)², r from the frame's centre; never below 0."""
    r2 = (view.x - view.frame_x) ** 2 + (view.y - view.frame_y) ** 2
    return np.maximum(1 - a * r2 / 100**2, 0.0)


EFFECT = Effect(
    name="vignetting",
    sentence="the light falls off from the frame's centre",
    place=Place.MODULATION,
    parameters=(Parameter("a", "1", 0.0, 1.0),),
    starts=lambda c: [(0.01,)],
    function=falloff,
)
'''
SCATTER = '''"""Mode hopping: the laser jumps between two modes of different power."""

from spotcheck.model.effect import Effect, Parameter, Place, Scatter


def factor(rng, *, rms):
    """Factor on one frame's light: 1 − rms or 1 + rms, as often."""
    return 1 + rms * rng.choice((-1.0, 1.0))


EFFECT = Effect(
    name="mode_hopping",
    sentence="the laser jumps between two modes of different power",
    place=Place.SCATTER,
    parameters=(Parameter("rms", "1", 0.0, 1.0),),
    starts=lambda c: [(0.02,)],
    function=factor,
    scatter=Scatter("gain", "frame", "gain"),
    needs=("frames", "law"),
    # A brightness of each frame's own fits any law of the brightness.
    contains=(Place.EXPOSURE, Place.BRIGHTNESS),
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


def bound(end: float | Callable[[Context], float]) -> str:
    """A bound as a number, or in words where the data set it."""
    if not callable(end):
        return _text(end)
    try:
        return _text(end(Context(*map(_Words, CONTEXT))))  # type: ignore[arg-type]
    except TypeError:  # more than arithmetic
        return "set by the data"


def _row(parameter: Parameter, neutral: float | None, least: float | Callable[[Context], float]) -> str:
    notes = ["inner"] if parameter.inner else []
    if neutral is not None and not math.isnan(neutral):
        notes.append("vanishes at " + ("∞" if math.isinf(neutral) else _text(neutral)))
    if least:
        notes.append(f"what is nearer than {bound(least)} counts as none")
    cells = (f"`{parameter.name}`", parameter.unit, bound(parameter.low), bound(parameter.high), "; ".join(notes))
    return "| " + " | ".join(cells) + " |"


def _forms(effect: Effect) -> str:
    named = []
    for form in effect.forms:
        idle = effect.idle.get(form, ())
        named.append(f"`{form}`" + (f" (without {', '.join(idle)})" if idle else ""))
    return "Forms, of which the data choose: " + ", ".join(named) + "."


def section(effect: Effect) -> str:
    """One effect: its sentence, place, parameters and forms."""
    place = f"Place: {effect.place.value} ({PLACES[effect.place]})"
    if effect.scatter:
        place += f": {effect.scatter.of}, one for each {effect.scatter.shared}; variance component {effect.component}"
    notes = [place + "."]
    if effect.needs:
        notes.append(f"Shows only where there are: {', '.join(NEEDS[need] for need in effect.needs)}.")
    if effect.replaces:
        notes.append(f"Takes the place of {', '.join(effect.replaces)}.")
    if effect.contains:
        special = [own if isinstance(own, str) else f"every effect at the place {own.value}" for own in effect.contains]
        notes.append(f"Has as special cases: {', '.join(special)}.")
    if not effect.flats:
        notes.append("Shows in levels of flats and darks too.")
    if len(effect.forms) > 1:
        notes.append(_forms(effect))
    rows = [
        _row(p, None if k else effect.neutral, 0.0 if k else effect.negligible) for k, p in enumerate(effect.parameters)
    ]
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


def _chain(effects: Iterable[Effect]) -> str:
    known = list(effects)
    rows = []
    for place in Place:
        own = ", ".join(effect.name for effect in known if effect.place is place)
        rows.append(f"| {place.value} | {PLACES[place]} | {own or '–'} |")
    head = "| place, in the chain's order | what an effect there does | effects |"
    return "\n".join([head, "|---|---|---|", *rows, ""])


def page(effects: Iterable[Effect]) -> str:
    """The whole page in Markdown."""
    known = sorted(effects, key=lambda effect: effect.number)
    sections = [section(effect) for effect in known]
    mean, scatter = (f"```python\n{file}```\n" for file in (MEAN, SCATTER))
    return "\n".join([INTRODUCTION, _chain(known), *sections, ADDING, mean, SCATTERING, scatter, IN_LIBRARY])


def write(path: Path) -> int:
    """Write the page of the vocabulary; how many effects that is."""
    effects = vocabulary()
    # A page of the repository, not a result: without a sidecar of the run that wrote it.
    path.write_text(page(effects.values()), encoding="utf-8")
    return len(effects)
