"""One look at a set of frames about a model: sums, condition means, the refit of the model, and all that is left
over."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.base import Base
from spotcheck.discrepancy.cells import Cells, Setting, cells_of, pooled
from spotcheck.discrepancy.measure import Measured, measure, spot_of
from spotcheck.discrepancy.noise import FrameFits, Observable, frame_fits, hot_field, hot_power, observables
from spotcheck.discrepancy.pixels import Scene
from spotcheck.discrepancy.refit import Latent, Model, Problem
from spotcheck.discrepancy.shots import Design, Shot
from spotcheck.discrepancy.stripes import beside_places, depth_of
from spotcheck.estimate.scoring import LIKELIHOOD, law_of, one_pass
from spotcheck.model.chain import Free, light, offset_response, readings, spot_state
from spotcheck.model.effect import Place, Present
from spotcheck.model.sensor import SensorModel

# Relative change of the light by which it is asked how a reading follows.
RIPPLE = 1e-3
# Steps towards each frame's own centre.
NEARER = 2


class Look(NamedTuple):
    """What was seen: sums, cells, the problem that refits solve, the model's light at the blocks [DN], what a reading
    there follows of an offset, observables, what each frame says of its own brightness, and χ² of pixels that are hot
    whatever their gain."""

    setting: Setting
    measured: Measured
    cells: Cells
    problem: Problem
    light: np.ndarray
    response: np.ndarray
    observables: list[Observable]
    brightness: FrameFits
    hot: float


def look_at(shots: Sequence[Shot], design: Design, base: Base, setting: Setting) -> Look:
    """Look at frames about the base model."""
    return _seen(measure(shots, design, base, setting.baseline, setting.sensor), setting, None)


def look_again(shots: Sequence[Shot], before: Look, model: Model, latent: Latent, prnu: float | None = None) -> Look:
    """Look at the same frames about a model with effects: every pixel's own mean, every frame's own brightness and
    place where those scatter; with `prnu`, the rms of the pixels' gains, also what hot pixels bring."""
    setting, design = before.setting, before.measured.design
    base, waves, expect = scenes(shots, before, model, latent)
    if prnu is not None:
        expect = _with_hot(expect, before.measured, prnu)
    common = _moved(before, model, latent)
    gain = own_gain(before, model, latent) / model.gain[design.condition] - 1
    given = np.stack([gain, base.x0 - common.x0, base.y0 - common.y0], axis=1)
    given[:, 1:] += before.measured.given[:, 1:]
    felt = _felt(setting, model.present)
    sensed = felt, _rows(model.present), _zone(model.present)
    measured = measure(shots, design, base, setting.baseline, setting.sensor, expect, *sensed)
    measured = measured._replace(given=given, waves=waves)
    model = model._replace(present=tuple(_with_depth(own, measured) for own in model.present))
    # The base has moved: no shift is left.
    near = _seen(measured, setting, model._replace(shift=0 * model.shift))
    # What was taken off still speaks against who knows nothing of it.
    return near._replace(hot=before.hot)


def look_about(shots: Sequence[Shot], before: Look, expect: Callable[[int], Scene]) -> Look:
    """Look at the same frames about what `expect` says of each; the model of conditions stays the base."""
    setting, old = before.setting, before.measured
    return _seen(measure(shots, old.design, old.base, setting.baseline, setting.sensor, expect), setting, None)


def _with_hot(expect: Callable[[int], Scene], measured: Measured, prnu: float) -> Callable[[int], Scene]:
    """Expectation of each frame with the offsets of the sensor's hot pixels."""
    field = hot_field(measured, prnu)
    rows, columns = measured.sums.row.shape[1], measured.sums.column.shape[1]

    def with_hot(k: int) -> Scene:
        scene = expect(k)
        top, left = int(measured.top[k]) - measured.corner[0], int(measured.left[k]) - measured.corner[1]
        return scene._replace(mean=scene.mean + field[top : top + rows, left : left + columns])

    return with_hot


def _seen(measured: Measured, setting: Setting, model: Model | None) -> Look:
    cells = cells_of(measured, setting)
    problem = Problem(cells, setting, model, mask=~held_blocks(measured.design, cells.residual.shape))
    at = pooled(problem.at_start.mean) - setting.sensor.black_level_dn
    fits = frame_fits(measured, "brightness")
    present = problem.start.present
    shone = problem.light(problem.start)
    response = offset_response(shone, _felt(setting, present), _rows(present))
    seen = observables(measured, cells, at, shone, response, setting.baseline.top_hat)
    return Look(setting, measured, cells, problem, at, response, seen, fits, hot_power(measured))


def _felt(setting: Setting, present: Sequence[Present]) -> SensorModel:
    """The sensor with the read noise that a model gives it."""
    read = setting.sensor.read_noise_e**2
    for own in present:
        read = own.apply(read) if own.effect.place is Place.NOISE else read
    return setting.sensor._replace(read_noise_e=float(np.sqrt(read)))


