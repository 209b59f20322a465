"""The light of a frame: the stages of the forward model from the exposure to the gains of pixels, in their order.

An effect has steps: functions that act at stages. A random step also takes a number or field that is drawn. `drawn`
holds these draws by step. Random steps without a draw are skipped: the result is then the mean light only if they
multiply by a factor of mean 1 and later stages are linear. Lengths are in px of the sensor, and widths are the standard
deviation σ_g of the spot's Gaussian.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from spotcheck.model.baseline import Baseline
from spotcheck.model.conditions import FrameConditions, SpotState, WidthLaw
from spotcheck.model.effect import AppliedEffect, AppliedStep
from spotcheck.model.spot import PIXEL
from spotcheck.model.stage import Stage

# Random step → the number or field [row, column] that was drawn for it.
Drawn = Mapping[AppliedStep, Any]
NOTHING_DRAWN: Drawn = MappingProxyType({})


@dataclass(frozen=True)
class ExposureLaw:
    """Parameters of the exposure law: the baseline's width p_b = p1 ln(t/1 s) + p2 and peak at an exposure t."""

    p1: float  # rise of the beam propagation p_b with ln(t/1 s) [px]
    p2: float  # p_b at 1 s [px]
    peak_dn: float  # peak of the spot at the longest exposure [DN]


@dataclass(frozen=True)
class Light:
    """Light of a frame [DN] after the gains of pixels; both parts broadcast with the pixels [row, column]."""

    spot: np.ndarray  # light of the spot, with halo, ghosts and modulation, without pedestals
    pedestal: np.ndarray | float  # light of pedestals, which lie under the spot

    @property
    def total(self) -> np.ndarray:
        """Sum of both parts [DN], the light that pixels convert to electrons."""
        return self.spot + self.pedestal


