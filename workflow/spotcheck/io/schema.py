"""YAML files and their schemas: reading, validation, and one sentence for the first error."""

import math
import re
from pathlib import Path
from typing import Any

import yaml
from jsonschema import Draft202012Validator
from jsonschema.exceptions import ValidationError, best_match

from spotcheck.errors import InputError
from spotcheck.io.text import read_text

# Longest wrong value, and longest reason of a parser, that a message quotes [characters].
MAX_QUOTED, MAX_REASON = 60, 80
SCHEMAS = Path(__file__).parent / "schemas"
# End of messages about the syntax of a file.
SYNTAX = "it must be YAML with `key: value` lines"
# Names of the types and of the bounds of JSON Schema in messages.
TYPE_NAMES = {
    "object": "a section with keys below it",
    "array": "a list",
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "string": "text",
}
BOUNDS = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most"}


def read_schema(name: str) -> dict[str, Any]:
    """Return the JSON schema with a name such as "instrument" from the folder of schemas."""
    return read_yaml(SCHEMAS / f"{name}.schema.yaml")


def find_violation(content: dict[str, Any], name: str) -> str | None:
    """Return one sentence on the most relevant violation of a schema, or None if the content is valid.

    Parameters
    ----------
    content : dict
        Content of a YAML file.
    name : str
        Name of the schema, such as "instrument".

    Returns
    -------
    str or None
        The key, what is wrong, and what would be right.
    """
    schema = read_schema(name)
    error = best_match(Draft202012Validator(schema).iter_errors(content))
    return None if error is None else _explain(error, schema)


def read_keys(path: Path) -> dict[str, Any]:
    """Return the keys and values of a YAML file; an empty file has none.

    Raises `InputError` if the file does not exist or is not YAML with keys.
    """
    if not path.is_file():
        raise InputError(f"{path.name}: is no file; {SYNTAX}")
    return parse_keys(read_text(path), path.name)


def parse_keys(text: str, name: str) -> dict[str, Any]:
    """Return the keys and values of a YAML text from a file with a name. Raises `InputError` as `read_keys` does."""
    try:
        content = yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise InputError(f"{name}{line}: {problem}; {SYNTAX}") from None
    except (ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0][:MAX_REASON]
        raise InputError(f"{name}: a value cannot be read ({reason}); it must be a number, text or list") from None
    if content is not None and not isinstance(content, dict):
        raise InputError(f"{name}: holds no keys; {SYNTAX}")
    return content or {}


def read_yaml(path: Path) -> Any:
    """Return the content of a YAML file by the rules of `_Loader`.

    Raises `yaml.YAMLError` for a mistake in the YAML, and `InputError` if the file is not text.
    """
    return yaml.load(read_text(path), _Loader)


class _Loader(yaml.SafeLoader):
    """Loader that reads numbers as YAML 1.2 does, and refuses duplicate keys, infinite numbers and aliases.

    YAML 1.1 reads 5e-6 as text and keeps the last of two equal keys. A few lines of aliases may stand for more values
    than memory holds.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return the next node of the document. Raises `yaml.YAMLError` for an alias."""
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise _make_yaml_error(f"*{event.anchor} is an alias, which is not read", event)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:
        """Return the dictionary of a node. Raises `yaml.YAMLError` for a key that is not text or occurs twice."""
        keys: set[str] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=deep)
            if not isinstance(key, str):
                raise _make_yaml_error(f"key {_quote(key)} is not a word", key_node)
            if key in keys:
                raise _make_yaml_error(f"key {key[:MAX_QUOTED]} stands twice", key_node)
            keys.add(key)
        return super().construct_mapping(node, deep)


def _make_yaml_error(problem: str, node: Any) -> yaml.MarkedYAMLError:
    """Return an error that names the line of a node or event."""
    return yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


def _construct_float(loader: _Loader, node: Any) -> float:
    """Return the number of a node. Raises `yaml.YAMLError` if it is not finite."""
    value = loader.construct_yaml_float(node)
    if not math.isfinite(value):
        raise _make_yaml_error(f"{node.value} is not a finite number", node)
    return value


def _construct_int(loader: _Loader, node: Any) -> int:
    """Return the whole number of a node. Raises `yaml.YAMLError` unless it is decimal with at most 18 digits.

    YAML 1.1 would read 012 as octal and 1:30 as sexagesimal.
    """
    text = loader.construct_scalar(node)
    if not re.fullmatch(r"[-+]?(0|[1-9]\d{0,17})", text):
        raise _make_yaml_error(f"{text[:40]} is not a decimal whole number", node)
    return int(text)


# Numbers in YAML 1.2: with an exponent, a point is not needed.
_Loader.add_constructor("tag:yaml.org,2002:int", _construct_int)
_Loader.add_constructor("tag:yaml.org,2002:float", _construct_float)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+0123456789."),
)


def _quote(value: Any) -> str:
    """Return a value for a message, shortened to `MAX_QUOTED` characters."""
    text = repr(value)
    return text if len(text) <= MAX_QUOTED else f"{text[:MAX_QUOTED]}…"


def _explain(error: ValidationError, schema: dict[str, Any]) -> str:
    """Return one sentence on a schema error: the key, what is wrong, and what would be right."""
    key = ".".join(str(part) for part in error.absolute_path)
    # The rule that is broken, such as "minimum", and its value in the schema.
    rule, rule_value = str(error.validator), error.validator_value
    if rule == "additionalProperties":
        return _explain_unknown_key(key, error, schema)
    if rule == "required":
        missing_key = next(name for name in rule_value if name not in error.instance)
        return f"key {key}.{missing_key} is missing" if key else f"key {missing_key} is missing"
    if rule == "type":
        return f"key {key} is {_quote(error.instance)}; it must be {TYPE_NAMES[rule_value]}"
    if rule == "enum":
        return f"key {key} is {_quote(error.instance)}; it must be one of {', '.join(map(str, rule_value))}"
    if rule in BOUNDS:
        return f"key {key} is {_quote(error.instance)}; it must be {BOUNDS[rule]} {rule_value}"
    return f"key {key}: {error.message}"


def _explain_unknown_key(section: str, error: ValidationError, schema: dict[str, Any]) -> str:
    """Return one sentence on a key that a section does not have; `section` is "" for the top level."""
    known_keys = error.schema["properties"]
    unknown_key = next(name for name in error.instance if name not in known_keys)
    right_sections = [
        name for name, entry in schema["properties"].items() if unknown_key in entry.get("properties", {})
    ]
    if right_sections and not section:
        return f"key {unknown_key} stands outside its section; put it under `{right_sections[0]}:`"
    # Other keys than words are quoted, which shows their blanks.
    unknown_key = unknown_key if re.fullmatch(r"\w{1,60}", unknown_key) else _quote(unknown_key)
    key = f"{section}.{unknown_key}" if section else unknown_key
    return f"unknown key {key}; known keys here: {', '.join(known_keys)}"
