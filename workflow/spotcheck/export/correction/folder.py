"""A folder of corrected frames: float TIFF of two pages, electrons and their variance, and a manifest of them."""

import csv
import io
import json
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tifffile

import spotcheck
from spotcheck.characterization.pixel_maps import SensorMaps, read_maps
from spotcheck.characterization.sensor_choice import EMVA_NAMES, read_sensor_model
from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import REQUIRED_COLUMNS, Frame
from spotcheck.errors import InputError
from spotcheck.export.correction.electrons import Corrected, corrected, curve_of
from spotcheck.io import provenance, store
from spotcheck.io.formats.names import split_inner_path
from spotcheck.io.writing import whole
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.effects import vocabulary
from spotcheck.model.model_file import read_model, reason_without_model
from spotcheck.model.stage import Stage
from spotcheck.sensor import SensorModel

# Files of results that a correction rests on.
SOURCES = ("frames.nc", "transfer.nc", "sensor.nc", "maps.nc", "verdict.json", "model.yaml")
COMMENTS = (
    "# Corrected frames, by `spotcheck correct`. Page 0 of a file holds electrons of the light [e-], page 1 their",
    "# variance [e-2], both 32-bit floats; NaN marks pixels that are bad or clipped. Black level, offsets of pixels,",
    "# dark current and the bend of the response are taken off, gains of pixels divided by, as far as the results tell",
    "# them: each file's description says which. source, source_page: the frame that was read. clipped_px: how many",
    "# pixels are clipped.",
)


class Known(NamedTuple):
    """What results tell of the sensor: its numbers, the verdict's effects on well and response, maps of its pixels, and
    digests of the files."""

    sensor: SensorModel
    effects: tuple[AppliedEffect, ...]
    maps: SensorMaps | None
    digests: dict[str, str]


def known_in(results: Path) -> Known:
    """What a folder of results tells. Raises `InputError` where it tells no gain."""
    sensor = _sensor(results)
    if sensor is None:
        raise InputError(f"{results}: tells no gain and read noise; correct by results that do, such as those of flats")
    maps = None
    if (results / "maps.nc").is_file():
        with store.read(results / "maps.nc") as ds:
            maps = read_maps(ds)
    digests = {name: provenance.file_digest(results / name)[:16] for name in SOURCES if (results / name).is_file()}
    return Known(sensor, tuple(_sensor_effects(results)), maps, digests)


def _sensor(results: Path) -> SensorModel | None:
    """The sensor that results rest on; of flats and darks alone that of their photon transfer."""
    if (results / "sensor.nc").is_file():
        with store.read(results / "sensor.nc") as ds:
            return read_sensor_model(ds)
    if not (results / "transfer.nc").is_file():
        return None
    with store.read(results / "transfer.nc") as ds, store.read(results / "frames.nc") as table:
        own, full_scale, bend = read_quantities(ds), float(table["full_scale"]), float(ds.attrs["response_bend"])
    gain, noise, current, black = (
        own[EMVA_NAMES[name]].value
        for name in ("gain_dn_per_e", "read_noise_e", "dark_current_e_per_s", "black_level_dn")
    )
    if not np.isfinite(gain + noise + black):
        return None
    current = max(np.nan_to_num(current), 0.0)
    return SensorModel(gain, noise, current, np.inf, black, full_scale, response_bend=bend)


def _sensor_effects(results: Path) -> list[AppliedEffect]:
    """Effects on well and response: those of model.yaml, which holds constants of a form too; of flats and darks alone
    those of the verdict that lack none."""
    model, verdict = results / "model.yaml", results / "verdict.json"
    effects: list[AppliedEffect] = []
    if model.is_file() and not reason_without_model(model):
        effects += read_model(model).effects
    elif verdict.is_file():
        for entry in json.loads(verdict.read_text(encoding="utf-8"))["effects"]:
            values = {name: parameter["value"] for name, parameter in entry["parameters"].items()}
            # An effect that is not known here, or lacks a value, cannot be corrected for.
            with suppress(KeyError, TypeError, ValueError):
                effects.append(vocabulary()[entry["name"]].apply(values, entry["form"]))
    return [applied for applied in effects if {Stage.WELL, Stage.RESPONSE} & set(applied.effect.stages)]


