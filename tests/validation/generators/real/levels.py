"""A real CCD's flats and darks with a known effect put into their readings, and what the verdict says of them."""

import csv
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from spotcheck.io.number_text import quantity_text
from tests.validation.protocol import manifest_of
from tests.validation.records import ROOT
from tests.validation.table import markdown

SOURCE = ROOT.parent / "shared" / "data" / "emva-ccd"
FULL_SCALE = 4095
# Sizes that a camera or a bench might have.
CLIP_DN, BEND, OFFSET_DN, LATE_S = 2600.0, 0.05, 10.0, 10e-6
# Readings [DN] of a flat; the effect's parameter, and in words how it differs then from that of the frames as they are.
PUT_IN: dict[str, tuple[Callable[[np.ndarray], np.ndarray], dict[str, float], str]] = {
    "saturation": (lambda y: np.minimum(y, CLIP_DN), {"level": CLIP_DN}, f"no reading above {CLIP_DN:g} DN"),
    "nonlinearity": (lambda y: y - BEND * y**2 / FULL_SCALE, {"q": BEND}, f"q increased by {BEND:g}"),
    "dark_offset": (lambda y: y + OFFSET_DN, {"level": OFFSET_DN}, f"increased by {OFFSET_DN:g} DN"),
    # The frames stay: their list says less than they were exposed.
    "shutter_offset": (lambda y: y, {"offset": LATE_S}, f"increased by {1e6 * LATE_S:g} µs"),
}


def write(name: str, folder: Path) -> dict[str, Any]:
    """The folder of flats and darks with an effect put in, readings rounded anew ("": as it is); returns what is known
    of the effect."""
    shutil.copytree(SOURCE, folder)
    if not name:
        return {}
    rows = manifest_of(SOURCE)
    rng = np.random.default_rng(1)
    for row in rows:
        if row["kind"] == "flat":
            pixels = np.asarray(Image.open(SOURCE / row["file"]), float)
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
    return PUT_IN[name][1]


def lines(verdicts: dict[str, dict[str, Any]]) -> list[str]:
    """A table of what was put in and what came out, of verdicts by what was put in ("": nothing)."""
    before = {own["name"]: own for own in verdicts[""]["effects"]}
    rows = []
    for name, (_, _, what) in PUT_IN.items():
        said = verdicts[name]
        sets = " and ".join(" or ".join(own["candidates"]) for own in said["effects"])
        own = next((effect for effect in said["effects"] if effect["name"] == name), None)
        rows.append((name, what, _first(before.get(name)), _first(own), said["status"], sets))
    return markdown(("added effect", "size", "parameter before", "parameter after", "status", "effects"), rows)


def _first(effect: dict[str, Any] | None) -> str:
    if effect is None:
        return "—"
    first = next(iter(effect["parameters"].values()))
    return quantity_text(first["value"], first["stderr"], first["unit"])
