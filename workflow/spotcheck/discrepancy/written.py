"""Checks of a verdict against its schema and against itself, and the file verdict.json."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from spotcheck.discrepancy.verdict import LEARNED_SHAPE, Status
from spotcheck.io import store
from spotcheck.io.schema import read_schema
from spotcheck.model.effects import vocabulary

# Name of the schema.
SCHEMA = "verdict"
# Digits of all numbers: more than any of them is known to, fewer than differ between processors.
DIGITS = 9
# Largest difference of a sum of weights from 1: they are rounded.
WEIGHT_ERROR = 1e-6
# Statuses with effects, and statuses that need a reason.
WITH_EFFECTS = (Status.NAMED, Status.NAMED_MORE_REMAINS, Status.AMBIGUOUS)
WITH_REASON = (Status.NOT_ASSESSED, Status.NOT_CONVERGED)


def write_verdict(
    verdict: dict[str, Any], path: str | Path, *, code: str = "", inputs: Sequence[str | Path] = ()
) -> None:
    """Write verdict.json.

    Parameters
    ----------
    verdict : dict
        As `compose_verdict` returns it, with its sentence.
    path : path
        File to write; an older one stays as it is if the verdict is refused.
    code, inputs : str, sequence of path
        Provenance, as `store.write_text` takes it.

    Raises
    ------
    ContractError
        If the verdict breaks its schema or contradicts itself, which is a defect of the program, not of the data.
    """
    plain = rounded(verdict)
    if breach := breach_of_verdict(plain):
        raise store.ContractError(f"verdict.json: {breach}")
    text = json.dumps(plain, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    store.write_text(path, text, code=code, inputs=inputs)


def rounded(value: Any) -> Any:
    """Return the same content with Python's own numbers, rounded to `DIGITS` digits."""
    if isinstance(value, dict):
        return {str(key): rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    return value


def breach_of_verdict(verdict: dict[str, Any]) -> str | None:
    """Return in one sentence what is wrong with a verdict: where, and what; None if nothing is."""
    schema = read_schema(SCHEMA)
    schema["$defs"]["effect"] = {"enum": sorted({*vocabulary(), LEARNED_SHAPE.name})}
    error = best_match(Draft202012Validator(schema).iter_errors(verdict))
    if error is not None:
        return f"{'.'.join(str(part) for part in error.absolute_path) or 'the whole'}: {error.message}"
    return _find_non_finite(verdict) or _find_contradiction(verdict)


def _find_non_finite(value: Any, path: str = "") -> str | None:
    """Return where a NaN or an infinity stands; None if there is none."""
    if isinstance(value, float) and not np.isfinite(value):
        return f"{path.lstrip('.')}: {value} is no number; write null"
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return next((text for key, item in items if (text := _find_non_finite(item, f"{path}.{key}"))), None)


def _find_contradiction(verdict: dict[str, Any]) -> str | None:
    """Return which parts of a verdict contradict each other; None if none do."""
    status, effects = Status(verdict["status"]), verdict["effects"]
    names = [effect["name"] for effect in effects]
    if len(set(names)) < len(names):
        return f"effects: {', '.join(names)} holds one twice"
    if text := next(filter(None, map(_contradiction_of, effects)), None):
        return text
    if (LEARNED_SHAPE.name in names) != (verdict["light"] is not None):
        return f"light: described without {LEARNED_SHAPE.name} among effects, or the other way round"
    if (status in WITH_EFFECTS) != bool(effects):
        return f"status {status.value} {'with' if effects else 'without'} effects"
    has_rivals = any(len(effect["candidates"]) > 1 for effect in effects)
    if (status is Status.AMBIGUOUS) != has_rivals:
        return f"status {status.value}, but rivals {'remain' if has_rivals else 'are missing'}"
    if status in WITH_REASON and not any(row["effect"] == "all" for row in verdict["not_assessed"]):
        return f"status {status.value} without a reason in not_assessed"
    return None


def _contradiction_of(effect: dict[str, Any]) -> str | None:
    """Return what is wrong with the candidates of an effect and their weights; None if nothing is."""
    name, evidence = effect["name"], effect["evidence"]
    if effect["candidates"] != [name, *(rival["name"] for rival in evidence["rivals"])]:
        return f"effects: the candidates of {name} are not itself and its rivals"
    if abs(evidence["weight"] + sum(rival["weight"] for rival in evidence["rivals"]) - 1) > WEIGHT_ERROR:
        return f"effects: the weights of {name} and its rivals do not add up to 1"
    return None
