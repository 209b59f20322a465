"""The whole chain with effects, in the order that the dataset contract fixes: mean and variance of readings at points.

Light: shape → top hat → motion blur → + halo, ghost → × fringes → + pedestal. Sensor: shot noise with dark current →
+ smear → well → + read noise → K → bend of the response → + black level → + row noise → black clipping → rounding, both
clips. Random fields (pixel gains, brightness and centre of a frame, fine speckle) have no mean of their own; coarse
speckle has one behind whatever bends.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from math import prod
from typing import NamedTuple

import numpy as np
from scipy.special import gammainc, gammaincinv

from spotcheck.old_engine.model import spot
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.converter import convert
from spotcheck.old_engine.model.effect import Context, Effect, Place, Present
from spotcheck.old_engine.model.response import bent
from spotcheck.old_engine.model.sensor import SensorModel, clipped_normal


class View(NamedTuple):
    """What some frames (views) see. Points lie on a grid: x [view, 1, column], y [view, row, 1] in px of the sensor;
    all else is [view, 1, 1]: spot centre x0, y0 [px], exposure [s], fibre angle [rad], and amplitudes (cos, sin) of
    fringes whose phase is anew at each site; but for the places in the order of acquisition (0 to 1) of all frames that
    a view is the mean of [view, 1, frame], NaN where a view has fewer.

    Scalars: the longest exposure and the reference exposure of the spread law [s], the frame's centre and rows [px],
    and how many rows of pixels each row of points stands for.
    """

    x: np.ndarray
    y: np.ndarray
    x0: np.ndarray
    y0: np.ndarray
    exposure_s: np.ndarray
    angle: np.ndarray
    order: np.ndarray
    wave_cos: np.ndarray
    wave_sin: np.ndarray
    longest_s: float
    reference_s: float
    frame_x: float
    frame_y: float
    frame_rows: float
    rows_each: float


class Law(NamedTuple):
    """Parameters of the baseline: p1, p2 [px], and the peak [DN] at the longest exposure."""

    p1: float
    p2: float
    peak: float


class Free(NamedTuple):
    """The baseline without a law: peak [DN] and σ_g [px] of every view [view, 1, 1]."""

    amplitude: np.ndarray
    sigma: np.ndarray


def bounds_context(
    base: Law | Free,
    baseline: Baseline,
    sensor: SensorModel,
    crop_px: float,
    shortest_s: float,
    longest_s: float,
    reference_s: float,
) -> Context:
    """What bounds and starts of effects depend on beside a base; times are those of `View`."""
    exponent = 0.0
    if isinstance(base, Law):
        exponent = float(base.p1 / baseline.propagation(reference_s, base.p1, base.p2))
        sigma, peak = float(baseline.sigma(longest_s, base.p1, base.p2)), base.peak
    else:
        # No reading lies above full scale, however bright the light that a free base has found.
        sigma, peak = float(np.median(base.sigma)), min(float(np.max(base.amplitude)), sensor.full_scale_dn)
    full_scale = float(min(sensor.full_scale_dn, 65535.0))
    return Context(
        sigma, float(baseline.plateau(peak)), full_scale, crop_px, shortest_s, sensor.read_noise_e,
        sensor.gain_dn_per_e, exponent, longest_s,
    )  # fmt: skip


# An offset of so little [DN] moves a mean in proportion.
SMALL_DN = 0.02
# Offsets of rows, in their rms, and how often each stands for (Gauss and Hermite).
ROW_NODES, ROW_WEIGHTS = np.polynomial.hermite_e.hermegauss(7)
ROW_WEIGHTS = ROW_WEIGHTS / ROW_WEIGHTS.sum()

# Granular fields of less contrast than this leave means as they are: what bends, bends by C² µ² f″/2.
COARSE = 0.1
# Bins of a granular field's law, and levels of light at which its averages are looked up.
GRAIN_NODES, LOOKED_UP = 16, 600
# Places of effects on which a reading depends when its light is given.
BEHIND_LIGHT = (Place.EXPOSURE, Place.PEDESTAL, Place.WELL, Place.NOISE, Place.RESPONSE, Place.DIGITAL, Place.SCATTER)


class Moments(NamedTuple):
    """Mean [DN] and variance [DN²] of the readings [view, row, column]."""

    mean: np.ndarray
    variance: np.ndarray


class BehindGrain(NamedTuple):
    """Mean [DN] of readings behind a granular field, their variance [DN²] about what each reads on average at its own
    grain, and the variance of that."""

    mean: np.ndarray
    variance: np.ndarray
    granular: np.ndarray


def true_exposure(view: View, present: Sequence[Present]):
    """Exposure [s] of every view that light, dark current and motion had."""
    exposure = view.exposure_s
    for own in _at(present, Place.EXPOSURE):
        exposure = own.apply(view, exposure)
    return exposure


def spot_state(view: View, baseline: Baseline, base: Law | Free, present: Sequence[Present], gain=1.0):
    """Peak [DN] and σ_g [px] of every view, with the effects that act on exposure, width and brightness; `gain`
    multiplies the peak."""
    if isinstance(base, Free):
        amplitude, sigma = base.amplitude, base.sigma
    else:
        exposure = true_exposure(view, present)
        propagation = baseline.propagation(exposure, base.p1, base.p2)
        longest = baseline.propagation(view.longest_s, base.p1, base.p2)
        for own in _at(present, Place.WIDTH):
            reference = baseline.propagation(view.reference_s, base.p1, base.p2)
            propagation = own.apply(view, reference, exposure / view.reference_s)
            longest = own.apply(view, reference, view.longest_s / view.reference_s)
        sigma = propagation + baseline.laser_px
        amplitude = base.peak * baseline.peak_law(exposure, propagation) / baseline.peak_law(view.longest_s, longest)
    for own in _at(present, Place.BRIGHTNESS):
        amplitude = amplitude * own.apply(view)
    return amplitude * gain, sigma


def light(view: View, baseline: Baseline, base: Law | Free, present: Sequence[Present], gain=1.0):
    """Light [DN] of the spot with all that belongs to it, and of pedestals that are light."""
    amplitude, sigma = spot_state(view, baseline, base, present, gain)
    metrics, profiles = _at(present, Place.METRIC), _at(present, Place.PROFILE)

    def sharp(shift_x, shift_y):
        dx, dy = view.x - view.x0 - shift_x, view.y - view.y0 - shift_y
        if not metrics and not profiles:
            two = 2 * sigma * sigma
            shape = amplitude * np.exp(-dx * dx / two) * np.exp(-dy * dy / two)
        else:
            dx, dy = round_again(view, dx, dy, present)
            half = (dx * dx + dy * dy) / (2 * sigma * sigma)
            for own in profiles:
                half = own.apply(view, half)
            shape = amplitude * np.exp(-half)
        shape = np.minimum(shape, spot.top_hat_level(amplitude)) if baseline.top_hat else shape
        return shape if baseline.learned is None else shape + amplitude * baseline.learned(dx / sigma, dy / sigma)

    blurred = _blurred(sharp, view, present, baseline.pixel_integration)
    total = blurred(0.0, 0.0)
    for own in _at(present, Place.ADDED):
        total = total + own.apply(view, blurred, amplitude, sigma)
    total = total * modulation(view, present)
    beside = 0.0
    for own in _at(present, Place.PEDESTAL):
        if own.form != "electronic":
            beside = beside + own.apply(view)
    return total, beside


def _blurred(sharp, view: View, present: Sequence[Present], integrated: bool):
    """A displaced spot as a function of its displacement, averaged over its paths, and over each pixel where light is
    `integrated`."""
    paths = _at(present, Place.BLUR)
    if not paths and not integrated:
        return sharp
    exposed = view._replace(exposure_s=true_exposure(view, present))
    # Two smears in a row are every pair of their shifts.
    every = list(product(*(own.apply(exposed) for own in paths), *([spot.PIXEL] if integrated else [])))

    def blurred(shift_x, shift_y):
        total = 0.0
        for steps in every:
            dx, dy = (sum(step[axis] for step in steps) for axis in (0, 1))
            total = total + prod(step[2] for step in steps) * sharp(shift_x + dx, shift_y + dy)
        return total

    return blurred


def modulation(view: View, present: Sequence[Present]):
    """Factor on the light of the spot."""
    factor = 1.0
    for own in _at(present, Place.MODULATION):
        factor = factor * own.apply(view)
    return factor


class Copies:
    """A sum of displaced spots, of each dx, dy [px] and its weight: what a spot is to a function linear in it."""

    # Arrays leave products with them to this class.
    __array_ufunc__ = None

    def __init__(self, each: tuple[tuple, ...]):
        self.each = each

    def __add__(self, other):
        return Copies(self.each + (other.each if isinstance(other, Copies) else ()))

    def __radd__(self, other):
        return self

    def __mul__(self, factor):
        return Copies(tuple((dx, dy, factor * weight) for dx, dy, weight in self.each))

    __rmul__ = __mul__


def copies_of(view: View, baseline: Baseline, present: Sequence[Present], amplitude, sigma) -> Copies:
    """The displaced copies of the spot of which its light is the sum; what is added otherwise is left out."""
    blurred = _blurred(lambda dx, dy: Copies(((dx, dy, 1.0),)), view, present, baseline.pixel_integration)
    total = blurred(0.0, 0.0)
    for own in _at(present, Place.ADDED):
        total = total + own.apply(view, blurred, amplitude, sigma)
    return total


def round_again(view: View, dx, dy, present: Sequence[Present]):
    """Displacements from the spot's centre [px] in which its shape is the declared one, whatever stretches it."""
    for own in _at(present, Place.METRIC):
        dx, dy = own.apply(view, dx, dy)
    return dx, dy


