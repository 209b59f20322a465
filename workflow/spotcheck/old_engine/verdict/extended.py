"""The model that a verdict stands for, as model.yaml holds it: a law or the frames' own numbers, and what was added."""

from collections.abc import Sequence

import numpy as np

from spotcheck.instrument import Instrument
from spotcheck.old_engine.conclude.judgement import Fits, Judgement
from spotcheck.old_engine.conclude.light import present_of
from spotcheck.old_engine.model.effect import Context, Effect, Present
from spotcheck.old_engine.model.extended import Extended, Site, Spot, context_of, within_bounds
from spotcheck.old_engine.observe.frames import Setting
from spotcheck.old_engine.observe.shots import Shot, pose_of

# A spot has some light and some width, however badly a frame was fitted [DN, px].
LEAST = 1e-3


def extended_of(judgement: Judgement, setting: Setting, instrument: Instrument, effects: Sequence[Effect]) -> Extended:
    """The model with all that is named; without any of it, the declared one as the frames fit it. `effects`: the run's
    vocabulary, in which one stands for a learned shape."""
    fits = judgement.fits
    assert fits is not None
    exposures = [float(t) for t in fits.design.exposures]
    shape, lights = None if judgement.light is None else present_of(judgement.light, effects), fits.after.lights
    plain = Extended(
        fits.law,
        max(exposures, default=1.0),
        fits.design.reference_s,
        setting.rows,
        setting.columns,
        (),
        _spots(fits, instrument),
        () if shape is None or lights is None else lights.shapes,
    )
    context = context_of(plain, setting.baseline, setting.sensor, instrument.crop_px, exposures)
    named = [one.own for one in judgement.found if one.own.effect.name not in judgement.beyond]
    present = (*named, *(() if shape is None else (shape,)))
    return plain._replace(present=tuple(within_bounds(_whole(own, context), context) for own in present))


def _whole(own: Present, context: Context) -> Present:
    """An effect with directions between 0 and 360 degrees; what a component of variance does not tell is as it
    starts."""
    told = len(own.values)
    rest = own.effect.starts(context)[0][told:] if told < len(own.effect.parameters) else ()
    units = (p.unit for p in own.effect.parameters)
    values = (float(v % 360 if u == "deg" else v) for u, v in zip(units, (*own.values, *rest), strict=True))
    return own._replace(values=tuple(values))


def _spots(fits: Fits, instrument: Instrument) -> dict[Site, Spot]:
    """Where the spot of each site lies, on average over its frames; without a law each frame has a spot of its own."""
    seen, unseen = fits.after.numbers, fits.unseen
    log_peak, log_width, x, y = (np.concatenate(own) for own in zip(seen, unseen, strict=True))
    lawful, lights = fits.law is not None, fits.after.lights
    which: dict[str, int] = {}
    if lights is not None and len(lights.coefficients) > 1:
        which = dict(zip(fits.design.pose.tolist(), lights.which.tolist(), strict=True))
    members: dict[Site, list[int]] = {}
    for k, shot in enumerate(fits.shots):
        members.setdefault(site_of_shot(shot, instrument, lawful), []).append(k)
    out = {}
    for site, own in members.items():
        spot = Spot(float(np.mean(x[own])), float(np.mean(y[own])), light=which.get(repr(pose_of(fits.shots[own[0]]))))
        if not lawful:
            peak, sigma = (float(max(np.exp(np.mean(v[own])), LEAST)) for v in (log_peak, log_width))
            spot = spot._replace(peak_dn=peak, sigma_px=sigma)
        out[site] = spot
    return out


def site_of_shot(shot: Shot, instrument: Instrument, lawful: bool) -> Site:
    """What the spot of a frame is known by in a model; without a law each frame has a spot of its own."""
    conditions = tuple(sorted(zip(instrument.conditions, shot.conditions, strict=True)))
    return Site(shot.angle_deg, None if lawful else shot.exposure_s, shot.repeat, conditions)
