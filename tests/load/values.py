"""Whether two runs gave the same values: every number and attribute of every result, whatever the file's bytes."""

import json
from pathlib import Path

import xarray as xr
import yaml


def values_of(results: Path) -> dict[str, object]:
    """Content of every netCDF, JSON and YAML file below a folder, sidecars of single runs apart."""
    readers = {".nc": xr.load_dataset, ".json": lambda p: json.loads(p.read_text()), ".yaml": read_yaml}
    paths = (p for p in sorted(results.rglob("*")) if p.suffix in readers and ".runs" not in p.parts)
    return {str(path.relative_to(results)): readers[path.suffix](path) for path in paths}


def read_yaml(path: Path) -> object:
    """Content of a YAML file."""
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def differing(one: dict[str, object], other: dict[str, object]) -> list[str]:
    """Names of the files that only one has, or that hold other values."""
    return [
        name for name in sorted({*one, *other}) if not (name in one and name in other and same(one[name], other[name]))
    ]


def same(one: object, other: object) -> bool:
    """Whether two contents are equal in every value and attribute."""
    return one.identical(other) if isinstance(one, xr.Dataset) else one == other
