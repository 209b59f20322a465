"""Read noise and black level from pixels that the spot does not light, by maximum likelihood.

A dark pixel has few electrons of known mean ν: dark current, stray light, smear. Its signal is b + K n + noise, n by
Poisson's law; it is rounded once and reads 0 below half a DN. The readings' histogram follows that law up to the code
below which all but 0.2 % of them lie, and is cut there: hot pixels are above.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln, ndtr, xlogy

from spotcheck.old_engine.model.chain import View, true_exposure
from spotcheck.old_engine.model.effect import Place, Present
from spotcheck.old_engine.model.sensor import ROUNDING_VARIANCE, SensorModel, clipped_normal
from spotcheck.old_engine.observe.pixels import Expectation, Frame, Model, scatters

# Pixels are dark beyond so many σ_g of the spot's centre: a Gaussian of 1000 DN adds 1e-5 DN there.
BEYOND = 6.0
# Readings above the code that this part of them does not exceed are left out: hot pixels.
KEPT = 0.998
# Pixels of light within this part of the noise of read-out and rounding [e-] count as of the same light: they add a
# ten-thousandth of its variance.
ALIKE = 0.03
# Two numbers need three codes; fewer readings of the third than this, or information as ill-conditioned as that, tell
# nothing.
THIRD, SINGULAR = 10, 1e12
# Least noise [DN]: below, rounding leaves one or two codes, which tell no more than that.
LEAST_DN = 0.03
# Fewest dark pixels; steps of the fit, the longest [DN, and 1 in ln noise], and the change in errors that ends it.
FEWEST, STEPS, LONGEST, ENOUGH = 100, 80, 0.5, 1e-4
# Black cuts a signal's noise up to so many of it, points of the curve that says how, and the least of a signal's change
# that shows in means.
CUT, CURVE, LEAST_SLOPE = 5.0, 401, 0.1
# Fewest blocks that tell a level, and how well it is known at best where readings are rounded [DN].
FEWEST_BLOCKS, ROUNDED_DN = 8, 0.02


class Darkness(NamedTuple):
    """Black level [DN] and read noise [e-] with their errors, infinite where the readings do not tell (one code or two
    alone), their correlation, and of how many pixels. Electronic pedestals of the model are not in the black level;
    noise that effects of the model add is in the read noise."""

    black_level_dn: float
    black_level_stderr: float
    read_noise_e: float
    read_noise_stderr: float
    correlation: float
    pixels: int


class Histogram(NamedTuple):
    """Mean electrons of some pixels, what is added to their black level [DN], and how often each code from 0 on is
    read; the last code is the highest that is kept."""

    electrons: float
    offset: float
    read: np.ndarray


def darkness(frames: Sequence[Frame], model: Model) -> Darkness | None:
    """Of the dark pixels of all frames, or where too few are among them of blocks beside; None where neither tells."""
    gain = model.sensor.gain_dn_per_e
    ready = Expectation(frames, model)
    dark: dict[tuple[int, float], list[np.ndarray]] = {}
    # Rounding is noise as well: below it no finer light is told apart.
    step = ALIKE * float(np.hypot(model.sensor.read_noise_e, np.sqrt(ROUNDING_VARIANCE) / gain))
    for k, frame in enumerate(frames):
        electrons = _electrons(ready, frame, k)
        own = ready.numbers_of(k)
        distance = np.hypot(frame.view.x - own.x, frame.view.y - own.y)[0] / np.exp(own.log_width[0])
        readings, light = (
            image[(distance > BEYOND) & np.isfinite(frame.pixels)] for image in (frame.pixels, electrons)
        )
        # A learned shape may lie a little below 0 out there.
        level = np.maximum(np.rint(light / step), 0).astype(int)
        offset = offset_of(frame.view, model.present) + model.level(k)
        for which in np.unique(level):
            dark.setdefault((int(which), offset), []).append(readings[level == which])
    own_histograms = [
        Histogram(level * step, offset, kept_counts(np.concatenate(parts))) for (level, offset), parts in dark.items()
    ]
    enough = sum(own.read.sum() for own in own_histograms) >= FEWEST
    found = fit_dark(own_histograms, gain, _dead(model.present)) if enough else None
    if found is None or np.isinf(found.black_level_stderr):
        return _around(frames, model, ready) or found
    # Offsets of rows scatter dark pixels as read noise does.
    rows = sum(own.values[0] ** 2 for own in model.present if scatters(own.effect, "row")) / gain**2
    alone = np.sqrt(max(found.read_noise_e**2 - rows, (LEAST_DN / gain) ** 2))
    error = found.read_noise_stderr * found.read_noise_e / alone
    return found._replace(read_noise_e=float(alone), read_noise_stderr=float(error))


def with_levels(frames: Sequence[Frame], model: Model) -> Model:
    """A model of several lights with the level of each as dark pixels tell it, about the median of all."""
    lights = model.lights
    if lights is None or len(lights.level) < 2:
        return model
    flat, told = model._replace(lights=lights._replace(level=0 * lights.level)), []
    for light in range(len(lights.level)):
        which = np.flatnonzero(lights.which == light)
        dark = darkness([frames[int(k)] for k in which], flat.take(which))
        told.append(dark.black_level_dn if dark is not None and np.isfinite(dark.black_level_stderr) else np.nan)
    if not np.isfinite(told).any():
        return model
    level = np.nan_to_num(np.array(told) - np.nanmedian(told))
    same = np.abs(level - lights.level).max() < ROUNDED_DN
    return model if same else model._replace(lights=lights._replace(level=level))


def _around(frames: Sequence[Frame], model: Model, ready: Expectation) -> Darkness | None:
    """The black level from means of blocks far from the spot, where the pixels do not reach so far; noise is not told.

    # ASSUME: the read noise is the model's, where black cuts it; nor is it so fine that rounding moves a block's mean:
    # at 0.3 DN it does by 0.05 DN at most.
    """
    levels, slopes = [], []
    for k, frame in enumerate(frames):
        if frame.around is None:
            continue
        own = ready.numbers_of(k)
        distance = np.hypot(frame.around.x - own.x, frame.around.y - own.y).ravel() / np.exp(own.log_width.item())
        electrons = model.sensor.dark_current_e_per_s * float(np.mean(true_exposure(frame.view, model.present)))
        offset = offset_of(frame.view, model.present) + model.level(k) + model.sensor.gain_dn_per_e * electrons
        signal, slope = _above_black(frame.around.mean[distance > BEYOND], electrons, model.sensor)
        levels.append(signal - offset)
        slopes.append(slope)
    blocks = np.concatenate(levels) if levels else np.zeros(0)
    # Where black hides nearly all noise a mean says that the level is low, and no more.
    if blocks.size < FEWEST_BLOCKS or np.median(np.concatenate(slopes)) < LEAST_SLOPE:
        return None
    # A speck of light or a gradient in a few blocks is none of the level.
    level = float(np.median(blocks))
    spread = 1.4826 * float(np.median(np.abs(blocks - level)))
    error = float(np.hypot(1.2533 * spread / np.sqrt(blocks.size), ROUNDED_DN))
    return Darkness(level, error, model.sensor.read_noise_e, np.inf, 0.0, blocks.size)


def _above_black(means: np.ndarray, electrons: float, sensor: SensorModel) -> tuple[np.ndarray, np.ndarray]:
    """Signals [DN] whose readings have these means [DN], and d mean/d signal: black cuts the noise of a low signal, so
    that it reads more than it is."""
    gain = sensor.gain_dn_per_e
    variance = gain**2 * (electrons + sensor.read_noise_e**2)
    signal = np.linspace(-CUT * variance**0.5, CUT * variance**0.5, CURVE)
    curve = clipped_normal(signal, variance, 0.0, 0.0, np.inf, rounding=ROUNDING_VARIANCE)
    low = means < curve.mean[-1]
    return (
        np.where(low, np.interp(means, curve.mean, signal), means),
        np.where(low, np.interp(means, curve.mean, curve.response), 1.0),
    )


def _electrons(ready: Expectation, frame: Frame, k: int) -> np.ndarray:
    """Mean electrons of each pixel of a frame."""
    model = ready.model
    spot, beside = ready.light(frame, k, ready.numbers_of(k))
    out = (spot + beside) / model.sensor.gain_dn_per_e
    out = out + model.sensor.dark_current_e_per_s * true_exposure(frame.view, model.present)
    for own in model.present:
        out = own.apply(frame.view, out) if own.effect.place is Place.CHARGE else out
    return np.broadcast_to(out, (1, *frame.pixels.shape))[0]


def offset_of(view: View, present: Sequence[Present]) -> float:
    """What effects add to the black level [DN]."""
    added = [own for own in present if own.effect.place is Place.PEDESTAL and own.form == "electronic"]
    taken = [own for own in present if own.effect.place is Place.DIGITAL and own.form == "subtracted"]
    return float(sum(np.mean(own.apply(view)) for own in added) - sum(own.apply() for own in taken))


def _dead(present: Sequence[Present]) -> float:
    """Signal [DN] below which a reading is 0."""
    zones = [own for own in present if own.effect.place is Place.DIGITAL and own.form != "subtracted"]
    return float(max((own.apply() for own in zones), default=0.0))


def kept_counts(readings: np.ndarray) -> np.ndarray:
    """How often each code is read, up to the code that all but `1 − KEPT` of the readings do not exceed."""
    count = np.bincount(np.asarray(readings).astype(int))
    highest = int(np.searchsorted(np.cumsum(count), KEPT * count.sum()))
    return count[: highest + 1]


def fit_dark(histograms: Sequence[Histogram], gain: float, dead: float = 0.0) -> Darkness:
    """Fisher's scoring for black level and ln noise [DN]; each histogram is a sample of the law below its last code."""
    pixels = int(sum(own.read.sum() for own in histograms))
    black, log_noise = _start(histograms, gain)
    reached, information = -np.inf, np.eye(2)
    step, best = np.zeros(2), np.array([black, log_noise])
    at = best.copy()
    for _ in range(STEPS):
        with np.errstate(invalid="ignore", divide="ignore"):
            likelihood, score, here = _told(histograms, gain, dead, at[0], np.exp(at[1]))
        # A step may lead where no reading would be kept: there is no likelihood.
        if not likelihood >= reached:
            # Half a step back; what is less than the sums' own rounding is the end.
            step = step / 2
            if step @ information @ step < ENOUGH**2:
                break
            at = best + step
            continue
        reached, best, information = likelihood, at, here
        step = np.linalg.pinv(information) @ score
        # Shorter, not turned: it has to lead upwards.
        step = step * min(1.0, LONGEST / max(np.abs(step).max(), LONGEST))
        if step @ information @ step < ENOUGH**2:
            break
        at = best + step
        at[1] = max(at[1], np.log(LEAST_DN))
    noise = float(np.exp(best[1]))
    if np.linalg.cond(information) > SINGULAR or max(map(_third, histograms)) < THIRD:
        return Darkness(float(best[0]), np.inf, noise / gain, np.inf, 0.0, pixels)
    covariance = np.linalg.inv(information)
    errors = np.sqrt(np.diag(covariance))
    correlation = float(covariance[0, 1] / errors.prod())
    return Darkness(
        float(best[0]), float(errors[0]), noise / gain, float(errors[1] * noise / gain), correlation, pixels
    )


