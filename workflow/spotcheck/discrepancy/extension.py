"""The extended model that a verdict stands for: the best account's numbers, as model.yaml holds them."""

from collections.abc import Sequence

import numpy as np

from spotcheck.discrepancy.base import Base, base_of, spots_of
from spotcheck.discrepancy.cells import Setting
from spotcheck.discrepancy.extend import Findings
from spotcheck.discrepancy.freed_named import spots_of_unseen
from spotcheck.discrepancy.look import Look
from spotcheck.discrepancy.refit import Model
from spotcheck.discrepancy.shots import Design, Shot, design_of, held_out
from spotcheck.discrepancy.verdict import parameters_of
from spotcheck.instrument import Instrument
from spotcheck.model.chain import Free, Law
from spotcheck.model.effect import Present
from spotcheck.model.effects import vocabulary
from spotcheck.model.extended import Extended, Site, Spot, context_of, within_bounds


def extended_of(
    found: Findings,
    names: Sequence[str],
    shots: Sequence[Shot],
    setting: Setting,
    instrument: Instrument,
) -> Extended:
    """The model with the effects `names`, in that order; without any it is the baseline as the frames fit it.

    `shots` are all usable frames, also those that were kept unseen: their sites have centres as well.
    """
    if found.freed is not None:
        return _freed(found, shots, setting, instrument)
    look, own = found.best if names and found.best else (found.look, found.base)
    model, view = own.refit.model, look.cells.view
    law = None
    if isinstance(model.base, Law):
        # A latent brightness shares its mean with the law's peak.
        law = Law(*(float(v) for v in model.base))._replace(peak=float(model.base.peak * model.gain.mean()))
    rows, columns = int(setting.frame_rows), int(2 * setting.frame_centre[0] + 1)
    spots = _spots(found, look, model, shots, instrument)
    plain = Extended(law, float(view.longest_s), float(view.reference_s), rows, columns, (), spots)
    known = [s.exposure_s for s in shots if s.exposure_s is not None]
    context = context_of(plain, setting.baseline, setting.sensor, instrument.crop_px, known)
    return plain._replace(present=tuple(within_bounds(_present(found, model, name), context) for name in names))


def _freed(found: Findings, shots: Sequence[Shot], setting: Setting, instrument: Instrument) -> Extended:
    """The model of frames that each have their own brightness and width, beside the effects."""
    assert found.freed is not None
    view, design = found.look.cells.view, design_of(shots)
    unseen = held_out(design.repeat)
    bases = {False: found.freed.base}
    if unseen.any():
        frames = np.flatnonzero(unseen)
        kept = [shots[int(k)] for k in frames]
        bases[True] = spots_of_unseen(found.freed, found.look, kept, design.take(frames))
    spots: dict[Site, Spot] = {}
    for k, shot in enumerate(shots):
        own, at = bases[bool(unseen[k])], int(np.count_nonzero(unseen[:k] == unseen[k]))
        conditions = tuple(sorted(zip(instrument.conditions, shot.conditions, strict=True)))
        centre = (float(shot.left + own.x0[at]), float(shot.top + own.y0[at]))
        spot = Spot(*centre, float(max(own.amplitude[at], 0.0)), float(max(own.sigma[at], 1e-3)))
        spots.setdefault(Site(shot.angle_deg, shot.exposure_s, shot.repeat, conditions), spot)
    rows, columns = int(setting.frame_rows), int(2 * setting.frame_centre[0] + 1)
    plain = Extended(None, float(view.longest_s), float(view.reference_s), rows, columns, (), spots)
    known = [s.exposure_s for s in shots if s.exposure_s is not None]
    context = context_of(plain, setting.baseline, setting.sensor, instrument.crop_px, known)
    turned = (_within_turn(p) for p in found.freed.whole)
    return plain._replace(present=tuple(within_bounds(p, context) for p in turned))


def _within_turn(own: Present) -> Present:
    """An effect with its directions between 0 and 360 degrees."""
    units = (p.unit for p in own.effect.parameters)
    return own._replace(
        values=tuple(float(v % 360 if u == "deg" else v) for u, v in zip(units, own.values, strict=True))
    )


