"""Each frame and what the base model leaves of it, side by side."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from spotcheck.figures import style

COLUMNS = 3
# Residuals beyond this part of the peak have the colours' ends.
END = 0.1


class Seen(NamedTuple):
    """A frame [DN], row and column of its crop's corner, the crop's side [px], and the residual of the crop's blocks
    over the peak; None where nothing was fitted."""

    frame: np.ndarray
    corner: tuple[int, ...]
    side: int
    left: np.ndarray | None


def draw(seen: dict[str, Seen], path: Path) -> None:
    """Pairs of pictures by name: the frame with its crop on a logarithmic scale, the residual on one scale for all."""
    rows = -(-len(seen) // COLUMNS)
    with style.applied():
        figure = Figure(figsize=(11.5, 1.75 * rows + 0.3), layout="constrained")
        axes = figure.subplots(rows, 2 * COLUMNS, squeeze=False)
        for own in axes.flat:
            own.set_axis_off()
        drawn = None
        for k, (name, own) in enumerate(seen.items()):
            left, right = axes[k // COLUMNS, 2 * (k % COLUMNS) :][:2]
            left.imshow(np.log1p(own.frame.astype(float)), cmap=style.IMAGE_MAP)
            left.add_patch(Rectangle(own.corner[::-1], own.side, own.side, fill=False, edgecolor="white"))
            left.set_title(name)
            if own.left is None:
                right.text(0.5, 0.5, "not assessed", ha="center", va="center", transform=right.transAxes)
                continue
            drawn = right.imshow(100 * own.left, cmap=style.DIVERGING_MAP, vmin=-100 * END, vmax=100 * END)
            right.set_title("measured − base model")
        if drawn is not None:
            figure.colorbar(drawn, ax=axes, label="residual [% of the peak]", shrink=0.6)
        figure.savefig(path, dpi=110, metadata={"Software": None})