def moments(
    view: View,
    baseline: Baseline,
    base: Law | Free,
    present: Sequence[Present],
    sensor: SensorModel,
    brightness=1.0,
) -> Moments:
    """Mean and variance of every reading; `brightness` [view, 1, 1] multiplies each view's peak. The variance is that
    about a reading's own grain, where a granular field is in the model."""
    own_light, beside = light(view, baseline, base, present, brightness)
    return readings(view, own_light, beside, present, sensor)


def readings(view: View, own_light, beside, present: Sequence[Present], sensor: SensorModel) -> Moments:
    """As `moments`, of light [DN] that is at hand: the spot's own and that of pedestals."""
    contrast = grain_contrast(present)
    if contrast < COARSE:
        return _readings(view, own_light, beside, present, sensor)
    return Moments(*_through_grain(view, own_light, beside, present, sensor, contrast)[:2])


def granular_variance(
    view: View, baseline: Baseline, base: Law | Free, present: Sequence[Present], sensor: SensorModel
) -> np.ndarray:
    """Variance [DN²] of readings [view, row, column] from grain to grain; 0 where no coarse field is in the model."""
    own_light, beside = light(view, baseline, base, present)
    contrast = grain_contrast(present)
    if contrast < COARSE:
        return np.zeros(own_light.shape)
    return _through_grain(view, own_light, beside, present, sensor, contrast).granular


