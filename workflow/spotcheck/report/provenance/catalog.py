"""Catalogue of a results folder: every number that can be looked up, by each of its names.

An entry is a number, or a table of numbers over dimensions such as angle and exposure. Its full name is the file
without suffix and the variable, joined by dots. A short name is the end of it. A question is a name with labels of
dimensions in brackets; a label is the value of a coordinate or an index. A secondary entry gives way to another entry
of the same name. A rule is a step of the workflow that writes result files.
"""

import difflib
import re
import unicodedata
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import xarray as xr

from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.report.provenance import netcdf, text_files
from spotcheck.report.provenance.records import CatalogEntry, Source, StoredNumber
from spotcheck.report.provenance.rules import read_source

# A question: "fits.sigma_mean[angle=90, exposure=0.0009, repeat=3]".
QUESTION = re.compile(r"\s*([^\[\]]+?)\s*(?:\[([^\[\]]*)\])?\s*")
# Comma between two labels. A label may itself contain a comma: "frames/stack.tif, page 2".
LABEL_SEPARATOR = re.compile(r",(?=[^,=]+=)")
# Most names that an error message lists.
MAX_NAMES = 6
# Similarity above which a name is proposed for a misspelt one [ratio of difflib, 0 to 1].
MIN_SIMILARITY = 0.6
# Larger variables are images and are not read [byte]: one number for each of 10,000 frames is smaller.
MAX_BYTES = 2**20
INSTRUMENT_FILE = "instrument.yaml"
# Numbers that people ask for by their short names, by the file without suffix: a skipped file does not name them.
NUMBERS_OF = {
    "calibration": ("p1", "p2", "peak"),
    "caustic": ("m2", "beam", "waist_radius", "waist_position", "divergence", "rayleigh_length"),
}
# Readers of the text files with numbers, by file name.
TEXT_READERS = {
    "verdict.json": text_files.read_verdict,
    "paper_numbers.csv": text_files.read_paper_numbers,
    INSTRUMENT_FILE: text_files.read_instrument_numbers,
}


@dataclass(frozen=True)
class Catalog:
    """Numbers and files of a results folder; files are named by their path without suffix."""

    entries: dict[str, CatalogEntry] = field(default_factory=dict)  # entries by full name
    entries_by_name: dict[str, list[CatalogEntry]] = field(default_factory=dict)  # entries by each of their names
    tables: dict[str, xr.Dataset] = field(default_factory=dict)  # contents of netCDF files without images, by file
    stored: dict[str, StoredNumber] = field(default_factory=dict)  # numbers of text files, by full name
    sources: dict[str, Source] = field(default_factory=dict)  # provenance, by file

    def add_entry(self, entry: CatalogEntry) -> None:
        """Add an entry under all its names."""
        self.entries[entry.key] = entry
        for name in entry.names():
            self.entries_by_name.setdefault(name, []).append(entry)

    def find_entry(self, name: str, dims: Collection[str]) -> CatalogEntry:
        """Return the entry that a name means.

        If several entries have the name, those that are not secondary take precedence, and among these the entries
        that need no further label.

        Parameters
        ----------
        name : str
            Full or short name.
        dims : collection of str
            Dimensions for which the question gives a label; "frame" stands for all dimensions of the frames' grid.

        Raises
        ------
        InputError
            If no entry, or more than one, has the name, or if the entry lacks one of the dimensions.
        """
        full = [self.entries[name]] if name in self.entries else []
        candidates = full or self.entries_by_name.get(name) or self._find_other_spelling(name)
        candidates = [entry for entry in candidates if not entry.is_secondary] or candidates
        labelled_dims = set(dims) - {"frame"}
        matches = [entry for entry in candidates if labelled_dims <= set(entry.dims)]
        # Entries that need no further label.
        complete = [entry for entry in matches if "frame" in dims or set(entry.required_dims) <= labelled_dims]
        matches = complete or matches
        if len(matches) == 1:
            return matches[0]
        if matches:
            names = _list_names([entry.key for entry in matches])
            raise InputError(f"{name}: is the name of several numbers; write one of {names}")
        if candidates:
            entry_dims = ", ".join(candidates[0].dims)
            shape = f"its dimensions are {entry_dims}" if entry_dims else "it is one number"
            raise InputError(f"{name}: has no {' and '.join(sorted(labelled_dims))}; {shape}")
        if reason := self._explain_skipped(name):
            raise InputError(f"{name}: was skipped: {reason}")
        similar = difflib.get_close_matches(_fold(name), self.entries_by_name, MAX_NAMES, MIN_SIMILARITY)
        hint = f"; nearest are {_list_names(similar)}" if similar else ""
        raise InputError(f"{name}: no number of these results has this name{hint}; `spotcheck explain` lists all")

    def _explain_skipped(self, name: str) -> str:
        """Return why the file that would have a number of this name was skipped; "" if none was, or is known."""
        for file, table in self.tables.items():
            numbers = NUMBERS_OF.get(file, ())
            names = {_fold(part) for number in numbers for part in (number, f"{file}.{number}")}
            if "skipped" in table.attrs and (_fold(name) in names or name.startswith(f"{file}.")):
                return str(table.attrs["skipped"])
        return ""

    def _find_other_spelling(self, name: str) -> list[CatalogEntry]:
        """Return the entries that have a name in another spelling: letters of another case, M² for m2."""
        folded = _fold(name)
        return [entry for entry in self.entries.values() if folded in map(_fold, (entry.key, *entry.names()))]

    def find_short_name(self, entry: CatalogEntry) -> str:
        """Return the shortest name that `find_entry` resolves to this entry without labels, or its full name."""
        for name in entry.names():
            with suppress(InputError):
                if self.find_entry(name, ()) is entry:
                    return name
        return entry.key


