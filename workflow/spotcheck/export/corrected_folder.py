"""Write a folder of corrected frames: float TIFF files of two pages, electrons and their variance, and a manifest.

An effect is a deviation of the frames from the baseline model that the verdict detected; its variant, called `form` in
files, is one of several formulas for it. The well limits the charge of a pixel, and the response is the signal of the
converter as a function of that charge. The vocabulary is the known effects by name. verdict.json holds the detected
effects, and model.yaml the model that has them. A results folder has the results of one dataset.
"""

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
from spotcheck.characterization.sensor_choice import EMVA_NAMES
from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import REQUIRED_COLUMNS, Frame
from spotcheck.errors import InputError
from spotcheck.export.frame_correction import CorrectedFrame, compute_response_curve, correct_frame
from spotcheck.export.learned_values import digest_sources, read_sensor, read_verdict
from spotcheck.io import provenance, store
from spotcheck.io.atomic_files import write_atomically
from spotcheck.io.formats.names import split_inner_path
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.effects import vocabulary
from spotcheck.model.model_file import read_model, reason_without_model
from spotcheck.model.stage import Stage
from spotcheck.sensor import SensorModel

# Files of a results folder that a correction uses, if they exist.
SOURCES = ("frames.nc", "transfer.nc", "sensor.nc", "maps.nc", "verdict.json", "model.yaml")
# Pages of a corrected file, as its description names them.
PAGES = ("electrons of the light [e-]", "variance [e-2]")
MANIFEST_HEAD = """\
# Corrected frames, by `spotcheck correct`. Page 0 of a file holds electrons of the light [e-], page 1 their
# variance [e-2], both 32-bit floats; NaN marks pixels that are bad or clipped. Black level, offsets of pixels,
# dark current and the curvature of the response are removed, and gains of pixels divided by, as far as the results
# contain them: the description of each file lists them. source, source_page: the frame that was read. clipped_px: how
# many pixels are clipped.
"""


class Calibration(NamedTuple):
    """Calibration of a sensor in a results folder, by which frames are corrected."""

    sensor: SensorModel  # gain, read noise and other parameters of the sensor
    effects: tuple[AppliedEffect, ...]  # detected effects on well and response
    maps: SensorMaps | None  # offset and gain of each pixel; None if they were not measured
    digests: dict[str, str]  # name of each file of the results that exists → first digits of its SHA-256


def read_calibration(results: Path) -> Calibration:
    """Return the calibration in a results folder. Raises `InputError` if it has no gain and read noise."""
    sensor = read_sensor(results) if (results / "sensor.nc").is_file() else _read_transfer_sensor(results)
    if sensor is None:
        raise InputError(
            f"{results}: holds no gain and read noise; use results that do, such as those of flats and darks"
        )
    maps = None
    if (results / "maps.nc").is_file():
        with store.read(results / "maps.nc") as ds:
            maps = read_maps(ds)
    return Calibration(sensor, tuple(_read_sensor_effects(results)), maps, digest_sources(results, SOURCES))


def _read_transfer_sensor(results: Path) -> SensorModel | None:
    """Return the sensor of transfer.nc, from flats and darks alone, with the full scale of frames.nc beside it.

    None without transfer.nc, or if gain, read noise or black level is unknown (NaN).
    """
    if not (results / "transfer.nc").is_file():
        return None
    with store.read(results / "transfer.nc") as ds, store.read(results / "frames.nc") as table:
        quantities, full_scale = read_quantities(ds), float(table["full_scale"])
        # Coefficient of the curvature of the response [1], see `SensorModel`.
        bend = float(ds.attrs["response_bend"])
    names = ("gain_dn_per_e", "read_noise_e", "black_level_dn")
    values = {name: quantities[EMVA_NAMES[name]].value for name in names}
    if not np.isfinite(list(values.values())).all():
        return None
    # Noise can make the estimate negative; an unknown dark current (NaN) counts as 0.
    dark_current = max(np.nan_to_num(quantities[EMVA_NAMES["dark_current_e_per_s"]].value), 0.0)
    return SensorModel(**values, dark_current_e_per_s=dark_current, full_scale_dn=full_scale, response_bend=bend)


def _read_sensor_effects(results: Path) -> list[AppliedEffect]:
    """Return the effects on well and response of model.yaml, or of verdict.json if there is no model.

    Effects of verdict.json are skipped if they are not in the vocabulary of this run, or if the verdict lacks the value
    of a parameter that their variant needs.
    """
    model_file = results / "model.yaml"
    effects: list[AppliedEffect] = []
    # The file may state why the dataset has no model instead of holding one.
    if model_file.is_file() and not reason_without_model(model_file):
        effects += read_model(model_file).effects
    else:
        for entry in read_verdict(results).get("effects", ()):
            values = {name: parameter["value"] for name, parameter in entry["parameters"].items()}
            # KeyError: unknown effect; TypeError: parameter without a value; ValueError: other parameters or variants.
            with suppress(KeyError, TypeError, ValueError):
                effects.append(vocabulary()[entry["name"]].apply(values, entry["form"]))
    return [applied for applied in effects if {Stage.WELL, Stage.RESPONSE} & set(applied.effect.stages)]


