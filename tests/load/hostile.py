"""Broken and hostile input to every reader: each try ends in frames or in one sentence, soon and in little memory.

    python -m tests.load.hostile --inputs 100000

prints what became of as many inputs of each kind. Image files are good ones with bytes changed; texts are put together
of what people write and of what nobody should.
"""

import argparse
import io
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import tifffile
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from spotcheck.crops.ingest import ingest_frames
from spotcheck.dataset import folder as dataset
from spotcheck.dataset.metadata.readers import read_metadata
from spotcheck.dataset.scan.draft import draft_manifest
from spotcheck.dataset.scan.folder_scan import FolderScan, scan_folder
from spotcheck.dataset.scan.summary import summarize_scan
from spotcheck.dataset.template import format_instrument, format_manifest
from spotcheck.errors import InputError
from tests.load.rows import Row, write

# A reader that computes longer than this on some kilobytes hangs [s]; a busy machine does not count.
LONGEST_S = 10
# Memory that a reader may ask for [byte]: less than a frame of `MOST_PIXELS` takes, which no small file should get.
MOST_BYTES = 1 << 30
RAMP = (np.arange(24 * 30).reshape(24, 30) * 5).astype(np.uint16)
HEADER = "file,kind,angle_deg,exposure_s,repeat"
# Numbers that break sums and sizes, in files of two, four and eight bytes a number.
EDGES = (0, 1, 2, 3, 8, 42, 255, 256, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)


class Tally(NamedTuple):
    """What became of the inputs of a kind: how many ended how, the longest time [s], and the first that ended badly."""

    ends: Counter[str]
    longest_s: float
    worst: tuple[str, bytes] | None


class Hang(BaseException):
    """Raised where a reader takes too long; no reader can catch it."""


def ended(read: Callable[[], Any]) -> tuple[str, float]:
    """How a try ended (`read`, `refused`, or what went wrong) and how long it took [s]."""
    before = time.process_time()
    try:
        with bounded():
            read()
        end = "read"
    except InputError as error:
        end = "refused" if one_sentence(error) else "no sentence"
        if "fit into memory" in str(error):
            end = "out of memory"
    except Hang:
        end = "hang"
    except Exception as error:
        end = type(error).__name__
    return end, time.process_time() - before


def one_sentence(error: InputError) -> bool:
    """Whether a message is a line of bearable length that says in which file something is wrong."""
    text, names = str(error), ("manifest.csv", "instrument.yaml", "frames/a.tif")
    return text.startswith(names) and "\n" not in text and len(text) < 1000


