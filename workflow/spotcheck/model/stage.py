"""The stages between laser and reading, in the order in which they act (dataset contract, "Exact meaning").

An effect is a deviation from the baseline model; it consists of functions that act at stages. p_b is the beam
propagation, the width of the spot without the laser's own.
"""

from dataclasses import dataclass
from enum import Enum


@dataclass(frozen=True)
class StageDescription:
    """Arguments and result of the functions that effects have at a stage."""

    arguments: str  # arguments of a function, in this order; parameters of the effect follow by name
    returns: str  # result of a function, with its unit
    action: str  # action of an effect at the stage, as a predicate: "ghost_reflection blurs or copies the spot"


class Stage(Enum):
    """A stage of the chain from laser to reading. Members are in the order in which they act.

    Functions up to the smear act on expected values. Those of the sensor act on the signal of a pixel with its noise
    (well, response, digital), on a variance (read noise) or on an offset (black level, row noise). The function of a
    `RandomStep` gets the number or field that was drawn as one more argument. Functions of several effects at a stage
    act one after another, each on the result of the previous one. Only blurs are convolved with each other, and smears
    are added.

    `frame` is a `FrameConditions` and `spot` a `SpotState`. Light is in DN: gain K times the mean electrons. Lengths
    are in px of the sensor.
    """

    EXPOSURE = StageDescription("frame, exposure_s", "true exposure [s] of light and dark current", "sets the exposure")
    WIDTH = StageDescription("frame, width", "`WidthLaw`: p_b [px] over the exposure", "changes the width of the spot")
    BRIGHTNESS = StageDescription("frame, peak_dn", "peak of the spot [DN]", "changes the brightness of the spot")
    # dx, dy are the displacements of a pixel from the centre of the spot. The light of a pixel is that of a round spot
    # at the returned displacements.
    COORDINATES = StageDescription("frame, dx, dy", "displacements on a round spot [px]", "stretches or moves the spot")
    # ρ is the distance from the centre of the round spot, in widths σ_g.
    PROFILE = StageDescription("frame, half_square", "E [1] of the profile exp(−E), from ρ²/2", "changes the profile")
    # `frame.exposure_s` is the true exposure here; elsewhere it is the nominal one.
    BLUR = StageDescription("frame", "dx, dy [px] and weights of copies [3, copy]", "blurs or copies the spot")
    ADDED_LIGHT = StageDescription("frame, light_dn, spot", "light of the spot [DN]", "adds light to the spot")
    MODULATION = StageDescription("frame, light_dn", "light of the spot [DN]", "modulates the light of the spot")
    # A random step here must multiply the light by its draw, as means over draws do not call its function.
    SPECKLE_FIELD = StageDescription("frame, light_dn", "light of the spot [DN]", "makes the light granular")
    PEDESTAL = StageDescription("frame, pedestal_dn", "all pedestals so far [DN]", "adds light under the spot")
    # Functions at this stage act on spot and pedestal separately. Like those at the modulation, they must be
    # proportional to the light.
    PIXEL_GAIN = StageDescription("frame, light_dn", "light that pixels convert [DN]", "changes the gains of pixels")
    CHARGE = StageDescription("frame, mean_e", "mean electrons of light and dark current [e-]", "changes the charge")
    SMEAR = StageDescription("frame, mean_e", "electrons without shot noise [e-]", "adds electrons without shot noise")
    # A random step here draws the level [DN] at which the charge of each pixel stops.
    WELL = StageDescription("signal_dn", "signal [DN] in front of the read noise", "limits the charge")
    READ_NOISE = StageDescription("variance_e2", "variance of the read noise [e-²]", "changes the read noise")
    # A function may also take `full_scale_dn` by name, the largest reading [DN].
    RESPONSE = StageDescription("signal_dn", "signal [DN] without black level", "bends the response")
    BLACK_LEVEL = StageDescription("frame, offset_dn", "offset beside the black level [DN]", "moves the black level")
    ROW_NOISE_AND_HOT_PIXELS = StageDescription(
        "frame, offset_dn", "offset [DN] as above", "adds noise to rows or pixels"
    )
    DIGITAL = StageDescription("signal_dn", "signal [DN] in front of the rounding", "cuts the faint end")

    @property
    def title(self) -> str:
        """Name of the stage in words, as documentation and messages use it."""
        return self.name.lower().replace("_", " ")
