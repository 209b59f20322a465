"""What is made, to look at: every beam, and what every effect and mechanism changes in a frame of it.

`python -m tests.validation.generators.light.picture FOLDER` draws beams.png and changes.png.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from tests.validation.generators.light import beams
from tests.validation.generators.light.case import draw_case
from tests.validation.generators.light.draw import hide
from tests.validation.generators.light.moments import moments
from tests.validation.generators.light.outside import MECHANISMS
from tests.validation.generators.second.effects import VOCABULARY

COLUMNS = 9
# Ends of the colours of what a beam is off by, in peaks.
OFF = 0.15
# Multiple of the bound, and seed of the set that is drawn.
LEVEL, SEED = 50.0, 12


def draw_beams(path: Path) -> None:
    """Every real beam and four draws of each kind of drawn one; below each what it is off a Gaussian."""
    found = [beams.real(name) for name in beams.real_names()] if beams.there() else []
    found += [beams.drawn(kind, np.random.default_rng([seed, 5])) for kind in beams.DRAWN for seed in range(4)]
    axis = np.arange(-5, 5.01, 0.05)
    gauss = np.exp(-(axis[None, :] ** 2 + axis[:, None] ** 2) / 2)
    tall = -(-len(found) // COLUMNS)
    figure = Figure(figsize=(1.5 * COLUMNS, 3 * tall), layout="constrained")
    axes = figure.subplots(2 * tall, COLUMNS, squeeze=False)
    for own in axes.flat:
        own.set_axis_off()
    for k, beam in enumerate(found):
        values = beam(axis[None, :], axis[:, None])
        above, under = axes[2 * (k // COLUMNS), k % COLUMNS], axes[2 * (k // COLUMNS) + 1, k % COLUMNS]
        above.imshow(values, vmin=0, vmax=1.1)
        above.set_title(f"{beam.name.split('/')[-1]} {100 * beam.off:.1f} %", fontsize=8)
        under.imshow(values - gauss, vmin=-OFF, vmax=OFF, cmap="RdBu_r")
    figure.savefig(path, dpi=70)


def draw_changes(path: Path) -> None:
    """What every effect changes in the mean of a site's frame, that which it changes most; in the noise where the mean
    stays."""
    names = [*VOCABULARY, *(f"outside:{name}" for name in MECHANISMS)]
    tall = -(-len(names) // COLUMNS)
    figure = Figure(figsize=(1.6 * COLUMNS, 1.8 * tall), layout="constrained")
    axes = figure.subplots(tall, COLUMNS, squeeze=False)
    for own in axes.flat:
        own.set_axis_off()
    for k, name in enumerate(names):
        case = draw_case(SEED, "default", "real" if beams.there() else "drawn", [name])
        (truth,) = hide(case, [name], LEVEL)
        frames = truth["form"].get("frames")
        looked = frames[:1] if isinstance(frames, list) else range(40, 46)
        found = [(moments(case, i), moments(case.only(), i)) for i in looked]
        change = max((own.mean - base.mean for own, base in found), key=lambda own: np.abs(own).max())
        of = "DN"
        if np.abs(change).max() < 1e-6:
            change, of = np.sqrt(found[0][0].variance) - np.sqrt(found[0][1].variance), "DN of noise"
        end = max(float(np.quantile(np.abs(change), 0.999)), 1e-3)
        axes[k // COLUMNS, k % COLUMNS].imshow(change, vmin=-end, vmax=end, cmap="RdBu_r")
        axes[k // COLUMNS, k % COLUMNS].set_title(f"{name.removeprefix('outside:')}\n±{end:.2g} {of}", fontsize=7)
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    draw_beams(Path(sys.argv[1], "beams.png"))
    draw_changes(Path(sys.argv[1], "changes.png"))
