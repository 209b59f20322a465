"""What the loop found, as plain numbers that a file can hold, and back: later steps take it up from there."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from spotcheck.discrepancy.base import Base
from spotcheck.discrepancy.cells import Setting
from spotcheck.discrepancy.detect import Detection
from spotcheck.discrepancy.explain import Account, account
from spotcheck.discrepancy.extend import Findings, Size, about, closer_account, with_freed
from spotcheck.discrepancy.freed_named import recalled_effect, recalled_freed, saved_effect, saved_of_freed
from spotcheck.discrepancy.look import Look, look_at
from spotcheck.discrepancy.name import present_of
from spotcheck.discrepancy.shots import Design, Shot
from spotcheck.discrepancy.surround import surround_of
from spotcheck.model.chain import Free, Law


def saved_of(found: Findings) -> dict[str, Any]:
    """Findings as numbers and texts."""
    return {
        "status": found.status,
        "detection": _plain(found.detection._asdict()),
        "size": _plain(found.size._asdict()),
        "rest": _plain(found.rest._asdict()),
        "rest_size": _plain(found.rest_size._asdict()),
        "explanations": [_saved_account(own) for own in found.explanations],
        "singles": {name: {"score": float(own.score - found.base.score), "chi2": float(own.refit.chi2)}
                    for name, own in found.singles.items()},
        "not_assessed": found.not_assessed,
        "freed": None if found.freed is None else saved_of_freed(found.freed),
    }  # fmt: skip


def recalled(saved: dict[str, Any], shots: Sequence[Shot], design: Design, base: Base, setting: Setting) -> Findings:
    """Findings again, from the frames that chose the model: fits are taken up where they ended."""
    look = look_at(shots, design, base, setting)
    first = account(look, ())
    explanations = [_recalled_account(look, own) for own in saved["explanations"]]
    best = None
    if explanations:
        near = about(shots, look, explanations[0])
        best = near, closer_account(near, explanations[0])
    found = Findings(
        look,
        first,
        Detection(**saved["detection"]),
        Size(**saved["size"]),
        explanations,
        best,
        Detection(**saved["rest"]),
        Size(**saved["rest_size"]),
        {},
        saved["not_assessed"],
        saved["status"],
        {name: (own["score"], own["chi2"]) for name, own in saved["singles"].items()},
        around=surround_of(shots, look, first),
    )
    freed = saved.get("freed")
    return found if freed is None else with_freed(found, recalled_freed(freed), shots)


def _saved_account(own: Account) -> dict[str, Any]:
    """Effects with their values, and the base that these belong to: from another a fit may go astray."""
    model = own.refit.model
    base = {name: np.asarray(value).tolist() for name, value in model.base._asdict().items()}
    return {"effects": [saved_effect(p) for p in present_of(own)], "base": base, "gain": model.gain.tolist()}


def _recalled_account(look: Look, saved: dict[str, Any]) -> Account:
    start = look.problem.start
    present = [recalled_effect(own) for own in saved["effects"]]
    base: Law | Free
    if isinstance(start.base, Law):
        base = Law(**saved["base"])
    else:
        base = Free(**{name: np.array(own) for name, own in saved["base"].items()})
    return account(look, present, start._replace(base=base, gain=np.array(saved["gain"])))


def _plain(value: Any) -> Any:
    """Numbers of Python's own."""
    if isinstance(value, dict):
        return {key: _plain(own) for key, own in value.items()}
    return value.item() if isinstance(value, np.generic) else value
