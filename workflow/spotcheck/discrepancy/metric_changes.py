"""The paper's metrics of held-out frames, compared with frames simulated by the declared and the extended model.

A chain of nested models leads from the declared model, without effects, to the extended one with all of them. It
predicts the spot (peak, width and centre) of each held-out frame. Simulated frames have the conditions and masked
pixels of the measured ones, the predicted spots, and noise. Those of the extended model also have all its random
effects. Both models use the same random numbers, so that only the effects make their metrics differ. A law gives
brightness and width of the spot from the conditions of a frame, such as its exposure.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

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
# Metrics of single crops: name, unit, function of the crop [row, column] in DN.
OF_IMAGES: tuple[tuple[str, str, Callable[[np.ndarray], float]], ...] = (
    ("speckle contrast", "1", crop_metrics.speckle_contrast),
    ("maximum", "DN", crop_metrics.largest_reading),
    ("sum", "DN", crop_metrics.pixel_sum),
)
# Metrics of the spot fit: name, unit, attribute of `SpotFits`.
OF_FITS = (("amplitude", "DN", "amplitude"), ("width", "px", "sigma_mean"))
# First part of the seed of pixel gains, which keeps them independent of other random numbers.
GAINS_KEY = 1


@dataclass(frozen=True)
class FrameSimulator:
    """A model of a chain that draws frames at predicted spots; frames are addressed by their index."""

    forward: ForwardModel  # model without a law of the exposure, with random effects
    gains: PixelGains | None  # gains of pixels and their errors; None if all pixels have the same gain
    spots: FrameParameters  # predicted spot of each frame
    frames: FrameSet  # measured frames, whose conditions and masked pixels the drawn ones share

    def conditions(self, frame: int) -> FrameConditions:
        """Return the conditions of a frame for the forward model, with the pixels of its crop."""
        frames, design, spots = self.frames, self.frames.design, self.spots
        rows, columns = (range(corner[frame], corner[frame] + size) for corner, size in
                         zip((frames.top, frames.left), frames.readings.shape[1:], strict=True))  # fmt: skip
        return FrameConditions(
            pixels=crop_grid(columns, rows, frames.sensor_columns, frames.sensor_rows),
            x0=float(spots.x[frame]),
            y0=float(spots.y[frame]),
            exposure_s=float(design.exposure_s[frame]),
            longest_s=design.longest_s,
            reference_s=design.reference_s,
            angle=float(design.angle[frame]),
            order=float(design.order[frame]),
            peak_dn=float(np.exp(spots.log_peak[frame])),
            sigma_px=float(np.exp(spots.log_sigma[frame])),
        )

    def draw(self, seed: int) -> np.ndarray:
        """Return one random frame for each measured one [frame, row, column] in DN; NaN at masked pixels."""
        frames, gains = self.frames, self.gains
        if gains is not None:
            # The gains are estimates: their errors are drawn.
            rng = np.random.default_rng([GAINS_KEY, seed])
            deviation = np.sqrt(gains.variance) * rng.standard_normal(gains.mean.shape)
            gains = replace(gains, mean=gains.mean + deviation)
        readings = np.empty(frames.readings.shape)
        # Frames of a site come one after the other, since the forward model keeps what it has drawn for a site.
        for frame in np.argsort(frames.design.site, kind="stable"):
            forward = self._with_gains(self.forward.effects, frame, gains)
            streams = RandomStreams(seed, int(frame), int(frames.design.site[frame]))
            readings[frame] = forward.sample(self.conditions(frame), streams)
        return np.where(np.isfinite(frames.readings), readings, np.nan)

    def mean_readings(self) -> np.ndarray:
        """Return the mean image of each frame [frame, row, column] in DN, without random effects."""
        images, effects = [], tuple(filter(acts_on_mean, self.forward.effects))
        for frame in range(len(self.frames)):
            images.append(self._with_gains(effects, frame, self.gains).expected(self.conditions(frame)).mean)
        return np.stack(images)

    def _with_gains(self, effects: tuple[AppliedEffect, ...], frame: int, gains: PixelGains | None) -> ForwardModel:
        """Return the model with some effects, and with the gains of the pixels under the crop of a frame as another."""
        if gains is not None:
            top, left = int(self.frames.top[frame]), int(self.frames.left[frame])
            effects = (*effects, _apply_gains(gains.under_crop(top, left, self.frames.readings.shape[1:])[0]))
        return replace(self.forward, effects=effects)


def _apply_gains(gains: np.ndarray) -> AppliedEffect:
    """Return an effect without parameters that multiplies the light of each pixel by 1 + gains [row, column]."""

    def multiply_light(frame: FrameConditions, light_dn: np.ndarray) -> np.ndarray:
        """Return the light [DN] times 1 + gains, at least 0; the frame has no influence."""
        return light_dn * np.maximum(1 + gains, 0.0)

    steps = (Step(Stage.PIXEL_GAIN, multiply_light),)
    return Effect("gains", "gains of pixels", (), {Only.ONLY: steps}, starts=lambda scales: [()]).apply({})


def compare_metrics(
    validated: ValidatedChain, unseen: FrameSet, scatter: Sequence[NamedScatter], seed: int = 0
) -> tuple[MetricChange, ...]:
    """Compare the paper's metrics of measured frames with those of frames simulated by both ends of a chain.

    Parameters
    ----------
    validated : ValidatedChain
        Chain of models (`NestedModel`: the effect that it `added`, its `forward` model and its `scatter`), with the
        spots that each predicts for the held-out frames.
    unseen : FrameSet
        The held-out frames.
    scatter : sequence of NamedScatter
        Random effects, with `reasons` if one is not named. Those that a model of the chain has added are drawn in
        frames of the extended model.
    seed : int
        Seed of the simulated frames.

    Returns
    -------
    tuple of MetricChange
        PSNR, speckle contrast, maximum, sum, amplitude and width. Each is the mean over conditions of its means over
        the frames of a condition. A metric that no frame has is left out; all are if no frame has a predicted spot.

    Notes
    -----
    The PSNR of a simulated frame is that to the measured one. The measured PSNR is that between repeats of a condition
    at the same angle. From these the difference that the extended model predicts, such as a shift of the spot, is
    subtracted. A frame simulated by a true model is then as close to the measured one as a repeat is. The peak of all
    PSNR is the sensor's largest reading.
    """
    chain, predictions = validated.chain, validated.predictions
    rows = np.array([predictions[end].spots.as_rows() for end in (0, -1)])
    predicted = np.flatnonzero(np.isfinite(rows).all(axis=(0, 1)))
    if len(predicted) == 0:
        return ()
    frames = unseen.select(predicted)
    added = {nested.added for nested in chain}
    random_effects = [named.applied for named in scatter if named.applied.effect.name in added and not named.reasons]
    declared = _build_simulator(chain[0], [], predictions[0].spots.select(predicted), frames)
    extended = _build_simulator(chain[-1], random_effects, predictions[-1].spots.select(predicted), frames)
    tables = _measure_sources(frames, declared, extended, seed)
    units = {PSNR: "dB"} | {name: unit for name, unit, _ in (*OF_IMAGES, *OF_FITS)}
    changes = []
    for name, unit in units.items():
        values = np.array([table[name] for table in tables])
        has_value = np.isfinite(values).all(axis=0)
        if has_value.any():
            conditions = [
                has_value & (frames.design.condition == k) for k in np.unique(frames.design.condition[has_value])
            ]
            means = np.mean([values[:, members].mean(axis=1) for members in conditions], axis=0)
            changes.append(MetricChange(name, unit, *means.tolist()))
    return tuple(changes)


def _build_simulator(
    nested: NestedModel, random_effects: Sequence[AppliedEffect], spots: FrameParameters, frames: FrameSet
) -> FrameSimulator:
    """Return the simulator of a model of the chain with random effects, at the spots that it predicts for frames."""
    # The predicted spots contain the laws across frames.
    effects = [applied for applied in nested.forward.effects if not is_law(applied.effect)]
    names = {applied.effect.name for applied in effects}
    # Gains of pixels were estimated from other frames: only the error of that estimate is drawn, not new gains.
    effects += [
        applied for applied in random_effects if applied.effect.name not in names and not _is_random_gain(applied)
    ]
    forward = replace(nested.forward, law=None, effects=tuple(effects))
    return FrameSimulator(forward, nested.scatter.gains, spots, frames)


def _measure_sources(
    frames: FrameSet, declared: FrameSimulator, extended: FrameSimulator, seed: int
) -> list[dict[str, np.ndarray]]:
    """Return the metrics [frame] by name of three sources: measured frames, declared model and extended model.

    All are fitted with the declared shape. The PSNR is that of the notes of `compare_metrics`.
    """
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
    """Return whether an effect draws the gains of pixels at random."""
    steps = applied.effect.variants[applied.variant]
    return any(isinstance(step, RandomStep) and step.stage is Stage.PIXEL_GAIN for step in steps)


def _measure_images(images: np.ndarray, forward: ForwardModel) -> dict[str, np.ndarray]:
    """Return the metrics [frame] of images [frame, row, column] in DN by name, without PSNR; NaN if the fit fails.

    `forward` gives the sensor and the shape that are fitted.
    """
    table = {name: np.array([function(image) for image in images]) for name, _, function in OF_IMAGES}
    baseline = forward.baseline
    fits = fit_spots(images, forward.sensor, top_hat=baseline.top_hat, integrated=baseline.pixel_integration)
    return table | {name: np.where(fits.flags == 0, getattr(fits, attribute), np.nan) for name, _, attribute in OF_FITS}


def _psnr_of_repeats(frames: FrameSet, means: np.ndarray, full_scale_dn: float) -> np.ndarray:
    """Return the mean PSNR of each frame to other repeats of its condition at its angle [frame] in dB.

    The difference of their mean images `means` [frame, row, column] in DN is subtracted. NaN without other repeats.
    """
    design, readings = frames.design, frames.readings
    keys = np.stack([design.condition, design.angle], axis=1)
    total, count = np.zeros(len(frames)), np.zeros(len(frames))
    for first, second in combinations(range(len(frames)), 2):
        if (keys[first] == keys[second]).all():
            corrected = readings[second] - means[second] + means[first]
            total[[first, second]] += crop_metrics.psnr(readings[first], corrected, full_scale_dn)
            count[[first, second]] += 1
    return np.divide(total, count, out=np.full(len(frames), np.nan), where=count > 0)
