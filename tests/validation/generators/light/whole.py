"""Two sets that are judged whole: the default dataset, and the nine HeNe frames at a wide crop."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

from tests.validation.generators.light.hene import SOURCE
from tests.validation.records import ROOT

# What the virtual rig puts into the default dataset. Every seventh row clips 4.4 % higher than 752.4 DN.
IN_DEFAULT = ("saturation", "fibre_anisotropy", "speckle", "photon_budget", "site_variation")
# Also in the rig, but weak: its name is neither asked for nor false. Pixels that clip at levels of their own are a
# pattern fixed to the sensor.
ALLOWED = ("angle_reflectance", "fixed_pattern")
CLIP_LEVEL = 752.4 * (1 + 0.044 / 7)
WIDE_CROP = 600


def write_default(folder: Path) -> dict[str, Any]:
    """Expose the default dataset on the virtual rig; returns the truth."""
    folder.mkdir(parents=True)
    for file in ("instrument.yaml", "manifest.csv"):
        shutil.copyfile(ROOT / "data" / "virtual-rig" / file, folder / file)
    settings = ROOT / "data" / "virtual-rig" / "rig.yaml"
    command = [Path(sys.executable).with_name("rig"), "expose", folder, "--settings", settings, "--truth",
               folder.parent / "rig.json", "--workers", "1"]  # fmt: skip
    subprocess.run([str(word) for word in command], check=True, capture_output=True, cwd=ROOT)
    effects = [{"name": name, "form": {}, "parameters": {}} for name in IN_DEFAULT]
    effects[0]["parameters"] = {"level": CLIP_LEVEL}
    return {"light": {"kind": "rig"}, "effects": effects, "allowed": list(ALLOWED)}


def write_wide_frames(folder: Path) -> dict[str, Any]:
    """The nine HeNe frames as one dataset with crops of 600 px; nobody knows what they hold."""
    shutil.copytree(SOURCE, folder)
    sheet = yaml.safe_load((folder / "instrument.yaml").read_text(encoding="utf-8"))
    sheet["crop_px"] = WIDE_CROP
    (folder / "instrument.yaml").write_text(yaml.safe_dump(sheet), encoding="utf-8")
    return {"light": {"kind": "frame"}, "effects": []}
