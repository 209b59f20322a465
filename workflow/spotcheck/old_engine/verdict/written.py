"""verdict.json as it is written: checked against its schema and against itself, whole or not at all."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from spotcheck import store
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.verdict.document import LIGHT
from spotcheck.schema import read_schema

SCHEMA = "verdict"
# Digits of every number: more than any of them is known to, fewer than change from one processor to the next.
DIGITS = 9
# By how much weights may miss 1 [1]: they are rounded.
WEIGHT_ERROR = 1e-6


def write_verdict(
    verdict: dict[str, Any], path: str | Path, *, code: str = "", inputs: Sequence[str | Path] = ()
) -> None:
    """Write verdict.json, with `code` and `inputs` as `store.write_text` takes them. Raises `ContractError` where it
    breaks the contract: a defect of the program, not of the data."""
    plain = rounded(verdict)
    if breach := breach_of_verdict(plain):
        raise store.ContractError(f"verdict.json: {breach}")
    text = json.dumps(plain, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    store.write_text(path, text, code=code, inputs=inputs)


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
    schema = read_schema(SCHEMA)
    schema["$defs"]["effect"] = {"enum": sorted({*vocabulary(), LIGHT})}
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
    status, effects = verdict["status"], verdict["effects"]
    names = [own["name"] for own in effects]
    if len(set(names)) < len(names):
        return f"effects: {', '.join(names)} holds one twice"
    for own in effects:
        name, evidence = own["name"], own["evidence"]
        if own["candidates"] != [name, *(rival["name"] for rival in evidence["rivals"])]:
            return f"effects: the candidates of {name} are not itself and its rivals"
        if abs(evidence["weight"] + sum(rival["weight"] for rival in evidence["rivals"]) - 1) > WEIGHT_ERROR:
            return f"effects: the weights of {name} and its rivals do not add up to 1"
    if (LIGHT in names) != (verdict["light"] is not None):
        return f"light: described without {LIGHT} among effects, or the other way round"
    found = status in ("named", "named_more_remains", "ambiguous")
    if found != bool(effects):
        return f"status {status} {'without' if found else 'with'} effects"
    if found and (status == "ambiguous") != any(len(own["candidates"]) > 1 for own in effects):
        return f"status {status}, but rivals {'are missing' if status == 'ambiguous' else 'remain'}"
    if status == "not_assessed" and not verdict["not_assessed"]:
        return "status not_assessed without a reason"
    return None
