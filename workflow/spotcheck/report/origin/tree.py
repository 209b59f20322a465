"""The files that a result was made from, down to the frames."""

from functools import cache
from pathlib import Path
from typing import NamedTuple

from spotcheck.dataset.instrument import read_instrument
from spotcheck.errors import InputError
from spotcheck.io import provenance, store
from spotcheck.report.origin.ask import shelf_of
from spotcheck.report.origin.number import Input, Source
from spotcheck.report.origin.rules import source_of


class Node(NamedTuple):
    """A file by name, path and digest (SHA-256, first 16 hex digits), the rule that made it ("": given), a remark, and
    what it was made from."""

    name: str
    path: str
    digest: str
    rule: str
    remark: str
    inputs: tuple["Node", ...] = ()


def grown(results: Path, source: Source) -> list[Node]:
    """Inputs of a file of results, and theirs, down to what the dataset gave. A file that stands above is not grown
    again."""
    seen: set[str] = set()
    return _below(results, source, seen)


def _below(results: Path, source: Source, seen: set[str]) -> list[Node]:
    folder = (results / source.file).parent
    return [_node(results, folder, own, seen) for own in source.inputs] + _frames(results, source)


def _node(results: Path, folder: Path, own: Input, seen: set[str]) -> Node:
    path, remark = found(results, folder, own)
    if path is None:
        return Node(own.name, "", own.digest, "", remark)
    file = path.relative_to(results).as_posix() if path.is_relative_to(results) else ""
    source = _source(results, file) if file else None
    name = file or own.name
    if source is None:
        return Node(name, str(path), own.digest, "", remark)
    if file in seen:
        return Node(name, str(path), own.digest, source.rule, remark or ("as above" if source.inputs else ""))
    seen.add(file)
    return Node(name, str(path), own.digest, source.rule, remark, tuple(_below(results, source, seen)))


def _source(results: Path, file: str) -> Source | None:
    """How a file of results came about; manifest and data sheet of simulated frames are written with their images."""
    known = shelf_of(results).sources
    name, images = file.removesuffix(Path(file).suffix), Path(file).parent.name
    return known.get(name) or source_of(results, file, {}) or known.get(images)


def found(results: Path, folder: Path, own: Input) -> tuple[Path | None, str]:
    """The file that an input of a file in `folder` was, by its name and digest, and a remark where it has changed since
    or is gone."""
    noted = store.read_owner(results)
    near = [place / own.name for place in (folder, results, *([Path(noted)] if noted else []))]
    near += [path for path in (_named(Path(noted)) if noted else []) if path.name == own.name]
    # Stages that compare take files of one name from the simulation, too.
    far = sorted(results.glob(f"*/{own.name}"))
    for path in (*near, *far):
        if path.is_file() and _digest(path, path.stat().st_mtime_ns).startswith(own.digest):
            return path, ""
    changed = next((path for path in near if path.is_file()), None)
    return changed, "has changed since" if changed else "is gone"


def _named(dataset: Path) -> list[Path]:
    """Files that the data sheet of a dataset names, wherever they lie."""
    try:
        return read_instrument(dataset / "instrument.yaml").files
    except (InputError, OSError):
        return []


@cache
def _digest(path: Path, time_ns: int) -> str:
    return provenance.file_digest(path)


def _frames(results: Path, source: Source) -> list[Node]:
    """The frames that a frames.nc records."""
    table = shelf_of(results).files[source.file.removesuffix(".nc")] if source.file.endswith("frames.nc") else None
    if table is None:
        return []
    count = table.sizes["frame"]
    frames = f"{count} frames" if count > 1 else "1 frame"
    return [Node(frames, "", "", "", f"SHA-256 of each file in {source.file}")]
