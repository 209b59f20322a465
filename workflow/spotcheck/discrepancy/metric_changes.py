"""The paper's metrics of held-out frames, beside those of frames simulated by the declared and the extended model.

Simulated frames have the conditions and masked pixels of the measured ones, the predicted spots, and noise. The
extended model's also have all its random effects. Both models use the same random numbers, so that a metric differs
between them by what the effects do.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from spotcheck.discrepancy.evaluation import THREADS
from spotcheck.discrepancy.findings import MetricChange
from spotcheck.discrepancy.frames import FrameParameters, FrameSet
from spotcheck.discrepancy.laws import is_law
from spotcheck.discrepancy.named_scatter import NamedScatter
from spotcheck.discrepancy.nested_models import ValidatedChain
from spotcheck.discrepancy.starting_spots import acts_on_mean
from spotcheck.discrepancy.validation import NestedModel, PixelGains
from spotcheck.fitting.spotfit import fit_spots
from spotcheck.metrics import crop_metrics
from spotcheck.model.conditions import FrameConditions, crop_grid
from spotcheck.model.effect import AppliedEffect, Effect, Only, RandomStep, Step
from spotcheck.model.forward import ForwardModel, RandomStreams
from spotcheck.model.stage import Stage

PSNR = "PSNR"
# Metrics of single crops: name, unit, function.
OF_IMAGES: tuple[tuple[str, str, Callable[[np.ndarray], float]], ...] = (
    ("speckle contrast", "1", crop_metrics.speckle_contrast),
    ("maximum", "DN", crop_metrics.largest_reading),
    ("sum", "DN", crop_metrics.pixel_sum),
)
# Metrics of the spot fit: name, unit, attribute of `SpotFits`.
OF_FITS = (("amplitude", "DN", "amplitude"), ("width", "px", "sigma_mean"))
# Key of the random numbers of the gains of pixels.
GAINS_KEY = 1


@dataclass(frozen=True)
class FrameSimulator:
    """A model of a chain that draws frames at predicted spots."""

    forward: ForwardModel  # without a law of the exposure, with random effects
    gains: PixelGains | None  # gains of pixels; None if all are alike
    spots: FrameParameters  # spot of each frame
    frames: FrameSet  # measured frames, whose conditions and masked pixels the drawn ones share

    def conditions(self, number: int) -> FrameConditions:
        """Return the conditions of a frame."""
        frames, design, spots = self.frames, self.frames.design, self.spots
        rows, columns = (range(corner[number], corner[number] + size) for corner, size in
                         zip((frames.top, frames.left), frames.readings.shape[1:], strict=True))  # fmt: skip
        return FrameConditions(
            pixels=crop_grid(columns, rows, frames.sensor_columns, frames.sensor_rows),
            x0=float(spots.x[number]),
            y0=float(spots.y[number]),
            exposure_s=float(design.exposure_s[number]),
            longest_s=design.longest_s,
            reference_s=design.reference_s,
            angle=float(design.angle[number]),
            order=float(design.order[number]),
            peak_dn=float(np.exp(spots.log_peak[number])),
            sigma_px=float(np.exp(spots.log_sigma[number])),
        )

    def draw(self, seed: int) -> np.ndarray:
        """Return one random frame for each measured one [frame, row, column] in DN; NaN at masked pixels."""
        frames, gains = self.frames, self.gains
        if gains is not None:
            rng = np.random.default_rng([GAINS_KEY, seed])
            deviation = np.sqrt(gains.variance) * rng.standard_normal(gains.mean.shape)
            gains = replace(gains, mean=gains.mean + deviation)
        readings = np.empty(frames.readings.shape)
        # Frames of a site follow each other: what is drawn for a site is kept for the next frame.
        for number in np.argsort(frames.design.site, kind="stable"):
            forward = replace(self.forward, effects=(*self.forward.effects, *self._gains_under(number, gains)))
            streams = RandomStreams(seed, int(number), int(frames.design.site[number]))
            readings[number] = forward.sample(self.conditions(number), streams)
        return np.where(np.isfinite(frames.readings), readings, np.nan)

    def mean_readings(self) -> np.ndarray:
        """Return the mean image of each frame [frame, row, column] in DN, without random effects."""
        images, effects = [], tuple(filter(acts_on_mean, self.forward.effects))
        for number in range(len(self.frames)):
            forward = replace(self.forward, effects=(*effects, *self._gains_under(number, self.gains)))
            images.append(forward.expected(self.conditions(number)).mean)
        return np.stack(images)

    def _gains_under(self, number: int, gains: PixelGains | None) -> tuple[AppliedEffect, ...]:
        """Return the gains of pixels under a frame as an effect; nothing without gains."""
        if gains is None:
            return ()
        top, left = int(self.frames.top[number]), int(self.frames.left[number])
        return (_apply_gains(gains.under_crop(top, left, self.frames.readings.shape[1:])[0]),)


def _apply_gains(gains: np.ndarray) -> AppliedEffect:
    """Return an effect that multiplies the light of each pixel by 1 + gains [row, column]."""

    def multiply_light(frame: FrameConditions, light_dn: np.ndarray) -> np.ndarray:
        return light_dn * np.maximum(1 + gains, 0.0)

    steps = (Step(Stage.PIXEL_GAIN, multiply_light),)
    effect = Effect("gains", "gains of pixels", (), {Only.ONLY: steps}, starts=lambda scales: [()])
    return AppliedEffect(effect, Only.ONLY, ())


def compare_metrics(
    validated: ValidatedChain, unseen: FrameSet, scatter: Sequence[NamedScatter], seed: int = 0
) -> tuple[MetricChange, ...]:
    """Return the paper's metrics of measured frames and of frames simulated by the first and last model of a chain.

    Parameters
    ----------
    validated : ValidatedChain
        Chain of models, with the spots that they predict for the held-out frames.
    unseen : FrameSet
        The held-out frames.
    scatter : sequence of NamedScatter
        Effects that scatter; those that the chain holds are drawn.
    seed : int
        Seed of the simulated frames.

    Returns
    -------
    tuple of MetricChange
        PSNR, speckle contrast, maximum, sum, amplitude and width. Each is the mean over conditions of its means over
        the frames of a condition. A metric that no frame has is left out.

    Notes
    -----
    The measured PSNR is that between repeats of a condition at the same angle. The difference between both repeats that
    the extended model predicts, such as a shift of the spot, is taken off. A simulated frame of a true model then comes
    as near to the measured one as a repeat does. All are relative to the sensor's largest reading.
    """
    chain, predictions = validated.chain, validated.predictions
    rows = np.array([predictions[end].spots.as_rows() for end in (0, -1)])
    kept = np.flatnonzero(np.isfinite(rows).all(axis=(0, 1)))
    if len(kept) == 0:
        return ()
    frames = unseen.select(kept)
    added = {nested.added for nested in chain}
    drawn = [named.applied for named in scatter if named.applied.effect.name in added and not named.reasons]
    declared = _simulator_of(chain[0], [], predictions[0].spots.select(kept), frames)
    extended = _simulator_of(chain[-1], drawn, predictions[-1].spots.select(kept), frames)
    tables = _measure_sources(frames, declared, extended, seed)
    units = {PSNR: "dB"} | {name: unit for name, unit, _ in (*OF_IMAGES, *OF_FITS)}
    changes = []
    for name, unit in units.items():
        values = np.array([table[name] for table in tables])
        has_value = np.isfinite(values).all(axis=0)
        if has_value.any():
            means = _mean_over_conditions(values[:, has_value], frames.design.condition[has_value])
            changes.append(MetricChange(name, unit, *(float(mean) for mean in means)))
    return tuple(changes)


def _simulator_of(
    nested: NestedModel, scatter: Sequence[AppliedEffect], spots: FrameParameters, frames: FrameSet
) -> FrameSimulator:
    """Return the simulator of a model, with effects that scatter, at the spots that it predicts."""
    effects = [applied for applied in nested.forward.effects if not is_law(applied.effect)]
    names = {applied.effect.name for applied in effects}
    # Gains of pixels are known from other frames: they are not drawn anew.
    effects += [applied for applied in scatter if applied.effect.name not in names and not _is_random_gain(applied)]
    forward = replace(nested.forward, law=None, effects=tuple(effects))
    return FrameSimulator(forward, nested.scatter.gains, spots, frames)


def _measure_sources(
    frames: FrameSet, declared: FrameSimulator, extended: FrameSimulator, seed: int
) -> list[dict[str, np.ndarray]]:
    """Return all metrics [frame] by name of measured frames, of the declared and of the extended model's."""
    images = [frames.readings.astype(float), declared.draw(seed), extended.draw(seed)]
    with ThreadPoolExecutor(THREADS) as pool:
        tables = list(pool.map(partial(_measure_images, forward=declared.forward), images))
    full_scale_dn = declared.forward.sensor.full_scale_dn
    tables[0][PSNR] = _psnr_of_repeats(frames, extended.mean_readings(), full_scale_dn)
    for table, simulated in zip(tables[1:], images[1:], strict=True):
        pairs = zip(images[0], simulated, strict=True)
        table[PSNR] = np.array([crop_metrics.psnr(reference, image, full_scale_dn) for reference, image in pairs])
    return tables