def _rows(present: Sequence[Present]) -> float:
    """Rms [DN] of the offsets that rows get."""
    return max((own.values[0] for own in present if own.effect.component == "row"), default=0.0)


def _zone(present: Sequence[Present]) -> float:
    """End [DN] of the dead zone of readings, 0 without one."""
    return max((own.values[0] for own in present if own.form == "dead zone"), default=0.0)


def held_blocks(design: Design, shape: tuple[int, ...]) -> np.ndarray:
    """Blocks [condition, row, column] that are kept unseen where nothing was repeated: every fourth square of 2 × 2."""
    out = np.zeros(shape, bool)
    if len(np.unique(design.repeat)) == 1:
        y, x = np.arange(shape[1])[:, None] // 2, np.arange(shape[2])[None, :] // 2
        out[:] = (y % 2 == 1) & (x % 2 == 1)
    return out


def scenes(
    shots: Sequence[Shot], before: Look, model: Model, latent: Latent
) -> tuple[Base, np.ndarray, Callable[..., Scene]]:
    """The base moved along with a model that was fitted to condition means, the amplitudes of each site's own stripes,
    and each frame's expectation, at the crop's own pixels or at evenly spaced points x, y [px of the sensor]."""
    setting, measured = before.setting, before.measured
    design, base, view = measured.design, measured.base, before.cells.view
    condition = design.condition
    rows, columns = shots[0].pixels().shape
    moved = _moved(before, model, latent)
    if measured.waves.any():
        moved = _with_own_places(measured, moved)
    if latent.centre:
        moved = with_own_centres(shots, measured, moved, setting)
    x0, y0 = moved.x0, moved.y0
    gain = own_gain(before, model, latent)
    stripes = next((own for own in model.present if _of_sites(own)), None)
    waves = _own_waves(measured, stripes, moved)[0] if stripes else np.zeros((design.sites, 2))

    first = before.cells.base
    bent = any(own.effect.place in (Place.WELL, Place.RESPONSE, Place.DIGITAL) for own in model.present)

    def expect(k: int, x: np.ndarray | None = None, y: np.ndarray | None = None) -> Scene:
        c = condition[k]
        x = measured.left[k] + np.arange(columns, dtype=float) if x is None else x
        y = measured.top[k] + np.arange(rows, dtype=float) if y is None else y
        own = model.base
        if isinstance(own, Free) and isinstance(first, Free):
            # A frame's own spot keeps its ratio to its condition's.
            ratio = base.amplitude[k] / first.amplitude[c], base.sigma[k] / first.sigma[c]
            own = Free(own.amplitude[c : c + 1] * ratio[0], own.sigma[c : c + 1] * ratio[1])

        def single(value: float) -> np.ndarray:
            return np.full((1, 1, 1), value)

        here = view._replace(
            x=x[None, None, :],
            y=y[None, :, None],
            x0=single(x0[k] + measured.left[k]),
            y0=single(y0[k] + measured.top[k]),
            exposure_s=single(view.exposure_s[c, 0, 0]),
            angle=single(view.angle[c, 0, 0]),
            order=single(design.order[k] if np.isfinite(design.order[k]) else 0.5),
            wave_cos=single(waves[design.site[k], 0]),
            wave_sin=single(waves[design.site[k], 1]),
            rows_each=float(y[1] - y[0]),
        )
        spot, beside = light(here, setting.baseline, own, model.present, gain[k])
        at, follows = readings(here, spot, beside, model.present, setting.sensor), spot
        if bent:
            more = readings(here, (1 + RIPPLE) * spot, beside, model.present, setting.sensor)
            follows = (more.mean - at.mean) / RIPPLE
        whole = (np.broadcast_to(v, (1, len(y), len(x)))[0] for v in (at.mean, at.variance, spot, follows))
        return Scene(*map(np.ascontiguousarray, whole))

    return moved, waves, expect


def own_gain(before: Look, model: Model, latent: Latent) -> np.ndarray:
    """Factor [frame] on the model's brightness: each frame's own where those scatter, else its condition's."""
    measured = before.measured
    condition = measured.design.condition
    if not latent.gain:
        return model.gain[condition]
    given = measured.given[:, 0]
    step = measured.base.amplitude * (frame_fits(measured, "brightness").value[:, 0] - given)
    start = before.problem.start
    seen = _brightness(before, start) * start.gain[condition] * (1 + given) + step
    return seen / _brightness(before, model)


def _brightness(look: Look, model: Model) -> np.ndarray:
    """A model's peak [DN] of each frame [frame], its conditions' gains left out."""
    peak = np.asarray(spot_state(look.cells.view, look.setting.baseline, model.base, model.present)[0])
    design = look.measured.design
    by_condition = np.broadcast_to(peak, (design.conditions, 1, 1))[design.condition, 0, 0]
    return by_condition * (1 + course_of(look, model.present))


