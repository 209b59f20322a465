"""What a model makes of the same frames that is told which effects are in them, and how well they can be told apart."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from spotcheck.discrepancy.assess import assessable
from spotcheck.discrepancy.explain import Account, account, is_component
from spotcheck.discrepancy.extend import Findings, about, closer_account
from spotcheck.discrepancy.isolability import isolation
from spotcheck.discrepancy.look import Look
from spotcheck.discrepancy.shots import Shot, design_of, held_out
from spotcheck.discrepancy.verdict import Judgement, parameters_of
from spotcheck.discrepancy.verify import verify
from spotcheck.model.effect import Present
from spotcheck.model.effects import vocabulary

# Where isolation is worth its time: signal-to-noise of the truth.
STRONG = 90.0
# A rival that is this far behind in −2 ln L on the data is further than 25 behind without their noise, by ten standard
# deviations.
CLEAR = 400.0


def told_truth(judgement: Judgement, truth: dict[str, Any], shots: Sequence[Shot]) -> dict[str, Any] | None:
    """Gap closed, parameters with errors, and isolation; None where there is nothing to tell."""
    found = judgement.findings
    entries = truth["effects"]
    if found is None or not entries:
        return None
    own = account_of(found.look, entries)
    out: dict[str, Any] = {"score": own.score - found.base.score}
    near, exact = found.look, own
    if found.explanations:
        near = about(shots_of_discovery(shots), found.look, own)
        exact = closer_account(near, own)
        out["closed"] = closed_by(found, own, exact, shots)
        best = found._replace(best=(near, exact))
        out["parameters"] = {name: parameters_of(best, name) for name in own.names}
    if len(entries) == 1 and entries[0]["snr"] >= STRONG:
        out["isolation"] = isolation_of(found, own, near, exact)
    return out


def account_of(look: Look, entries: Sequence[dict[str, Any]]) -> Account:
    """The best account of the true effects, from their true parameters, over the library's forms and, for constants
    that the truth does not hold, over its starts."""
    trials = [_presents(look, entry) for entry in entries]
    chosen = [own[0] for own in trials]
    best = account(look, chosen)
    for k, others in enumerate(trials):
        for other in others[1:]:
            trial = [*chosen[:k], other, *chosen[k + 1 :]]
            found = account(look, trial)
            if found.score < best.score:
                best, chosen = found, trial
    return best


def _presents(look: Look, entry: dict[str, Any]) -> list[Present]:
    effect, given = vocabulary()[entry["name"]], dict(entry["parameters"])
    if "order" in entry["form"] and effect.name == "saturation":
        # The rig's soft clip is our `power`.
        given["knee"] = 1 / entry["form"]["order"]
    starts = list(effect.starts(look.problem.context)) or [tuple(0.0 for _ in effect.parameters)]
    values = [
        tuple(float(given.get(p.name, value)) for p, value in zip(effect.parameters, start, strict=True))
        for start in starts
    ]
    forms = effect.forms[:1] if is_component(effect) else effect.forms
    if "clips" in entry["form"]:
        behind = entry["form"]["clips"] == "after read noise"
        forms = tuple(form for form in forms if form.endswith("with noise") == behind)
    return [Present(effect, form, own) for form in forms for own in dict.fromkeys(values)]


def closed_by(found: Findings, own: Account, exact: Account, shots: Sequence[Shot]) -> float | None:
    """Part of the gap on unseen data that the account closes, at a first and at a closer look."""
    whole = design_of(shots)
    out = np.flatnonzero(held_out(whole.repeat))
    unseen = [shots[int(k)] for k in out]
    gap = verify(found.look, found.base, [own], unseen, whole.take(out) if len(out) else None, exact)
    return float(gap.closed) if np.isfinite(gap.closed) else None


def shots_of_discovery(shots: Sequence[Shot]) -> list[Shot]:
    """The frames that may choose the model."""
    held = held_out(design_of(shots).repeat)
    return [shot for shot, out in zip(shots, held, strict=True) if not out]


def isolation_of(found: Findings, own: Account, near: Look, exact: Account) -> dict[str, float]:
    """−2 ln L by which every rival falls behind an account at a look, if that is the truth. Those that contain it do
    not count: the simplest wins. Where all fall far behind on the data themselves, that is told: it is much faster."""
    contains = {
        more.name for more in vocabulary().values() for single, _ in own.effects if more.has_as_special_case(single)
    }
    contains |= {"", *own.names}
    rivals = {name: score - (own.score - found.base.score) for name, (score, _) in found.evidence.items()}
    if not rivals or min((v for k, v in rivals.items() if k not in contains), default=0.0) < CLEAR:
        rivals = isolation(near, exact, assessable(found.look)[0])
    return {name: float(delta) for name, delta in rivals.items() if name not in contains}
