"""How well a design can tell an effect from all else that may be so: Fisher's information of mean and variance of
normal readings (Kay, Estimation Theory, 3.9), beside every frame's brightness, width and centre or the laws of these,
and beside a light's shape that is free.

Some sites stand for all; information of others is the same. Changes are those at the effect's own strength, not slopes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from tests.validation.generators.light.moments import moments
from tests.validation.generators.second.case import LASER_WIDTH, Case
from tests.validation.generators.second.optics import budget, coordinates, light, spread

# Distance of the free shape's nodes and how far they go [σ]. Stripes stand out of the spectrum of any light, so a net
# fine enough to draw them is no rival: beside them, that of which the light itself needs no finer. Beside a shape of
# the light, such as a halo, the light may reach as far as the frame does.
NODES, BESIDE_STRIPES, REACH, FAR_REACH = 0.15, 0.3, 4.8, 8.0
# What is thought of a coefficient of the shape before there are data: 0 ± this, in peaks. Wide; it only keeps parts of
# the shape that no pixel sees from being singular.
PRIOR = 0.3
# Sites that stand for all; every so many pixels of a row and of a column, but all where there is one frame.
SITES, STRIDE = {"default": 4, "one_exposure": 12, "single_frame": 1}, 2
# Change of light by which the slopes of a reading are taken [DN].
NUDGE = 0.5
NUMBERS = 4
# What is thought of the laws' unknowns before there are data, 0 ± this: ln scale, p2 and p1 [px], a centre [px]. With
# the shape free all spots may be wider alike, and a p2 that is off by hundreds of px would bend brightness by any law.
LAWS, CENTRE = (0.3, 2.0, 1.0), 1.0


class Whitened(NamedTuple):
    """A change of all readings in standard errors: of means, and of variances as a normal law tells them; both
    [frame, y, x]."""

    mean: np.ndarray
    variance: np.ndarray

    def dot(self, other: "Whitened") -> float:
        """The information that two changes share."""
        return float(np.sum(self.mean * other.mean) + np.sum(self.variance * other.variance))


class Snr(NamedTuple):
    """Signal-to-noise of an effect: with the light's shape known, and with it free."""

    known: float
    free: float