def write_corrected_frames(dataset: Dataset, calibration: Calibration, folder: Path) -> int:
    """Correct every frame of a dataset and write it to a folder, with a manifest.csv; return the number of frames.

    Parameters
    ----------
    dataset : Dataset
        Dataset whose frames are corrected. They are read one at a time.
    calibration : Calibration
        Calibration of the sensor that recorded the frames.
    folder : Path
        Folder to write, which must be empty or not exist.

    Raises
    ------
    InputError
        If the folder is not empty, or if the frames and the maps differ in size.
    """
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder}: is not empty; name a new folder, nothing is overwritten")
    curve = compute_response_curve(calibration.sensor, calibration.effects)
    maps = None
    # Rows of the new manifest, which names the source of each frame.
    rows = []
    # All pages of a stack have the digest of one file.
    digest = cache(provenance.file_digest)
    for frame, name in zip(dataset.frames, name_corrected_frames(dataset.frames), strict=True):
        image = frames.read_masked_image(dataset, frame).astype(float)
        if calibration.maps is not None:
            _check_size(frame, image.shape, calibration.maps)
            # The dark current of a pixel makes its offset grow with the exposure.
            maps = calibration.maps.at(frame.exposure_s)
        corrected = correct_frame(image, calibration.sensor, curve, maps, frame.exposure_s)
        description = _describe(dataset, frame, calibration, digest(dataset.folder / frame.path))
        _write_tiff(folder / name, corrected, description)
        condition = ["" if value is None else value for value in (frame.angle_deg, frame.exposure_s, frame.repeat)]
        row = [name, frame.kind, *condition, *frame.extra.values()]
        rows.append([*row, frame.file, frame.page, corrected.clipped_count])
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow([*REQUIRED_COLUMNS, *dataset.frames[0].extra, "source", "source_page", "clipped_px"])
    writer.writerows(rows)
    store.write_text(folder / "manifest.csv", MANIFEST_HEAD + table.getvalue())
    return len(rows)


def _check_size(frame: Frame, shape: tuple[int, ...], maps: SensorMaps) -> None:
    """Raise `InputError` if a frame of shape (rows, columns) differs from the maps in size."""
    expected = maps.offset.values.shape
    if expected != shape:
        raise InputError(
            f"{frame.label}: has {shape[1]} × {shape[0]} px, but maps.nc of the results {expected[1]} × {expected[0]}"
            " px; take frames and results of the same part of the sensor"
        )


def name_corrected_frames(manifest: Sequence[Frame]) -> list[str]:
    """Return the path of each corrected frame, relative to its folder, unique and derived from the path of its source.

    The path inside an HDF5 file and the page of a stack become part of the name. So does the suffix if files differ
    only in it.
    """
    page_counts = Counter(frame.file for frame in manifest)
    # Path of each file, and path inside it: "" but for HDF5 files.
    sources = {file: (Path(path), inside) for file in page_counts for path, inside in (split_inner_path(file),)}
    stem_counts = Counter((path.with_suffix(""), inside) for path, inside in sources.values())
    names = []
    for frame in manifest:
        path, inside = sources[frame.file]
        stem = path.name.replace(".", "_") if stem_counts[path.with_suffix(""), inside] > 1 else path.stem
        stem += inside.replace("/", "_") + (f"_p{frame.page}" if page_counts[frame.file] > 1 else "")
        names.append(path.with_name(f"{stem}.tif").as_posix())
    return names


def _describe(dataset: Dataset, frame: Frame, calibration: Calibration, sha256: str) -> dict[str, Any]:
    """Return the description of a corrected file: its source with the digest `sha256`, sensor, effects, maps, results.

    It is written as JSON, so unknown and infinite values are left out.
    """
    maps = calibration.maps
    return {
        "made_by": f"spotcheck correct {spotcheck.__version__}",
        "dataset": dataset.name,
        "source": frame.file,
        "source_page": frame.page,
        "source_sha256": sha256,
        "pages": PAGES,
        "nan": "bad or clipped",
        "sensor": {key: value for key, value in asdict(calibration.sensor).items() if np.isfinite(value)},
        # Effects whose action the correction inverts.
        "turned_round": {
            applied.effect.name: {"form": applied.variant.value}
            | {name: value for name, value in applied.parameters.items() if np.isfinite(value)}
            for applied in calibration.effects
        },
        "maps": [] if maps is None else ["offset", *(["gain"] if maps.gain is not None else [])],
        "results": calibration.digests,
    }


def _write_tiff(path: Path, frame: CorrectedFrame, description: dict[str, Any]) -> None:
    """Write electrons and variance of a frame as two pages of a TIFF with 32-bit floats, atomically.

    The first page has the description as JSON, the second one its name. No date or software tag is written, so that
    equal frames and descriptions give equal bytes.
    """
    with write_atomically(path) as scratch, tifffile.TiffWriter(scratch) as tiff:
        for page, text in ((frame.electrons, json.dumps(description)), (frame.variance, PAGES[1])):
            tiff.write(page.astype(np.float32), compression="zlib", photometric="minisblack", description=text,
                       metadata=None, software="")  # fmt: skip
