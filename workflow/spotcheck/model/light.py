"""The light of a frame: stages from the exposure to the gains of pixels, walked in their order.

`drawn` gives what the random steps of effects have drawn, by step. Steps without a draw are skipped. That gives the
mean light only if their factor has the mean 1 and later stages are linear.
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

# Number or field that each random step has drawn.
Drawn = Mapping[AppliedStep, Any]
NOTHING_DRAWN: Drawn = MappingProxyType({})


@dataclass(frozen=True)
class ExposureLaw:
    """Parameters of the baseline's law of the exposure."""

    p1: float  # rise of p_b with ln(t / 1 s) [px]
    p2: float  # p_b at 1 s [px]
    peak_dn: float  # peak of the spot at the longest exposure [DN]


@dataclass(frozen=True)
class Light:
    """Light of a frame [DN] behind the gains of pixels; each part broadcasts with the pixels."""

    spot: np.ndarray  # light of the spot and what belongs to it, without pedestals
    pedestal: np.ndarray | float  # light of pedestals

    @property
    def total(self) -> np.ndarray:
        """Light that pixels convert [DN]."""
        return self.spot + self.pedestal


class LightStages:
    """The stages up to the pixels, as methods of a model with a baseline, a law and effects.

    `drawn` holds the number or field of each random step that was drawn; the others leave the light as it is.
    """

    baseline: Baseline
    law: ExposureLaw | None
    effects: tuple[AppliedEffect, ...]

    def steps_at(self, stage: Stage) -> list[AppliedStep]:
        """Return the steps of all effects at a stage: random ones first, which act on the sensor's coordinates, then
        the others, in the order of the effects' numbers."""
        steps = [step for applied in self.effects for step in applied.steps_at(stage)]
        return sorted(steps, key=lambda step: (step.random is None, step.applied.effect.number))

    def apply_stage(self, stage: Stage, drawn: Drawn, frame: FrameConditions | None, *value: Any) -> Any:
        """Return what the steps of all effects at a stage make of a value, or of a pair of values."""
        result: Any = value if len(value) > 1 else value[0]
        for step in self.steps_at(stage):
            arguments = result if isinstance(result, tuple) else (result,)
            if frame is not None:
                arguments = (frame, *arguments)
            if step.random is None:
                result = step(*arguments)
            elif step in drawn:
                result = step(*arguments, drawn[step])
        return result

    def true_exposure(self, frame: FrameConditions, drawn: Drawn = NOTHING_DRAWN) -> float:
        """Return the true exposure [s], which the law of the exposure, dark current and motion follow."""
        return self.apply_stage(Stage.EXPOSURE, drawn, frame, frame.exposure_s)

    def spot(self, frame: FrameConditions, drawn: Drawn = NOTHING_DRAWN) -> SpotState:
        """Return peak and width of a frame's spot; without a law those of the frame's conditions."""
        baseline, law = self.baseline, self.law
        if law is None:
            width = self.apply_stage(Stage.WIDTH, drawn, frame, WidthLaw(lambda exposure_s: frame.sigma_px))
            peak, sigma = frame.peak_dn, frame.sigma_px * width.factor
        else:
            width = WidthLaw(lambda exposure_s: baseline.propagation(exposure_s, law.p1, law.p2))
            width = self.apply_stage(Stage.WIDTH, drawn, frame, width)
            exposure_s = self.true_exposure(frame, drawn)
            propagation = width.propagation_px(exposure_s)
            longest = baseline.peak_law(frame.longest_s, width.propagation_px(frame.longest_s))
            peak = law.peak_dn * baseline.peak_law(exposure_s, propagation) / longest
            sigma = (propagation + baseline.laser_px) * width.factor
        return SpotState(self.apply_stage(Stage.BRIGHTNESS, drawn, frame, peak), sigma)

    def copies(self, frame: FrameConditions, drawn: Drawn = NOTHING_DRAWN) -> Iterator[tuple[Any, Any, Any]]:
        """Yield the copies of the sharp spot of which the light consists: displacements dx, dy [px] of the pixels from
        the centre of a round spot, and the weight of the copy."""
        exposed = replace(frame, exposure_s=self.true_exposure(frame, drawn))
        path = np.array([[0.0], [0.0], [1.0]])
        for step in self.steps_at(Stage.BLUR):
            path = convolve_paths(path, step(exposed))
        if self.baseline.pixel_integration:
            path = convolve_paths(path, np.transpose(PIXEL))
        for shift_x, shift_y, weight in np.moveaxis(path, 0, 1):
            dx, dy = frame.pixels.x - frame.x0 - shift_x, frame.pixels.y - frame.y0 - shift_y
            yield *self.apply_stage(Stage.COORDINATES, drawn, frame, dx, dy), weight

    def light(self, frame: FrameConditions, drawn: Drawn = NOTHING_DRAWN) -> Light:
        """Return the light of a frame [DN]."""
        spot = self.spot(frame, drawn)
        total = sum(weight * self._sharp(frame, spot, dx, dy, drawn) for dx, dy, weight in self.copies(frame, drawn))
        for step in self.steps_at(Stage.ADDED_LIGHT):
            total = step(frame, total, spot)
        for stage in (Stage.MODULATION, Stage.SPECKLE_FIELD):
            total = self.apply_stage(stage, drawn, frame, total)
        pedestal = self.apply_stage(Stage.PEDESTAL, drawn, frame, 0.0)
        return Light(*(self.apply_stage(Stage.PIXEL_GAIN, drawn, frame, part) for part in (total, pedestal)))

    def _sharp(self, frame: FrameConditions, spot: SpotState, dx: Any, dy: Any, drawn: Drawn) -> np.ndarray:
        """Return the light [DN] of the sharp spot at displacements [px]."""
        if not self.steps_at(Stage.PROFILE):
            return self.baseline.spot(dx, dy, spot.peak_dn, spot.sigma_px)
        half_square = (dx * dx + dy * dy) / (2 * spot.sigma_px**2)
        exponent = self.apply_stage(Stage.PROFILE, drawn, frame, half_square)
        return self.baseline.finish(spot.peak_dn * np.exp(-exponent), dx, dy, spot.peak_dn, spot.sigma_px)

    def shape_response(self, frame: FrameConditions) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield places u, v [σ] in the shape for each copy of the spot, and the derivative of the light [DN] by it."""
        spot = self.spot(frame)
        factor = np.ones(np.broadcast_shapes(np.shape(frame.pixels.x), np.shape(frame.pixels.y)))
        for stage in (Stage.MODULATION, Stage.SPECKLE_FIELD, Stage.PIXEL_GAIN):
            factor = self.apply_stage(stage, NOTHING_DRAWN, frame, factor)
        for dx, dy, weight in self.copies(frame):
            yield dx / spot.sigma_px, dy / spot.sigma_px, weight * spot.peak_dn * factor


def convolve_paths(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return every pair of displacements of two paths [3, point, …]: dx and dy add up, weights multiply.

    Further axes are those of frames, if paths differ between frames.
    """
    axes = max(first.ndim, second.ndim)
    first, second = (path.reshape(path.shape + (1,) * (axes - path.ndim)) for path in (first, second))
    first, second = first[:, :, None], second[:, None]
    paths = np.concatenate([first[:2] + second[:2], first[2:] * second[2:]])
    return paths.reshape(3, -1, *paths.shape[3:])
