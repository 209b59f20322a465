"""The forward model: what a frame reads, on average, by how much it scatters, and at random.

`expected`, `jacobian` and `sample` go through the same stages in the same order: `light` up to the pixels,
`sensor_input` and `distribution` those of the sensor, which become one `ReadingDistribution`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial, reduce
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from spotcheck.model.baseline import Baseline
from spotcheck.model.conditions import FrameConditions
from spotcheck.model.effect import AppliedEffect, AppliedStep, RandomStep, Scope, Step
from spotcheck.model.light import NOTHING_DRAWN, Drawn, ExposureLaw, Light, LightStages
from spotcheck.model.stage import Stage
from spotcheck.sensor import ROUNDING_VARIANCE, ReadingDistribution, ReadingMoments, ReadingTable, SensorModel

# Random steps at these stages act on the reading of each pixel through a table of its own.
TABULATED = (Stage.SPECKLE_FIELD, Stage.WELL)
# Stages whose parameters are differentiated through new tables, all others through the slopes of one table.
SENSOR_STAGES = tuple(Stage)[tuple(Stage).index(Stage.PIXEL_GAIN) :]
# Brightest grain that tables of granular light are made for [mean]; the table behind it is constant beyond.
BRIGHTEST_GRAIN = 16.0
# Digits [DN] to which pedestals are even beside grains: those of single pixels differ by rounding.
EVEN_DIGITS = 9
# Relative step of central differences in parameters of the light and of the sensor; the latter is larger, since tables
# are interpolated.
LIGHT_STEP, SENSOR_STEP = 1e-5, 1e-3
# Dark noise [DN] that hides the rounding: the mean reading is then a straight line in an offset to 1e-4 DN.
HIDDEN_ROUNDING = 0.7
# Distance of readings from the ends of the converter [standard deviations] at which these change nothing.
FAR_FROM_ENDS = 4.5
# Parameters of the law.
LAW_PARAMETERS = ("p1", "p2", "peak_dn")


class ExpectedReading(NamedTuple):
    """Mean and variance of the readings of a frame over everything that is random."""

    mean: np.ndarray  # [row, column, DN]
    variance: np.ndarray  # [row, column, DN²]


@dataclass(frozen=True)
class SensorInput:
    """Input of the sensor in a frame, and the distribution of its readings."""

    distribution: ReadingDistribution  # of a reading given its light
    light: Light  # light of the frame [DN]
    smear_e: np.ndarray | float  # electrons that are added behind the Poisson draw [e-]
    offset_dn: np.ndarray | float  # what is added beside the black level [DN]


@dataclass(frozen=True)
class RandomStreams:
    """Random numbers of a frame: each belongs to a frame, a site or the sensor, and to one effect.

    A frame is the same whatever the order or number of cores, and another effect leaves the draws of all others as they
    were.
    """

    seed: int  # seed of all random numbers
    frame: int  # number of the frame
    site: int  # number of its site

    def readings(self) -> np.random.Generator:
        """Return the generator of the frame's own noise."""
        return _generator(self.seed, self.frame)

    def key(self, scope: Scope) -> int:
        """Return the number of the frame or site; there is one sensor."""
        return {Scope.FRAME: self.frame, Scope.SITE: self.site, Scope.SENSOR: 0}[scope]