class Reference:
    """The readings of a case without effects, and what is not known of them."""

    def __init__(
        self, case: Case, also: Sequence[int] = (), nodes: float | None = None, reach: float | None = None
    ) -> None:
        """`also` are frames of sites that have to be among those that stand for all; `nodes` the distance of the free
        shape's, and `reach` how far they go [σ]."""
        self.case, self.nodes, self.reach = case.only(), nodes or NODES, reach or REACH
        sites = SITES[case.design]
        every = sorted({frame.site for frame in case.frames})
        chosen = [own[(3 * k + 1) % len(own)] for k, own in enumerate(_groups(case, every, sites))]
        chosen += [case.frames[i].site for i in also]
        self.frames = [i for i, frame in enumerate(case.frames) if frame.site in chosen]
        self.stride = STRIDE if len(self.frames) > 1 else 1
        # How many readings each one stands for.
        self.scale = self.stride**2 * len(case.frames) / len(self.frames)
        self._readings()
        self._numbers()

    # What is looked at

    def thin(self, image: np.ndarray) -> np.ndarray:
        """The pixels that are looked at."""
        return image[:: self.stride, :: self.stride]

    def _readings(self) -> None:
        """Moments, and their slopes by light, of every frame."""
        self.light = [light(self.case, i) for i in self.frames]
        middle = [moments(self.case, i, image) for i, image in zip(self.frames, self.light, strict=True)]
        ends = [
            [moments(self.case, i, np.maximum(image + d, 0.0)) for d in (-NUDGE, NUDGE)]
            for i, image in zip(self.frames, self.light, strict=True)
        ]
        step = [np.maximum(image + NUDGE, 0.0) - np.maximum(image - NUDGE, 0.0) for image in self.light]
        self.mean, self.variance = (np.stack([self.thin(own[k]) for own in middle]) for k in (0, 1))
        slopes = [
            [self.thin((high[k] - low[k]) / h) for (low, high), h in zip(ends, step, strict=True)] for k in (0, 1)
        ]
        self.by_light = self.whiten(*(np.stack(own) for own in slopes))

    def whiten(self, mean: np.ndarray, variance: np.ndarray) -> Whitened:
        """Changes of mean [DN] and variance [DN²] in standard errors."""
        return Whitened(mean / np.sqrt(self.variance), variance / (np.sqrt(2) * self.variance))

    def change(self, case: Case) -> Whitened:
        """What the effects of a case change. A variance tells −ln of its ratio and more, half the square of its change
        where that is small: twice the divergence of two normal laws. A clip leaves next to none."""
        found = [moments(case, i) for i in self.frames]
        mean, variance = (np.stack([self.thin(own[k]) for own in found]) for k in (0, 1))
        ratio = variance / self.variance
        apart = np.sign(ratio - 1) * np.sqrt(np.maximum(ratio - 1 - np.log(ratio), 0.0))
        return Whitened((mean - self.mean) / np.sqrt(self.variance), apart)

    # What is not known

    def _numbers(self) -> None:
        """Normal equations of the frames' numbers (ln peak, ln σ, x and y over σ) and of the shape."""
        case = self.case
        self.sigma = np.array([spread(case, case.frames[i].exposure) + LASER_WIDTH for i in self.frames])
        self.peak = np.array([float(image.max()) for image in self.light])
        slopes, self.axes = [], []
        for k, (i, image) in enumerate(zip(self.frames, self.light, strict=True)):
            dx, dy = coordinates(case, i)
            by_y, by_x = np.gradient(image)
            own = (image, -(dx * by_x + dy * by_y), -self.sigma[k] * by_x, -self.sigma[k] * by_y)
            slopes.append([self.thin(part) for part in own])
            self.axes.append(
                [_basis(d.ravel()[:: self.stride] / self.sigma[k], self.nodes, self.reach) for d in (dx, dy)]
            )
        self.slopes = np.array(slopes)  # [frame, number, y, x], light by number [DN]
        self.sure = self.by_light.mean**2 + self.by_light.variance**2
        side = self.axes[0][0].shape[1]
        band = np.zeros((3 * side + 4, side * side))
        for k, (across, along) in enumerate(self.axes):
            _gather(band, self.peak[k] ** 2 * self.sure[k], along, across)
        band[0] += 1 / (PRIOR**2 * self.scale)
        self.factor = (linalg.cholesky_banded(band, lower=True), True)
        few = NUMBERS * len(self.frames)
        self.joined, self.dense = np.zeros((side * side, few)), np.zeros((few, few))
        for k in range(len(self.frames)):
            at = slice(NUMBERS * k, NUMBERS * (k + 1))
            weighted = self.slopes[k] * self.sure[k]
            self.joined[:, at] = np.stack([self._onto_shape(k, part) for part in weighted], 1)
            self.dense[at, at] = np.tensordot(weighted, self.slopes[k], axes=([1, 2], [1, 2]))
        self.solved = linalg.cho_solve_banded(self.factor, self.joined)
        self.left = self.dense - self.joined.T @ self.solved

    def _onto_shape(self, k: int, image: np.ndarray) -> np.ndarray:
        """Products of an image of frame k with every coefficient's light."""
        across, along = self.axes[k]
        return self.peak[k] * (along.T @ image @ across).ravel()

    def lawful(self) -> np.ndarray:
        """Numbers [number, unknown] that the laws allow, in the unknowns' priors: one scale, p2 and p1, and a centre
        for every site."""
        case = self.case
        sites = [case.frames[i].site for i in self.frames]
        every = sorted(set(sites))
        several = len(case.exposures) > 1
        out = np.zeros((len(sites), NUMBERS, 2 + several + 2 * len(every)))
        for k, i in enumerate(self.frames):
            t = case.frames[i].exposure
            out[k, 0, 0] = LAWS[0]
            width, h = spread(case, t), 1e-4
            rise = np.log(budget(case.budget, width + h, t) / budget(case.budget, width - h, t)) / (2 * h)
            for column, slope in ((1, LAWS[1]), (2, LAWS[2] * np.log(t / case.exposures[-1])))[: 1 + several]:
                out[k, 0, column], out[k, 1, column] = rise * slope, slope / self.sigma[k]
            at = 2 + several + 2 * every.index(sites[k])
            out[k, 2, at] = out[k, 3, at + 1] = CENTRE / self.sigma[k]
        return out.reshape(NUMBERS * len(sites), -1)

    # What is left

    def snr(self, change: Whitened, unknown: np.ndarray | None = None) -> Snr:
        """Of a change beside the frames' numbers, or beside numbers [number, unknown] alone."""
        parts = [change.mean[k] * self.by_light.mean[k] + change.variance[k] * self.by_light.variance[k]
                 for k in range(len(self.frames))]  # fmt: skip
        onto = np.concatenate([self.slopes[k].reshape(NUMBERS, -1) @ own.ravel() for k, own in enumerate(parts)])
        shape = sum(self._onto_shape(k, own) for k, own in enumerate(parts))
        solved = linalg.cho_solve_banded(self.factor, shape)
        total = change.dot(change)
        known = self.beside(total, onto, self.dense, unknown)
        free = self.beside(total - float(shape @ solved), onto - self.joined.T @ solved, self.left, unknown)
        return Snr(known, free)

    def beside(self, total: float, onto: np.ndarray, dense: np.ndarray, unknown: np.ndarray | None) -> float:
        """Signal-to-noise from a change's own product, its products with the numbers, and those among these."""
        if unknown is not None:
            onto, dense = unknown.T @ onto, unknown.T @ dense @ unknown
            dense = dense + np.eye(len(dense)) / self.scale
        # All brighter is the shape's too: singular where it is free.
        taken = float(onto @ linalg.pinvh(dense, rtol=1e-9) @ onto)
        return float(np.sqrt(max(total - taken, 0.0) * self.scale))

    def errors(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Standard errors of one of the frames' numbers, each frame's alone: with the shape known, and free; there
        those of what differs between frames; infinite for one frame."""
        count = len(self.frames)
        if count == 1:
            return np.full(1, np.inf), np.full(1, np.inf)
        out = []
        for dense, several in ((self.dense, False), (self.left, True)):
            covariance = linalg.pinvh(dense, rtol=1e-9)[number::NUMBERS, number::NUMBERS]
            if several:
                mean = np.eye(count) - 1 / count
                # A mean taken off leaves less of every number.
                covariance = mean @ covariance @ mean * (count / max(count - 1, 1))
            # One frame's error is that of its pixels alone; the shape, of all frames.
            out.append(np.sqrt(np.maximum(np.diag(covariance), 1e-300)) / self.stride)
        return out[0], out[1]


def _groups(case: Case, sites: list[int], count: int) -> list[list[int]]:
    """Sites in so many groups, each of one angle."""
    angle = {frame.site: frame.angle for frame in case.frames}
    angles = sorted(set(angle.values()))
    own = {a: [site for site in sites if angle[site] == a] for a in angles}
    each = max(count // len(angles), 1)
    return [list(part) for a in angles for part in np.array_split(own[a], each) if len(part)]


def _basis(u: np.ndarray, step: float, reach: float) -> np.ndarray:
    """Cubic B-splines [point, node] at u, with nodes so far from each other, as far as `reach` [σ]."""
    count = int(np.ceil(reach / step))
    t = np.abs(u[:, None] / step - np.arange(-count, count + 1))
    return np.where(t < 1, 2 / 3 - t * t * (1 - t / 2), np.maximum(2 - t, 0.0) ** 3 / 6)


def _gather(band: np.ndarray, weight: np.ndarray, along: np.ndarray, across: np.ndarray) -> None:
    """Add Bᵀ diag(weight) B to the lower bands of a matrix; B is along ⊗ across. Node (j, i) has the place j·side + i,
    and meets no node that is more than three off."""
    side = along.shape[1]
    for dj in range(4):
        pairs_y = along[:, : side - dj] * along[:, dj:]
        for di in range(-3, 4):
            if dj == 0 and di < 0:
                continue
            low = max(-di, 0)
            high = side - max(di, 0)
            pairs_x = across[:, low:high] * across[:, low + di : high + di]
            block = pairs_y.T @ weight @ pairs_x
            rows = np.arange(side - dj)[:, None] * side + np.arange(low, high)[None, :]
            band[dj * side + di, rows] += block


def behind_grain(
    reference: Reference, change: Whitened, contrast: float, grain: float, unknown: np.ndarray | None = None
) -> float:
    """Signal-to-noise where a field of a contrast and a grain [px] multiplies the light, which the exposures of a site
    share. Beside the field a free shape takes no more: the field already lets every site have one of its own.

    # ASSUME: what is coarser than a grain is disturbed by white noise of the same power at low frequencies.
    """
    case, few = reference.case, NUMBERS * len(reference.frames)
    # Integral of the correlation exp(−4 ln 2 d²/g²) [px²].
    power = contrast * np.sqrt(max(np.pi * grain**2 / (4 * np.log(2)), 1.0))
    grained = power * np.stack([reference.thin(image) for image in reference.light]) * reference.by_light.mean
    means, variances = (reference.slopes * part[:, None] for part in reference.by_light)
    total, onto, dense = change.dot(change), np.zeros(few), np.zeros((few, few))
    for k in range(len(reference.frames)):
        own = slice(NUMBERS * k, NUMBERS * (k + 1))
        for slopes, part in ((means, change.mean), (variances, change.variance)):
            onto[own] += np.tensordot(slopes[k], part[k], 2)
            dense[own, own] += np.tensordot(slopes[k], slopes[k], axes=([1, 2], [1, 2]))
    sites = np.array([case.frames[i].site for i in reference.frames])
    for site in set(sites.tolist()):
        which = np.flatnonzero(sites == site)
        # (1 + ccᵀ)⁻¹ = 1 − ccᵀ/(1 + cᵀc), pixel by pixel; c is the field's own change of all exposures.
        root = 1 / np.sqrt(1 + np.sum(grained[which] ** 2, axis=0))
        taken = root * np.sum(change.mean[which] * grained[which], axis=0)
        by_number = (root * means[which] * grained[which][:, None]).reshape(-1, taken.size)
        index = (NUMBERS * which[:, None] + np.arange(NUMBERS)).ravel()
        total -= float(np.sum(taken**2))
        onto[index] -= by_number @ taken.ravel()
        dense[np.ix_(index, index)] -= by_number @ by_number.T
    return reference.beside(total, onto, dense, unknown)
