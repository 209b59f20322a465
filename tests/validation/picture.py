"""The confusion matrix: what was put in, downwards; what was named first, across."""

from collections import Counter
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from rig import hidden


def draw(confusion: dict[str, Counter], path: Path) -> None:
    """Shares of a row as shades of blue, counts in the cells; what is right has a frame."""
    rows = [name for name, found in confusion.items() if found]
    columns = ["consistent", *hidden.EFFECTS, "unknown", "not_assessed", "error"]
    count = np.array([[confusion[row][column] for column in columns] for row in rows], float).reshape(len(rows), -1)
    share = count / np.maximum(count.sum(axis=1, keepdims=True), 1)
    figure = Figure(figsize=(11.5, 2.6 + 0.245 * max(len(rows), 1)), layout="constrained")
    axes = figure.subplots()
    if rows:
        axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for y, row in enumerate(rows):
        for x, column in enumerate(columns):
            if count[y, x]:
                colour = "white" if share[y, x] > 0.6 else "black"
                axes.text(x, y, f"{count[y, x]:.0f}", ha="center", va="center", fontsize=7.5, color=colour)
            if column == _right(row):
                at = (x - 0.5, y - 0.5)
                axes.add_patch(Rectangle(at, 1, 1, fill=False, edgecolor="#D55E00", linewidth=1.3, zorder=3))
    axes.set_xticks(range(len(columns)), [c.replace("_", " ") for c in columns], rotation=60, ha="right", fontsize=8)
    axes.set_yticks(range(len(rows)), [r.replace("_", " ") for r in rows], fontsize=8)
    axes.set_xticks(np.arange(len(columns) + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(rows) + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="0.88", linewidth=0.6)
    axes.tick_params(which="both", length=0)
    axes.set_xlabel("first name of the verdict, or its status where nothing is named")
    axes.set_ylabel("what was hidden, strong; in brackets: outside the vocabulary")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150, metadata={"Software": None})


def _right(row: str) -> str:
    return "consistent" if row == "none" else "unknown" if row.startswith("(") else row
