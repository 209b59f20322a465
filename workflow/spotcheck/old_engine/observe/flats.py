"""Levels of flats over their darks, and what they should read: spots of endless width in the chain that spots have."""

from typing import NamedTuple

import numpy as np

from spotcheck.estimate.photon_transfer import Transfer, light_of
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import Law, View, bounds_context, moments
from spotcheck.old_engine.model.effect import NEEDS, Context, Effect
from spotcheck.old_engine.model.sensor import ROUNDING_VARIANCE, SensorModel
from spotcheck.old_engine.observe.design import Design, view_of
from spotcheck.old_engine.observe.pixels import Model, Numbers

# Wider than any sensor [px].
ENDLESS = 1e9
# Levels of which a larger part of the pixels reads full scale are left out: there the light's unevenness would count.
MOST_CLIPPED = 1e-3
# Every so many levels one is kept unseen; of fewer levels than this nothing is said.
EVERY, FEWEST = 3, 6
# Relative scatter of light over exposure up to which a lamp shines alike all the time, so that exposures tell.
STEADY = 0.02
# Least dark noise [e-], for at 0 a reading's variance has no slope, and least error of a mean [DN].
LEAST_E, LEAST_DN = 0.1, 1e-6


class Series(NamedTuple):
    """Levels in the order of their light (as a part of the largest): of how many frames all are; signal [DN] and excess
    of variance [DN²] over the darks [2, level] with errors, which levels are kept unseen, whether their exposures tell,
    the chain's view, what bounds of effects depend on, and the declared model: a straight line by what plain photon
    transfer says."""

    frames: int
    light: np.ndarray
    values: np.ndarray
    errors: np.ndarray
    unseen: np.ndarray
    timed: bool
    view: View
    context: Context
    model: Model


def series_of(found: Transfer, full_scale_dn: float) -> Series | None:
    """The levels that can be judged; None where there are too few."""
    # Without darks there is no signal, and without noise that grows no gain.
    if np.isnan(found.quantities["gain"].value):
        return None
    light = light_of(found.flats)
    good = np.array([own.at_full <= MOST_CLIPPED for own in found.flats], bool) & (found.signal > 0) & (light > 0)
    kept = np.flatnonzero(good)[np.argsort(light[good], kind="stable")]
    light = light[kept]
    if len(kept) < FEWEST or not np.isfinite(light).all() or np.ptp(light) == 0:
        return None
    exposure = np.array([found.flats[k].exposure_s for k in kept])
    rate = light / exposure
    timed = bool(np.isfinite(exposure).all()) and float(np.std(rate) / np.mean(rate)) < STEADY
    longest = float(exposure.max()) if timed else 1.0
    gain, dark, black = (found.quantities[name].value for name in ("gain", "dark_noise", "dark_offset"))
    part, place, signal = light / light.max(), np.arange(len(kept)), found.signal[kept]
    slope = np.log([float(np.median(signal / part))])
    baseline, base = Baseline(0.0, "linear", False, longest), Law(0.0, ENDLESS, float(signal.max()))
    sensor = SensorModel(gain, max(dark, LEAST_E), 0.0, np.inf, black, full_scale_dn)
    return Series(
        frames=sum(found.flats[k].frames for k in kept),
        light=part,
        values=np.stack([signal, found.excess[kept]]),
        errors=np.stack([np.maximum([found.flats[k].mean_error for k in kept], LEAST_DN), found.excess_error[kept]]),
        # Both ends are seen: a fit is to be tried between levels, not beyond them.
        unseen=(place % EVERY == 1) & (place < len(kept) - 1),
        timed=timed,
        view=view_of(Design(0 * place, place, 0.0 * part, part * longest, 0 * part + 0.5, place)),
        context=bounds_context(base, baseline, sensor, 1.0, float(part.min()) * longest, longest, longest),
        model=Model(baseline, sensor, (), Numbers(slope, np.log([ENDLESS]), np.zeros(1), np.zeros(1))),
    )


def foretold(series: Series, model: Model) -> np.ndarray:
    """Signal [DN] and excess of variance [DN²] of all levels [2, level] under a model. The dark noise is the measured
    one, whatever the gain."""
    dark = series.model.sensor.gain_dn_per_e * series.model.sensor.read_noise_e
    sensor = model.sensor._replace(read_noise_e=dark / model.sensor.gain_dn_per_e)
    law = Law(0.0, ENDLESS, float(np.exp(model.numbers.log_peak[0])))
    own = moments(series.view, model.baseline, law, model.present, sensor)
    return np.stack([own.mean.ravel() - sensor.black_level_dn, own.variance.ravel() - dark**2 - ROUNDING_VARIANCE])


def hidden(effect: Effect, series: Series) -> str:
    """Why levels cannot show an effect; "" where they can."""
    if effect.scatter:
        return effect.flats or "levels hold no scatter"
    return effect.flats or ("" if series.timed or "exposure" not in effect.needs else NEEDS["exposure"])