def grain_contrast(present: Sequence[Present]) -> float:
    """Contrast of the granular field among the effects; 0 without one."""
    return max((own.values[0] for own in present if own.effect.component == "grain"), default=0.0)


def _through_grain(
    view: View, own_light, beside, present: Sequence[Present], sensor: SensorModel, contrast: float
) -> BehindGrain:
    """Moments of readings under light that a granular field multiplies: averages over the law of its factor.

    What follows the light acts on each reading alone, so the averages are a function of the light, made once for each
    exposure and looked up.
    """
    if np.size(beside) and np.ptp(beside) == 0:
        beside = float(np.ravel(beside)[0])
    mixing = [own for own in present if own.effect.place is Place.CHARGE or _is_uneven(own.effect)]
    if mixing:
        # ASSUME: what mixes pixels or is uneven is faint beside the light that bends, so it adds up with the grain.
        plain = [own for own in present if own not in mixing]
        rest = _through_grain(view, own_light, 0.0, plain, sensor, contrast)
        whole = _readings(view, own_light, beside, present, sensor)
        part = _readings(view, own_light, 0.0, plain, sensor)
        variance = np.maximum(rest.variance + whole.variance - part.variance, 0.1 * rest.variance)
        return BehindGrain(rest.mean + whole.mean - part.mean, variance, rest.granular)
    exposures, which = np.unique(np.ravel(view.exposure_s), return_inverse=True)
    # By powers of two, so that a table serves many models.
    highest = 2.0 ** np.ceil(np.log2(max(float(np.max(own_light)), 1.0)))
    behind = tuple(own for own in present if own.effect.place in BEHIND_LIGHT)
    which_effects = tuple((own.effect.function, own.form, own.values) for own in behind)
    out = [np.empty(own_light.shape) for _ in BehindGrain._fields]
    for k, exposure in enumerate(exposures):
        key = (which_effects, sensor, contrast, float(exposure), float(beside), float(highest))
        table = _grain_table(_Case(key, behind, view))
        own = which == k if len(which) == len(own_light) else slice(None)
        place = np.sqrt(np.maximum(own_light[own], 0.0) * ((LOOKED_UP - 1) ** 2 / highest))
        left = np.minimum(place.astype(int), LOOKED_UP - 2)
        part = place - left
        for values, line in zip(out, table, strict=True):
            step = np.diff(line)
            values[own] = line[left] + step[left] * part
    return BehindGrain(*out)


