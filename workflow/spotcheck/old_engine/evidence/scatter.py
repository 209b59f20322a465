"""What the frames' brightness and centres say of a scatter from frame to frame, whatever the laws.

Of every site one value, of every exposure one shift: what follows exposure or site is no scatter of frames, and a model
of light or sensor that is not quite right moves all frames of an exposure alike. What these leave is noise of known
covariance and one variance, by restricted maximum likelihood.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from scipy import linalg, stats

from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence import components as mixed
from spotcheck.old_engine.evidence.components import Component
from spotcheck.old_engine.evidence.influence import FrameNumbers
from spotcheck.old_engine.model.effect import Effect, Present
from spotcheck.old_engine.observe.design import Design

# Which of a frame's numbers scatter, by component: along each axis with the same variance.
AXES = {"gain": (0,), "centre": (2, 3)}
# Singular values of the sites' and exposures' places below this, of the largest, are none.
NONE = 1e-9
# Fewer degrees of freedom than this tell no variance, and so few frames leave nothing beside two numbers of a law.
FEWEST = 4


class Trial(NamedTuple):
    """What the frames' numbers say of one effect, beside the effects that are present already.

    - `present`: the effect, its best form and values; `error` of its strength, in its unit.
    - `z`: of the strength against the neutral one, by Student's t with `freedom` degrees of freedom, where the sum of
      an effect's several parameters counts by Fisher's F; of a scatter the root of its gain, and `freedom` the steps
      between frames that tell it.
    - `gain`: what it gains in −2 ln L, scatter of the frames being free with and without it; of a scatter, against none
      of it, the worst frames left out (by chance half χ²₁, half 0).
    - `alone`: −2 ln L of the model with it where no scatter that is itself an effect is there, but its own: for rivals.
    """

    present: Present
    error: float
    z: float
    freedom: float
    gain: float
    alone: float

    @property
    def value(self) -> float:
        """The strength; of a scatter the rms, along each axis."""
        return float(self.present.values[0])


class Variance(NamedTuple):
    """A variance, its standard error, the gain in −2 ln L against 0, and the steps between frames that tell it."""

    variance: float
    error: float
    gain: float
    steps: int


def scatters_of(numbers: FrameNumbers, design: Design, effects: Iterable[Effect]) -> Iterator[Trial]:
    """The scatter of frames that each of some effects is, of brightness or of centre."""
    # ASSUME: the light's scatter is small, so that its logarithm's is the same.
    every = np.arange(len(design.site))
    for effect in effects:
        axes = AXES.get(effect.component)
        if axes is None or effect.scatter is None or effect.scatter.shared != "frame":
            continue
        fitted = scatter_of(numbers, design, axes, every)
        if fitted is not None:
            kept = kept_of(numbers, design, axes, fitted.variance)
            tested = scatter_of(numbers, design, axes, kept, narrowed(1 - len(kept) / len(every), len(axes)))
            gain = tested.gain if tested is not None else 0.0
            # Where a variance is less than its error, that of the root of one as large as its error.
            error = fitted.error / (2 * np.sqrt(max(fitted.variance, fitted.error)))
            present = Present(effect, effect.forms[0], (float(np.sqrt(fitted.variance)),))
            yield Trial(present, float(error), float(np.sqrt(gain)), fitted.steps, gain, np.nan)


def narrowed(part: float, axes: int) -> float:
    """What is left of the variance of normal numbers along some axes without that part which lies furthest out."""
    return float(stats.chi2.cdf(stats.chi2.isf(part, axes), axes + 2) / (1 - part)) if part else 1.0


def scatter_of(
    numbers: FrameNumbers, design: Design, axes: tuple[int, ...], frames: np.ndarray, part: float = 1.0
) -> Variance | None:
    """The scatter of some frames' numbers; None where sites and exposures take all. `part` multiplies noise and scatter
    alike."""
    apart = _apart(design, axes, frames)
    if len(axes) * apart.shape[1] < FEWEST:
        return None
    known, values = _numbers(numbers, axes, frames)
    lift = np.kron(apart, np.eye(len(axes)))
    known, rest = part * (lift.T @ known @ lift), lift.T @ values
    scatter = (Component("", "frame", np.sqrt(part) * np.eye(len(rest))),)
    none = np.zeros((len(rest), 0))
    # From none, and from all: the likelihood may have more than one top.
    found = [
        mixed.estimate(known, scatter, none, rest, np.array([own]), restricted=False)
        for own in (0.0, float(np.mean(rest**2)) / part)
    ]
    best = min(found, key=lambda own: own.deviance)
    without = mixed.estimated(known, scatter, none, rest, np.zeros(1), restricted=False).deviance
    return Variance(float(best.tau[0]), float(best.information[0, 0] ** -0.5), max(without - best.deviance, 0.0),
                    len(rest))  # fmt: skip


def kept_of(numbers: FrameNumbers, design: Design, axes: tuple[int, ...], variance: float) -> np.ndarray:
    """The frames but for the worst, which lie furthest off in the errors of what sites and exposures leave."""
    every, each = np.arange(len(design.site)), len(axes)
    apart = _apart(design, axes, every)
    lift = np.kron(apart @ apart.T, np.eye(each))
    known, values = _numbers(numbers, axes, every)
    off = (lift @ values).reshape(-1, each)
    errors = (lift @ (known + variance * np.eye(len(known))) @ lift).reshape(len(every), each, len(every), each)
    # A frame alone at its site is off by nothing, with an error of nothing.
    far = [own @ np.linalg.pinv(errors[k, :, k], rcond=NONE, hermitian=True) @ own for k, own in enumerate(off)]
    return np.sort(np.argsort(far, kind="stable")[: len(every) - int(criteria.WORST.value * len(every))])


def _apart(design: Design, axes: tuple[int, ...], frames: np.ndarray) -> np.ndarray:
    """Orthonormal steps [frame, step] between frames that no value of a site and no shift of an exposure brings.

    Where no site was seen twice, brightness may be compared from site to site, beside a shift of each angle; places may
    not.
    """
    site, exposure, angle = (own[frames] for own in (design.site, design.exposure_s, design.angle_deg))
    first = site
    if axes == AXES["gain"] and len(np.unique(design.site)) == len(design.site):
        first = angle
    places = [own[:, None] == np.unique(own) for own in (first, exposure)]
    columns = np.concatenate([np.ones((len(frames), 1)), *places], 1)
    return linalg.null_space(columns.T.astype(float), rcond=NONE)


def _numbers(numbers: FrameNumbers, axes: tuple[int, ...], frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance and values [frame × axis] of some numbers of some frames."""
    own = (len(numbers.values) * frames[:, None] + np.array(axes)).ravel()
    return numbers.covariance[np.ix_(own, own)], numbers.values[np.ix_(np.array(axes), frames)].T.ravel()
