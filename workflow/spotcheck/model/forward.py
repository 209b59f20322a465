"""The forward model: mean and variance of the readings of a frame, their derivatives, and random frames.

An effect has steps: functions that act at stages of the chain from laser to reading. A random step also takes a number
or field that is drawn; `drawn` holds these draws by step. A quadrature of a random step has nodes, values of the draw
with weights, whose weighted sums are means over the draw. `expected`, `jacobian` and `sample` go through the same
stages in the same order: `light` up to the gains of pixels, then `sensor_input` and `distribution`, which make one
`ReadingDistribution` of the stages of the sensor. Its tables give mean and variance of a reading, and their slopes, as
functions of the light.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from spotcheck.model.baseline import Baseline
from spotcheck.model.conditions import FrameConditions
from spotcheck.model.effect import AppliedEffect, AppliedStep, RandomStep, Scope
from spotcheck.model.light import NOTHING_DRAWN, Drawn, ExposureLaw, Light, LightStages
from spotcheck.model.pixel_offsets import moments_with_offsets
from spotcheck.model.stage import Stage
from spotcheck.sensor import ReadingDistribution, ReadingMoments, ReadingTable, SensorModel

# Random steps at these stages are averaged in the tables of readings, as their draws differ from pixel to pixel.
TABULATED = (Stage.SPECKLE_FIELD, Stage.WELL)
# Stages from the gains of pixels on, at which effects belong to the sensor.
SENSOR_STAGES = tuple(Stage)[tuple(Stage).index(Stage.PIXEL_GAIN) :]
# Granular light is light that a random field multiplies. Tables for it go up to grains of this brightness, divided by
# the mean light [1]. Readings of brighter grains count as those of this one.
BRIGHTEST_GRAIN = 16.0
# Decimals of a pedestal [DN] to which pixels must agree for it to count as even: rounding differs between pixels.
EVEN_DIGITS = 9
# Step of central differences, relative to the scale on which readings change with the parameter. A smaller one would
# show the errors of interpolated tables.
RELATIVE_STEP = 7e-4
# Least variance of readings of granular light, over that without offsets: a guard of the sum of two corrections.
LEAST_VARIANCE_SHARE = 0.1
# Least scale of the step in a central difference: for a parameter of an effect, and for one of the law or the frame,
# in the unit of the parameter.
LEAST_EFFECT_SCALE, LEAST_LAW_SCALE = 1e-3, 0.1
# Parameters of the exposure law, `ExposureLaw`.
LAW_PARAMETERS = ("p1", "p2", "peak_dn")


class ExpectedReading(NamedTuple):
    """Mean and variance of each reading of a frame over everything that is random."""

    mean: np.ndarray  # [row, column] in DN
    variance: np.ndarray  # [row, column] in DN²


@dataclass(frozen=True)
class SensorInput:
    """Input of the sensor in a frame, and the distribution of readings as a function of the light."""

    distribution: ReadingDistribution  # distribution of a reading given its light
    light: Light  # light of the frame [DN]; its pedestal contains the dark electrons
    smear_e: np.ndarray | float  # electrons without shot noise that are added to each pixel [e-]
    offset_dn: np.ndarray | float  # offset of each pixel in addition to the black level [DN]; 0.0 if all are equal


@dataclass(frozen=True)
class RandomStreams:
    """Random numbers of a frame, each for one effect and for a frame, a site or the sensor.

    A frame does not depend on the order of simulation or the number of cores. Adding an effect leaves the draws of all
    others unchanged.
    """

    seed: int  # seed of all random numbers
    frame: int  # number of the frame, from 0
    site: int  # number of its site, from 0

    def readings(self) -> np.random.Generator:
        """Return the generator of the noise in the readings of this frame."""
        return _generator(self.seed, self.frame)

    def key(self, scope: Scope) -> int:
        """Return the number that identifies the frame, site or sensor of this frame; it is 0 for the one sensor."""
        return {Scope.FRAME: self.frame, Scope.SITE: self.site, Scope.SENSOR: 0}[scope]


@dataclass(frozen=True)
class ForwardModel(LightStages):
    """The model of frames: a baseline, an exposure law, effects and the camera.

    Parameters
    ----------
    baseline : Baseline
        The part of the model that the instrument fixes, with the learned light shape.
    sensor : SensorModel
        The camera.
    law : ExposureLaw or None
        Law of peak and width over the exposure; without it each frame has its own (`FrameConditions.peak_dn`,
        `sigma_px`).
    effects : tuple of AppliedEffect
        Effects in addition to the baseline. Their order is irrelevant: stages act in their order, and effects at a
        stage in the order of their numbers.
    """

    baseline: Baseline
    sensor: SensorModel
    law: ExposureLaw | None = None
    effects: tuple[AppliedEffect, ...] = ()

    def expected(self, frame: FrameConditions) -> ExpectedReading:
        """Return mean and variance of every reading of a frame over all random numbers.

        They are those of the frames that `sample` draws with different seeds.
        """
        # A mixture over the draws of random steps; the law of total variance gives its variance.
        nodes = self._quadrature_nodes()
        mixture = [(weight, self.moments(self.sensor_input(frame, drawn), drawn)) for weight, drawn in nodes]
        mean = sum(weight * moments.mean for weight, moments in mixture)
        variance = sum(weight * (moments.variance + (moments.mean - mean) ** 2) for weight, moments in mixture)
        return ExpectedReading(np.asarray(mean), np.asarray(variance))

    def sample(self, frame: FrameConditions, streams: RandomStreams) -> np.ndarray:
        """Return one random frame [row, column] in DN (uint16), drawn with the random numbers of `streams`."""
        pixels = frame.pixels
        shape = (np.size(pixels.y), np.size(pixels.x))
        # Level [DN] at which the charge of each pixel stops; infinite without a random step at the well.
        drawn, levels_dn = {}, np.inf
        for step, random_step in self._random_steps():
            drawn[step] = _draw(step, shape, streams.seed, streams.key(random_step.scope))
            if random_step.stage is Stage.WELL:
                levels_dn = np.minimum(levels_dn, drawn[step])
        inputs = self.sensor_input(frame, drawn)
        # The level of each pixel is drawn, so the distribution of levels is dropped.
        distribution = replace(inputs.distribution, charge_levels=())
        light = np.broadcast_to(inputs.light.total, shape)
        return distribution.sample(
            light, streams.readings(), smear_e=inputs.smear_e, charge_level=levels_dn, offset_dn=inputs.offset_dn
        )

    def jacobian(self, frame: FrameConditions, parameters: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of mean and variance [parameter, row, column] by parameters of the model.

        Parameters
        ----------
        frame : FrameConditions
            The frame.
        parameters : sequence of str
            "x0" and "y0" of the frame, and without a law its "peak_dn" and "sigma_px"; "p1", "p2" and "peak_dn" of the
            law; "NAME.PARAMETER" of an effect.

        Raises
        ------
        KeyError
            If the model has no such parameter.

        Notes
        -----
        They are central differences through the whole model, accurate to about 1e-3 of the largest derivative.
        """
        pairs = [self._differentiate(frame, name) for name in parameters]
        return np.array([mean for mean, _ in pairs]), np.array([variance for _, variance in pairs])

    # Stages of the sensor.

    def sensor_input(
        self, frame: FrameConditions, drawn: Drawn = NOTHING_DRAWN, light: Light | None = None
    ) -> SensorInput:
        """Return the input of the sensor in a frame; `light` is the light of the frame if it is already computed."""
        light, sensor = light or self.light(frame, drawn), self.sensor
        # Mean electrons of light and dark current.
        mean_e = light.total / sensor.gain_dn_per_e + sensor.dark_current_e_per_s * self.true_exposure(frame, drawn)
        charge_e = self.apply_stage(Stage.CHARGE, drawn, frame, mean_e)
        # Dark electrons are part of the pedestal, so that frames of all exposures share one distribution.
        light = replace(light, pedestal=sensor.gain_dn_per_e * charge_e - light.spot)
        smear_e = sum((step(frame, charge_e) for step in self.steps_at(Stage.SMEAR)), 0.0)
        offset_dn: Any = self.apply_stage(Stage.BLACK_LEVEL, drawn, frame, 0.0)
        offset_dn = self.apply_stage(Stage.ROW_NOISE_AND_HOT_PIXELS, drawn, frame, offset_dn)
        # An offset that all pixels share is part of the black level.
        if np.ndim(offset_dn) == 0:
            sensor = replace(sensor, black_level_dn=sensor.black_level_dn + float(offset_dn))
            offset_dn = 0.0
        return SensorInput(replace(self, sensor=sensor).distribution(), light, smear_e, offset_dn)

    def distribution(self) -> ReadingDistribution:
        """Return the distribution of a reading as a function of the light, with effects at the stages of the sensor.

        The light contains the dark signal, which `sensor_input` adds; so the dark current is 0 here.
        """
        sensor = replace(self.sensor, dark_current_e_per_s=0.0)
        # Functions at these stages do not take a frame.
        variance = self.apply_stage(Stage.READ_NOISE, NOTHING_DRAWN, None, sensor.read_noise_e**2)
        well, response = self.steps_at(Stage.WELL), self.steps_at(Stage.RESPONSE)
        # Pairs (weight, level [DN]) of each random step at the well. Only one effect of the library has such a step.
        levels = [zip(*reversed(step.quadrature()), strict=True) for step in well if step.random_step]
        return ReadingDistribution(
            replace(sensor, read_noise_e=float(np.sqrt(variance))),
            charge=tuple(step for step in well if not step.random_step),
            charge_levels=tuple(levels[0]) if levels else (),
            response=tuple(replace(step, full_scale_dn=sensor.full_scale_dn) for step in response),
            digital=tuple(self.steps_at(Stage.DIGITAL)),
        )

    def moments(self, inputs: SensorInput, drawn: Drawn = NOTHING_DRAWN) -> ReadingMoments:
        """Return mean [DN] and variance [DN²] of the readings of a frame and their slopes by the light, [row, column].

        They are averaged over random steps at the speckle field and at the well that are not in `drawn`.
        """
        light, distribution = inputs.light, inputs.distribution
        grains = [step for step in self.steps_at(Stage.SPECKLE_FIELD) if step.random_step and step not in drawn]
        if not grains:
            return moments_with_offsets(distribution, light.total, inputs.smear_e, inputs.offset_dn)
        # Moments of granular light on an even pedestal, the mean one, without smear and offsets.
        # ASSUME: uneven pedestals, gains and offsets of pixels, and smear are small beside the light that clips, so
        # that the changes of the moments by them and by grains add up.
        even_pedestal = round(float(np.mean(light.pedestal)), EVEN_DIGITS)
        highest = float(np.max(light.spot))
        table = distribution.tabulate(BRIGHTEST_GRAIN * highest)
        # Rounded up to a power of two, so that frames share tables.
        highest = 2.0 ** np.ceil(np.log2(max(highest, 1.0)))
        granular = _granular_table(table, tuple(grains), even_pedestal, highest).moments(light.spot)
        is_even = np.max(np.abs(light.pedestal - even_pedestal)) < 10.0**-EVEN_DIGITS
        if is_even and np.all(inputs.smear_e == 0) and np.all(inputs.offset_dn == 0):
            return granular
        # Add the change of the moments by uneven pedestals, smear and offsets, from light without grains.
        smooth = np.array(moments_with_offsets(distribution, light.total, inputs.smear_e, inputs.offset_dn))
        smooth_even = np.array(moments_with_offsets(distribution, light.spot + even_pedestal))
        mean, variance, *slopes = np.array(granular) + smooth - smooth_even
        return ReadingMoments(mean, np.maximum(variance, LEAST_VARIANCE_SHARE * granular.variance), *slopes)

    # Random steps.

    def _random_steps(self) -> Iterator[tuple[AppliedStep, RandomStep]]:
        """Yield (step with the parameters of its effect, the same step without them) of each random step.

        Steps are in the order of the stages.
        """
        for stage in Stage:
            yield from ((step, step.random_step) for step in self.steps_at(stage) if step.random_step)

    def _quadrature_nodes(self) -> Iterator[tuple[float, Drawn]]:
        """Yield weights and draws whose weighted sums are means over all random steps, except those at `TABULATED`.

        They are the products of the quadratures of all steps. Without such steps there is one node, without draws and
        with weight 1.
        """
        steps = [step for step, random_step in self._random_steps() if random_step.stage not in TABULATED]
        # Pairs (value, weight) of the nodes of each step.
        quadratures = [list(zip(*step.quadrature(), strict=True)) for step in steps]
        for nodes in product(*quadratures):
            weight = float(np.prod([node_weight for _, node_weight in nodes]))
            yield weight, {step: value for step, (value, _) in zip(steps, nodes, strict=True)}

    # Derivatives.

    def _differentiate(self, frame: FrameConditions, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of mean and variance [row, column] by the parameter `name`; see `jacobian`."""
        effect_name, _, parameter = name.rpartition(".")
        applied = {applied.effect.name: applied for applied in self.effects}[effect_name] if effect_name else None
        in_law = self.law is not None and name in LAW_PARAMETERS
        value = (applied.parameters if applied else vars(self.law if in_law else frame))[parameter]
        if np.isnan(value):
            # Neither the variant of the effect nor the frame has the parameter.
            raise KeyError(name)

        def evaluate(value: float) -> np.ndarray:
            """Return mean and variance [2, row, column] of the model with the parameter at `value`."""
            change: dict[str, Any] = {name: value}
            model, conditions = self, frame
            if applied:
                changed = applied.with_value(parameter, value)
                effects = (changed if effect is applied else effect for effect in self.effects)
                model = replace(self, effects=tuple(effects))
            elif self.law is not None and in_law:
                model = replace(self, law=replace(self.law, **change))
            else:
                conditions = replace(frame, **change)
            return np.array(model.expected(conditions))

        scale = max(abs(value), LEAST_EFFECT_SCALE if applied else LEAST_LAW_SCALE)
        if name in ("x0", "y0"):
            scale = self.spot(frame).sigma_px
        elif applied and {p.name: p.unit for p in applied.effect.parameters}[parameter] == "s":
            scale = frame.exposure_s
        step = RELATIVE_STEP * scale
        mean, variance = (evaluate(value + step) - evaluate(value - step)) / (2 * step)
        return mean, variance


@lru_cache(maxsize=16)
def _granular_table(
    table: ReadingTable, grains: tuple[AppliedStep, ...], pedestal_dn: float, light_max: float
) -> ReadingTable:
    """Return the table of readings of granular light: the light of `table`, multiplied by the random steps `grains`.

    It goes up to the mean light `light_max` [DN]. The light of the pedestal, `pedestal_dn`, has no grains.
    """
    for step in grains:
        table = table.with_random_factor(*step.quadrature(), pedestal_dn, light_max)
    return table


@lru_cache(maxsize=4)
def _draw(step: AppliedStep, shape: tuple[int, int], seed: int, key: int) -> Any:
    """Return the drawn number or field [row, column] of a random step, for a frame of `shape` (rows, columns).

    `key` is the number of the frame, site or sensor (`RandomStreams.key`). Draws are cached, as frames of a site follow
    each other.
    """
    assert step.random_step is not None
    # Each step of an effect has a generator of its own. The key of the first step ends without its index.
    index = step.applied.effect.variants[step.applied.variant].index(step.step)
    spawn_key = (step.applied.effect.number, key, index) if index else (step.applied.effect.number, key)
    return step.call(step.random_step.draw, _generator(seed, *spawn_key), shape)


def _generator(seed: int, *key: int) -> np.random.Generator:
    """Return a random generator that is independent of those with another seed or key."""
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)))