def course_of(look: Look, present: Sequence[Present]) -> np.ndarray:
    """Relative brightness of each frame to its condition's mean under effects that act frame by frame [frame]."""
    design, view = look.measured.design, look.cells.view
    out = np.zeros(len(design.condition))
    for own in present:
        if "order" in own.effect.needs:
            frame = own.apply(view._replace(order=design.order[:, None, None]))
            out += (frame / own.apply(view)[design.condition]).ravel() - 1
    return out


def _moved(before: Look, model: Model, latent: Latent) -> Base:
    """The base of a look with the centres that a model found."""
    design, base = before.measured.design, before.measured.base
    by_condition = len(model.shift) == design.conditions and len(model.shift) != design.places
    shift = model.shift[design.condition if by_condition else design.place[design.condition]]
    if latent.gain and not latent.centre:
        shift = shift - _lean(before)[design.place[design.condition]]
    return base._replace(x0=base.x0 + shift[:, 0], y0=base.y0 + shift[:, 1])


def _lean(before: Look) -> np.ndarray:
    """By how much the condition means of each place lie towards its brighter frames [place, (x, y)] in px."""
    design, base = before.measured.design, before.measured.base
    bright = base.amplitude * np.maximum(1 + frame_fits(before.measured, "brightness").value[:, 0], 0.0)
    at = np.stack([base.x0, base.y0], axis=1)
    out, total = np.zeros((design.places, 2)), np.zeros((design.places, 1))
    for c in np.unique(design.condition):
        own = design.condition == c
        weight = bright[own].sum() ** 2
        if weight > 0:
            out[design.place[c]] += weight * (bright[own] @ at[own] / bright[own].sum() - at[own].mean(axis=0))
            total[design.place[c]] += weight
    return out / np.maximum(total, 1e-300)


def with_own_centres(shots: Sequence[Shot], measured: Measured, base: Base, setting: Setting) -> Base:
    """A base with every frame's own centre, near that given."""
    law = law_of(setting.sensor)
    images = [np.ascontiguousarray(shot.pixels(), dtype=np.float64) for shot in shots]
    for _ in range(NEARER):
        spots = [spot_of(k, measured.design, base, setting.sensor) for k in range(len(shots))]
        scores = [
            one_pass(image, spot, LIKELIHOOD, law, setting.baseline.top_hat)
            for image, spot in zip(images, spots, strict=True)
        ]
        score, information = (np.array([own[part] for own in scores]) for part in range(2))
        near = measured._replace(base=base, score=score, information=information, given=0 * measured.given)
        step = frame_fits(near, "centre").value
        base = base._replace(x0=base.x0 + step[:, 0], y0=base.y0 + step[:, 1])
    return base


def _with_own_places(measured: Measured, base: Base) -> Base:
    """A base whose sites lie where their frames see them now that stripes were taken off: those had pulled."""
    fits, site = frame_fits(measured, "centre"), measured.design.site
    weight = fits.weight
    step = weight * (fits.value - measured.given[:, 1:])
    x, y = (np.bincount(site, step[:, k]) / np.maximum(np.bincount(site, weight[:, k]), 1e-300) for k in (0, 1))
    return base._replace(x0=base.x0 + x[site], y0=base.y0 + y[site])


def _of_sites(own: Present) -> bool:
    """Whether an effect is stripes of a site's own phase."""
    return own.effect.spectral and own.form == "site"


def _with_depth(own: Present, measured: Measured) -> Present:
    """Stripes of a site's own phase with the depth of all that was seen of them, other effects as they are."""
    if not _of_sites(own):
        return own
    amplitude, noise = _own_waves(measured, own, measured.base)
    return own._replace(values=(depth_of((amplitude**2).sum(axis=1), noise), *own.values[1:]))


def _own_waves(measured: Measured, stripes: Present, base: Base) -> tuple[np.ndarray, np.ndarray]:
    """Amplitudes [site, (cos, sin)] about each site's spot, from what the site's exposures share: those that a look was
    about, and what it still saw of them; and the mean square of each that is noise alone."""
    fringes = stripes.named()
    angle = np.deg2rad(fringes["direction"])
    kx, ky = np.cos(angle) / fringes["period"], np.sin(angle) / fringes["period"]
    own, noise = beside_places(measured, fringes["period"], fringes["direction"])
    first = np.unique(measured.design.site, return_index=True)[1]
    dx = base.x0[first] + measured.left[first] - measured.site_left
    dy = base.y0[first] + measured.top[first] - measured.site_top
    turned = own * np.exp(2j * np.pi * (kx * dx + ky * dy))
    return measured.waves + np.stack([turned.real, -turned.imag], axis=1), noise
