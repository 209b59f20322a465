"""Which next measurement would tell tied explanations apart, and how many frames of it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.cells import pooled
from spotcheck.discrepancy.explain import Account, is_component
from spotcheck.discrepancy.look import Look
from spotcheck.discrepancy.refit import Problem, refit

# −2 ln L by which an explanation must fall behind to be told apart: five standard deviations.
APART = 25.0
MOST_FRAMES = 200


class Condition(NamedTuple):
    """A feasible measurement: exposure [s], fibre angle [deg], and laser power over the present one."""

    exposure_s: float
    angle_deg: float
    power: float


class Advice(NamedTuple):
    """The condition that separates two explanations best, how many frames of it, and which two (by number)."""

    condition: Condition
    pair: tuple[int, int]
    frames: int
    gain_a_frame: float


def advise(look: Look, tied: Sequence[Account]) -> list[Advice]:
    """One piece of advice for the best explanation against each other, as far as any feasible condition tells them
    apart."""
    out = []
    for k, rival in enumerate(tied[1:], start=1):
        gains = [(separation(look, tied[0], rival, condition), condition) for condition in feasible(look)]
        already, _ = separations(look, tied[0], rival, None)
        best, condition = max(gains, key=lambda item: item[0])
        if best > 0:
            frames = int(np.ceil(max(APART - already, 1.0) / best))
            if frames <= MOST_FRAMES:
                out.append(Advice(condition, (0, k), frames, best))
    return out


def feasible(look: Look) -> list[Condition]:
    """Exposures from a quarter of the shortest to four times the longest, half and a tenth of the power, angles
    between; none brighter than the converter's range."""
    view = look.cells.view
    exposures = np.unique(view.exposure_s[view.exposure_s > 0])
    angles = np.rad2deg(np.unique(view.angle))
    if not exposures.size:
        return []
    longer = [exposures[0] / 4, exposures[0] / 2, *exposures, *np.sqrt(exposures[:-1] * exposures[1:]),
              2 * exposures[-1], 4 * exposures[-1]]  # fmt: skip
    between = [*angles, *((angles[:-1] + angles[1:]) / 2), angles[-1] + 22.5]
    out = [Condition(float(t), float(angles[0]), power) for t in longer for power in (1.0, 0.5, 0.1)]
    return out + [Condition(float(exposures[-1]), float(a), 1.0) for a in between[1:]]


def separation(look: Look, first: Account, rival: Account, condition: Condition) -> float:
    """−2 ln L by which a rival falls behind with every frame of a condition, if the first explanation is true."""
    few = 8
    without, _ = separations(look, first, rival, None)
    with_it, dark = separations(look, first, rival, condition, few)
    return 0.0 if dark else max(with_it - without, 0.0) / few


def separations(
    look: Look, first: Account, rival: Account, condition: Condition | None, frames: int = 1
) -> tuple[float, bool]:
    """−2 ln L of the rival's best fit to what the first explanation expects, over its own; and whether the condition is
    of no use (too bright)."""
    if any(is_component(e) for own in (first, rival) for e, _ in own.effects):
        return 0.0, True
    problem = look.problem
    view, cells = problem.cells.view, problem.cells
    if condition is not None:
        # The new frames lie as those of the nearest exposure do.
        near = int(np.argmin(np.abs(view.exposure_s.ravel() - condition.exposure_s)))
        own = {name: getattr(view, name)[near : near + 1] for name in view._fields[:9]}
        own["exposure_s"] = np.full((1, 1, 1), condition.exposure_s)
        own["angle"] = np.full((1, 1, 1), np.deg2rad(condition.angle_deg))
        view = view._replace(**{name: np.concatenate([getattr(view, name), own[name]]) for name in own})  # type: ignore[arg-type]
        each = float(cells.pixels.max() / max(cells.frames.max(), 1))
        more = np.where(cells.pixels[near : near + 1] > 0, each * frames, 0.0)
        cells = cells._replace(
            view=view,
            place=np.append(cells.place, cells.place.max() + 1),
            frames=np.append(cells.frames, frames),
            pixels=np.concatenate([cells.pixels, more]),
        )
    gain = np.ones(len(cells.place))
    if condition is not None:
        gain[-1] = condition.power
    model = first.refit.model
    shift = np.zeros((int(cells.place.max()) + 1, 2))
    shift[: len(model.shift)] = model.shift[: len(shift)]
    truth = model._replace(shift=shift, gain=gain)
    blank = cells._replace(residual=np.zeros(cells.pixels.shape), variance=np.ones(cells.pixels.shape))
    asimov = Problem(blank, look.setting, truth)
    at = asimov.at_start
    if float(np.max(at.mean)) > 0.97 * look.setting.sensor.full_scale_dn:
        return 0.0, True
    variance = np.where(cells.pixels > 0, pooled(at.variance) / np.maximum(cells.pixels, 1), np.inf)
    asimov.cells = asimov.cells._replace(variance=variance)
    start = rival.refit.model
    shift = np.zeros_like(shift)
    shift[: len(start.shift)] = start.shift[: len(shift)]
    fit = refit(asimov, rival.refit_effects, start._replace(shift=shift, gain=gain))
    return fit.chi2, False
