"""The gap on held-out data before and after as one bar, with the noise floor."""

from typing import Any, NamedTuple

from spotcheck.discrepancy.words import over_noise_text, percent_text
from spotcheck.report.pages.plots import figure

# Keys of verdict.json's gap: what each is called, and the colour of page.css in which it is drawn.
SHOWN = {
    "before": ("before", "simulated"),
    "after": ("after", "measured"),
    "noise_floor": ("noise floor", "ink"),
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
    # Where nothing was added there is no before and after.
    added = was_added(verdict)
    shown = SHOWN if added else {"before": ("residuals", "simulated"), "noise_floor": SHOWN["noise_floor"]}
    numbers = [
        (name, colour, over_noise_text(own[key]), f"verdict.gap.{key}")
        for key, (name, colour) in shown.items()
        if own[key] is not None
    ]
    is_closed = added and own["closed"] is not None and own["closed"] > 0
    closed = percent_text(min(own["closed"], 1.0)) if is_closed else ""
    told = ", ".join(f"{name} {text}" for name, _, text, _ in numbers)
    alt = f"Gap on {own['on']}, mean square of block residuals over that of the noise: {told}."
    return Gap(_figure(own, shown), alt, numbers, closed, str(own["on"]))


def was_added(verdict: dict[str, Any]) -> bool:
    """Whether the verdict adds anything to the declared model: effects, or a learned shape of the light."""
    return bool(verdict["effects"]) or verdict["light"] is not None


def _figure(own: dict[str, Any], shown: dict[str, tuple[str, str]]) -> str:
    bars = [
        _bar(*shown[key], own[key], height)
        for key, height in (("before", 0.9), ("after", 0.5))
        if key in shown and own[key] is not None
    ]
    floor = own["noise_floor"]
    mark = {"type": "line", "x0": floor, "x1": floor, "y0": 0, "y1": 1, "yref": "paper",
            "line": {"color": "var(--ink)", "width": 2, "dash": "dot"}}  # fmt: skip
    layout = {
        "barmode": "overlay",
        "shapes": [] if floor is None else [mark],
        "showlegend": False,
        "margin": {"l": 4, "r": 12, "t": 2, "b": 34},
        "xaxis": {
            "rangemode": "tozero",
            "nticks": 8,
            "title": {"text": "mean square of block residuals / noise", "standoff": 2},
        },
        "yaxis": {"visible": False, "fixedrange": True},
    }
    return figure(bars, layout)


def _bar(words: str, colour: str, value: float, height: float) -> dict[str, Any]:
    return {
        "type": "bar",
        "orientation": "h",
        "name": words,
        "x": [value],
        "y": ["gap"],
        "width": height,
        "marker": {"color": f"var(--{colour})"},
        "hovertemplate": f"{words}: %{{x:.4~g}}<extra></extra>",
    }
