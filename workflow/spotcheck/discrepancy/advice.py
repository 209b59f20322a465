"""The additional measurement that would separate a named effect from its nearest rival.

A rival is an effect that explains the present frames nearly as well as the named one. For each of a few candidate
conditions, the model with the named effect predicts the readings of n more frames. The model with the rival is then
refitted to them linearly.

Let r be the residual of the rival in one such frame, after a fit of the spot parameters (ln peak, ln σ, x, y) of this
frame, and V its covariance. C holds the derivatives by the fitted parameters of sensor and effects of the rival's
model. Their score is c = C'V⁻¹r. Their information is M = C'V⁻¹C by one new frame, and I by the present frames. Then
−2 ln L of the rival increases by n r'V⁻¹r − n² c'(I + n M)⁻¹ c.

A law is an effect that changes only brightness and width of the spots, from frame to frame. Laws are compared by
ln peak and ln σ of the spots, all other effects by the readings of the pixels. A `Design` has the conditions of frames.
A `LawSearch` has the inverse of the covariance of the observed ln peak and ln σ (`inverse`), and the part of that
covariance by the fits of the spots (`noise`). A `LawFit` has the fitted laws (`law`, `effects`), the names of their
parameters, and the derivatives of the observations by these (`jacobian`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.candidates import changes_mean_image, list_starts, screen_candidates
from spotcheck.discrepancy.criteria import MIN_GAIN
from spotcheck.discrepancy.evaluation import differentiate_readings, evaluate
from spotcheck.discrepancy.findings import Advice, NamedEffect
from spotcheck.discrepancy.frames import SPOT_PARAMETERS, Design, FrameParameters, Pixels, thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.laws import LawFit, LawSearch, is_law, predict_spots, spot_conditions
from spotcheck.discrepancy.normal_equations import information_beside
from spotcheck.model.effect import Effect, EffectScales

# Most frames that an advice may ask for; nobody takes more for one question.
MOST_FRAMES = 200
# Part of full scale above which a predicted reading might clip.
USABLE_SHARE = 0.97
# ln of the peak [DN] of a blocked beam.
BLOCKED_LOG_PEAK = -20.0
# Effort of fits to thinned pixels: Newton decrement of the effects, and most iterations.
TOLERANCE, ITERATIONS = 0.3, 14
# Singular value of the derivatives by spot parameters that counts as 0, relative to the largest.
NULL_SINGULAR = 1e-9
# Angles [deg] beyond the largest present one that are tried.
FURTHER_ANGLES_DEG = (22.5, 45)

# Condition of a new frame: `exposure_s`, and perhaps `angle_deg`, or `blocked` (True) for a blocked beam.
Condition = Mapping[str, float | bool]


@dataclass(frozen=True)
class FrameWorth:
    """Evidence of one frame of a condition against the rival; symbols as in the module's formula."""

    square: float  # r'V⁻¹r
    score: np.ndarray  # c of the rival's parameters [parameter]
    information: np.ndarray  # M [parameter, parameter]

    def growth(self, frames: int, known: np.ndarray) -> float:
        """Return the increase of −2 ln L of the rival by `frames` new frames.

        `known` is the information I of the present frames on the parameters of the rival [parameter, parameter].
        """
        # (I + n M)⁻¹ c
        solution = np.linalg.lstsq(known + frames * self.information, self.score, rcond=None)[0]
        return float(frames * self.square - frames**2 * self.score @ solution)

    def frames_needed(self, known: np.ndarray) -> int:
        """Return the least number of new frames by which −2 ln L of the rival grows by `MIN_GAIN`.

        `known` is that of `growth`. `MOST_FRAMES` + 1 is returned if more frames than `MOST_FRAMES` are needed.
        """
        counts = range(1, MOST_FRAMES + 1)
        return next((count for count in counts if self.growth(count, known) >= MIN_GAIN), MOST_FRAMES + 1)


# Function that returns the worth of a frame of a condition; None if its readings might clip or cannot be predicted.
WorthFunction = Callable[[Condition], FrameWorth | None]


@dataclass(frozen=True)
class PresentFits:
    """Fits of the present frames."""

    fit: JointFit  # final fit of the mean image
    scales: EffectScales  # sizes of the dataset, from which effects derive bounds and starting values
    search: LawSearch | None = None  # search for laws; None without a law of the exposure
    laws: LawFit | None = None  # fit of the laws; None without a law of the exposure


