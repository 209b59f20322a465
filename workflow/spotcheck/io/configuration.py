"""The configuration of a workflow run: paths exactly as the user typed them, validated against the schema."""

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import yaml

from spotcheck.errors import InputError
from spotcheck.io.schema import find_violation

# Keys whose values are paths of folders.
PATH_KEYS = ("dataset", "results")


def resolve_config(config: Mapping[str, Any], words: Sequence[str]) -> dict[str, Any]:
    """Return the configuration with its paths and the names of datasets as text, validated against its schema.

    Snakemake reads each value on the command line as YAML, where ` #` starts a comment and `: ` separates a key from a
    value: `my frames #2` would become the folder `my frames`. Therefore the paths `dataset` and `results` are taken
    from the words themselves. `datasets`, which replaces `dataset` by several, is a list of names in YAML, so that
    names with these characters need quotes. Slashes at the end of a path or name are removed.

    Parameters
    ----------
    config : Mapping
        Configuration as Snakemake has read it.
    words : Sequence of str
        Words `key=value` that follow `--config` on the command line.

    Returns
    -------
    dict
        All keys of `config`.

    Raises
    ------
    InputError
        If a value breaks the schema, `datasets` is no list of names, or the results folder has braces in its name.
    """
    typed_values = dict(word.split("=", 1) for word in words)
    paths = {key: typed_values.get(key, config[key]) for key in PATH_KEYS if key in config}
    # YAML reads a folder called 2024 as a number.
    resolved = dict(config) | {key: str(path).rstrip(os.sep) for key, path in paths.items()}
    datasets = config.get("datasets")
    if isinstance(datasets, list) and not any(isinstance(name, list | dict) for name in datasets):
        resolved["datasets"] = [str(name).rstrip(os.sep) for name in datasets]
    elif datasets is not None:
        raise InputError(
            f"config: datasets is {typed_values.get('datasets', datasets)}; it must be a list such as"
            " [monday, tuesday], and a name in it with # or : or a comma stands in quotes"
        )
    if violation := find_violation(resolved, "config"):
        raise InputError(f"config: {violation}")
    # Snakemake takes braces for wildcards.
    if set("{}") & set(resolved["results"]):
        raise InputError(f"config: results is {resolved['results']}, which has braces in it; name another folder")
    return resolved


def remark_on_quotes(path: str) -> str | None:
    """Return a remark if a path needs quotes in config.yaml and in lists, because YAML reads it as something else.

    Returns None if it needs none.
    """
    with suppress(yaml.YAMLError):
        if [str(name) for name in yaml.safe_load(f"[{path}]")] == [path]:
            return None
    return f"{path}: this name must stand in quotes in config.yaml and in `datasets=[…]`, where YAML reads it otherwise"