@dataclass(frozen=True)
class ForwardModel(LightStages):
    """A baseline, effects, and the camera that sees them.

    Parameters
    ----------
    baseline : Baseline
        The instrument's part of the model, with the light's learned shape.
    sensor : SensorModel
        The camera.
    law : ExposureLaw or None
        Law of peak and width; without one each frame has its own (`FrameConditions.peak_dn`, `sigma_px`).
    effects : tuple of AppliedEffect
        Effects on top of the baseline, in any order: stages are in their order, and at a stage effects are in that of
        their numbers.
    """

    baseline: Baseline
    sensor: SensorModel
    law: ExposureLaw | None = None
    effects: tuple[AppliedEffect, ...] = ()

    def expected(self, frame: FrameConditions) -> ExpectedReading:
        """Return mean and variance of every reading of a frame.

        Both are over everything that is random, so that they are those of frames that `sample` draws with other seeds.
        """
        parts = [(weight, self.moments(self.sensor_input(frame, drawn), drawn)) for weight, drawn in self._averages()]
        mean = sum(weight * moments.mean for weight, moments in parts)
        variance = sum(weight * (moments.variance + (moments.mean - mean) ** 2) for weight, moments in parts)
        return ExpectedReading(np.asarray(mean), np.asarray(variance))

    def sample(self, frame: FrameConditions, streams: RandomStreams) -> np.ndarray:
        """Return one random frame [row, column] in DN (uint16)."""
        pixels = frame.pixels
        shape = (np.size(pixels.y), np.size(pixels.x))
        drawn, levels = {}, np.inf
        for step, random in self._random_steps():
            drawn[step] = _draw(step, shape, streams.seed, streams.key(random.scope))
            if random.stage is Stage.WELL:
                levels = np.minimum(levels, drawn[step])
        at = self.sensor_input(frame, drawn)
        # The levels of all pixels are drawn.
        distribution = replace(at.distribution, charge_levels=())
        light = np.broadcast_to(at.light.total, shape)
        return distribution.sample(
            light, streams.readings(), smear_e=at.smear_e, charge_level=levels, offset_dn=at.offset_dn
        )

    def jacobian(self, frame: FrameConditions, parameters: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of mean and variance [parameter, row, column] by parameters.

        Parameters
        ----------
        frame : FrameConditions
            The frame.
        parameters : sequence of str
            "x0", "y0" and, without a law, "peak_dn", "sigma_px" of the frame; "p1", "p2", "peak_dn" of the law;
            "effect.parameter" of an effect.

        Raises
        ------
        KeyError
            If the model has no such parameter.

        Notes
        -----
        A parameter of the light moves mean and variance by the slopes of their table times the derivative of the light.
        The latter is in closed form where a step registers it, else a central difference through the light's stages.
        With a random step, or one at charge or smear, all parameters are differences through the whole model. Else
        those of effects at the exposure and from the gains of pixels on are.
        """
        pairs = [self._derivatives(frame, name) for name in parameters]
        return np.array([mean for mean, _ in pairs]), np.array([variance for _, variance in pairs])

    # Stages of the sensor.

    def sensor_input(
        self, frame: FrameConditions, drawn: Drawn = NOTHING_DRAWN, light: Light | None = None
    ) -> SensorInput:
        """Return what the sensor gets in a frame; `light` is that of the frame if it is known already."""
        light, sensor = light or self.light(frame, drawn), self.sensor
        mean_e = light.total / sensor.gain_dn_per_e + sensor.dark_current_e_per_s * self.true_exposure(frame, drawn)
        charge_e = self.apply_stage(Stage.CHARGE, drawn, frame, mean_e)
        # Dark electrons count as a pedestal, so that frames of all exposures share one distribution.
        light = replace(light, pedestal=sensor.gain_dn_per_e * charge_e - light.spot)
        smear_e = sum((step(frame, charge_e) for step in self.steps_at(Stage.SMEAR)), 0.0)
        offset_dn: Any = self.apply_stage(Stage.BLACK_LEVEL, drawn, frame, 0.0)
        offset_dn = self.apply_stage(Stage.ROW_NOISE_AND_HOT_PIXELS, drawn, frame, offset_dn)
        if np.ndim(offset_dn) == 0:
            sensor = replace(sensor, black_level_dn=sensor.black_level_dn + float(offset_dn))
            offset_dn = 0.0
        return SensorInput(replace(self, sensor=sensor).distribution(), light, smear_e, offset_dn)

    def distribution(self) -> ReadingDistribution:
        """Return the distribution of a reading given its light and dark signal, with the effects on the sensor's
        stages."""
        sensor = replace(self.sensor, dark_current_e_per_s=0.0)
        variance = self.apply_stage(Stage.READ_NOISE, NOTHING_DRAWN, None, sensor.read_noise_e**2)
        well = self.steps_at(Stage.WELL)
        response = self.steps_at(Stage.RESPONSE)
        levels = [zip(*reversed(step.average()), strict=True) for step in well if step.random]
        return ReadingDistribution(
            replace(sensor, read_noise_e=float(np.sqrt(variance))),
            charge=tuple(step for step in well if not step.random),
            charge_levels=tuple(levels[0]) if levels else (),
            response=tuple(replace(step, full_scale_dn=sensor.full_scale_dn) for step in response),
            digital=tuple(self.steps_at(Stage.DIGITAL)),
        )

    def moments(self, at: SensorInput, drawn: Drawn = NOTHING_DRAWN) -> ReadingMoments:
        """Return mean and variance of readings and their slopes by the light; grains and levels are averaged over."""
        light, distribution, total = at.light, at.distribution, at.light.total
        plain = partial(moments_with_offsets, distribution, smear_e=at.smear_e, offset_dn=at.offset_dn)
        grains = [step for step in self.steps_at(Stage.SPECKLE_FIELD) if step.random and step not in drawn]
        if not grains:
            return plain(total)
        # ASSUME: uneven pedestals, gains of pixels and smear are small beside the light that clips, so that their
        # changes of the moments add to those of the grains.
        even = round(float(np.mean(light.pedestal)), EVEN_DIGITS)
        highest = float(np.max(light.spot))
        table = distribution.tabulate(BRIGHTEST_GRAIN * highest)
        # Rounded, so that frames share tables.
        highest = 2.0 ** np.ceil(np.log2(max(highest, 1.0)))
        granular = _granular_table(table, tuple(grains), even, highest).moments(light.spot)
        is_even = np.max(np.abs(light.pedestal - even)) < 10.0**-EVEN_DIGITS
        if is_even and np.all(at.smear_e == 0) and np.all(at.offset_dn == 0):
            return granular
        alone = np.array(moments_with_offsets(distribution, light.spot + even))
        mean, variance, *slopes = np.array(granular) + np.array(plain(total)) - alone
        return ReadingMoments(mean, np.maximum(variance, 0.1 * granular.variance), *slopes)

    # What is random.

    def _random_steps(self) -> Iterator[tuple[AppliedStep, RandomStep]]:
        for stage in Stage:
            yield from ((step, step.random) for step in self.steps_at(stage) if step.random)

    def _averages(self) -> Iterator[tuple[float, Drawn]]:
        """Yield what random steps draw and with which weight; grains and levels are left to their tables."""
        steps = [step for step, random in self._random_steps() if random.stage not in TABULATED]
        quadratures = [list(zip(*step.average(), strict=True)) for step in steps]
        for nodes in product(*quadratures):
            weight = float(np.prod([node_weight for _, node_weight in nodes]))
            yield weight, {step: value for step, (value, _) in zip(steps, nodes, strict=True)}

    # Derivatives.

    def _derivatives(self, frame: FrameConditions, name: str) -> tuple[np.ndarray, np.ndarray]:
        effect = name.rpartition(".")[0]
        stages = {step.stage for applied in self.effects if applied.effect.name == effect
                  for step in applied.effect.variants[applied.variant]}  # fmt: skip
        # Charge and smear of a pixel follow the light of others.
        mixing = [step for stage in (Stage.CHARGE, Stage.SMEAR) for step in self.steps_at(stage)]
        if mixing or any(self._random_steps()) or stages & {Stage.EXPOSURE, *SENSOR_STAGES}:
            return tuple(self._difference(frame, name, SENSOR_STEP, lambda model, at: np.array(model.expected(at))))
        slope = self._registered_slope(frame, name)
        if slope is None:
            slope = self._difference(frame, name, LIGHT_STEP, lambda model, at: model.light(at).total)
        moments = self.moments(self.sensor_input(frame))
        return moments.mean_slope * slope, moments.variance_slope * slope

    def _registered_slope(self, frame: FrameConditions, name: str) -> np.ndarray | None:
        """Return the derivative of the light [DN] in closed form; None if no step registers one."""
        effect, _, parameter = name.rpartition(".")
        for stage in (Stage.BRIGHTNESS, Stage.PEDESTAL):
            steps = self.steps_at(stage)
            for step in steps:
                derivatives = step.step.derivatives if isinstance(step.step, Step) else {}
                if step.applied.effect.name != effect or parameter not in derivatives:
                    continue
                if stage is Stage.PEDESTAL:
                    slope = step.call(derivatives[parameter], frame, 0.0) * np.ones_like(self.light(frame).total)
                    return self.apply_stage(Stage.PIXEL_GAIN, NOTHING_DRAWN, frame, slope)
                if len(steps) == 1:
                    without = replace(self, effects=tuple(a for a in self.effects if a is not step.applied))
                    slope = step.call(derivatives[parameter], frame, without.spot(frame).peak_dn)
                    return self.light(frame).spot * slope / self.spot(frame).peak_dn
        return None

    def _difference(self, frame: FrameConditions, name: str, relative: float, function: Callable) -> np.ndarray:
        """Return the central difference of a function of model and frame in a parameter."""
        effect, _, parameter = name.rpartition(".")
        applied = {applied.effect.name: applied for applied in self.effects}[effect] if effect else None
        in_law = self.law is not None and name in LAW_PARAMETERS
        value = (applied.parameters if applied else vars(self.law if in_law else frame))[parameter]
        if np.isnan(value):
            raise KeyError(name)

        def moved(value: float) -> np.ndarray:
            change: dict[str, Any] = {name: value}
            if applied:
                other = applied.with_value(parameter, value)
                return function(replace(self, effects=tuple(other if a is applied else a for a in self.effects)), frame)
            if self.law is not None and in_law:
                return function(replace(self, law=replace(self.law, **change)), frame)
            return function(self, replace(frame, **change))

        # Scale on which readings change.
        scale = max(abs(value), 1e-3 if applied else 1.0)
        if name in ("x0", "y0"):
            scale = self.spot(frame).sigma_px
        elif applied and {p.name: p.unit for p in applied.effect.parameters}[parameter] == "s":
            scale = frame.exposure_s
        step = relative * scale
        return (moved(value + step) - moved(value - step)) / (2 * step)


def moments_with_offsets(
    distribution: ReadingDistribution, light: np.ndarray, smear_e=0.0, offset_dn=0.0
) -> ReadingMoments:
    """Return mean and variance of readings whose pixels have offsets [DN] beside the black level.

    Far from both ends of the converter, and with noise that hides the rounding, an offset adds to the mean. Else tables
    for offsets a quarter of the dark noise apart are interpolated by cubics, since rounding and black clipping depend
    on where a signal lies between whole numbers.
    """
    highest = float(np.max(light)) + distribution.sensor.gain_dn_per_e * float(np.max(smear_e))
    if np.ndim(offset_dn) == 0:
        return distribution.tabulate(highest).moments(light, smear_e)
    if not distribution.digital and distribution.noise_dn > HIDDEN_ROUNDING:
        alone = distribution.tabulate(highest).moments(light, smear_e)
        mean, spread = alone.mean + offset_dn, FAR_FROM_ENDS * np.sqrt(np.maximum(alone.variance, 0.0))
        if np.min(mean - spread) > 0 and np.max(mean + spread) < distribution.sensor.full_scale_dn:
            return alone._replace(mean=mean)
    offset_dn = np.broadcast_to(offset_dn, np.shape(light))
    step = max(np.sqrt(distribution.noise_dn**2 + ROUNDING_VARIANCE) / 4, 1e-3)
    place = offset_dn / step
    low = np.floor(place).astype(int)
    fraction = place - low
    parts = [np.zeros(np.shape(light)) for _ in range(4)]
    black = distribution.sensor.black_level_dn
    for node in range(int(low.min()) - 1, int(low.max()) + 3):
        distance = node - low
        is_near = (distance >= -1) & (distance <= 2)
        shifted = replace(distribution, sensor=replace(distribution.sensor, black_level_dn=black + node * step))
        smear = np.broadcast_to(smear_e, np.shape(light))[is_near]
        moments = shifted.tabulate(highest).moments(light[is_near], smear)
        weight = _lagrange(fraction[is_near], distance[is_near])
        for part, values in zip(parts, moments, strict=True):
            part[is_near] += weight * values
    return ReadingMoments(*parts)


def _lagrange(fraction: np.ndarray, node: np.ndarray) -> np.ndarray:
    """Return the weight of a node −1 … 2 in the cubic through four nodes, `fraction` beyond node 0."""
    others = [np.where(node == k, 1.0, (fraction - k) / np.where(node == k, 1, node - k)) for k in (-1, 0, 1, 2)]
    return reduce(np.multiply, others)


@lru_cache(maxsize=16)
def _granular_table(
    table: ReadingTable, grains: tuple[AppliedStep, ...], pedestal_dn: float, light_max: float
) -> ReadingTable:
    for step in grains:
        table = table.with_random_factor(*step.average(), pedestal_dn, light_max)
    return table


@lru_cache(maxsize=4)
def _draw(step: AppliedStep, shape: tuple[int, int], seed: int, key: int) -> Any:
    """Draw a number or field; kept for the next frames: those of a site follow each other, and there is one sensor."""
    assert step.random is not None
    # Each step of an effect has a generator of its own; the first keeps the shorter key.
    number = step.applied.effect.variants[step.applied.variant].index(step.step)
    spawned = (step.applied.effect.number, key) if number == 0 else (step.applied.effect.number, key, number)
    return step.call(step.random.draw, _generator(seed, *spawned), shape)


def _generator(seed: int, *key: int) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)))
