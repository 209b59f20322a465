"""Every effect by name, and which design can show it."""

from __future__ import annotations

from rig.hidden import faults, laws, lights, oddities, sensors, shapes
from rig.hidden.designs import BY_NAME, Design
from rig.hidden.effect import Effect
from rig.hidden.names import EFFECTS

_CLASSES: tuple[type[Effect], ...] = (
    sensors.Saturation,
    sensors.Nonlinearity,
    sensors.BlackClipping,
    lights.DarkOffset,
    lights.BackgroundGradient,
    shapes.SuperGaussian,
    lights.ScatterHalo,
    shapes.FibreAnisotropy,
    shapes.BeamEllipticity,
    laws.AngleReflectance,
    laws.PhotonBudget,
    laws.ShutterOffset,
    laws.SpreadLaw,
    shapes.MotionBlur,
    lights.InterferenceFringes,
    lights.GhostReflection,
    lights.Speckle,
    sensors.ExcessReadNoise,
    laws.PowerFluctuation,
    laws.LaserDrift,
    laws.PointingJitter,
    sensors.FixedPattern,
    sensors.RowNoise,
    sensors.Smear,
)
VOCABULARY: dict[str, type[Effect]] = {cls.name: cls for cls in _CLASSES}
assert tuple(VOCABULARY) == EFFECTS


_OUTSIDE: tuple[type[Effect], ...] = (
    oddities.Coma,
    oddities.Trefoil,
    oddities.SquareSpot,
    oddities.Donut,
    oddities.RingModulation,
    oddities.BeamShadow,
    oddities.WidthAngle,
    oddities.WidthScatter,
    faults.ColumnNoise,
    faults.BlackWander,
    faults.CorrelatedNoise,
    faults.ConverterSteps,
    faults.ExcessShotNoise,
    faults.CosmicRays,
    faults.LineJitter,
    faults.TwoTaps,
)
OUTSIDERS: dict[str, type[Effect]] = {cls.name: cls for cls in _OUTSIDE}


def find(name: str) -> type[Effect]:
    """An effect or a mechanism by name."""
    return VOCABULARY[name] if name in VOCABULARY else OUTSIDERS[name]


def is_outside(name: str) -> bool:
    """Whether a name is not of the vocabulary."""
    return name in OUTSIDERS


def shows(name: str, design: Design) -> bool:
    """Whether an effect is more than a change of the baseline's own numbers in a design."""
    exposures, angles = len(design.exposures_s), len(design.angles_deg)
    return {
        "angle_reflectance": angles > 1,
        "photon_budget": exposures > 1,
        "shutter_offset": exposures > 1,  # with two exposures only under `linear`: two widths are taken up by p1, p2
        "spread_law": exposures > 2,
        "power_fluctuation": design.frames > 1,
        "laser_drift": design.frames > 1,
        "pointing_jitter": exposures > 1,
        "width_angle": angles > 1,
        "width_scatter": design.sites > 1,
        "black_wander": design.frames > 1,
    }.get(name, True)


def needed_budget(name: str, design: Design) -> str | None:
    """The photon budget without which the baseline would take up the effect."""
    return "linear" if name == "shutter_offset" and len(design.exposures_s) == 2 else find(name).budget


def design(name: str) -> Design:
    """A design by name."""
    if name not in BY_NAME:
        raise ValueError(f"no design {name!r}; there are {', '.join(BY_NAME)}")
    return BY_NAME[name]
