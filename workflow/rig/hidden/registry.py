"""Every effect by name, and which design can show it."""

from __future__ import annotations

from rig.hidden import laws, lights, sensors, shapes
from rig.hidden.designs import Design
from rig.hidden.effect import Effect

_CLASSES: tuple[type[Effect], ...] = (
    *(sensors.Saturation, sensors.Nonlinearity, sensors.BlackClipping),
    *(lights.DarkOffset, lights.BackgroundGradient, shapes.SuperGaussian, lights.ScatterHalo),
    *(shapes.FibreAnisotropy, shapes.BeamEllipticity, laws.AngleReflectance, laws.PhotonBudget),
    *(laws.ShutterOffset, laws.SpreadLaw, shapes.MotionBlur, lights.InterferenceFringes),
    *(lights.GhostReflection, lights.Speckle, sensors.ExcessReadNoise, laws.PowerFluctuation),
    *(laws.LaserDrift, laws.PointingJitter, sensors.FixedPattern, sensors.RowNoise, sensors.Smear),
)
VOCABULARY: dict[str, type[Effect]] = {cls.name: cls for cls in _CLASSES}


def shows(name: str, design: Design) -> bool:
    """Whether an effect is more than a change of the baseline's own numbers in a design."""
    exposures = len(design.exposures_s)
    return {
        "angle_reflectance": len(design.angles_deg) > 1,
        "photon_budget": exposures > 1,
        "shutter_offset": exposures > 1,  # with two exposures only under `linear`: two widths are taken up by p1, p2
        "spread_law": exposures > 2,
        "power_fluctuation": design.frames > 1,
        "laser_drift": design.frames > 1,
        "pointing_jitter": exposures > 1,
    }.get(name, True)
