"""What every pixel of every frame should read under a model: mean, variance and slopes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import Free, View, copies_of, light, modulation, round_again, true_exposure
from spotcheck.old_engine.model.effect import Effect, Place, Present
from spotcheck.old_engine.model.light_shape import LightShape
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.observe.readings import ReadingLaw, compiled, look_up, reading_law, through_field

# No model is surer of a reading than this [DN²]: where a clip leaves no noise, one odd pixel would decide all.
LEAST_VARIANCE = 0.01
# Places of effects on which the light at a pixel depends.
LIGHT = frozenset(Place) - {Place.CHARGE, Place.WELL, Place.NOISE, Place.RESPONSE, Place.DIGITAL, Place.SCATTER}
# Relative steps of width and place [σ] by which their slopes are taken.
NUDGE = 1e-4
# By which part of itself a level is raised to tell what its scatter does to a reading.
RAISED = 1e-3


class Around(NamedTuple):
    """Means of square blocks of the whole frame [block]: places of their middles x, y [px of the sensor], mean reading
    [DN], and how many pixels each has."""

    x: np.ndarray
    y: np.ndarray
    mean: np.ndarray
    pixels: int


class Frame(NamedTuple):
    """One frame: its pixels [row, column] in DN, NaN where masked, and where they lie; the chain's view of it, with its
    place and amplitudes left to the model; and what is around the pixels, where it is known."""

    pixels: np.ndarray
    view: View
    around: Around | None = None

    @property
    def step(self) -> int:
        """Every so many rows and columns of the sensor the frame has one [px]."""
        return int(self.view.rows_each)


class Numbers(NamedTuple):
    """Of every frame [frame]: log of the peak [DN], log of σ_g [px], centre [px of the sensor]."""

    log_peak: np.ndarray
    log_width: np.ndarray
    x: np.ndarray
    y: np.ndarray


class Sheet(NamedTuple):
    """A data sheet: the sensor as stated, the standard errors of its gain [DN/e-], read noise [e-] and black level [DN]
    (0: exact), and which of the three a fit is to tell; the others are exact, or dark pixels tell them."""

    sensor: SensorModel
    stderr: tuple[float, float, float] = (0.0, 0.0, 0.0)
    free: tuple[bool, bool, bool] = (True, True, True)


class Lights(NamedTuple):
    """Shapes that are learned: the distance of their nodes [σ], coefficients [light, row, column] in peaks, which light
    each frame has [frame], and by how much the level under each lies above the sensor's [DN]: several lights come with
    stray light of their own."""

    step: float
    coefficients: np.ndarray
    which: np.ndarray
    level: np.ndarray

    @classmethod
    def common(cls, shape: LightShape, frames: int) -> "Lights":
        """One light for so many frames."""
        return cls(shape.step, shape.coefficients[None], np.zeros(frames, int), np.zeros(1))

    @property
    def side(self) -> int:
        """Splines along each axis."""
        return self.coefficients.shape[1]

    @property
    def shapes(self) -> tuple[LightShape, ...]:
        """The shape of each light."""
        return tuple(LightShape(self.step, own) for own in self.coefficients)

    def of(self, k: int) -> LightShape:
        """The shape of frame `k`."""
        return self.shapes[self.which[k]]

    def rows(self, k: int) -> slice:
        """Where the coefficients of frame `k` lie among all of them."""
        size = self.side**2
        return slice(int(self.which[k]) * size, (int(self.which[k]) + 1) * size)


class Model(NamedTuple):
    """The baseline, the sensor, effects, the numbers of the frames; what the sensor was stated to be (None: as it is);
    by which part of itself the level at which a signal stops differs from pixel to pixel (rms), where an effect stops
    it; and the light's shapes where they are learned, in place of one that was measured before."""

    baseline: Baseline
    sensor: SensorModel
    present: tuple[Present, ...]
    numbers: Numbers
    sheet: Sheet | None = None
    uneven: float = 0.01
    lights: Lights | None = None

    def baseline_of(self, k: int) -> Baseline:
        """The baseline with the light of frame `k`."""
        return self.baseline if self.lights is None else self.baseline._replace(learned=self.lights.of(k))

    def level(self, k: int) -> float:
        """By how much the level of frame `k` lies above the sensor's [DN]."""
        return 0.0 if self.lights is None else float(self.lights.level[self.lights.which[k]])

    @property
    def stated(self) -> Sheet:
        """What is stated of the sensor."""
        return self.sheet or Sheet(self.sensor)

    def with_effect(self, own: Present) -> "Model":
        """The model with an effect more, behind the others."""
        return self._replace(present=(*self.present, own))

    def without(self, k: int) -> "Model":
        """The model without the effect of a number."""
        return self._replace(present=self.present[:k] + self.present[k + 1 :])

    def take(self, frames: np.ndarray) -> "Model":
        """The model of some of its frames."""
        lights = self.lights and self.lights._replace(which=self.lights.which[frames])
        return self._replace(numbers=Numbers(*(own[frames] for own in self.numbers)), lights=lights)