class LightStages:
    """The stages up to the gains of pixels, as methods of a model with a baseline, an exposure law and effects."""

    baseline: Baseline  # the part of the model that the instrument fixes
    law: ExposureLaw | None  # exposure law; None: each frame has its own peak and width
    effects: tuple[AppliedEffect, ...]  # effects with the values of their parameters

    def steps_at(self, stage: Stage) -> list[AppliedStep]:
        """Return the steps of all effects at a stage, random ones first, each in the order of the effects' numbers.

        Random steps come first because their draws refer to the coordinates of the sensor.
        """
        steps = [step for applied in self.effects for step in applied.steps_at(stage)]
        return sorted(steps, key=lambda step: (step.random_step is None, step.applied.effect.number))

    def apply_stage(self, stage: Stage, drawn: Drawn, frame: FrameConditions | None, *value: Any) -> Any:
        """Apply the steps of all effects at a stage one after another, and return the result.

        `value` is the argument of the first step, or a pair of arguments such as dx and dy; the result has the same
        form. Each further step takes the result of the previous one. `frame` is None at stages whose functions take no
        frame.
        """
        result: Any = value if len(value) > 1 else value[0]
        for step in self.steps_at(stage):
            arguments = result if isinstance(result, tuple) else (result,)
            if frame is not None:
                arguments = (frame, *arguments)
            if step.random_step is None:
                result = step(*arguments)
            elif step in drawn:
                result = step(*arguments, drawn[step])
            elif frame is not None and step.applied.effect.name in frame.draws:
                result = step(*arguments, frame.draws[step.applied.effect.name])
        return result

    def true_exposure(self, frame: FrameConditions, drawn: Drawn = NOTHING_DRAWN) -> float:
        """Return the true exposure of a frame [s], on which exposure law, dark current and motion blur depend."""
        return self.apply_stage(Stage.EXPOSURE, drawn, frame, frame.exposure_s)

    def spot(self, frame: FrameConditions, drawn: Drawn = NOTHING_DRAWN) -> SpotState:
        """Return peak and width of the spot of a frame, after the effects on width and brightness.

        They come from the exposure law, or from the conditions of the frame if there is no law.
        """
        baseline, law = self.baseline, self.law
        if law is None:
            # Effects on the width change only its factor then.
            width = self.apply_stage(Stage.WIDTH, drawn, frame, WidthLaw(lambda exposure_s: frame.sigma_px))
            peak, sigma = frame.peak_dn, frame.sigma_px * width.factor
        else:
            width = WidthLaw(lambda exposure_s: baseline.propagation(exposure_s, law.p1, law.p2))
            width = self.apply_stage(Stage.WIDTH, drawn, frame, width)
            exposure_s = self.true_exposure(frame, drawn)
            propagation_px = width.propagation_px(exposure_s)
            # The law states the peak at the longest exposure.
            longest_factor = baseline.peak_law(frame.longest_s, width.propagation_px(frame.longest_s))
            peak = law.peak_dn * baseline.peak_law(exposure_s, propagation_px) / longest_factor
            sigma = (propagation_px + baseline.laser_px) * width.factor
        return SpotState(self.apply_stage(Stage.BRIGHTNESS, drawn, frame, peak), sigma)

    def copies(self, frame: FrameConditions, drawn: Drawn = NOTHING_DRAWN) -> Iterator[tuple[Any, Any, Any]]:
        """Yield dx, dy [px] and weight [1] of each copy of the sharp spot; their weighted sum is the blurred spot.

        dx, dy are the displacements of the pixels from the centre of the copy, on a round spot; they broadcast with the
        pixels.
        """
        # Blurs depend on the true exposure.
        true_frame = replace(frame, exposure_s=self.true_exposure(frame, drawn))
        # dx [px], dy [px] and weight of each copy, [3, copy]: at first one copy at the place of the spot.
        shifts = np.array([[0.0], [0.0], [1.0]])
        for step in self.steps_at(Stage.BLUR):
            shifts = convolve_shifts(shifts, step(true_frame))
        if self.baseline.pixel_integration:
            shifts = convolve_shifts(shifts, np.transpose(PIXEL))
        for shift_x, shift_y, weight in np.moveaxis(shifts, 0, 1):
            dx, dy = frame.pixels.x - frame.x0 - shift_x, frame.pixels.y - frame.y0 - shift_y
            yield *self.apply_stage(Stage.COORDINATES, drawn, frame, dx, dy), weight

    def light(self, frame: FrameConditions, drawn: Drawn = NOTHING_DRAWN) -> Light:
        """Return the light of a frame [DN] after the gains of pixels."""
        spot = self.spot(frame, drawn)
        light = sum(
            weight * self._sharp_light(frame, spot, dx, dy, drawn) for dx, dy, weight in self.copies(frame, drawn)
        )
        for step in self.steps_at(Stage.ADDED_LIGHT):
            light = step(frame, light, spot)
        for stage in (Stage.MODULATION, Stage.SPECKLE_FIELD):
            light = self.apply_stage(stage, drawn, frame, light)
        pedestal = self.apply_stage(Stage.PEDESTAL, drawn, frame, 0.0)
        return Light(*(self.apply_stage(Stage.PIXEL_GAIN, drawn, frame, part) for part in (light, pedestal)))

    def _sharp_light(self, frame: FrameConditions, spot: SpotState, dx: Any, dy: Any, drawn: Drawn) -> np.ndarray:
        """Return the light [DN] of the spot without blur at displacements dx, dy from its centre [px].

        Effects at the profile replace the exponent ρ²/2 of the Gaussian, with the distance ρ from the centre in σ_g.
        """
        if not self.steps_at(Stage.PROFILE):
            return self.baseline.spot(dx, dy, spot.peak_dn, spot.sigma_px)
        half_square = (dx * dx + dy * dy) / (2 * spot.sigma_px**2)
        exponent = self.apply_stage(Stage.PROFILE, drawn, frame, half_square)
        profile = spot.peak_dn * np.exp(-exponent)
        return self.baseline.add_top_hat_and_shape(profile, dx, dy, spot.peak_dn, spot.sigma_px)

    def shape_response(self, frame: FrameConditions) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield u, v and ∂light/∂s for each copy of the spot: how the light depends on the learned light shape s(u, v).

        u, v [σ_g] are the places of the pixels in the shape, and ∂light/∂s [DN] is the derivative of their light by the
        value of s there. All broadcast with the pixels. Random steps count as absent.
        """
        spot = self.spot(frame)
        # Factor on the light of the spot by the stages that are proportional to it.
        factor = np.ones(np.broadcast_shapes(np.shape(frame.pixels.x), np.shape(frame.pixels.y)))
        for stage in (Stage.MODULATION, Stage.SPECKLE_FIELD, Stage.PIXEL_GAIN):
            factor = self.apply_stage(stage, NOTHING_DRAWN, frame, factor)
        for dx, dy, weight in self.copies(frame):
            yield dx / spot.sigma_px, dy / spot.sigma_px, weight * spot.peak_dn * factor


def convolve_shifts(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the convolution of two sets of copies [3, copy, ...]: dx, dy of every pair are added, weights multiplied.

    The first axis is dx [px], dy [px] and weight [1]. Further axes, which broadcast, are those of frames whose copies
    differ.
    """
    # Missing axes of frames get the length 1.
    axes = max(first.ndim, second.ndim)
    first, second = (shifts.reshape(shifts.shape + (1,) * (axes - shifts.ndim)) for shifts in (first, second))
    # One axis for the copies of each set, [3, copy of the first, copy of the second, ...].
    first, second = first[:, :, None], second[:, None]
    pairs = np.concatenate([first[:2] + second[:2], first[2:] * second[2:]])
    return pairs.reshape(3, -1, *pairs.shape[3:])
