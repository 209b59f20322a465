"""YAML files and their schemas: one sentence for what breaks one."""

import math
import re
from pathlib import Path
from typing import Any

import yaml
from jsonschema import Draft202012Validator
from jsonschema.exceptions import ValidationError, best_match

from spotcheck.errors import InputError
from spotcheck.io.text import read_text

# Characters of a wrong value that a message shows: more would hide what it says.
LONGEST_SHOWN = 60
SCHEMAS = Path(__file__).parent / "schemas"


def read_schema(name: str) -> dict[str, Any]:
    """A schema by its name, such as "instrument"."""
    return read_yaml(SCHEMAS / f"{name}.schema.yaml")


def breach_of(content: dict[str, Any], name: str) -> str | None:
    """What breaks a schema, in one sentence: key, what is wrong, what would be right; None where nothing does."""
    schema = read_schema(name)
    breach = best_match(Draft202012Validator(schema).iter_errors(content))
    return None if breach is None else _explain(breach, schema)


def read_keys(path: Path) -> dict[str, Any]:
    """Keys and values of a YAML file; an empty one has none. Raises `InputError`."""
    if not path.is_file():
        raise InputError(f"{path.name}: is no file; it must be YAML with `key: value` lines")
    try:
        content = read_yaml(path)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise InputError(f"{path.name}{line}: {problem}; it must be YAML with `key: value` lines") from None
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0][:80]
        raise InputError(f"{path.name}: a value cannot be read ({reason}); it must be a number, text or list") from None
    if content is not None and not isinstance(content, dict):
        raise InputError(f"{path.name}: holds no keys; it must be YAML with `key: value` lines")
    return content or {}


def read_yaml(path: Path) -> Any:
    """Content of a YAML file, with numbers such as 5e-6 read as numbers and doubled keys refused."""
    return yaml.load(read_text(path), _Loader)


class _Loader(yaml.SafeLoader):
    """YAML 1.2 numbers, no doubled keys and no aliases: YAML 1.1 reads 5e-6 as text and keeps the last of two equal
    keys, and a few lines of aliases stand for more values than memory holds."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.MarkedYAMLError(
                problem=f"*{event.anchor} is an alias, which is not read", problem_mark=event.start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:
        seen: set = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=deep)
            if not isinstance(key, str):
                raise yaml.MarkedYAMLError(problem=f"key {_shown(key)} is no word", problem_mark=key_node.start_mark)
            if key in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {key[:LONGEST_SHOWN]} stands twice", problem_mark=key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


def _construct_float(loader: _Loader, node: Any) -> float:
    value = loader.construct_yaml_float(node)
    if not math.isfinite(value):
        raise yaml.MarkedYAMLError(problem=f"{node.value} is no number to reckon with", problem_mark=node.start_mark)
    return value


def _construct_int(loader: _Loader, node: Any) -> int:
    text = loader.construct_scalar(node)
    if not re.fullmatch(r"[-+]?(0|[1-9]\d{0,17})", text):
        raise yaml.MarkedYAMLError(problem=f"{text[:40]} is no decimal whole number", problem_mark=node.start_mark)
    return int(text)


_Loader.add_constructor("tag:yaml.org,2002:int", _construct_int)
_Loader.add_constructor("tag:yaml.org,2002:float", _construct_float)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+0123456789."),
)


def _shown(value: Any) -> str:
    """A value as a message shows it: its first characters."""
    text = repr(value)
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}…"


def _explain(error: ValidationError, schema: dict[str, Any]) -> str:
    """One sentence for a schema error: key, what is wrong, what would be right."""
    key = ".".join(str(part) for part in error.absolute_path)
    if error.validator == "additionalProperties":
        known = error.schema["properties"]
        unknown = next(k for k in error.instance if k not in known)
        sections = {name: own.get("properties", {}) for name, own in schema["properties"].items()}
        home = next((name for name, own in sections.items() if unknown in own), None)
        if home and not key:
            return f"key {unknown} stands outside its section; put it under `{home}:`"
        unknown = unknown if re.fullmatch(r"\w{1,60}", unknown) else _shown(unknown)
        where = f"{key}.{unknown}" if key else unknown
        return f"unknown key {where}; known keys here: {', '.join(known)}"
    if error.validator == "type":
        kind = {"object": "a section with keys below it", "array": "a list", "number": "a number"}
        kind |= {"integer": "a whole number", "boolean": "true or false", "string": "text"}
        return f"key {key} is {_shown(error.instance)}; it must be {kind[error.validator_value]}"
    if error.validator == "enum":
        return f"key {key} is {_shown(error.instance)}; it must be one of {', '.join(map(str, error.validator_value))}"
    if error.validator == "required":
        missing = next(own for own in error.validator_value if own not in error.instance)
        return f"key {key}.{missing} is missing" if key else f"key {missing} is missing"
    bound = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most"}.get(str(error.validator))
    if bound:
        return f"key {key} is {_shown(error.instance)}; it must be {bound} {error.validator_value}"
    return f"key {key}: {error.message}"
