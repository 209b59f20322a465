"""Whether two runs gave the same values: every number of every result, whatever the file's bytes."""

import json
from pathlib import Path

import xarray as xr
import yaml

# Not results: what changes from run to run.
TIMES = ("benchmarks", "logs", "notebooks", "provenance")


def differences(one: Path, other: Path) -> list[str]:
    """Results of one folder that are missing in another or differ from it, by name."""
    names = {
        path.relative_to(folder) for folder in (one, other) for path in folder.rglob("*") if is_result(path, folder)
    }
    return sorted(str(name) for name in names if not same(one / name, other / name))


def is_result(path: Path, folder: Path) -> bool:
    """Whether a file holds values: netCDF, JSON, YAML or CSV outside of logs and times."""
    inner = path.relative_to(folder).parts
    hidden = any(part.startswith(".") or part in TIMES for part in inner)
    return path.suffix in (".nc", ".json", ".yaml", ".csv") and not hidden


def same(one: Path, other: Path) -> bool:
    """Whether two files hold the same values."""
    if not (one.exists() and other.exists()):
        return False
    if one.suffix == ".nc":
        with xr.open_dataset(one, decode_times=False) as a, xr.open_dataset(other, decode_times=False) as b:
            return bool(a.equals(b))
    read = {".json": json.loads, ".yaml": yaml.safe_load}.get(one.suffix, str)
    return bool(read(one.read_text(encoding="utf-8")) == read(other.read_text(encoding="utf-8")))