def _is_random_gain(applied: AppliedEffect) -> bool:
    """Return whether an effect draws gains of pixels."""
    steps = applied.effect.variants[applied.variant]
    return any(isinstance(step, RandomStep) and step.stage is Stage.PIXEL_GAIN for step in steps)


def _measure_images(images: np.ndarray, forward: ForwardModel) -> dict[str, np.ndarray]:
    """Return the metrics [frame] of images [frame, row, column] by name; NaN where the fit has failed."""
    table = {name: np.array([function(image) for image in images]) for name, _, function in OF_IMAGES}
    baseline = forward.baseline
    fits = fit_spots(images, forward.sensor, top_hat=baseline.top_hat, integrated=baseline.pixel_integration)
    return table | {name: np.where(fits.flags == 0, getattr(fits, attribute), np.nan) for name, _, attribute in OF_FITS}


def _psnr_of_repeats(frames: FrameSet, means: np.ndarray, full_scale_dn: float) -> np.ndarray:
    """Return the mean PSNR [frame, dB] of each frame to other repeats of its condition at its angle; NaN without any.

    The other repeat is corrected by the difference of their mean images `means` [frame, row, column] in DN.
    """
    design, readings = frames.design, frames.readings
    keys = np.stack([design.condition, design.angle], axis=1)
    total, count = np.zeros(len(frames)), np.zeros(len(frames))
    for first in range(len(frames)):
        for second in np.flatnonzero((keys == keys[first]).all(axis=1)):
            if second > first:
                corrected = readings[second] - means[second] + means[first]
                ratio = crop_metrics.psnr(readings[first], corrected, full_scale_dn)
                for number in (first, int(second)):
                    total[number] += ratio
                    count[number] += 1
    return np.divide(total, count, out=np.full(len(frames), np.nan), where=count > 0)


def _mean_over_conditions(values: np.ndarray, condition: np.ndarray) -> np.ndarray:
    """Return the means over conditions of the means over their frames, of values [source, frame]."""
    numbers = np.unique(condition)
    return np.mean([values[:, condition == number].mean(axis=1) for number in numbers], axis=0)