def _present(found: Findings, model: Model, name: str) -> Present:
    """An effect with the values of the best account: those of the joint fit, or a variance component's."""
    effect = vocabulary()[name]
    fitted = next((own for own in model.present if own.effect.name == name), None)
    values = fitted.named() if fitted else {}
    values |= {key: own["value"] for key, own in parameters_of(found, name).items()}
    # A fit may leave a direction some turns on.
    values |= {p.name: values[p.name] % 360 for p in effect.parameters if p.unit == "deg"}
    form = fitted.form if fitted else effect.forms[0]
    return Present(effect, form, tuple(float(values[p.name]) for p in effect.parameters))


def _spots(
    found: Findings, look: Look, model: Model, shots: Sequence[Shot], instrument: Instrument
) -> dict[Site, Spot]:
    """Where the spot of each site lies; without a law, peak and width of each frame as well."""
    design = design_of(shots)
    base = _base(found, shots, design, instrument.crop_px)
    corners = np.array([(s.left, s.top) for s in shots], float)
    centre = corners + np.transpose([base.x0, base.y0]) + _moved(found, look, model)[design.place[design.condition]]
    lawful = isinstance(model.base, Law)
    amplitude, sigma = (None, None) if lawful else _own(look, model, base, design)
    out: dict[Site, Spot] = {}
    for k, shot in enumerate(shots):
        if not np.isfinite(centre[k]).all():
            continue
        own = tuple(sorted(zip(instrument.conditions, shot.conditions, strict=True)))
        site = Site(shot.angle_deg, None if lawful else shot.exposure_s, shot.repeat, own)
        spot = Spot(float(centre[k, 0]), float(centre[k, 1]))
        if amplitude is not None and sigma is not None:
            spot = spot._replace(peak_dn=float(max(amplitude[k], 0.0)), sigma_px=float(max(sigma[k], 1e-3)))
        out.setdefault(site, spot)
    return out


def _base(found: Findings, shots: Sequence[Shot], design: Design, crop_px: int) -> Base:
    """The base of all frames: that of the findings, and one through the frames that were kept unseen (NaN where none of
    them can be fitted)."""
    setting, base = found.look.setting, found.look.measured.base
    unseen = np.flatnonzero(held_out(design.repeat))
    if not len(unseen):
        return base
    own = [shots[int(k)] for k in unseen]
    single = spots_of(own, setting.sensor, setting.baseline.top_hat)
    other = base_of(single, np.array([(s.left, s.top) for s in own], float), design.take(unseen), setting.baseline,
                    crop_px)  # fmt: skip
    amplitude, sigma, x0, y0 = values = np.full((4, len(shots)), np.nan)
    if other is not None:
        values[:, unseen] = other[:4]
    values[:, np.setdiff1d(np.arange(len(shots)), unseen)] = base[:4]
    return Base(amplitude, sigma, x0, y0, base.law)


def _moved(found: Findings, look: Look, model: Model) -> np.ndarray:
    """By how much the last joint fit has the centres elsewhere than the base [place, (x, y)] in px, on average over the
    frames: where centres scatter each frame's differs."""
    design, first, last = look.measured.design, found.look.measured.base, look.measured.base
    by_place = len(model.shift) == design.places
    shift = model.shift[design.place[design.condition] if by_place else design.condition]
    moved = np.transpose([last.x0 - first.x0, last.y0 - first.y0]) + shift
    place = design.place[design.condition]
    # A place of unseen frames alone was not fitted.
    return np.array(
        [moved[place == p].mean(axis=0) if (place == p).any() else (0.0, 0.0) for p in range(design.places)]
    )


def _own(look: Look, model: Model, base: Base, design: Design) -> tuple[np.ndarray, np.ndarray]:
    """Peak [DN] and σ_g [px] of every frame: its own fit's, changed as the joint fit changed its condition's."""
    first = look.cells.base
    assert isinstance(first, Free) and isinstance(model.base, Free)
    out = []
    for own, after, before in zip((base.amplitude, base.sigma), model.base, first, strict=True):
        ratio = np.ravel(after / before)
        # Conditions that only unseen frames have were not fitted.
        out.append(own * np.where(np.isfinite(ratio) & (ratio > 0), ratio, 1.0)[design.condition])
    return out[0], out[1]