def _third(own: Histogram) -> float:
    """Readings of the third most frequent code."""
    return float(np.sort(own.read)[-3]) if len(own.read) > 2 else 0.0


def _start(histograms: Sequence[Histogram], gain: float) -> tuple[float, float]:
    """Black level and ln noise [DN] by the moments of the readings."""
    own = max(histograms, key=lambda one: one.read.sum())
    codes = np.arange(len(own.read))
    mean = codes @ own.read / own.read.sum()
    variance = (codes - mean) ** 2 @ own.read / own.read.sum() - gain**2 * own.electrons - 1 / 12
    return float(mean - own.offset - gain * own.electrons), 0.5 * float(np.log(max(variance, 0.2**2)))


def _told(histograms: Sequence[Histogram], gain: float, dead: float, black: float, noise: float):
    """ln likelihood, score and information of (black, ln noise)."""
    total, score, information = 0.0, np.zeros(2), np.zeros((2, 2))
    for own in histograms:
        below, slopes = _law(own, gain, dead, black, noise)
        # Given that a reading is kept; no less than what double precision leaves of a difference.
        part = np.maximum(np.diff(below, prepend=0.0), 1e-300) / below[-1]
        change = np.diff(slopes, axis=1, prepend=0.0) / below[-1] - part * (slopes[:, -1:] / below[-1])
        relative = np.where(part > 1e-14, change / part, 0.0)
        total += float(own.read @ np.log(part))
        score += relative @ own.read
        information += own.read.sum() * (relative * part) @ relative.T
    return total, score, information


def _law(own: Histogram, gain: float, dead: float, black: float, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """P(reading ≤ code) [code] and its slopes by black level and ln noise [2, code]."""
    reach = 8 * np.sqrt(own.electrons) + 12
    counts = np.arange(max(int(own.electrons - reach), 0), int(own.electrons + reach) + 1) if own.electrons > 0 else [0]
    counts = np.asarray(counts, float)
    mean = max(own.electrons, 0.0)
    weight = np.exp(xlogy(counts, mean) - mean - gammaln(counts + 1))
    # Below no light at all, as a black level stated too high makes it, noise is read noise alone.
    signal = black + own.offset + gain * (counts if own.electrons > 0 else np.full(1, own.electrons))
    edges = np.maximum(np.arange(len(own.read)) + 0.5, dead)
    z = (edges - signal[:, None]) / noise
    density = np.exp(-z * z / 2) / np.sqrt(2 * np.pi)
    return weight @ ndtr(z), np.stack([-(weight @ density) / noise, -(weight @ (z * density))])
