"""Refits: the leading candidates of the selection, each fitted to the thinned pixels.

A candidate is a `start` of an effect with the expected drop by a score test (`score`). A drop is a decrease of −2 ln L.
Thinned pixels are a random subset of the pixels. The dispersion is the variance of a score over that of independent
readings: it exceeds 1 if granular light is common to neighbouring pixels. A `JointFit` has the fitted `model`, its
`pixels` and its `deviance`, −2 ln L.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from spotcheck.discrepancy.candidates import Candidate, is_unresolved_shape
from spotcheck.discrepancy.criteria import MIN_GAIN, PARAMETER_PRICE
from spotcheck.discrepancy.evidence import least_gain
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.site_draws import start_draws
from spotcheck.model.effect import AppliedEffect, EffectScales

# Effort of a refit: Newton decrement of the effects at which it ends, and most iterations.
REFIT_TOLERANCE, REFIT_ITERATIONS = 0.1, 9
# Candidates whose score test is below this part of the best one are not refitted.
SCORE_SHARE = 0.05
# Most candidates that are refitted in one step of the selection, beside the declared and beside a free light shape.
MOST_REFITS, MOST_REFITS_BESIDE_SHAPE = 6, 4
# Most variants of one effect among them, and most starts of one variant; the best effect has all its variants refitted.
MOST_VARIANTS, MOST_STARTS = 2, 1

Log = Callable[[str], None]


@dataclass(frozen=True)
class Refit:
    """The present model with a candidate, fitted to the thinned pixels."""

    candidate: Candidate  # the effect with its start
    model: JointModel  # the fitted model
    value: float  # drop over the light's dispersion, scaled to all pixels, less `PARAMETER_PRICE` for each parameter

    @property
    def effect_name(self) -> str:
        """Name of the effect."""
        return self.candidate.start.effect.name

    @property
    def is_at_bound(self) -> bool:
        """Whether a parameter of the effect is at its bound, where the variant acts much as another one does."""
        return self.model.is_at_bound(self.effect_name)


def least_drop_of(candidate: Candidate, present: JointFit) -> float:
    """Return the least drop of an effect, over the dispersion of the light.

    The least gain is a drop over the dispersion of the candidate's own score, which depends on where it changes the
    light.
    """
    pixels = present.pixels
    return least_gain(present.model) * float(pixels.dispersion_of(candidate.field_share)) / pixels.dispersion


def price_of(candidate: Candidate) -> float:
    """Return the price of a candidate's parameters in −2 ln L."""
    start = candidate.start
    return PARAMETER_PRICE * (len(start.effect.parameters_of(start.variant)) + candidate.draws)


def refit_candidates(
    thinned: JointFit, candidates: Sequence[Candidate], present: JointFit, scales: EffectScales, log: Log
) -> list[Refit]:
    """Refit the leading candidates and all variants of the best effect; the best refit comes first.

    Parameters
    ----------
    thinned, present : JointFit
        Fits of the present model to the thinned and to all pixels; drops are scaled to the latter.
    candidates : sequence of Candidate
        Candidates by falling score.
    scales : EffectScales
        Typical sizes of the dataset, from which effects derive bounds.
    log : callable
        Receives lines of text.
    """
    ratio = present.pixels.count / thinned.pixels.count / present.pixels.dispersion
    refits: list[Refit] = []
    starts_of: dict[tuple, int] = {}  # number of refits by (effect, variant)
    most = MOST_REFITS if thinned.model.grid is None else MOST_REFITS_BESIDE_SHAPE
    for candidate in candidates:
        start = candidate.start
        variant = (start.effect.name, start.variant)
        other_variants = len({key for key in starts_of if key[0] == start.effect.name} - {variant})
        if candidate.score < SCORE_SHARE * candidates[0].score or len(refits) >= most:
            break
        if (
            candidate.score * ratio < least_drop_of(candidate, present)
            or starts_of.get(variant, 0) >= MOST_STARTS
            or other_variants >= MOST_VARIANTS
            or is_unresolved_shape(thinned, candidate)
        ):
            continue
        refits.append(refit_candidate(thinned, candidate, ratio, scales, log))
        starts_of[variant] = starts_of.get(variant, 0) + 1
    if not refits:
        return []
    best = max(refits, key=lambda refit: refit.value).effect_name
    for candidate in candidates:
        variant = (candidate.start.effect.name, candidate.start.variant)
        if variant[0] == best and variant not in starts_of and candidate.score * ratio > MIN_GAIN:
            refits.append(refit_candidate(thinned, candidate, ratio, scales, log))
            starts_of[variant] = 1
    return sorted(refits, key=lambda refit: -refit.value)


def refit_candidate(thinned: JointFit, candidate: Candidate, ratio: float, scales: EffectScales, log: Log) -> Refit:
    """Fit the present model with a candidate to the thinned pixels; `ratio` scales drops to all pixels."""
    start = start_draws(thinned.model.with_effect(candidate.start, scales), thinned.pixels)
    fit = fit_jointly(
        start, thinned.pixels, tolerance=REFIT_TOLERANCE, iterations=REFIT_ITERATIONS, rival=thinned.deviance
    )
    drop = (thinned.deviance - fit.deviance) * ratio
    text = describe_start(candidate.start)
    log(f"    {text}: promised {candidate.score * ratio:.0f}, got {drop:.0f}, {fit.iterations} steps")
    return Refit(candidate, fit.model, drop - price_of(candidate))


def describe_start(start: AppliedEffect) -> str:
    """Return effect, variant and values of a start as a text for the log."""
    values = ", ".join(f"{name} {value:.4g}" for name, value in start.parameters.items())
    return f"{start.effect.name} {start.variant.value} ({values})"
