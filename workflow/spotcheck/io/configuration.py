"""The configuration of a run: paths as they were typed, and one sentence for what breaks its schema."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from spotcheck.errors import InputError
from spotcheck.io.schema import breach_of

PATHS = ("dataset", "results")


def settled(config: Mapping[str, Any], typed: Sequence[str]) -> dict[str, Any]:
    """The configuration with its paths as text, checked against its schema. Raises `InputError`.

    `typed` are the words `key=value` after `--config`. Snakemake reads each value as YAML, where ` #` starts a comment
    and `: ` parts a key from a value, so that `my frames #2` would be the folder `my frames`: a path counts as it was
    typed.
    """
    words = dict(word.split("=", 1) for word in typed)
    named = {key: words.get(key, config[key]) for key in PATHS if key in config}
    # A dataset or folder may be called 2024.
    found = dict(config) | {key: str(value).rstrip(os.sep) for key, value in named.items()}
    datasets = config.get("datasets")
    if isinstance(datasets, list) and not any(isinstance(own, list | dict) for own in datasets):
        found["datasets"] = [str(own).rstrip(os.sep) for own in datasets]
    elif datasets is not None:
        raise InputError(
            f"config: datasets is {words.get('datasets', datasets)}; it must be a list such as [monday, tuesday], and a"
            " name in it with # or : or a comma stands in quotes"
        )
    if breach := breach_of(found, "config"):
        raise InputError(f"config: {breach}")
    if set("{}") & set(found["results"]):
        raise InputError(f"config: results is {found['results']}, which has braces in it; name another folder")
    return found


def remark_on(path: str) -> str | None:
    """What to mind with a path that YAML reads as something else, as config.yaml and lists do; None for most."""
    try:
        if [str(own) for own in yaml.safe_load(f"[{path}]")] == [path]:
            return None
    except yaml.YAMLError:
        pass
    return f"{path}: this name must stand in quotes in config.yaml and in `datasets=[…]`, where YAML reads it otherwise"
