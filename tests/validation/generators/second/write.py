"""A case as a dataset folder: instrument.yaml, manifest.csv and TIFF frames."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import tifffile
import yaml

from tests.validation.generators.second.case import BITS, CROP, FULL_SCALE, FULL_WELL, LASER, OPTICS, PIXEL_PITCH, Case
from tests.validation.generators.second.sensor import expose


def instrument(case: Case, name: str) -> dict[str, object]:
    """What the experimenter states: the true camera and the base model, no effect."""
    sensor = {
        "pixel_pitch_m": PIXEL_PITCH,
        "bit_depth": BITS,
        "gain_dn_per_e": case.gain,
        "read_noise_e": case.read_noise,
        "dark_current_e_per_s": case.dark_current,
        "quantum_efficiency": 0.38,
        "black_level_dn": case.black,
        "value_shift_bits": case.shift,
    }
    if FULL_WELL * case.gain > 1.1 * FULL_SCALE:
        sensor["full_well_e"] = FULL_WELL
    return {
        "name": name,
        "order_known": True,
        "crop_px": CROP,
        "sensor": sensor,
        "optics": OPTICS,
        "laser": LASER,
        "material": {"reflectance": 0.02},
        "model": {"photon_budget": case.budget, "top_hat": case.top_hat},
    }


def write_dataset(case: Case, folder: Path) -> None:
    """One file a frame, or one stack a site."""
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    (folder / "instrument.yaml").write_text(yaml.safe_dump(instrument(case, folder.name), sort_keys=False))
    stacks: dict[str, list[np.ndarray]] = {}
    rows = []
    for i, frame in enumerate(case.frames):
        file = f"frames/site{frame.site:03d}.tif" if case.stacked else f"frames/{i:04d}.tif"
        pages = stacks.setdefault(file, [])
        row = [file, "spot", f"{frame.angle:g}", f"{frame.exposure:g}", frame.repeat]
        rows.append([*row, len(pages)] if case.stacked else row)
        pages.append(expose(case, i).astype(np.uint16) << case.shift)
    for file, pages in stacks.items():
        tifffile.imwrite(folder / file, np.stack(pages) if case.stacked else pages[0], photometric="minisblack")
    header = ["file", "kind", "angle_deg", "exposure_s", "repeat"] + (["page"] if case.stacked else [])
    with (folder / "manifest.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([header, *rows])
