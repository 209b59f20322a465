"""Inputs of a result file, traced back to the frames.

Each result file records the names and digests of its inputs when it was written. A rule is a step of the workflow that
writes result files.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from spotcheck.dataset.instrument import read_instrument
from spotcheck.errors import InputError
from spotcheck.io import provenance, store
from spotcheck.report.provenance.catalog import INSTRUMENT_FILE, load_catalog
from spotcheck.report.provenance.records import Input, Source
from spotcheck.report.provenance.rules import read_source


@dataclass(frozen=True)
class InputFile:
    """An input file with its own inputs."""

    name: str  # path in the results folder, file name of a file elsewhere, or text such as "48 frames"
    path: str  # path on this computer; "" if the file is gone, and for frames
    digest: str  # first 16 hex digits of the SHA-256 that the file had when it was read; "" for frames
    rule: str  # rule that wrote the file; "" for a file of the user
    remark: str  # "has changed since", "is gone", "as above", or where digests of frames are; "" if none applies
    inputs: tuple["InputFile", ...] = ()  # its inputs; empty if they were listed above


def trace_inputs(results: Path, source: Source) -> list[InputFile]:
    """Return the inputs of a result file, with their inputs; the inputs of a repeated file are listed once."""
    return list(_list_inputs(results, source, set()))


def _list_inputs(results: Path, source: Source, listed: set[str]) -> Iterator[InputFile]:
    """Yield the inputs of a result file; adds to `listed` the paths of files whose inputs were listed.

    The last input of a frames.nc stands for all frames, whose digests it stores.
    """
    for recorded in source.inputs:
        yield _trace_input(results, (results / source.file).parent, recorded, listed)
    if source.file.endswith("frames.nc"):
        table = load_catalog(results).tables[source.file.removesuffix(".nc")]
        count = table.sizes["frame"]
        name = f"{count} frames" if count > 1 else "1 frame"
        yield InputFile(name, "", "", "", f"SHA-256 of each file in {source.file}")


def _trace_input(results: Path, folder: Path, recorded: Input, listed: set[str]) -> InputFile:
    """Return an input that a result file in `folder` recorded, with its own inputs.

    Adds to `listed` the path of the input, so that the inputs of a repeated file are listed once.
    """
    path, remark = _find_input(results, folder, recorded)
    file = path.relative_to(results).as_posix() if path and path.is_relative_to(results) else ""
    source = _find_source(results, file) if file else None
    inputs: tuple[InputFile, ...] = ()
    if source is not None and file in listed:
        remark = remark or ("as above" if source.inputs else "")
    elif source is not None:
        listed.add(file)
        inputs = tuple(_list_inputs(results, source, listed))
    rule = source.rule if source else ""
    return InputFile(file or recorded.name, str(path or ""), recorded.digest, rule, remark, inputs)


def _find_source(results: Path, file: str) -> Source | None:
    """Return the provenance of a file in the results folder; None if no rule writes it.

    Manifest and instrument file of simulated frames are written with simulated.nc and have its provenance.
    """
    sources = load_catalog(results).sources
    name, folder = file.removesuffix(Path(file).suffix), Path(file).parent.name
    return sources.get(name) or read_source(results, file, {}) or sources.get(folder)


def _find_input(results: Path, folder: Path, recorded: Input) -> tuple[Path | None, str]:
    """Return the path of an input of a file in `folder`, and a remark if it has changed or is gone.

    The input is the file with the recorded name and digest. If there is only a file with the name, it has changed and
    is returned. If there is none, the input is gone and the path is None.
    """
    dataset = store.read_owner(results)
    likely_paths = [parent / recorded.name for parent in (folder, results, *([Path(dataset)] if dataset else []))]
    likely_paths += [path for path in _list_shared_files(dataset) if path.name == recorded.name]
    # Stages that compare measured with simulated frames read files of the same name from a subfolder.
    for path in (*likely_paths, *sorted(results.glob(f"*/{recorded.name}"))):
        if path.is_file() and _digest(path, path.stat().st_mtime_ns).startswith(recorded.digest):
            return path, ""
    changed = next((path for path in likely_paths if path.is_file()), None)
    return changed, "has changed since" if changed else "is gone"


def _list_shared_files(dataset: str | None) -> list[Path]:
    """Return the files that the instrument file of a dataset refers to; [] if the file cannot be read."""
    if not dataset:
        return []
    try:
        return read_instrument(Path(dataset, INSTRUMENT_FILE)).files
    except (InputError, OSError):
        return []


@cache
def _digest(path: Path, time_ns: int) -> str:
    """Return the SHA-256 of a file; the time of modification [ns] makes the cache forget changed files."""
    return provenance.file_digest(path)
