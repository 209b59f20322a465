"""What a design can show, and how much what is left looks like any of it."""

import numpy as np

from spotcheck.discrepancy.explain import Account, is_component
from spotcheck.discrepancy.look import Look
from spotcheck.discrepancy.refit import basis, promised
from spotcheck.model.effect import Effect, Place
from spotcheck.model.effects import vocabulary

# Its statistic.
LIKELIEST = "mean: likeliest effect"
# The largest z of all effects that chance alone brings in most sets.
BY_CHANCE = 3.0


def assessable(look: Look) -> tuple[list[Effect], dict[str, str]]:
    """Effects that the design can show, and why the others cannot be shown: both before the data are looked at."""
    design = look.measured.design
    law = look.measured.base.law is not None
    exposures = len(np.unique(design.exposure_s[np.isfinite(design.exposure_s)]))
    angles = len(np.unique(design.angle_deg[np.isfinite(design.angle_deg)]))
    frames = len(design.condition)
    per_site = np.bincount(design.site)
    reasons = {
        "exposure": "" if exposures > 1 else "all frames have one exposure",
        "three exposures": "" if exposures > 2 else "two exposures fit any law of the width",
        "angle": "" if angles > 2 else "fewer than three fibre angles",
        "order": "" if np.isfinite(design.order).all() and frames > 2 else "the order of acquisition is not known",
        "frames": "" if frames > 2 else "too few frames",
        "exposures of a site": "" if per_site.max(initial=0) > 1 else "no site was seen more than once",
        "law": "" if law else "the baseline leaves brightness and width of every frame free",
    }
    out, why = [], {}
    for effect in vocabulary().values():
        # This search takes the light's shape as declared.
        if effect.place is Place.SHAPE:
            continue
        missing = next((reasons[need] for need in effect.needs if reasons[need]), "")
        if missing:
            why[effect.name] = missing
        else:
            out.append(effect)
    return out, why


def of_means(effect: Effect) -> bool:
    """Whether means of conditions ask for an effect: stripes show in the spectrum, what goes with the order from frame
    to frame."""
    return not (is_component(effect) or effect.spectral or "order" in effect.needs)


def likeliest(look: Look, own: Account) -> dict[str, float]:
    """The largest z, to first order, with which the means that an account leaves ask for one effect more: a faint one
    drowns in statistics that see everything."""
    problem, fit = look.problem, own.refit
    if not problem.used.any():
        return {LIKELIEST: 0.0}
    span = basis(problem, fit, own.refit_effects, own.latent)
    taken = {name for present in fit.model.present for name in (present.effect.name, *present.effect.replaces)}
    promises = [0.0]
    for effect in assessable(look)[0]:
        if of_means(effect) and not taken & {effect.name, *effect.replaces}:
            promises.append(promised(problem, fit, span, effect))
    return {LIKELIEST: float(np.sqrt(max(promises) / own.together))}