def advise(named: Sequence[NamedEffect], effects: Sequence[Effect], present: PresentFits) -> tuple[Advice, ...]:
    """Return, for each named effect with rivals, the measurement that separates it from the nearest one.

    Parameters
    ----------
    named : sequence of NamedEffect
        Effects that are reported, with their rivals.
    effects : sequence of Effect
        Effects that were searched for.
    present : PresentFits
        Fits of the present frames.

    Returns
    -------
    tuple of Advice
        At most one per named effect. There is none if no condition separates the pair within `MOST_FRAMES` frames, or
        if one of both effects is random.
    """
    by_name = {effect.name: effect for effect in effects}
    advices = []
    for effect in named:
        # Nearest: the rival with the least excess of −2 ln L over the named effect.
        excesses = {name: excess for name, excess in effect.rivals.items() if name in by_name}
        if not excesses:
            continue
        rival = by_name[min(excesses, key=lambda name: excesses[name])]
        comparison = None
        if is_law(effect.applied.effect) and is_law(rival):
            comparison = compare_laws(effect.applied.effect, rival, present)
        elif effect.name in present.fit.model.effect_names and changes_mean_image(rival):
            comparison = compare_images(effect.name, rival, present)
        best = None if comparison is None else choose_condition(list_conditions(present.fit.model.design), *comparison)
        if best is not None:
            advices.append(Advice(best[0], (effect.name, rival.name), best[1]))
    return tuple(advices)


def choose_condition(
    conditions: Sequence[Condition], worth_of: WorthFunction, known: np.ndarray
) -> tuple[Condition, int] | None:
    """Return the condition that needs the fewest frames, and their number; None if none suffices.

    Among conditions that need equally many, the one with the largest growth of −2 ln L wins. `known` is the information
    I of the present frames [parameter, parameter].
    """
    sufficient = []
    for condition in conditions:
        worth = worth_of(condition)
        frames = MOST_FRAMES + 1 if worth is None else worth.frames_needed(known)
        if worth is not None and frames <= MOST_FRAMES:
            sufficient.append((frames, -worth.growth(frames, known), condition))
    best = min(sufficient, key=lambda entry: entry[:2], default=None)
    return None if best is None else (best[2], best[0])


def list_conditions(design: Design) -> list[Condition]:
    """Return candidate conditions of a new frame.

    These are exposures below, between and above the present ones if exposures were recorded; at the longest present
    exposure, angles between and beyond the present ones if there are several; and a blocked beam.
    """
    exposures, angles = np.unique(design.exposure_s), np.unique(np.rad2deg(design.angle))
    conditions: list[Condition] = []
    if design.has_exposures:
        between = np.sqrt(exposures[:-1] * exposures[1:])
        candidates = (exposures[0] / 4, exposures[0] / 2, *between, *(exposures[-1] * np.array([1, 2, 4])))
        conditions = [{"exposure_s": float(exposure_s)} for exposure_s in candidates]
    longest = {"exposure_s": float(exposures[-1])}
    if len(angles) > 1:
        candidates = (*((angles[:-1] + angles[1:]) / 2), *(angles[-1] + FURTHER_ANGLES_DEG))
        conditions += [{**longest, "angle_deg": float(angle_deg)} for angle_deg in candidates]
    return [*conditions, {**longest, "blocked": True}]


def design_at(design: Design, condition: Condition) -> tuple[int, Design]:
    """Return (frame, design): the present frame of the nearest exposure, and the design of a new frame of a condition.

    The new frame is taken after all present ones, and like the nearest one in all that the condition does not fix.
    """
    exposure_s = float(condition["exposure_s"])
    frame = int(np.argmin(np.abs(np.log(design.exposure_s / exposure_s))))
    angle = np.deg2rad(float(condition["angle_deg"])) if "angle_deg" in condition else design.angle[frame]
    nearest = design.select(slice(frame, frame + 1))
    return frame, replace(nearest, exposure_s=np.array([exposure_s]), order=np.ones(1), angle=np.array([angle]))


# Effects of the mean image


def compare_images(name: str, rival: Effect, present: PresentFits) -> tuple[WorthFunction, np.ndarray] | None:
    """Compare a named effect and a rival by the pixels of a new frame.

    Returns
    -------
    tuple of function and array [parameter, parameter], or None
        Worth of a frame of a condition, and the information I of the present frames on the fitted parameters of sensor
        and effects of the rival's model. None if no start of the rival can be fitted.
    """
    fit, thinned = present.fit, thin_pixels(present.fit.pixels)
    without = fit_jointly(fit.model.without_effect(name), thinned, tolerance=TOLERANCE, iterations=ITERATIONS)
    candidates = screen_candidates(without, list_starts([rival], present.scales))
    if not candidates:
        return None
    rival_model = without.model.with_effect(candidates[0].start, present.scales)
    rival_fit = fit_jointly(rival_model, thinned, tolerance=TOLERANCE, iterations=ITERATIONS)
    targets = np.arange(SPOT_PARAMETERS * rival_fit.equations.frame_count, rival_fit.equations.size)
    # Scaled from the thinned to all pixels.
    known = information_beside(rival_fit.equations.information, targets) * fit.pixels.share / thinned.share

    def worth_of(condition: Condition) -> FrameWorth | None:
        """Return the worth of a frame of a condition; None if its readings might clip."""
        model, pixels = predict_frame(fit.model, fit.pixels, condition, present)
        expected = evaluate(model, pixels, slice(0, 1), with_slopes=False)
        readings, root_weight = expected.moments.mean, np.sqrt(expected.weight).ravel()
        if readings.max() > USABLE_SHARE * model.forward.sensor.full_scale_dn:
            return None
        # The rival's spot starts from that of the named effect, and is refitted linearly: `basis` spans the changes of
        # the whitened readings by the spot. A blocked beam has no spot to fit.
        model = replace(model, forward=rival_fit.model.forward, free=rival_fit.model.free)
        rival = evaluate(model, replace(pixels, readings=np.where(pixels.is_used, readings, 0.0)), slice(0, 1))
        shape = rival.weight.shape
        columns = np.array(
            [np.broadcast_to(mean, shape).ravel() * root_weight for mean, _ in differentiate_readings(model, rival)]
        )
        basis = np.zeros((0, root_weight.size))
        if not condition.get("blocked"):
            spot = (rival.moments.mean_slope * rival.slopes).reshape(SPOT_PARAMETERS, -1) * root_weight
            _, singular, basis = np.linalg.svd(spot / np.linalg.norm(spot, axis=1, keepdims=True), full_matrices=False)
            basis = basis[singular > NULL_SINGULAR]
        residual = rival.residual.ravel() * root_weight
        residual, columns = residual - basis.T @ (basis @ residual), columns - columns @ basis.T @ basis
        return FrameWorth(float(residual @ residual), columns @ residual, columns @ columns.T)

    return worth_of, known