def write(dataset: Dataset, known: Known, folder: Path) -> int:
    """Write every frame of a dataset corrected, frame by frame, and manifest.csv; returns their number.

    Raises `InputError` where the folder holds something, or maps are those of frames of another size.
    """
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder}: is not empty; name a new folder, nothing is overwritten")
    curve, rows = curve_of(known.sensor, known.effects), []
    # Of a stack every page asks for the digest of the one file.
    digest = cache(provenance.file_digest)
    for frame, name in zip(dataset.frames, names_of(dataset.frames), strict=True):
        image = frames.read_good(dataset, frame).astype(float)
        if known.maps is not None and known.maps.offset.values.shape != image.shape:
            size = " × ".join(map(str, known.maps.offset.values.shape[::-1]))
            raise InputError(
                f"{frame.label}: has {image.shape[1]} × {image.shape[0]} px, but maps.nc of the results {size} px;"
                " correct frames of the sensor's same part"
            )
        maps = None if known.maps is None else known.maps.at(frame.exposure_s)
        own = corrected(image, known.sensor, curve, maps, frame.exposure_s)
        _write_frame(folder / name, own, _told(dataset, frame, known, digest(dataset.folder / frame.path)))
        numbers = ("" if v is None else v for v in (frame.angle_deg, frame.exposure_s, frame.repeat))
        rows.append([name, frame.kind, *numbers, *frame.extra.values(), frame.file, frame.page, own.clipped])
    text = io.StringIO("\n".join(COMMENTS) + "\n")
    text.seek(0, io.SEEK_END)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*REQUIRED_COLUMNS, *dataset.frames[0].extra, "source", "source_page", "clipped_px"])
    writer.writerows(rows)
    store.write_text(folder / "manifest.csv", text.getvalue())
    return len(rows)


def names_of(own: Sequence[Frame]) -> list[str]:
    """Path of each corrected frame: that of its source, with the path inside an HDF5 file; of a stack each page has a
    file."""
    pages = Counter(frame.file for frame in own)
    parts = {file: (Path(path), inside) for file in pages for path, inside in (split_inner_path(file),)}
    alike = Counter((path.with_suffix(""), inside) for path, inside in parts.values())
    names = []
    for frame in own:
        path, inside = parts[frame.file]
        stem = path.name.replace(".", "_") if alike[path.with_suffix(""), inside] > 1 else path.stem
        stem += inside.replace("/", "_") + (f"_p{frame.page}" if pages[frame.file] > 1 else "")
        names.append(path.with_name(f"{stem}.tif").as_posix())
    return names


def _told(dataset: Dataset, frame: Frame, known: Known, sha256: str) -> dict[str, Any]:
    """What a file says of its making; `sha256` is that of its source."""
    maps = known.maps
    return {
        "made_by": f"spotcheck correct {spotcheck.__version__}",
        "dataset": dataset.name,
        "source": frame.file,
        "source_page": frame.page,
        "source_sha256": sha256,
        "pages": ["electrons of the light [e-]", "variance [e-2]"],
        "nan": "bad or clipped",
        "sensor": {key: value for key, value in asdict(known.sensor).items() if np.isfinite(value)},
        "turned_round": {
            applied.effect.name: {"form": applied.variant.value}
            | {name: value for name, value in applied.parameters.items() if np.isfinite(value)}
            for applied in known.effects
        },
        "maps": [] if maps is None else ["offset", *(["gain"] if maps.gain is not None else [])],
        "results": known.digests,
    }


def _write_frame(path: Path, own: Corrected, told: dict[str, Any]) -> None:
    """A TIFF of two pages that appears whole, and equal for equal frames."""
    with whole(path) as scratch, tifffile.TiffWriter(scratch) as tiff:
        for page, said in ((own.electrons, json.dumps(told)), (own.variance, told["pages"][1])):
            tiff.write(page.astype(np.float32), compression="zlib", photometric="minisblack", description=said,
                       metadata=None, software="")  # fmt: skip