class _Case:
    """What a table of readings behind grain depends on (`key`), with the effects and a view that make it."""

    def __init__(self, key: tuple, behind: tuple[Present, ...], view: View):
        self.key, self.behind, self.view = key, behind, view

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Case) and self.key == other.key


@lru_cache(maxsize=512)
def _grain_table(case: _Case) -> BehindGrain:
    """Moments of readings behind grain over even steps of the root of light, up to the highest: fine at the dark end,
    where read noise acts, and where light bends."""
    _, sensor, contrast, exposure, beside, highest = case.key
    factors, weights = grain_law(contrast)
    knots = highest * np.linspace(0.0, 1.0, LOOKED_UP) ** 2
    one = np.zeros((1, 1, 1))
    # Where a point lies does not matter here, so any will do.
    view = case.view._replace(x=np.zeros((1, 1, LOOKED_UP)), y=one, x0=one, y0=one, exposure_s=exposure + one,
                              order=one, angle=one, wave_cos=one, wave_sin=one)  # fmt: skip
    under = (knots * factors[:, None])[:, None, :]
    parts = _readings(view, under, beside, case.behind, sensor)
    means, variances = parts.mean[:, 0], parts.variance[:, 0]
    mean = weights @ means
    return BehindGrain(mean, weights @ variances, weights @ (means - mean) ** 2)


@lru_cache(maxsize=64)
def grain_law(contrast: float) -> tuple[np.ndarray, np.ndarray]:
    """Factors of a granular field of that contrast, and how often each stands for.

    # ASSUME: intensities of summed independent speckle patterns, a gamma law of shape 1/C² (Goodman, Speckle
    # Phenomena in Optics, 2nd ed., sec. 3.3). Mean factors of bins of probability, the finer the nearer to both ends.
    """
    shape = contrast**-2.0
    edges = np.sin(np.pi / 2 * np.linspace(0, 1, GRAIN_NODES + 1)) ** 2
    weights = np.diff(edges)
    factors = np.diff(gammainc(shape + 1, gammaincinv(shape, edges))) / weights
    # What scatters within a bin is given back to the bins, so that mean and contrast are exact.
    spread = np.sqrt(weights @ (factors - 1) ** 2)
    return np.maximum(1 + (factors - 1) * contrast / spread, 0.0), weights


def _readings(view: View, own_light, beside, present: Sequence[Present], sensor: SensorModel) -> Moments:
    """What the sensor makes of light [DN] without grain."""
    gain = sensor.gain_dn_per_e
    electrons = (own_light + beside) / gain + sensor.dark_current_e_per_s * true_exposure(view, present)
    variance = np.maximum(electrons, 0.0)
    for own in _at(present, Place.CHARGE):
        electrons = own.apply(view, electrons)
    mean, variance = gain * electrons, gain**2 * variance
    # Of shot noise; what stops or bends does so far from black, where alone it is asked for.
    return behind_charge(mean, variance, gain * variance, view, present, sensor)


