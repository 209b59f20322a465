"""Test of the beam propagation ratio M² against its lower limit of 1."""

from collections.abc import Mapping

from spotcheck.io.number_text import quantity_text

# M² below 1 by this many standard errors means a wrong input: a perfect beam gives it in 1 of 700 scans.
IMPOSSIBLE_SIGMAS = 3.0


def describe_impossible_m2(m2_by_axis: Mapping[str, tuple[float, float]], pitch: str, wavelength: str, z: str) -> str:
    """Return a remark if M² is significantly below 1, which no beam can have; "" otherwise.

    Parameters
    ----------
    m2_by_axis : M² and its standard error, by the name of the axis; NaN if unknown.
    pitch, wavelength : pixel pitch and wavelength, by the name that the user knows, with their values.
    z : name of the positions along the beam.
    """
    low = list_low_axes(m2_by_axis, IMPOSSIBLE_SIGMAS)
    return low and (
        f"M² is below 1 ({low}), which no beam can have; it grows with {pitch} squared and falls with {wavelength} and"
        f" with the unit of {z}: correct the wrong one, unless the camera sees an image of the beam and not the beam;"
        " the pitch of binned frames is that of the sensor times the binning"
    )


def list_low_axes(m2_by_axis: Mapping[str, tuple[float, float]], sigmas: float) -> str:
    """Return the axes whose M² is below 1 by more than `sigmas` standard errors, with M²; "" if there are none."""
    return ", ".join(
        f"{name} {quantity_text(m2, stderr)}" for name, (m2, stderr) in m2_by_axis.items() if m2 + sigmas * stderr < 1
    )
