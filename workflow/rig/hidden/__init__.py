"""Blind test datasets: the contract's baseline model with hidden effects, or none, and the truth kept apart.

Written from the dataset contract alone. Nothing here is shared with the analysis library, nor with the rest of the rig
but its image files.

    names, designs, kinds    what can be asked for
    base                     the baseline's numbers and the data sheet
    effect, world            hooks of an effect; the chain of light: shape, top hat, blur, effects on light
    laws, shapes, lights, sensors    the vocabulary, by what an effect acts on; each docstring says how it is read
    oddities, faults         mechanisms outside the vocabulary
    expose; moments          the chain of the sensor, drawn; the same in mean and variance (clips: clipping)
    strength                 Fisher signal-to-noise after a refit of the baseline; the strength that reaches a target
    case, files              a case of a seed; its folder and its truth
"""

from rig.hidden.case import Case, blocked, draw_case, frames, with_more
from rig.hidden.designs import DESIGNS
from rig.hidden.files import write
from rig.hidden.kinds import possible
from rig.hidden.names import EFFECTS
from rig.hidden.registry import OUTSIDERS

OUTSIDE = tuple(OUTSIDERS)

__all__ = ["DESIGNS", "EFFECTS", "OUTSIDE", "Case", "blocked", "draw_case", "frames", "possible", "with_more", "write"]