def predict_frame(
    model: JointModel, pixels: Pixels, condition: Condition, present: PresentFits
) -> tuple[JointModel, Pixels]:
    """Return the model of one new frame of a condition, and its pixels.

    Spot and pixels are those of the present frame of the nearest exposure. Its peak and width follow the fitted laws;
    without laws, the peak is proportional to the exposure.
    """
    frame, design = design_at(model.design, condition)
    nearest = slice(frame, frame + 1)
    spots = model.spots.select(nearest)
    log_peak, log_sigma = spots.log_peak, spots.log_sigma
    if condition.get("blocked"):
        log_peak = np.full(1, BLOCKED_LOG_PEAK)
    elif present.search is None or present.laws is None:
        log_peak = log_peak + np.log(design.exposure_s / model.design.exposure_s[frame])
    else:
        law = replace(present.search.forward, law=present.laws.law, effects=present.laws.effects)
        predicted, at_present = (
            predict_spots(law, spot_conditions(other)) for other in (design, model.design.select(nearest))
        )
        log_peak, log_sigma = np.array([log_peak, log_sigma]) + predicted - at_present
    spots = FrameParameters(log_peak, log_sigma, spots.x, spots.y)
    # Without a grid the light shape is kept as fitted.
    return replace(model, spots=spots, design=design, grid=None), pixels.select(nearest)


# Laws


def compare_laws(effect: Effect, rival: Effect, present: PresentFits) -> tuple[WorthFunction, np.ndarray] | None:
    """Compare a named law and a rival law by brightness and width of the spot of a new frame.

    Returns
    -------
    tuple of function and array [parameter, parameter], or None
        Worth of a frame of a condition, and the information I of the present frames on the parameters of the laws with
        the rival. None without laws.
    """
    search, laws = present.search, present.laws
    if search is None or laws is None:
        return None
    others = [applied.effect for applied in laws.effects if applied.effect.name not in (effect.name, rival.name)]
    rival_laws = search.fit([*others, rival])
    model, rival_model = (replace(search.forward, law=fit.law, effects=fit.effects) for fit in (laws, rival_laws))
    covariance = np.linalg.inv(search.inverse)

    def worth_of(condition: Condition) -> FrameWorth | None:
        """Return the worth of a frame of a condition; None if it is blocked, might clip, or has no finite spot."""
        if condition.get("blocked"):
            return None
        frame, design = design_at(search.design, condition)
        conditions = spot_conditions(design)
        expected, rival_expected = (predict_spots(law, conditions).ravel() for law in (model, rival_model))
        sensor = search.forward.sensor
        brightest = sensor.black_level_dn + search.forward.baseline.plateau(np.exp(expected[0]))
        if not np.isfinite([*expected, *rival_expected]).all() or brightest > USABLE_SHARE * sensor.full_scale_dn:
            return None
        # Places of ln peak and ln σ of the nearest frame among the observations: ln peak of all frames, then ln σ.
        places = [frame, search.frame_count + frame]
        index = np.ix_(places, places)
        # Their covariance [2, 2]. The part by photon noise grows as 1/exposure; a longer exposure does not reduce it.
        exposure_ratio = max(search.design.exposure_s[frame] / design.exposure_s[0], 1.0)
        weight = np.linalg.inv(covariance[index] + (exposure_ratio - 1) * search.noise[index])
        _, slopes = search.linearize(rival_model, rival_laws.names, conditions)
        residual = expected - rival_expected
        return FrameWorth(float(residual @ weight @ residual), slopes.T @ weight @ residual, slopes.T @ weight @ slopes)

    return worth_of, rival_laws.jacobian.T @ search.inverse @ rival_laws.jacobian
