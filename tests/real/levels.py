"""What the verdict says of the real CCD's flats once a known effect is put into their readings."""

import contextlib
import csv
import io
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from spotcheck.cli import main as command
from spotcheck.estimate.plus_minus import plus_minus
from tests.blind.table import markdown
from tests.real.listed import rows_of

FULL_SCALE = 4095
# Sizes that a camera or a bench might have.
CLIP_DN, BEND, OFFSET_DN, LATE_S = 2600.0, 0.05, 10.0, 10e-6
# Readings [DN] of a flat; how the effect's first parameter differs then from that of the frames as they are.
PUT_IN: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "saturation": (lambda y: np.minimum(y, CLIP_DN), f"no reading above {CLIP_DN:g} DN"),
    "nonlinearity": (lambda y: y - BEND * y**2 / FULL_SCALE, f"q more by {BEND:g}"),
    "dark_offset": (lambda y: y + OFFSET_DN, f"more by {OFFSET_DN:g} DN"),
    # The frames stay: their list says less than they were exposed.
    "shutter_offset": (lambda y: y, f"more by {1e6 * LATE_S:g} µs"),
}


def verdict_on(folder: Path) -> dict[str, Any]:
    """The verdict on a folder of flats and darks."""
    with tempfile.TemporaryDirectory() as base, contextlib.redirect_stdout(io.StringIO()):
        frames, verdict = str(Path(base, "frames.nc")), Path(base, "verdict.json")
        command(["ingest", str(folder), "--output", frames])
        command(["flats", str(folder), "--frames", frames, "--output", str(verdict)])
        return json.loads(verdict.read_text(encoding="utf-8"))


def with_effect(source: Path, name: str, folder: Path) -> Path:
    """A copy of a folder of flats and darks with an effect put in, readings rounded anew."""
    shutil.copytree(source, folder)
    rows = rows_of(source)
    rng = np.random.default_rng(1)
    for row in rows:
        if row["kind"] == "flat":
            pixels = np.asarray(Image.open(source / row["file"]), float)
            # Whole numbers that are bent and rounded again would leave gaps.
            signal = PUT_IN[name][0](pixels + rng.uniform(-0.5, 0.5, pixels.shape))
            Image.fromarray(np.clip(np.rint(signal), 0, FULL_SCALE).astype(np.uint16)).save(folder / row["file"])
    if name == "shutter_offset":
        for row in rows:
            row["exposure_s"] = repr(float(row["exposure_s"]) - LATE_S)
            # What is known of the light would give it away.
            del row["photons_per_px"]
    with (folder / "manifest.csv").open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return folder


def lines(source: Path, as_is: dict[str, Any]) -> list[str]:
    """A table of what was put in and what came out."""
    before = {own["name"]: own for own in as_is["effects"]}
    rows = []
    for name, (_, what) in PUT_IN.items():
        with tempfile.TemporaryDirectory() as base:
            said = verdict_on(with_effect(source, name, Path(base, "flats")))
        sets = " or ".join(" + ".join(names) for names in said["explanations"])
        own = next((effect for effect in said["effects"] if effect["name"] == name), None)
        rows.append((name, what, _first(before.get(name)), _first(own), said["status"], sets))
    return markdown(("put in", "that is", "as they are", "with it", "status", "explanations"), rows)


def _first(effect: dict[str, Any] | None) -> str:
    if effect is None:
        return "—"
    first = next(iter(effect["parameters"].values()))
    unit, scale = ("µs", 1e6) if first["unit"] == "s" else (first["unit"], 1.0)
    error = scale * (first["stderr"] or np.nan)
    return plus_minus(scale * first["value"], error, "" if unit == "1" else unit)
