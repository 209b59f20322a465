"""The gap before and after as one bar, with the noise floor."""

from typing import Any, NamedTuple

from spotcheck.discrepancy.verdict.words import percent_text
from spotcheck.pages.plots import figure

# Keys of verdict.json's gap: what each is called, and the colour of page.css in which it is drawn.
SHOWN = {
    "before": ("before", "simulated"),
    "after": ("after", "measured"),
    "noise_floor": ("noise alone", "ink"),
}


class Gap(NamedTuple):
    """The bar, what it shows in words, its numbers (name, colour, text, key), the part that is closed, and on what."""

    figure: str
    alt: str
    numbers: list[tuple[str, str, str, str]]
    closed: str
    on: str


def gap_of(verdict: dict[str, Any]) -> Gap | None:
    """The gap of a verdict; None where none was measured."""
    own = verdict["gap"]
    if own["before"] is None:
        return None
    numbers = [
        (name, colour, f"{own[key]:.3g}", f"verdict.gap.{key}")
        for key, (name, colour) in SHOWN.items()
        if own[key] is not None
    ]
    closed = "" if own["closed"] is None or own["closed"] <= 0 else percent_text(min(own["closed"], 1.0))
    told = ", ".join(f"{name} {text}" for name, _, text, _ in numbers)
    alt = f"What is left on {own['on']}, rms of residuals over their noise: {told}."
    return Gap(_figure(own), alt, numbers, closed, str(own["on"]))


def _figure(own: dict[str, Any]) -> str:
    bars = [
        _bar(name, own[name], height) for name, height in (("before", 0.9), ("after", 0.5)) if own[name] is not None
    ]
    floor = own["noise_floor"]
    mark = {"type": "line", "x0": floor, "x1": floor, "y0": 0, "y1": 1, "yref": "paper",
            "line": {"color": "var(--ink)", "width": 2, "dash": "dot"}}  # fmt: skip
    layout = {
        "barmode": "overlay",
        "shapes": [] if floor is None else [mark],
        "showlegend": False,
        "margin": {"l": 4, "r": 12, "t": 2, "b": 34},
        "xaxis": {"rangemode": "tozero", "nticks": 8, "title": {"text": "rms of residuals / noise σ", "standoff": 2}},
        "yaxis": {"visible": False, "fixedrange": True},
    }
    return figure(bars, layout)


def _bar(name: str, value: float, height: float) -> dict[str, Any]:
    words, colour = SHOWN[name]
    return {
        "type": "bar",
        "orientation": "h",
        "name": words,
        "x": [value],
        "y": ["gap"],
        "width": height,
        "marker": {"color": f"var(--{colour})"},
        "hovertemplate": f"{words}: %{{x:.4~g}} noise σ<extra></extra>",
    }
