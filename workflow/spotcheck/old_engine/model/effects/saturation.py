"""Saturation: the signal stops at a level, the full well's or the converter's."""

import numpy as np
from scipy.special import ndtr

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def stop(mean, variance, read_variance, *, level, knee, form):
    """Mean and variance [DN] of a signal that stops at `level` [DN without black level], read noise left out.

    `sharp`: a clip; `soft`: a knee some `knee` times the level wide; `power`: (x⁻ᵐ + level⁻ᵐ)^(−1/m), m = 1/knee. The
    well clips before read noise comes in; forms that say `with noise` clip that as well, as a converter does. Of these
    the chain leaves the sharp one to the converter, which knows the law of what it rounds.
    """
    clips_noise = form.endswith("with noise")
    noise = read_variance if clips_noise else 0.0
    if form.startswith("sharp"):
        out, spread = _clipped(mean, variance + noise, level)
    else:
        out, slope, bend = (_soft if form.startswith("soft") else _power)(mean, level, knee)
        # The knee is wider than the noise, or the sharp form would fit: half of the variance times curvature is enough.
        out, spread = out + bend * (variance + noise) / 2, slope * slope * (variance + noise)
    return out, spread - noise


def _soft(x, level, knee):
    """Value, slope and curvature of a logarithmic knee that begins at 0, however wide it is, and ends at the level."""
    width = level / np.logaddexp(0.0, 1 / knee)
    above = x / width - 1 / knee
    slope = 1 / (1 + np.exp(np.clip(above, -60, 60)))
    return x - width * (np.logaddexp(0.0, above) - np.log1p(np.exp(-1 / knee))), slope, -slope * (1 - slope) / width


def _power(x, level, knee):
    """Value, slope and curvature of the harmonic knee."""
    power, lit = 1 / knee, x > 1e-9
    ratio = np.log(np.maximum(x, 1e-9) / level)
    grown = np.logaddexp(0.0, power * ratio)
    slope = np.exp(-(1 + 1 / power) * grown)
    bend = -(power + 1) * slope * np.exp(power * ratio - grown) / np.maximum(x, 1e-9)
    out = level * np.exp(ratio - grown / power)
    return np.where(lit, out, x), np.where(lit, slope, 1.0), np.where(lit, bend, 0.0)


def _clipped(mean, variance, level):
    sd = np.sqrt(np.maximum(variance, 1e-12))
    b = np.clip((level - mean) / sd, -12.0, 12.0)
    below, pdf = ndtr(b), np.exp(-b * b / 2) / np.sqrt(2 * np.pi)
    first = b * (1 - below) - pdf
    second = b * b * (1 - below) + below - b * pdf
    far = (level - mean) / sd < -12.0
    return np.where(far, level, mean + sd * first), np.where(far, 0.0, sd * sd * np.maximum(second - first**2, 0.0))


def ends(sensor, *, level, knee, form):
    """The full well, or the reading at which the converter stops; no key describes a knee."""
    if form == "sharp":
        return {"sensor.full_well_e": level / sensor.gain_dn_per_e}
    return {"sensor.full_scale_dn": sensor.black_level_dn + level} if form == "sharp with noise" else {}


EFFECT = Effect(
    number=1,
    name="saturation",
    sentence="the signal stops at a level, below the converter's full scale",
    noun="clip",
    place=Place.WELL,
    parameters=(
        Parameter("level", "DN", lambda c: 0.02 * c.peak_dn, lambda c: 3 * c.full_scale_dn),
        Parameter("knee", "1", 0.002, 1.0, inner=True),
    ),
    starts=lambda c: [(f * c.peak_dn, k) for f in (0.97, 0.8, 0.5) for k in (0.03,)],
    function=stop,
    forms=("sharp", "soft", "power", "sharp with noise", "soft with noise", "power with noise"),
    neutral=np.inf,
    idle={"sharp": ("knee",), "sharp with noise": ("knee",)},
    rounded=("sharp with noise", "soft with noise", "power with noise"),
    always=True,
    # Clipped noise is skewed and has tails of its own, and readings gather at the code of the level.
    marks=("code", "skewness", "outliers"),
    flats="",
    adopts=ends,
)
