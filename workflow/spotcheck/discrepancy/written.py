"""The file verdict.json: its writer, and checks of a verdict against its schema and of its parts against each other.

A verdict is a tree of dicts, lists and numbers, as `compose_verdict` returns it.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from spotcheck.discrepancy.verdict import LEARNED_SHAPE, Status
from spotcheck.io import store
from spotcheck.io.schema import read_schema
from spotcheck.model.effects import vocabulary

# Name of the schema of verdict.json.
SCHEMA = "verdict"
# Largest deviation from 1 of the sum of the probabilities (weights) of an effect and its rivals: they are rounded.
WEIGHT_ERROR = 1e-6
# Statuses of verdicts that list effects, and statuses that need a reason in `not_assessed`.
WITH_EFFECTS = (Status.NAMED, Status.NAMED_MORE_REMAINS, Status.AMBIGUOUS)
WITH_REASON = (Status.NOT_ASSESSED, Status.NOT_CONVERGED)


def write_verdict(
    verdict: dict[str, Any], path: str | Path, *, code: str = "", inputs: Sequence[str | Path] = ()
) -> None:
    """Write verdict.json.

    Parameters
    ----------
    verdict : dict
        Result of `compose_verdict`, with its `sentence` filled in.
    path : path
        File to write. An existing file is kept if the verdict is refused.
    code : str
        Digest of the code, for the provenance that `store.write_text` keeps; "" for no provenance.
    inputs : sequence of path
        Files from which the verdict follows, also for the provenance; unused if `code` is "".

    Raises
    ------
    ContractError
        If the verdict does not follow its schema, or its parts contradict each other. This is a defect of the program,
        not of the data.
    """
    if breach := breach_of_verdict(verdict):
        raise store.ContractError(f"verdict.json: {breach}")
    text = json.dumps(verdict, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    store.write_text(path, text, code=code, inputs=inputs)


def breach_of_verdict(verdict: dict[str, Any]) -> str | None:
    """Return what is wrong with a verdict in one sentence that says where; None if it is right."""
    schema = read_schema(SCHEMA)
    schema["$defs"]["effect"] = {"enum": sorted({*vocabulary(), LEARNED_SHAPE.name})}
    error = best_match(Draft202012Validator(schema).iter_errors(verdict))
    if error is not None:
        return f"{'.'.join(str(part) for part in error.absolute_path) or 'the whole'}: {error.message}"
    return _find_contradiction(verdict)


def _find_contradiction(verdict: dict[str, Any]) -> str | None:
    """Return a sentence that says which parts of a verdict contradict each other; None if none do."""
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
    """Return a sentence on candidates or weights of an effect that contradict its rivals; None if none do."""
    name, evidence = effect["name"], effect["evidence"]
    if effect["candidates"] != [name, *(rival["name"] for rival in evidence["rivals"])]:
        return f"effects: the candidates of {name} are not itself and its rivals"
    if abs(evidence["weight"] + sum(rival["weight"] for rival in evidence["rivals"]) - 1) > WEIGHT_ERROR:
        return f"effects: the weights of {name} and its rivals do not add up to 1"
    return None