@contextmanager
def bounded() -> Iterator[None]:
    """Let what follows take neither more than `LONGEST_S` nor, on top of what is in use, more than `MOST_BYTES`."""

    def stop(*_: object) -> None:
        raise Hang

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    in_use = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    handler = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
    resource.setrlimit(resource.RLIMIT_AS, (in_use + MOST_BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, handler)


def tiff(pixels: np.ndarray = RAMP, **options: Any) -> bytes:
    """A TIFF file."""
    out = io.BytesIO()
    tifffile.imwrite(out, pixels, **({"photometric": "minisblack"} | options))
    return out.getvalue()


def png(pixels: np.ndarray = RAMP, chunk: tuple[bytes, bytes] | None = None) -> bytes:
    """A PNG file, with a chunk before its pixels."""
    out, extra = io.BytesIO(), PngImagePlugin.PngInfo()
    if chunk:
        extra.add(*chunk)
    Image.fromarray(pixels).save(out, "PNG", pnginfo=extra)
    return out.getvalue()


def npy(pixels: np.ndarray = RAMP) -> bytes:
    """A .npy file."""
    out = io.BytesIO()
    np.save(out, pixels)
    return out.getvalue()


def hdf5(pixels: np.ndarray, libver: str | None = None, **options: Any) -> bytes:
    """An HDF5 file."""
    out = io.BytesIO()
    with h5py.File(out, "w", libver=libver) as file:
        file.create_dataset("entry/data", data=pixels, **options)
        file["entry/data"].attrs["units"] = "DN"
    return out.getvalue()


@cache
def good_files() -> dict[str, list[bytes]]:
    """Files that are read, by format."""
    stack = np.stack([RAMP, RAMP + 1, RAMP + 2])
    small, lossless = RAMP.astype(np.uint8), {"reversible": True, "level": 0}
    packed = [{"compression": name} for name in ("zlib", "lzw", "packbits", "zstd", "lzma")]
    tiffs = [
        *(tiff(small), tiff(byteorder=">"), tiff(bigtiff=True), tiff(tile=(16, 16)), tiff(rowsperstrip=5)),
        *(tiff(RAMP // 4, bitspersample=12), tiff(small, photometric="miniswhite")),
        *(tiff(predictor=True, compression=8), *(tiff(**options) for options in packed)),
        tiff(compression="jpeg2000", compressionargs=lossless),
        *(tiff(stack), tiff(np.tile(stack, (40, 1, 1))[:, :4, :4].copy()), tiff(stack, imagej=True)),
        tiff(stack, metadata={"axes": "ZYX"}, contiguous=True, compression=None),
    ]
    pngs = [png(), png(small), png(RAMP << 4, (b"sBIT", b"\x0c")), png(small, (b"tEXt", b"a\0b"))]
    pgms = [
        b"P5\n# camera\n30 24\n4095\n" + RAMP.astype(">u2").tobytes(),
        b"P5 30 24 255\n" + small.tobytes(),
        b"P2\n30 24\n4095\n" + b" ".join(b"%d" % v for v in RAMP.ravel()),
    ]
    single = RAMP[np.newaxis]
    npys = [npy(), npy(small), npy(stack), npy(np.asfortranarray(RAMP)), npy(RAMP.astype(">u2")), npy(single)]
    gzip: dict[str, Any] = {"compression": "gzip", "shuffle": True}
    hdf5s = [
        *(hdf5(stack), hdf5(RAMP), hdf5(single, libver="latest"), hdf5(single, chunks=(1, 24, 30), **gzip)),
        hdf5(single, chunks=(1, 8, 16), fletcher32=True, libver="latest", **gzip),
        hdf5(single, chunks=(1, 24, 30), compression="lzf"),
    ]
    return {"TIFF": tiffs, "PNG": pngs, "PGM": pgms, "NumPy": npys, "HDF5": hdf5s}


def changed(rng: np.random.Generator, good: list[bytes]) -> bytes:
    """A good file with some bytes changed, most of them where formats have their headers."""
    out = bytearray(good[rng.integers(len(good))])
    for _ in range(1 + rng.poisson(0.5)):
        near = min(len(out), int(rng.choice([16, 64, 400, 10**6])))
        at = int(rng.integers(near)) if rng.random() < 0.8 else len(out) - 1 - int(rng.integers(near))
        size = int(rng.choice([1, 2, 4, 8]))
        match int(rng.choice(6, p=(0.3, 0.2, 0.2, 0.2, 0.05, 0.05))):
            case 0:
                out[at] ^= 1 << int(rng.integers(8))
            case 1:
                out[at : at + size] = rng.bytes(size)
            case 2 | 3:
                edge = EDGES[rng.integers(len(EDGES))] % 256**size
                out[at : at + size] = edge.to_bytes(size, str(rng.choice(["little", "big"])))
            case 4:
                del out[at : at + int(rng.choice([1, size, len(out)]))]
            case 5:
                other = good[rng.integers(len(good))]
                out[at:at] = other[: int(rng.integers(len(other)))]
        if not out:
            break
    return sealed(bytes(out)) if rng.random() < 0.7 else bytes(out)


def sealed(content: bytes) -> bytes:
    """A PNG file whose checksums are right again, so that its readers look further than those."""
    out, at = bytearray(content), 8
    while content[:4] == b"\x89PNG" and at + 12 <= len(out):
        end = at + 8 + int.from_bytes(out[at : at + 4])
        if end + 4 > len(out):
            break
        out[end : end + 4] = zlib.crc32(out[at + 4 : end]).to_bytes(4)
        at = end + 4
    return bytes(out)


ODD_WORDS = ["", "nan", "-1", "0.1ms", "1e999", "1_0", "٣", "#", '"', "'", ";", "\0", "9" * 400, "../x.tif"]
ODD = st.text(max_size=12) | st.sampled_from([*ODD_WORDS, "frames\\a.tif", "{x}", "="])
CELLS = {
    "file": st.sampled_from(["frames/a.tif", "frames\\a.tif", "A.TIF", "#1.tif", "\u00e4.tif"]),
    "kind": st.sampled_from(["spot", "spot", "dark", "flat"]),
    "angle_deg": st.sampled_from(["", "0", "90", "-45.5"]),
    "exposure_s": st.sampled_from(["1e-3", "0.5"]),
    "repeat": st.integers(0, 30).map(str),
    "page": st.sampled_from(["", "0", "1", "2"]),
    "z_m": st.floats().map(repr),
}


@st.composite
def manifests(draw: st.DrawFn) -> bytes:
    """A manifest as a spreadsheet, an editor or nobody would write it."""
    more = draw(st.lists(st.sampled_from(["page", "z_m", "", "note"]), max_size=2, unique=True))
    names = draw(st.permutations([*HEADER.split(","), *more]))
    rows = [[draw(st.sampled_from([name, name, name.upper(), f" {name}"])) for name in names]]
    for _ in range(draw(st.integers(1, 3))):
        rows.append([draw(CELLS.get(name, st.just(""))) for name in names])
    for _ in range(draw(st.sampled_from([0, 0, 1, 2]))):
        row = rows[draw(st.integers(0, len(rows) - 1))]
        row[draw(st.integers(0, len(row) - 1))] = draw(ODD)
    lines = [draw(st.sampled_from([","] * 9 + [";", "\t"])).join(row) for row in rows]
    lines += draw(st.sampled_from([[], [], ["", "# the end"]]) | st.lists(ODD, max_size=1))
    lines = [*draw(st.sampled_from([[], ["sep=,"], ["# made by hand"]])), *lines]
    text = draw(st.sampled_from(["\n", "\r\n", "\r"])).join(lines)
    encodings = ["utf-8"] * 4 + ["utf-8-sig", "utf-16", "utf-16-le", "latin-1"]
    return text.encode(draw(st.sampled_from(encodings)), "replace")


ANY = st.none() | st.booleans() | st.integers() | st.floats() | ODD | st.lists(ODD, max_size=2)
# Keys of the data sheet with values that suit them.
SHEET: dict[str, st.SearchStrategy[Any]] = {
    "name": st.text(max_size=9),
    "crop_px": st.sampled_from([8, 12, 24.0]),
    "order_known": st.booleans(),
    "sensor": st.fixed_dictionaries({}, optional={"bit_depth": st.just(12), "gain_dn_per_e": st.floats(1e-3, 10)}),
    "optics": st.fixed_dictionaries({}, optional={"f_number": st.floats(1, 30), "focal_length_m": st.floats(1e-3, 1)}),
    "model": st.fixed_dictionaries({"photon_budget": st.sampled_from(["linear", "spot_area", "free"])}),
}


@st.composite
def instruments(draw: st.DrawFn) -> bytes:
    """A data sheet, often with a key or a value that it should not have, or with text that is hardly YAML."""
    content = draw(st.fixed_dictionaries({}, optional=SHEET))
    for _ in range(draw(st.sampled_from([0, 0, 1, 2]))):
        own = draw(st.sampled_from([content, *(v for v in content.values() if isinstance(v, dict))]))
        own[draw(st.sampled_from([*SHEET, "light", "conditions", *own]) | ODD)] = draw(ANY)
    text = yaml.safe_dump(content, allow_unicode=True)
    endings = ["a: &a [*a]", "? x", "\t", "!!python/object:os.system {}", "- 1", "crop_px: 8"]
    text += draw(st.sampled_from([*[""] * 9, *endings]))
    return text.encode(draw(st.sampled_from(["utf-8", "utf-8", "utf-16", "utf-16-le"])), "replace")


# Pieces of names of files and of HDF5 datasets, and of the cells of log tables.
NAME_PIECES = st.sampled_from(
    "z t= exp dark flat r img 2026-01-31 1 00012 3p5 1,000 1e-3 1e999 - _ . = ms us nm deg ° # { } % ' ".split(" ")
) | st.text(st.characters(min_codepoint=32, max_codepoint=400), max_size=3)
LOG_HEADINGS = st.sampled_from(["File name", "path", "Exposure (ms)", "z [mm]", "angle", "Binning", "kind"]) | ODD
LOG_NAMES = st.sampled_from(
    ["a.tif", "frames/a.tif", r"D:\frames\a.tif", "b/a.tif", "../frames/a.tif", "x" * 300 + "/a.tif"]
)
LOG_CELLS = st.sampled_from(["0.5", "1,000", "1,5", "1/200", "2x2", "dark", "3 mm", "nan", '"1', "9" * 30]) | ODD
LONGEST_NAME = 200


@st.composite
def names(draw: st.DrawFn) -> bytes:
    """A name of a file and one of an HDF5 dataset, without what file systems refuse, parted by a slash."""
    parts = ["".join(draw(st.lists(NAME_PIECES, min_size=1, max_size=8))) for _ in range(2)]
    cleaned = [re.sub(r"[/\0\ud800-\udfff]", "", part)[: LONGEST_NAME // 4].strip(".") or "a" for part in parts]
    return "/".join(cleaned).encode()


@st.composite
def log_tables(draw: st.DrawFn) -> bytes:
    """A table beside images as an instrument, a spreadsheet or nobody would write it, or an EMVA 1288 list."""
    if draw(st.integers(0, 4)) == 0:
        words = st.sampled_from(["n 12 30 24", "b 1000 5", "d 1e999", r"i frames\a.tif", "i a.tif", "i", "n x", "#"])
        return "\n".join(["n 8 30 24", "b 5", "i a.tif", *draw(st.lists(words | ODD, max_size=9))]).encode()
    headings = ["File", *draw(st.lists(LOG_HEADINGS, max_size=4))]
    rows = [headings]
    for _ in range(draw(st.integers(0, 5))):
        rows.append([draw(LOG_NAMES), *(draw(LOG_CELLS) for _ in headings[1:])])
    mark = draw(st.sampled_from([",", ",", ";", "\t"]))
    lines = draw(st.sampled_from([[], ["# log"], ["sep=;"]])) + [mark.join(row) for row in rows]
    text = draw(st.sampled_from(["\n", "\r\n"])).join(lines)
    return text.encode(draw(st.sampled_from(["utf-8", "utf-8", "utf-16", "latin-1"])), "replace")


def tally(inputs: Iterator[bytes], read: Callable[[bytes], Any]) -> Tally:
    """What became of inputs."""
    ends, longest, worst = Counter[str](), 0.0, None
    for content in inputs:
        end, seconds = ended(lambda content=content: read(content))
        ends[end] += 1
        longest = max(longest, seconds)
        if worst is None and end not in ("read", "refused"):
            worst = (end, content)
    return Tally(ends, longest, worst)


def examples(strategy: st.SearchStrategy[bytes], count: int) -> list[bytes]:
    """As many inputs of a strategy, the same at every call."""
    out: list[bytes] = []

    @settings(max_examples=count, database=None, derandomize=True, deadline=None, phases=[Phase.generate],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(strategy)
    def collect(content: bytes) -> None:
        out.append(content)

    collect()
    return out


def describe(folder: Path) -> FolderScan:
    """Read what the images of a folder state, and say it, as `new-dataset` does."""
    scan = scan_folder(folder)
    if not scan.frames:
        raise InputError(scan.errors[0])
    draft = draft_manifest(scan, {})
    assert all(line.isprintable() for line in summarize_scan("my-frames", scan, draft))
    format_manifest(draft)
    yaml.safe_load(format_instrument(draft, None))
    return scan


def describe_by_log(folder: Path, content: bytes) -> None:
    """Describe an image with a text beside it as a table and as an EMVA 1288 list; refused if neither says anything."""
    for name in ("log.csv", "list.txt"):
        (folder / name).write_bytes(content)
    entries = [entry for frame in describe(folder).frames for entry in frame.metadata]
    if not any(entry.source in ("log.csv", "list.txt") for entry in entries):
        raise InputError("frames/a.tif: neither log.csv nor list.txt describes it")


def scan_names(folder: Path, content: bytes) -> None:
    """Describe a TIFF and an HDF5 file of a name, the latter with a dataset of a name."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    name, inner_name = content.decode().split("/")
    (folder / f"{name}.tif").write_bytes(tiff())
    with h5py.File(folder / f"{name}.h5", "w") as file:
        file.create_dataset(inner_name, data=RAMP)
    try:
        describe(folder)
    except InputError as error:
        # Messages of a scan start with the name of the file; the tally counts by a name of its own.
        raise InputError(f"frames/a.tif: {error}") from None


def tallies(folder: Path, count: int, seed: int = 1) -> Iterator[tuple[str, Tally]]:
    """What becomes of `count` inputs of each kind, tried in a folder."""
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    manifest, instrument, frame = folder / "manifest.csv", folder / "instrument.yaml", folder / "frames" / "a.tif"
    plain, keys = f"{HEADER}\nframes/a.tif,spot,0,1e-3,0\n".encode(), b"crop_px: 8\n"

    def trying(path: Path, read: Callable[[], Any]) -> Callable[[bytes], Any]:
        def one(content: bytes) -> None:
            path.write_bytes(content)
            read()

        return one

    def ingest() -> None:
        read_metadata(frame, folder)
        ingest_frames(dataset.load(folder))

    def load() -> None:
        list(dataset.load(folder).cells())

    for name, good in good_files().items():
        manifest.write_bytes(plain)
        instrument.write_bytes(keys)
        rng = np.random.default_rng(seed)
        yield name, tally((changed(rng, good) for _ in range(count)), trying(frame, ingest))
    frame.write_bytes(tiff())
    for name in ("A.TIF", "#1.tif", "a\u0308.tif"):
        (folder / name).touch()
    yield "manifest.csv", tally(iter(examples(manifests(), count)), trying(manifest, load))
    manifest.write_bytes(plain)
    yield "instrument.yaml", tally(iter(examples(instruments(), count)), trying(instrument, load))
    instrument.write_bytes(keys)
    with tempfile.TemporaryDirectory() as named:
        inner_folder = Path(named) / "a"
        yield "file names", tally(iter(examples(names(), count)), lambda content: scan_names(inner_folder, content))
    yield "log tables", tally(iter(examples(log_tables(), count)), lambda content: describe_by_log(folder, content))


def main() -> None:
    """Try, and print a table of what became of the tries; of what ended badly the first goes to standard error."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=1000, help="inputs of each kind")
    parser.add_argument("--seed", type=int, default=1, help="seed of the changes to image files")
    args = parser.parse_args()
    bad, rows = False, []
    with tempfile.TemporaryDirectory() as folder:
        for name, own in tallies(Path(folder), args.inputs, args.seed):
            other = {end: n for end, n in own.ends.items() if end not in ("read", "refused")}
            said = ", ".join(f"{n} {end}" for end, n in other.items()) or "nothing else"
            rows.append(Row(name, own.ends.total(), f"{own.ends['read']} read, {own.ends['refused']} refused in a "
                            f"sentence, {said}; {own.longest_s:.2g} s at most"))  # fmt: skip
            print(rows[-1].what, rows[-1].happened, sep=": ", flush=True)
            if own.worst:
                bad = True
                print(f"{name}: {own.worst[0]} by {own.worst[1]!r:.3000}", file=sys.stderr)
    write("hostile", rows)
    sys.exit(bad)


if __name__ == "__main__":
    main()
