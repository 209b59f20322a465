"""verdict.json as it is written: checked against its schema and against itself, whole or not at all."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from spotcheck import store
from spotcheck.model.effects import vocabulary
from spotcheck.schema import read_schema

# Digits of every number: more than any of them is known to, fewer than change from one processor to the next.
DIGITS = 9


def write_verdict(verdict: dict[str, Any], path: str | Path) -> None:
    """Write verdict.json. Raises `ContractError` where it breaks the contract: a defect of the program, not of the
    data."""
    plain = rounded(verdict)
    if breach := breach_of_verdict(plain):
        raise store.ContractError(f"verdict.json: {breach}")
    store.write_text(path, json.dumps(plain, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def rounded(value: Any) -> Any:
    """The same with numbers of Python's own, to `DIGITS` digits."""
    if isinstance(value, dict):
        return {str(key): rounded(own) for key, own in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(own) for own in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    return value


def breach_of_verdict(verdict: dict[str, Any]) -> str | None:
    """What breaks the contract, in one sentence; None where nothing does."""
    schema = read_schema("verdict")
    schema["$defs"]["effect"] = {"enum": list(vocabulary())}
    error = best_match(Draft202012Validator(schema).iter_errors(verdict))
    if error is not None:
        return f"{'.'.join(str(part) for part in error.absolute_path) or 'the whole'}: {error.message}"
    return _not_a_number(verdict) or _contradiction(verdict)


def _not_a_number(value: Any, path: str = "") -> str | None:
    """Where a NaN or an infinity stands; a missing number is null."""
    if isinstance(value, float) and not np.isfinite(value):
        return f"{path.lstrip('.')}: {value} is no number; write null"
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return next((found for key, own in inner if (found := _not_a_number(own, f"{path}.{key}"))), None)


def _contradiction(verdict: dict[str, Any]) -> str | None:
    """What a schema cannot say: parts that must agree with each other."""
    status, effects, explanations = (verdict[key] for key in ("status", "effects", "explanations"))
    names = [own["name"] for own in effects]
    if len(set(names)) < len(names):
        return f"effects: {', '.join(names)} holds one twice"
    if explanations[:1] != ([names] if names else []):
        return f"explanations: the first is not effects, {names}"
    if len({frozenset(own) for own in explanations}) < len(explanations):
        return "explanations: one stands twice"
    if any(own["name"] not in own["candidates"] for own in effects):
        return "effects: one is not among its own candidates"
    if status in ("named", "ambiguous") and not effects:
        return f"status {status} without an effect"
    if status in ("consistent", "not_assessed") and effects:
        return f"status {status} with effects"
    alone = len(explanations) == 1 and all(len(own["candidates"]) == 1 for own in effects)
    if status == "named" and not alone:
        return "status named, but rivals remain"
    if status == "ambiguous" and len(explanations) < 2:
        return "status ambiguous with one explanation"
    if status == "not_assessed" and not verdict["not_assessed"]:
        return "status not_assessed without a reason"
    return None