def _fold(name: str) -> str:
    """Return a name in lower case, with digits for superscripts: m2 for M²."""
    return unicodedata.normalize("NFKC", name).casefold()


def _list_names(names: list[str]) -> str:
    """Return names as text, the first `MAX_NAMES` of them and the number of others."""
    more = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    return ", ".join(names[:MAX_NAMES]) + more


def parse_question(text: str) -> tuple[str, dict[str, str | int]]:
    """Return the name in a question, and its labels by dimension; {} without labels.

    All labels are text. The type also allows int, since `lookup` replaces the name of a frame by its index.

    Raises
    ------
    InputError
        If the question is malformed.
    """
    match = QUESTION.fullmatch(text)
    pairs = [item.split("=", 1) for item in LABEL_SEPARATOR.split(match[2] or "") if item.strip()] if match else []
    if match is None or any(len(pair) != 2 for pair in pairs):
        raise InputError(f"{text}: is no name of a number; write e.g. p1 or fits.sigma_mean[angle=0, repeat=1]")
    return match[1], {dim.strip(): label.strip() for dim, label in pairs}


def add_labels(name: str, entry: CatalogEntry, labels: Mapping[str, object]) -> str:
    """Return a name of an entry with labels in the order of its dimensions: "fits.sigma_mean[angle=90,repeat=3]".

    Labels of other dimensions are ignored.
    """
    selection = ",".join(f"{dim}={labels[dim]}" for dim in entry.dims if dim in labels)
    return f"{name}[{selection}]" if selection else name


def load_catalog(results: Path) -> Catalog:
    """Return the catalogue of a results folder, cached until one of its files changes.

    Raises `InputError` if the folder does not exist or has no results.
    """
    if not results.is_dir():
        raise InputError(f"{results}: no such folder; name the results of a dataset, such as results/virtual-rig")
    files = [*sorted(results.glob("*.nc")), *sorted(results.glob("*/*.nc")), *(results / name for name in TEXT_READERS)]
    # `read_owner` returns the folder of the dataset of these results; "" if it is not recorded.
    if dataset := store.read_owner(results):
        files.append(Path(dataset, INSTRUMENT_FILE))
    dated_files = tuple((str(path), path.stat().st_mtime_ns) for path in files if path.is_file())
    return _load_catalog(results, dated_files)


@lru_cache(maxsize=4)
def _load_catalog(results: Path, dated_files: tuple[tuple[str, int], ...]) -> Catalog:
    """Return the catalogue of files, given as pairs of path and time of modification [ns].

    The times make the cache forget changed files.
    """
    catalog = Catalog()
    for path in (Path(name) for name, _ in dated_files):
        is_instrument = path.name == INSTRUMENT_FILE
        file = str(path) if is_instrument else path.relative_to(results).as_posix()
        name = path.stem if is_instrument else file.removesuffix(path.suffix)
        attributes: Mapping = {}
        if path.suffix == ".nc":
            with store.read(path) as ds:
                without_images = [key for key, variable in ds.variables.items() if variable.nbytes <= MAX_BYTES]
                catalog.tables[name] = ds[without_images].load()
            attributes = catalog.tables[name].attrs
        # A file that no rule writes is from another version of the workflow and is ignored. The user writes the
        # instrument file, which therefore has a source without rule.
        if source := Source(file, "", "") if is_instrument else read_source(results, file, attributes):
            catalog.sources[name] = source
            _add_numbers(catalog, path, name)
    if not any(catalog.sources[entry.path[0]].rule for entry in catalog.entries.values()):
        raise InputError(f"{results}: holds no results; name the results of a dataset, such as results/virtual-rig")
    return catalog


def _add_numbers(catalog: Catalog, path: Path, name: str) -> None:
    """Add the numbers of a file to the catalogue; `name` is its path without suffix."""
    if path.name in TEXT_READERS:
        # The user may have made the instrument file invalid since the results were written; these remain valid.
        numbers: list[tuple[CatalogEntry, StoredNumber]] = []
        with suppress(InputError):
            numbers = list(TEXT_READERS[path.name](path))
        for entry, number in numbers:
            catalog.stored[entry.key] = number
            catalog.add_entry(entry)
    elif "skipped" not in catalog.tables[name].attrs:
        for entry in netcdf.list_entries(name, catalog.tables[name]):
            catalog.add_entry(entry)
