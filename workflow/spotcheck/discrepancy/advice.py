"""The additional measurement that would separate a named effect from its nearest rival.

For a few candidate conditions the named effect predicts what n more frames would read, and the rival is refitted to
them linearly. With residuals r of the rival in one frame beside the spot of this frame, the scores c = C'V⁻¹r of the
rival's parameters, their information M = C'V⁻¹C by one frame and I by the present ones, −2 ln L of the rival grows by
n r'V⁻¹r − n² c'(I + n M)⁻¹ c.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.candidates import changes_mean_image, list_starts, screen_candidates
from spotcheck.discrepancy.criteria import MIN_GAIN
from spotcheck.discrepancy.evaluation import columns_of, evaluate
from spotcheck.discrepancy.evidence import information_beside
from spotcheck.discrepancy.findings import Advice, NamedEffect
from spotcheck.discrepancy.frames import Design, FrameParameters, Pixels, thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.laws import LawFit, LawSearch, is_law, spot_conditions
from spotcheck.model.effect import Effect, EffectScales
from spotcheck.model.forward import ForwardModel

# More frames than this nobody takes for one question.
MOST_FRAMES = 200
# Part of full scale above which a predicted reading might clip.
USABLE_SHARE = 0.97
# ln of the peak [DN] of a blocked beam.
BLOCKED_LOG_PEAK = -20.0
# Effort of fits to thinned pixels: decrement of the effects and most iterations.
TOLERANCE, ITERATIONS = 0.3, 14
# Relative step of differences in parameters of laws, and the least scale of a parameter.
STEP, LEAST_SCALE = 1e-5, 1e-2
# Singular value below which the columns of a spot are taken as 0, in terms of the largest.
NULL_SINGULAR = 1e-9

Condition = Mapping[str, float | bool]


@dataclass(frozen=True)
class FrameWorth:
    """What one frame of a condition says against the rival."""

    square: float  # r'V⁻¹r
    score: np.ndarray  # c of the rival's parameters [parameter]
    information: np.ndarray  # M [parameter, parameter]

    def growth(self, frames: int, known: np.ndarray) -> float:
        """Return how much −2 ln L of the rival grows by some frames; `known` is the information I so far."""
        solved = np.linalg.lstsq(known + frames * self.information, self.score, rcond=None)[0]
        return float(frames * self.square - frames**2 * self.score @ solved)

    def frames_needed(self, known: np.ndarray) -> int:
        """Return the least number of frames with a growth of `MIN_GAIN`; one more than `MOST_FRAMES` if these fail."""
        numbers = range(1, MOST_FRAMES + 1)
        return next((n for n in numbers if self.growth(n, known) >= MIN_GAIN), MOST_FRAMES + 1)


@dataclass(frozen=True)
class PresentFits:
    """Fits of the frames that there are."""

    fit: JointFit  # final fit of the mean image
    scales: EffectScales  # scales of the dataset
    search: LawSearch | None = None  # search for laws; None without a law of the exposure
    laws: LawFit | None = None  # fit of the laws


def advise(named: Sequence[NamedEffect], effects: Sequence[Effect], present: PresentFits) -> tuple[Advice, ...]:
    """Return, for each named effect with rivals, the measurement that separates it from the nearest one.

    Parameters
    ----------
    named : sequence of NamedEffect
        Effects that are reported, with their rivals.
    effects : sequence of Effect
        Effects that were looked for.
    present : PresentFits
        Fits of the frames that there are.

    Returns
    -------
    tuple of Advice
        None for pairs that no condition separates within `MOST_FRAMES` frames, and for effects that scatter.
    """
    by_name = {effect.name: effect for effect in effects}
    found = []
    for effect in named:
        rivals = {name: behind for name, behind in effect.rivals.items() if name in by_name}
        if not rivals:
            continue
        rival = by_name[min(rivals, key=lambda name: rivals[name])]
        pair = None
        if is_law(effect.applied.effect) and is_law(rival):
            pair = compare_laws(effect.applied.effect, rival, present)
        elif effect.name in present.fit.model.effect_names and changes_mean_image(rival):
            pair = compare_images(effect.name, rival, present)
        best = None if pair is None else choose_condition(list_conditions(present.fit.model.design), *pair)
        if best is not None:
            found.append(Advice(best[0], (effect.name, rival.name), best[1]))
    return tuple(found)


def choose_condition(
    conditions: Sequence[Condition], worth_of: Callable[[Condition], FrameWorth | None], known: np.ndarray
) -> tuple[Condition, int] | None:
    """Return the condition that needs the fewest frames, of those the one that is worth most, and their number; None if
    none will do."""
    needed = []
    for condition in conditions:
        worth = worth_of(condition)
        frames = MOST_FRAMES + 1 if worth is None else worth.frames_needed(known)
        if worth is not None and frames <= MOST_FRAMES:
            needed.append((frames, -worth.growth(frames, known), condition))
    best = min(needed, key=lambda entry: entry[:2], default=None)
    return None if best is None else (best[2], best[0])


def list_conditions(design: Design) -> list[Condition]:
    """Return candidate conditions: exposures and, at the longest one, angles between and beyond the present ones; and a
    blocked beam."""
    exposures, angles = np.unique(design.exposure_s), np.unique(np.rad2deg(design.angle))
    conditions: list[Condition] = []
    if design.has_exposures:
        between = np.sqrt(exposures[:-1] * exposures[1:])
        tried = (exposures[0] / 4, exposures[0] / 2, *between, *exposures[[-1]], 2 * exposures[-1], 4 * exposures[-1])
        conditions = [{"exposure_s": float(exposure_s)} for exposure_s in tried]
    longest = {"exposure_s": float(exposures[-1])}
    if len(angles) > 1:
        tried = (*((angles[:-1] + angles[1:]) / 2), angles[-1] + 22.5, angles[-1] + 45)
        conditions += [{**longest, "angle_deg": float(angle_deg)} for angle_deg in tried]
    return [*conditions, {**longest, "blocked": True}]


def design_at(design: Design, condition: Condition) -> tuple[int, Design]:
    """Return the present frame whose exposure comes nearest to a condition, and the design of a new frame after all
    present ones."""
    exposure_s = float(condition["exposure_s"])
    frame = int(np.argmin(np.abs(np.log(design.exposure_s / exposure_s))))
    new = replace(design.select(slice(frame, frame + 1)), exposure_s=np.array([exposure_s]), order=np.ones(1))
    angle = np.deg2rad(float(condition["angle_deg"])) if "angle_deg" in condition else design.angle[frame]
    return frame, replace(new, angle=np.array([angle]))


# Effects of the mean image


def compare_images(
    name: str, rival: Effect, present: PresentFits
) -> tuple[Callable[[Condition], FrameWorth | None], np.ndarray] | None:
    """Return the worth of a frame by its condition, and the information on the rival so far; None if no rival fits."""
    fit, thin = present.fit, thin_pixels(present.fit.pixels)
    without = fit_jointly(fit.model.without_effect(name), thin, tolerance=TOLERANCE, iterations=ITERATIONS)
    candidates = screen_candidates(without, list_starts([rival], present.scales))
    if not candidates:
        return None
    model = without.model.with_effect(candidates[0].start, present.scales)
    other = fit_jointly(model, thin, tolerance=TOLERANCE, iterations=ITERATIONS)
    targets = np.arange(4 * other.equations.frames, other.equations.size)
    known = information_beside(other, targets) * fit.pixels.share / thin.share

    def worth_of(condition: Condition) -> FrameWorth | None:
        first, pixels = predict_frame(fit.model, fit.pixels, condition, present)
        expected = evaluate(first, pixels, slice(0, 1), with_slopes=False)
        readings, root = expected.moments.mean, np.sqrt(expected.weight).ravel()
        if readings.max() > USABLE_SHARE * first.forward.sensor.full_scale_dn:
            return None
        # The rival's spot starts from that of the named effect, and is refitted linearly.
        second = replace(first, forward=other.model.forward, free=other.model.free)
        at = evaluate(second, replace(pixels, readings=np.where(pixels.is_used, readings, 0.0)), slice(0, 1))
        spot = (at.moments.mean_slope * at.slopes).reshape(4, -1) * root
        columns = np.array(
            [np.broadcast_to(mean, at.weight.shape).ravel() * root for mean, _ in columns_of(second, at)]
        )
        basis = np.zeros((0, root.size))
        if not condition.get("blocked"):
            _, singular, basis = np.linalg.svd(spot / np.linalg.norm(spot, axis=1, keepdims=True), full_matrices=False)
            basis = basis[singular > NULL_SINGULAR]
        residual = at.residual.ravel() * root
        residual, columns = residual - basis.T @ (basis @ residual), columns - columns @ basis.T @ basis
        return FrameWorth(float(residual @ residual), columns @ residual, columns @ columns.T)

    return worth_of, known


def predict_frame(
    model: JointModel, pixels: Pixels, condition: Condition, present: PresentFits
) -> tuple[JointModel, Pixels]:
    """Return the model of one frame of a condition, and its pixels."""
    frame, design = design_at(model.design, condition)
    spots = model.spots.select(slice(frame, frame + 1))
    log_peak, log_sigma = spots.log_peak, spots.log_sigma
    if condition.get("blocked"):
        log_peak = np.full(1, BLOCKED_LOG_PEAK)
    elif present.search is None or present.laws is None:
        log_peak = log_peak + np.log(design.exposure_s / model.design.exposure_s[frame])
    else:
        law = replace(present.search.forward, law=present.laws.law, effects=present.laws.effects)
        new, old = (predict_spot(law, d) for d in (design, model.design.select(slice(frame, frame + 1))))
        log_peak, log_sigma = log_peak + new[0] - old[0], log_sigma + new[1] - old[1]
    moved = FrameParameters(log_peak, log_sigma, spots.x, spots.y)
    return replace(model, spots=moved, design=design, grid=None), pixels.select(slice(frame, frame + 1))


# Laws


def predict_spot(model: ForwardModel, design: Design) -> np.ndarray:
    """Return ln peak and ln σ of one frame under a law [2]."""
    spot = model.spot(spot_conditions(design))
    return np.log([float(np.ravel(spot.peak_dn)[0]), float(np.ravel(spot.sigma_px)[0])])


def compare_laws(
    effect: Effect, rival: Effect, present: PresentFits
) -> tuple[Callable[[Condition], FrameWorth | None], np.ndarray] | None:
    """Return the worth of a frame by its condition, and the information on the laws with the rival so far."""
    search, laws = present.search, present.laws
    if search is None or laws is None:
        return None
    kept = [applied.effect for applied in laws.effects if applied.effect.name not in (effect.name, rival.name)]
    other = search.fit([*kept, rival])
    first, second = (replace(search.forward, law=fit.law, effects=fit.effects) for fit in (laws, other))
    covariance = np.linalg.inv(search.inverse)

    def worth_of(condition: Condition) -> FrameWorth | None:
        if condition.get("blocked"):
            return None
        frame, design = design_at(search.design, condition)
        expected, predicted = predict_spot(first, design), predict_spot(second, design)
        sensor = search.forward.sensor
        brightest = sensor.black_level_dn + search.forward.baseline.plateau(np.exp(expected[0]))
        if not np.isfinite([*expected, *predicted]).all() or brightest > USABLE_SHARE * sensor.full_scale_dn:
            return None
        # The errors of a shorter exposure are those of its photons.
        index = np.ix_([frame, search.frames + frame], [frame, search.frames + frame])
        fewer = max(search.design.exposure_s[frame] / design.exposure_s[0], 1.0)
        weight = np.linalg.inv(covariance[index] + (fewer - 1) * search.noise[index])
        slopes = np.array([slope_of_spot(second, parameter, design) for parameter in other.names]).T
        residual = expected - predicted
        return FrameWorth(float(residual @ weight @ residual), slopes.T @ weight @ residual, slopes.T @ weight @ slopes)

    return worth_of, other.jacobian.T @ search.inverse @ other.jacobian


def slope_of_spot(model: ForwardModel, parameter: tuple[str, str], design: Design) -> np.ndarray:
    """Return the derivative of ln peak and ln σ of one frame by a parameter (effect, name) of laws [2]."""
    effect, name = parameter
    if effect:
        applied = next(applied for applied in model.effects if applied.effect.name == effect)
        step = STEP * max(abs(applied.parameters[name]), LEAST_SCALE)
        other = applied.with_value(name, applied.parameters[name] + step)
        moved = replace(model, effects=tuple(other if a is applied else a for a in model.effects))
    else:
        assert model.law is not None
        value = getattr(model.law, name)
        step = STEP * max(abs(value), LEAST_SCALE)
        moved = replace(model, law=replace(model.law, **{name: value + step}))
    return (predict_spot(moved, design) - predict_spot(model, design)) / step
