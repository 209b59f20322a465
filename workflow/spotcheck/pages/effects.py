"""The page of effects, written from the effects' own files."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path

from spotcheck.model.effect import Context, Effect, Parameter, Place
from spotcheck.model.effects import vocabulary

# What happens at each place of the chain, in words.
PLACES = {
    Place.EXPOSURE: "sets the true exposure",
    Place.WIDTH: "sets the width p_b",
    Place.BRIGHTNESS: "multiplies the spot's light",
    Place.METRIC: "squeezes the coordinates of the shape",
    Place.PROFILE: "changes the exponent of the shape",
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
CONTEXT = ("σ_g", "peak", "full scale", "crop", "shortest exposure", "read noise", "K", "power of t nearest to p1, p2")

# What a design must vary, in words; others stand as they are.
NEEDS = {
    "exposure": "several exposures",
    "angle": "several angles",
    "order": "a known order of acquisition",
    "frames": "several frames of a condition",
    "sites": "several sites",
    "law": "a law of the light in exposure",
}

INTRODUCTION = """# The vocabulary of effects

Written by `spotcheck effects --output workflow/docs/effects.md` from the files in
[model/effects](../spotcheck/model/effects): do not edit. What each effect means exactly is told in its
file; how the places follow each other is in [model/chain.py](../spotcheck/model/chain.py).

A bound in words is set by the data: σ_g at the longest exposure [px], the brightest light (peak) and full scale [DN],
the crop's side [px], the shortest exposure [s], read noise [e-]. Directions are in degrees from +x towards +y. A
parameter marked *inner* is a constant of the form: it is fitted, and reported as part of the form.
"""

ADDING = """## Adding an effect

One file in `workflow/spotcheck/model/effects/` is enough; no list in the library names it. It holds
a function and an `EFFECT`:

1. Choose the place in the chain; the comments of `Place` in [model/effect.py](../spotcheck/model/effect.py) say what
   the function gets and returns there. Parameters come by name, and `form` too where there are several forms.
2. Write the function on arrays that broadcast over views and points, in px, DN (or e-), s and rad; `View` in
   [model/chain.py](../spotcheck/model/chain.py) says what it can look at.
3. List the parameters, strength first, each with unit, lowest and highest value (numbers, or functions of the
   `Context`); `neutral` is the strength at which the effect vanishes, 0 unless said; `starts` is where its fit begins.
4. Say in `needs` what a design must vary for it to show, and write this page anew with the command above.

The file below is complete: as `vignetting.py` in that folder it is found, fitted and listed here.
"""

EXAMPLE = '''"""Vignetting: the light falls off from the frame's centre."""

import numpy as np

from spotcheck.model.effect import Effect, Parameter, Place


def falloff(view, *, a):
    """Factor 1 − a (r/100 px)², r from the frame's centre; never below 0."""
    r2 = (view.x - view.frame_x) ** 2 + (view.y - view.frame_y) ** 2
    return np.maximum(1 - a * r2 / 100**2, 0.0)


EFFECT = Effect(
    number=25,
    name="vignetting",
    sentence="the light falls off from the frame's centre",
    place=Place.MODULATION,
    parameters=(Parameter("a", "1", 0.0, 1.0),),
    starts=lambda c: [(0.01,)],
    function=falloff,
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


def _row(parameter: Parameter, neutral: float | None) -> str:
    notes = ["inner"] if parameter.inner else []
    if neutral is not None and not math.isnan(neutral):
        notes.append("vanishes at " + ("∞" if math.isinf(neutral) else _text(neutral)))
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
        place += f": {effect.scatter.of}, one for each {effect.scatter.shared}"
    notes = [place + "."]
    if effect.needs:
        notes.append(f"Shows only where there are: {', '.join(NEEDS.get(need, need) for need in effect.needs)}.")
    if effect.replaces:
        notes.append(f"Takes the place of {', '.join(effect.replaces)}.")
    if len(effect.forms) > 1:
        notes.append(_forms(effect))
    rows = [_row(p, None if k else effect.neutral) for k, p in enumerate(effect.parameters)]
    return "\n".join(
        [
            f"## {effect.number}. [{effect.name}](../spotcheck/model/effects/{effect.name}.py)",
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
    return "\n".join([INTRODUCTION, _chain(known), *sections, ADDING, f"```python\n{EXAMPLE}```", ""])


def write(path: Path) -> int:
    """Write the page of all effects that there are; how many that is."""
    effects = vocabulary()
    # A page of the repository, not a result: without a sidecar of the run that wrote it.
    path.write_text(page(effects.values()), encoding="utf-8")
    return len(effects)