class Expected(NamedTuple):
    """Of every pixel [row, column]: mean [DN] and variance [DN²], and the slopes of both by the light [1, DN]; light of
    the spot and beside it [DN]; its place u, v in the spot's own coordinates [σ]: [1, column] and [row, 1], or all of
    [row, column] where the spot is turned; places and weights (u, v, weight) of all copies of the spot of which its
    light is the sum; and the factor on that [1]."""

    mean: np.ndarray
    variance: np.ndarray
    slope: np.ndarray
    growth: np.ndarray
    spot: np.ndarray
    beside: np.ndarray
    u: np.ndarray
    v: np.ndarray
    copies: tuple[tuple[np.ndarray, np.ndarray, float], ...]
    factor: np.ndarray | float


class Expectation:
    """A model made ready: the law of a reading is a table, made once for all frames. Where another model, `like`, has
    the same light, what was found of that is taken over."""

    def __init__(self, frames: Sequence[Frame], model: Model, like: "Expectation | None" = None):
        self.model = model
        brightest = float(np.exp(np.max(model.numbers.log_peak))) if len(frames) else 1.0
        highest = 4 * max(brightest, min(model.sensor.full_scale_dn, 65535.0)) / model.sensor.gain_dn_per_e
        behind = [own for own in model.present if own.effect.place not in LIGHT or own.form == "electronic"]
        behind = [own for own in behind if own.effect.place is not Place.CHARGE and not _is_uneven(own)]
        stops = [own for own in behind if own.effect.place is Place.WELL]
        self.behind = model.sensor, highest, behind, model.uneven if stops else 0.0
        self.same_light = like is not None and _same_light(like.model, model)
        self.law: ReadingLaw
        self.table: np.ndarray
        if like is not None and like.behind == self.behind:
            self.table, self.law = like.table, like.law
        else:
            contrast = sum(own.values[0] ** 2 for own in model.present if scatters(own.effect, "field")) ** 0.5
            plain = reading_law(model.sensor, behind, frames[0].view, highest)
            if stops:
                # ASSUME: the levels of pixels scatter normally about the effect's, and by little.
                higher = [_raised(own, 1 + RAISED) if own in stops else own for own in behind]
                raised = reading_law(model.sensor, higher, frames[0].view, highest)
                scatter = (model.uneven / RAISED * (raised.mean - plain.mean)) ** 2
                plain = plain._replace(variance=plain.variance + scatter)
            self.law = through_field(plain, contrast, model.sensor.gain_dn_per_e)
            # Of rows that scatter the chain gives the variance within a row.
            rows = sum(own.values[0] ** 2 for own in model.present if scatters(own.effect, "row"))
            # Columns of one node side by side: a pixel asks for all of them.
            self.table = np.stack([self.law.mean, self.law.variance + rows, self.law.slope, self.law.growth], axis=1)

    def numbers_of(self, k: int) -> Numbers:
        """A frame's own numbers as the chain takes them, each [1, 1, 1]."""
        return Numbers(*(np.full((1, 1, 1), float(v[k])) for v in self.model.numbers))

    def light(self, frame: Frame, k: int, own: Numbers):
        """Light of the spot and beside it [DN], each [row, column] of frame `k` with numbers of its own."""
        base = Free(np.exp(own.log_peak), np.exp(own.log_width))
        view = frame.view._replace(x0=own.x, y0=own.y)
        return light(view, self.model.baseline_of(k), base, self.model.present)

    def of(self, frame: Frame, k: int, like: Expected | None = None) -> Expected:
        """What every pixel of frame `k` should read; `like` is what the model of the same light expects."""
        model, own, shape = self.model, self.numbers_of(k), frame.pixels.shape
        view = frame.view._replace(x0=own.x, y0=own.y)
        if like is not None and self.same_light:
            spot, beside, u, v, copies, factor = (like.spot[None], *like[5:])
        else:
            spot, beside = self.light(frame, k, own)
            u, v = self._place(view, own, 0.0, 0.0)
            peak, width = np.exp(own.log_peak), np.exp(own.log_width)
            every = copies_of(view, model.baseline_of(k), model.present, peak, width).each
            copies = ((u, v, 1.0),)
            if len(every) > 1:
                copies = tuple((*self._place(view, own, dx, dy), float(weight)) for dx, dy, weight in every)
            factor = modulation(view, model.present)
            factor = factor if np.ndim(factor) == 0 else factor[0]
        electrons = (spot + beside) / model.sensor.gain_dn_per_e
        electrons = electrons + model.sensor.dark_current_e_per_s * true_exposure(view, model.present)
        level = model.level(k)
        # ASSUME: a level of a light's own lies where the sensor is linear, so that it counts as charge.
        charge = electrons + level / model.sensor.gain_dn_per_e if level else electrons
        for effect in model.present:
            if effect.effect.place is Place.CHARGE:
                charge = effect.apply(view, charge)
            elif _is_uneven(effect):
                # ASSUME: an uneven black level lies where the sensor is linear, so that it counts as charge.
                charge = charge + effect.apply(view) / model.sensor.gain_dn_per_e
        out = np.empty((4, *shape))
        look_up(np.broadcast_to(charge, (1, *shape))[0], self.law.first, self.law.step, self.table, out)
        if charge is not electrons:
            # What was moved there brings no shot noise of its own.
            out[1] -= out[2] ** 2 * model.sensor.gain_dn_per_e**2 * (charge - electrons)[0]
            np.maximum(out[1], LEAST_VARIANCE, out=out[1])
        mean, variance, slope, growth = out
        spot = np.broadcast_to(spot, (1, *shape))[0]
        return Expected(mean, variance, slope, growth, spot, beside, u, v, copies, factor)

    def _place(self, view: View, own: Numbers, shift_x, shift_y) -> tuple[np.ndarray, np.ndarray]:
        """Places of a frame's pixels about its spot, displaced by so many px, in the spot's own coordinates [σ]."""
        dx, dy = round_again(view, view.x - own.x - shift_x, view.y - own.y - shift_y, self.model.present)
        width = np.exp(own.log_width[0])
        return dx[0] / width, dy[0] / width

    def by_numbers(self, frame: Frame, k: int, seen: Expected) -> np.ndarray:
        """Slopes [4, row, column] of the light by the frame's numbers: logs of peak and width, centre in σ."""
        own = self.numbers_of(k)
        width = np.exp(own.log_width)
        moved = (
            own._replace(log_width=own.log_width + NUDGE),
            own._replace(x=own.x + NUDGE * width),
            own._replace(y=own.y + NUDGE * width),
        )
        steps = [(self.light(frame, k, numbers)[0][0] - seen.spot) / NUDGE for numbers in moved]
        return np.stack([seen.spot, *steps])


