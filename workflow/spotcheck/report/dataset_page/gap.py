"""The gap on held-out data before and after effects were added to the model, as bars with a line at the noise floor.

The gap is the mean square of block residuals over that of their noise [1]. The noise floor is its value for a complete
model. The verdict (verdict.json) may add effects or a learned light shape to the declared model, which closes a part of
the gap.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from spotcheck.discrepancy.words import over_noise_text, percent_text
from spotcheck.report.pages.plots import figure_json

# (name, colour of page.css) of each number of the gap, by its key in verdict.json. For a verdict that adds nothing to
# the model, there is no number after, and the one before has another name.
LABELS = {"before": ("before", "simulated"), "after": ("after", "measured"), "noise_floor": ("noise floor", "ink")}
LABELS_WITHOUT_ADDITION = {"before": ("residuals", "simulated"), "noise_floor": LABELS["noise_floor"]}


class GapNumber(NamedTuple):
    """A number of the gap: mean square of block residuals over that of the noise."""

    name: str  # name on the page
    colour: str  # name of its colour in page.css
    text: str  # the number [1]
    key: str  # full name of the number for `spotcheck explain`


class Gap(NamedTuple):
    """The gap for the page."""

    figure: str  # the bars, as JSON for Plotly
    numbers: list[GapNumber]  # gap before and after, and noise floor; unknown numbers are missing
    closed: str  # share of the gap that the added effects close, in per cent; "" if they close none
    on: str  # the held-out data on which the gap was measured, in words

    @property
    def alt(self) -> str:
        """Alternative text of the figure."""
        numbers = ", ".join(f"{number.name} {number.text}" for number in self.numbers)
        return f"Gap on {self.on}, mean square of block residuals over that of the noise: {numbers}."


def plot_gap(verdict: dict[str, Any]) -> Gap | None:
    """Return the gap for the page; None if it was not measured. `verdict` is the content of verdict.json."""
    gap = verdict["gap"]
    if gap["before"] is None:
        return None
    has_additions = adds_to_model(verdict)
    labels = LABELS if has_additions else LABELS_WITHOUT_ADDITION
    known_labels = {key: label for key, label in labels.items() if gap[key] is not None}
    numbers = [
        GapNumber(name, colour, over_noise_text(gap[key]), f"verdict.gap.{key}")
        for key, (name, colour) in known_labels.items()
    ]
    is_closed = has_additions and gap["closed"] is not None and gap["closed"] > 0
    # Noise may raise the closed share above 1.
    closed = percent_text(min(gap["closed"], 1.0)) if is_closed else ""
    return Gap(_draw_bars(gap, known_labels), numbers, closed, str(gap["on"]))


def adds_to_model(verdict: dict[str, Any]) -> bool:
    """Return whether the verdict adds effects or a learned light shape to the declared model."""
    return bool(verdict["effects"]) or verdict["light"] is not None


def _draw_bars(gap: Mapping[str, Any], labels: Mapping[str, tuple[str, str]]) -> str:
    """Return a figure of overlaid bars of the gap and a line at the noise floor, as JSON for Plotly.

    `gap` is the entry `gap` of verdict.json; `labels` has (name, colour) of each known number by its key.
    """
    bars = []
    for key, width in (("before", 0.9), ("after", 0.5)):
        if key in labels:
            name, colour = labels[key]
            trace = {"type": "bar", "orientation": "h", "name": name, "x": [gap[key]], "y": ["gap"], "width": width}
            trace["hovertemplate"] = f"{name}: %{{x:.4~g}}<extra></extra>"
            bars.append(trace | {"marker": {"color": f"var(--{colour})"}})
    floor = gap["noise_floor"]
    line = {"type": "line", "x0": floor, "x1": floor, "y0": 0, "y1": 1, "yref": "paper"}
    line["line"] = {"color": "var(--ink)", "width": 2, "dash": "dot"}
    title = {"text": "mean square of block residuals / noise", "standoff": 2}
    layout = {
        "barmode": "overlay",
        "shapes": [] if floor is None else [line],
        "showlegend": False,
        "margin": {"l": 4, "r": 12, "t": 2, "b": 34},
        "xaxis": {"rangemode": "tozero", "nticks": 8, "title": title},
        "yaxis": {"visible": False, "fixedrange": True},
    }
    return figure_json(bars, layout)
