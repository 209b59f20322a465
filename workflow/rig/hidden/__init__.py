"""Blind test datasets: the contract's baseline model with a hidden effect, or none, and the truth kept apart.

Written from the dataset contract alone. Nothing here is shared with the analysis library, nor with the rest of the rig
but its image files.

    designs, base            grids of conditions; the baseline's numbers and the data sheet
    effect, world            hooks of an effect; the light of a frame: shape, top hat, blur, effects on light
    laws, shapes, lights, sensors    the vocabulary, by what an effect acts on; each docstring says how it is read
    chain                    the chain of the sensor, drawn, and in mean and variance (clips: clipping)
    strength                 Fisher signal-to-noise after a refit of the baseline; the strength that reaches a target
    case                     a case of a seed, its folder and its truth
"""

from rig.hidden.case import Case, draw_case, frames, write
from rig.hidden.designs import DESIGNS
from rig.hidden.registry import VOCABULARY

EFFECTS = tuple(VOCABULARY)

__all__ = ["DESIGNS", "EFFECTS", "Case", "draw_case", "frames", "write"]