def _raised(own: Present, factor: float) -> Present:
    """An effect with its strength times a factor."""
    return own._replace(values=(factor * own.values[0], *own.values[1:]))


def scatters(effect: Effect, of: str) -> bool:
    """Whether an effect is a random field, row, centre or gain."""
    return effect.scatter is not None and effect.scatter.of == of


def _is_uneven(own: Present) -> bool:
    """Whether an effect is a black level that differs from pixel to pixel."""
    return own.effect.place is Place.PEDESTAL and own.form == "electronic" and not own.effect.uniform


def _same_light(one: Model, other: Model) -> bool:
    """Whether two models, of which one was made from the other, have the same light."""
    lights = [[own for own in model.present if own.effect.place in LIGHT and own.form != "electronic"]
              for model in (one, other)]  # fmt: skip
    same = one.baseline is other.baseline and one.lights is other.lights and one.numbers is other.numbers
    return same and lights[0] == lights[1]


class Told(NamedTuple):
    """What the readings of a frame tell [row, column]. A change of mean and variance by (m, w) has the score m·`mean` +
    w·`variance` and, with another, the information m m'·`sure` + w w'·`sure_variance`; all are 0 where a pixel is
    masked. `light` and `sure_light` are both for the light; −2 ln L but for constants is `deviance`, a part of it
    χ²."""

    mean: np.ndarray
    variance: np.ndarray
    sure: np.ndarray
    sure_variance: np.ndarray
    light: np.ndarray
    sure_light: np.ndarray
    slope: np.ndarray
    growth: np.ndarray
    deviance: float
    chi2: float

    def score(self, mean: np.ndarray, variance: np.ndarray) -> float:
        """Score of changes of mean and variance."""
        return float(np.vdot(mean, self.mean) + np.vdot(variance, self.variance))

    def information(self, one: tuple[np.ndarray, np.ndarray], two: tuple[np.ndarray, np.ndarray]) -> float:
        """Information that two changes share."""
        return float(np.vdot(one[0] * two[0], self.sure) + np.vdot(one[1] * two[1], self.sure_variance))

    def with_light(self, mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Information that a change shares with the light of each pixel."""
        return mean * (self.slope * self.sure) + variance * (self.growth * self.sure_variance)


def told(frame: Frame, seen: Expected, *, by_variance: bool = True) -> Told:
    """What a frame tells about what was expected: the likelihood of normal readings, in mean and in variance, or in the
    mean alone (quasi-likelihood: McCullagh & Nelder, Generalized Linear Models, 2nd ed., ch. 9)."""
    out = np.empty((6, *frame.pixels.shape))
    deviance, chi2 = _told(frame.pixels, seen.mean, seen.variance, seen.slope, seen.growth, by_variance, out)
    mean, variance, sure, sure_variance, light, sure_light = out
    slopes = seen.slope, seen.growth
    return Told(mean, variance, sure, sure_variance, light, sure_light, *slopes, deviance, chi2)


def deviance_of(frame: Frame, seen: Expected) -> float:
    """−2 ln L of a frame but for constants."""
    return float(_deviance(frame.pixels, seen.mean, seen.variance))


@compiled
def _told(pixels, mean, variance, slope, growth, by_variance, out):
    deviance = chi2 = 0.0
    for r in range(pixels.shape[0]):
        for c in range(pixels.shape[1]):
            if np.isnan(pixels[r, c]):
                out[:, r, c] = 0.0
                continue
            own = max(variance[r, c], LEAST_VARIANCE)
            weight = 1 / own
            rest = pixels[r, c] - mean[r, c]
            one = rest * weight
            two = (rest * one - 1) * weight / 2 if by_variance else 0.0
            sure = weight * weight / 2 if by_variance else 0.0
            s, g = slope[r, c], growth[r, c]
            out[0, r, c], out[1, r, c], out[2, r, c], out[3, r, c] = one, two, weight, sure
            out[4, r, c] = s * one + g * two
            out[5, r, c] = s * s * weight + g * g * sure
            chi2 += rest * one
            deviance += rest * one + np.log(own)
    return deviance, chi2


@compiled
def _deviance(pixels, mean, variance):
    deviance = 0.0
    for r in range(pixels.shape[0]):
        for c in range(pixels.shape[1]):
            if not np.isnan(pixels[r, c]):
                own = max(variance[r, c], LEAST_VARIANCE)
                deviance += (pixels[r, c] - mean[r, c]) ** 2 / own + np.log(own)
    return deviance
