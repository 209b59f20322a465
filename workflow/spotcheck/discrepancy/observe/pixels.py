"""What every pixel of every frame should read under a model: mean, variance and slopes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.observe.readings import look_up, reading_law
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Free, View, light, round_again, true_exposure
from spotcheck.model.effect import Place, Present
from spotcheck.model.sensor import SensorModel

# No model is surer of a reading than this [DN²]: where a clip leaves no noise, one odd pixel would decide all.
LEAST_VARIANCE = 0.01
# Relative steps of width and place [σ] by which their slopes are taken.
NUDGE = 1e-4


class Frame(NamedTuple):
    """One frame: its pixels [row, column] in DN, NaN where masked, and where they lie; the chain's view of it, with its
    place and amplitudes left to the model."""

    pixels: np.ndarray
    view: View


class Numbers(NamedTuple):
    """Of every frame [frame]: log of the peak [DN], log of σ_g [px], centre [px of the sensor]."""

    log_peak: np.ndarray
    log_width: np.ndarray
    x: np.ndarray
    y: np.ndarray


class Model(NamedTuple):
    """The baseline with the light's shape, the sensor, effects, and the numbers of the frames."""

    baseline: Baseline
    sensor: SensorModel
    present: tuple[Present, ...]
    numbers: Numbers


class Expected(NamedTuple):
    """Of every pixel [row, column]: mean [DN] and variance [DN²], and the slopes of both by the light [1, DN]; light of
    the spot [DN]; and its place u, v in the spot's own coordinates [σ]."""

    mean: np.ndarray
    variance: np.ndarray
    slope: np.ndarray
    growth: np.ndarray
    spot: np.ndarray
    u: np.ndarray
    v: np.ndarray


class Expectation:
    """A model made ready: the law of a reading is a table, made once for all frames."""

    def __init__(self, frames: Sequence[Frame], model: Model):
        self.model = model
        gain = model.sensor.gain_dn_per_e
        brightest = float(np.exp(np.max(model.numbers.log_peak))) if len(frames) else 1.0
        highest = 4 * max(brightest, min(model.sensor.full_scale_dn, 65535.0)) / gain
        behind = [own for own in model.present if own.effect.place is not Place.CHARGE and not _is_uneven(own)]
        self.law = reading_law(model.sensor, behind, frames[0].view, highest)
        self.table = np.stack(self.law[2:])

    def numbers_of(self, k: int) -> Numbers:
        """A frame's own numbers as the chain takes them, each [1, 1, 1]."""
        return Numbers(*(np.full((1, 1, 1), float(v[k])) for v in self.model.numbers))

    def light(self, frame: Frame, own: Numbers):
        """Light of the spot and beside it [DN], each [row, column] of one frame."""
        base = Free(np.exp(own.log_peak), np.exp(own.log_width))
        view = frame.view._replace(x0=own.x, y0=own.y)
        return light(view, self.model.baseline, base, self.model.present)

    def of(self, frame: Frame, k: int) -> Expected:
        """What every pixel of frame `k` should read."""
        model, own = self.model, self.numbers_of(k)
        view = frame.view._replace(x0=own.x, y0=own.y)
        spot, beside = self.light(frame, own)
        electrons = (spot + beside) / model.sensor.gain_dn_per_e
        electrons = electrons + model.sensor.dark_current_e_per_s * true_exposure(view, model.present)
        charge = electrons
        for effect in model.present:
            if effect.effect.place is Place.CHARGE:
                charge = effect.apply(view, charge)
            elif _is_uneven(effect):
                # ASSUME: an uneven black level lies where the sensor is linear, so that it counts as charge.
                charge = charge + effect.apply(view) / model.sensor.gain_dn_per_e
        shape = frame.pixels.shape
        out = np.empty((4, frame.pixels.size))
        look_up(np.ascontiguousarray(charge, float).ravel(), self.law.first, self.law.step, self.table, out)
        if charge is not electrons:
            # What was moved there brings no shot noise of its own.
            out[1] -= out[2] ** 2 * model.sensor.gain_dn_per_e**2 * (charge - electrons).ravel()
        mean, variance, slope, growth = out.reshape(4, *shape)
        dx, dy = round_again(view, view.x - own.x, view.y - own.y, model.present)
        width = np.exp(own.log_width)
        u, v = (np.broadcast_to(d / width, (1, *shape))[0] for d in (dx, dy))
        return Expected(mean, variance, slope, growth, np.broadcast_to(spot, (1, *shape))[0], u, v)

    def by_numbers(self, frame: Frame, k: int, seen: Expected) -> np.ndarray:
        """Slopes [4, pixel] of the light by the frame's numbers: logs of peak and width, centre in σ."""
        own = self.numbers_of(k)
        width = np.exp(own.log_width)
        moved = (
            own._replace(log_width=own.log_width + NUDGE),
            own._replace(x=own.x + NUDGE * width),
            own._replace(y=own.y + NUDGE * width),
        )
        steps = [(self.light(frame, numbers)[0][0] - seen.spot) / NUDGE for numbers in moved]
        return np.stack([seen.spot, *steps]).reshape(4, -1)


def _is_uneven(own: Present) -> bool:
    """Whether an effect is a black level that differs from pixel to pixel."""
    return own.effect.place is Place.PEDESTAL and own.form == "electronic" and not own.effect.uniform


class Told(NamedTuple):
    """What the readings of a frame tell [pixel]. A change of mean and variance by (m, w) has the score m·`mean` +
    w·`variance` and, with another, the information m m'·`sure` + w w'·`sure_variance`; all are 0 where a pixel is
    masked. `light` and `sure_light` are both for the light; −2 ln L but for constants is `deviance`."""

    mean: np.ndarray
    variance: np.ndarray
    sure: np.ndarray
    sure_variance: np.ndarray
    light: np.ndarray
    sure_light: np.ndarray
    slope: np.ndarray
    growth: np.ndarray
    deviance: float

    def score(self, mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Score of each pixel for changes of mean and variance [..., pixel]."""
        return mean * self.mean + variance * self.variance

    def information(self, one: tuple[np.ndarray, np.ndarray], two: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Information that two changes share, of each pixel."""
        return one[0] * two[0] * self.sure + one[1] * two[1] * self.sure_variance

    def with_light(self, mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Information that changes [..., pixel] share with the light."""
        return mean * (self.slope * self.sure) + variance * (self.growth * self.sure_variance)


def told(frame: Frame, seen: Expected) -> Told:
    """What a frame tells about what was expected: the likelihood of normal readings, in mean and in variance."""
    known = np.isfinite(frame.pixels).ravel()
    weight = np.where(known, 1 / np.maximum(seen.variance.ravel(), LEAST_VARIANCE), 0.0)
    residual = np.where(known, (frame.pixels - seen.mean).ravel(), 0.0)
    mean = residual * weight
    variance = np.where(known, (residual * mean - 1) * weight / 2, 0.0)
    sure_variance = weight * weight / 2
    slope, growth = seen.slope.ravel(), seen.growth.ravel()
    deviance = float(residual @ mean - np.sum(np.log(weight[known])))
    return Told(mean, variance, weight, sure_variance, slope * mean + growth * variance,
                slope * slope * weight + growth * growth * sure_variance, slope, growth, deviance)  # fmt: skip