def behind_charge(mean, variance, third, view: View, present: Sequence[Present], sensor: SensorModel) -> Moments:
    """Moments of readings whose charge has a `mean` [DN], a variance [DN²] and a third central moment [DN³]: what the
    well, read noise, response, black level and converter make of them."""
    gain = sensor.gain_dn_per_e
    read = sensor.read_noise_e**2
    for own in _at(present, Place.NOISE):
        read = own.apply(read)
    read = gain**2 * read
    if np.isfinite(sensor.full_well_e):
        at_well = clipped_normal(mean, variance, gain, -np.inf, gain * sensor.full_well_e, rounding=0.0)
        mean, variance = at_well.mean, at_well.variance
    # Clipped noise is not normal, so the converter clips it where it rounds: the level moves along up to there.
    stops: list = []
    for own in _at(present, Place.WELL):
        if own.form == "sharp with noise":
            stops.append(own.values[0])
        else:
            mean, variance = own.apply(mean, variance, read)
    variance = variance + read
    if sensor.curvature:
        mean, variance = bent(mean, variance, sensor.curvature)
        stops = [bent(stop, 0.0, sensor.curvature)[0] for stop in stops]
    for own in _at(present, Place.RESPONSE):
        mean, variance = own.apply(mean, variance, sensor.full_scale_dn)
        stops = [own.apply(stop, 0.0, sensor.full_scale_dn)[0] for stop in stops]
    mean, stops = mean + sensor.black_level_dn, [stop + sensor.black_level_dn for stop in stops]
    for own in _at(present, Place.PEDESTAL):
        if own.form == "electronic":
            pedestal = own.apply(view)
            mean, stops = mean + pedestal, [stop + pedestal for stop in stops]
    out, spread, third = (np.array(v, float) for v in np.broadcast_arrays(mean, variance, third))
    zones = _at(present, Place.DIGITAL)
    black = float(sum(own.apply() for own in zones if own.form == "subtracted"))
    dead = float(max((own.apply() for own in zones if own.form != "subtracted"), default=0.0))
    out -= black
    highest = np.full(out.size, min(sensor.full_scale_dn, 1e9))
    for stop in stops:
        highest = np.minimum(highest, np.broadcast_to(stop - black, out.shape).reshape(-1))
    rows = sum(own.values[0] ** 2 for own in present if own.effect.component == "row")
    if rows:
        # Rows that scatter move the mean where black cuts them; the variance given is that of pixels within a row.
        within, wider = np.zeros_like(spread), spread + rows
        for node, weight in zip(np.sqrt(rows) * ROW_NODES, ROW_WEIGHTS, strict=True):
            moved, around = out + node, spread.copy()
            convert(moved.reshape(-1), around.reshape(-1), third.reshape(-1), highest, dead)
            within += weight * around
        convert(out.reshape(-1), wider.reshape(-1), third.reshape(-1), highest, dead)
        return Moments(out, within)
    convert(out.reshape(-1), spread.reshape(-1), third.reshape(-1), highest, dead)
    return Moments(out, spread)


def offset_response(light_dn: np.ndarray, sensor: SensorModel, rms_dn: float = 0.0) -> np.ndarray:
    """By how much the mean reading moves [1] with an offset behind the gain, under `light_dn` [DN]: below 1 where black
    or full scale cut readings, and uneven where noise is finer than a DN.

    Root of the variance of the mean over that of a normal offset of `rms_dn` [DN]; for 0 the slope.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(2 if rms_dn < SMALL_DN else 9)
    weights = weights / weights.sum()
    shot = sensor.gain_dn_per_e * np.maximum(np.asarray(light_dn, float), 0.0)
    variance, third = shot + (sensor.gain_dn_per_e * sensor.read_noise_e) ** 2, sensor.gain_dn_per_e * shot
    moved = []
    for node in max(rms_dn, SMALL_DN) * nodes:
        mean, spread = np.array(light_dn + sensor.black_level_dn + node, float), np.array(variance, float)
        highest = np.full(mean.size, min(sensor.full_scale_dn, 1e9))
        convert(mean.reshape(-1), spread.reshape(-1), third.reshape(-1), highest, 0.0)
        moved.append(mean)
    about = np.stack(moved) - np.tensordot(weights, moved, 1)
    return np.sqrt(np.tensordot(weights, about**2, 1)) / max(rms_dn, SMALL_DN)


def _is_uneven(effect: Effect) -> bool:
    return effect.place is Place.PEDESTAL and not effect.uniform


def _at(present: Sequence[Present], place: Place) -> list[Present]:
    return [own for own in present if own.effect.place is place]
