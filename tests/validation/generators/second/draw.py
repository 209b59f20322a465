"""One seed, one dataset folder, one truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.validation.generators.second.case import Case, draw_case
from tests.validation.generators.second.effects import VOCABULARY
from tests.validation.generators.second.outside import MECHANISMS
from tests.validation.generators.second.strength import Refit, fit_under_full_scale, tune
from tests.validation.generators.second.write import instrument, write_dataset


def hide(case: Case, names: list[str]) -> tuple[list[dict[str, object]], dict[str, float]]:
    """Draw the named effects into the case, each tuned by itself. Returns their truths, and that of all together."""
    refit = Refit(case)
    truths = []
    for k, name in enumerate(names):
        rng = np.random.default_rng([case.seed, 1, k])
        outside = name.startswith("outside:")
        effect = (MECHANISMS[name.removeprefix("outside:")] if outside else VOCABULARY[name])(case, rng)
        effect.name = name
        strengths = tune(refit, effect, rng)
        case.effects[name] = effect
        truths.append({"name": name, "form": effect.form, "strength": strengths})
    fit_under_full_scale(case)
    for truth in truths:
        effect = case.effects[str(truth["name"])]
        truth["parameters"] = effect.at(effect.s)
    together = Refit(case).measure(case, max((e.unknowns for e in case.effects.values()), default=0))
    return truths, together


def write_case(seed: int, names: list[str], design: str, folder: Path) -> dict[str, object]:
    """Draw effects (or `outside:KIND`) into a case, write it as a dataset folder, and return the truth."""
    case = draw_case(seed, design, names)
    effects, together = hide(case, names)
    write_dataset(case, folder)
    return {
        "seed": seed,
        "design": design,
        "effects": effects,
        "together": together,
        "frame_px": case.size,
        "instrument": instrument(case, folder.name),
        "base": {"p1_px": case.p1, "p2_px": case.p2, "peak_dn": case.peak, "centres_px": case.centres.tolist()},
    }
