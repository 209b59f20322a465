"""Validation on held-out frames: how well nested models predict repeats that no earlier step has seen.

Brightness and width of a held-out frame come from the laws that were fitted to the other repeats; only the centre, one
for each site, is fitted to it. The gap is the mean over blocks of `BLOCK_PX` pixels near the spot of (Σ r)²/Σ v: noise
alone gives 1.
"""

from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.evaluation import evaluate, map_batches
from spotcheck.discrepancy.frames import Design, FrameParameters, FrameSet, Pixels
from spotcheck.discrepancy.joint_fit import JointModel
from spotcheck.discrepancy.laws import is_law, spot_conditions
from spotcheck.discrepancy.normal_equations import assemble
from spotcheck.discrepancy.residuals import whole_crops
from spotcheck.model.forward import ForwardModel

# Side of the blocks, and distance from the spot [σ] within which they count.
BLOCK_PX, GAP_RADIUS = 8, 3.5
# Steps of the fit of centres, the largest step [px], and the promised drop of −2 ln L for each site at which it ends.
CENTRE_STEPS, LARGEST_STEP, CENTRE_TOLERANCE = 6, 4.0, 0.01
# Standard deviations of the gap beyond its floor up to which nothing is left open.
NOISE_Z = 2.0


@dataclass(frozen=True)
class Prediction:
    """Held-out frames under one model."""

    gap: float  # mean over blocks of the squared sum of residuals over its variance; 1 is noise alone
    floor: float  # its expectation under the model
    deviation: float  # standard deviation of gap − floor under the model
    rms_dn: float  # rms of block means beyond noise [DN]
    score: float  # −2 ln p for each frame but for a constant

    @property
    def left_open(self) -> float:
        """What the model leaves of the gap; 0 if that is within `NOISE_Z` standard deviations."""
        return self.gap - self.floor if self.gap - self.floor > NOISE_Z * self.deviation else 0.0


@dataclass(frozen=True)
class Gap:
    """Gap of the declared and of the extended model on held-out frames."""

    before: Prediction  # declared model
    after: Prediction  # extended model
    by_effect: dict[str, float]  # share of the declared model's gap that each effect closes

    @property
    def closed(self) -> float:
        """Share of the declared model's gap that the effects close."""
        return 1 - self.after.left_open / max(self.before.gap - self.before.floor, 1e-9)


def predict_frames(model: ForwardModel, frames: FrameSet, start: FrameParameters) -> Prediction:
    """Compare held-out frames with a model that has a law.

    Parameters
    ----------
    model : ForwardModel
        With a law of peak and width.
    frames : FrameSet
        Held-out frames.
    start : FrameParameters
        Centres from which their fit starts, one mean for each site; peak and width are not used.
    """
    pixels = whole_crops(frames)
    spots = _site_means(frames.design, start)
    spots = _from_law(model, frames.design, spots)
    free = replace(model, law=None, effects=tuple(applied for applied in model.effects if not is_law(applied.effect)))
    spots = _fit_centres(JointModel(free, spots, frames.design), pixels)
    return _measure(JointModel(free, spots, frames.design), pixels)


def _site_means(design: Design, spots: FrameParameters) -> FrameParameters:
    """Return the spots with the mean centre of each site."""
    count = np.bincount(design.site)
    centres = [np.bincount(design.site, axis)[design.site] / count[design.site] for axis in (spots.x, spots.y)]
    return replace(spots, x=centres[0], y=centres[1])


def _from_law(model: ForwardModel, design: Design, spots: FrameParameters) -> FrameParameters:
    """Return the spots with peak and width of the law."""
    spot = model.spot(spot_conditions(design))
    shape = (len(spots.x), 1, 1)
    peak, sigma = (np.broadcast_to(part, shape).ravel() for part in (spot.peak_dn, spot.sigma_px))
    return replace(spots, log_peak=np.log(peak), log_sigma=np.log(sigma))


def _fit_centres(model: JointModel, pixels: Pixels) -> FrameParameters:
    """Return the spots with one centre for each site, fitted to the frames."""
    site = model.design.site
    for _ in range(CENTRE_STEPS):
        equations = assemble(model, pixels)
        frames = np.arange(equations.frames)
        promise, moves = 0.0, np.zeros((2, len(frames)))
        for number in np.unique(site):
            members = frames[site == number]
            index = 4 * members[:, None] + np.array([2, 3])
            gradient = equations.gradient[index].sum(axis=0)
            information = sum(equations.information[np.ix_(rows, rows)] for rows in index)
            step = np.clip(np.linalg.solve(information, gradient), -LARGEST_STEP, LARGEST_STEP)
            moves[:, members] = step[:, None]
            promise += float(gradient @ step)
        spots = replace(model.spots, x=model.spots.x + moves[0], y=model.spots.y + moves[1])
        model = replace(model, spots=spots)
        if promise < CENTRE_TOLERANCE * len(np.unique(site)):
            break
    return model.spots


def _measure(model: JointModel, pixels: Pixels) -> Prediction:
    """Return gap and score of frames under a model."""

    def of_batch(part: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        at = evaluate(model, pixels, part, with_slopes=False)
        conditions, used = at.conditions, at.weight > 0
        distance = np.hypot(conditions.pixels.x - conditions.x0, conditions.pixels.y - conditions.y0)
        is_near = used & (distance < GAP_RADIUS * conditions.sigma_px)
        variance = 1 / np.where(used, at.weight, 1.0)
        sums, noise, count = (_block_sums(values * is_near) for values in (at.residual, variance, np.ones(used.shape)))
        is_full = count > BLOCK_PX**2 / 2
        score = float(np.sum((at.residual**2 * at.weight + np.log(variance))[used]))
        return sums[is_full], noise[is_full], count[is_full], score

    parts = map_batches(of_batch, pixels)
    sums, noise, count = (np.concatenate([part[k] for part in parts]) for k in range(3))
    squares = sums**2 / noise
    excess = (sums**2 - noise) / count**2
    return Prediction(
        gap=float(squares.mean()),
        floor=1.0,
        deviation=float(np.sqrt(2 / len(squares))),
        rms_dn=float(np.sqrt(max(excess.mean(), 0.0))),
        score=sum(part[3] for part in parts) / len(model.spots.x),
    )


def _block_sums(values: np.ndarray) -> np.ndarray:
    """Return sums over blocks of the crops [frame, block row, block column]."""
    frames, rows, columns = (values.shape[0], *(size // BLOCK_PX for size in values.shape[1:]))
    cut = values[:, : rows * BLOCK_PX, : columns * BLOCK_PX]
    return cut.reshape(frames, rows, BLOCK_PX, columns, BLOCK_PX).sum(axis=(2, 4))
