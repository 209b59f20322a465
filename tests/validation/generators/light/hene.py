"""One of the nine HeNe frames with an effect put into its readings."""

from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from tests.validation.generators.light.beams import SHARED
from tests.validation.protocol import manifest_of

SOURCE = SHARED / "hene-zscan"
FULL = 255
# The spot's highest readings: a bright speck of dust is no spot.
TOP = 99.9
# Stripes' direction [deg].
ACROSS = 37.0


def stems() -> list[str]:
    """The names of the frames."""
    return [Path(row["file"]).stem for row in manifest_of(SOURCE)]


def put(pixels: np.ndarray, what: str, rng: np.random.Generator) -> tuple[np.ndarray, str, dict[str, float]]:
    """Readings [DN] with `what` put in, the effect's name ("": none) and its parameters."""
    name, *given = what.split()
    if what == "as it is":
        return pixels, "", {}
    size = float(given[0])
    # Whole numbers that are bent leave a comb of empty codes, which gives the answer away: undo the rounding first.
    before = pixels + rng.uniform(-0.5, 0.5, pixels.shape)
    if name == "clip":
        level = size * float(np.percentile(pixels, TOP))
        return _codes(np.minimum(before, level)), "saturation", {"level": level}
    if name == "rise":
        return _codes(before + size), "dark_offset", {"rise": size}
    if name == "bend":
        return _codes(before - size * before**2 / FULL), "nonlinearity", {"q": size}
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
    period, angle = float(given[1]), np.radians(ACROSS)
    factor = 1 + size * np.cos(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period)
    return _codes(before * factor), "interference_fringes", {"d": size, "period": period, "direction": ACROSS}


def _codes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, FULL)


def write(frame: int, what: str, seed: int, folder: Path) -> dict[str, object]:
    """A frame as a data set of its own; returns its truth."""
    stem = stems()[frame]
    (file,) = (row["file"] for row in manifest_of(SOURCE) if Path(row["file"]).stem == stem)
    pixels = np.asarray(Image.open(SOURCE / file), float)
    found, name, parameters = put(pixels, what, np.random.default_rng([seed, 3]))
    (folder / "frames").mkdir(parents=True)
    Image.fromarray(found.astype(np.uint8)).save(folder / "frames" / "spot.png")
    manifest = "file,kind,angle_deg,exposure_s,repeat\nframes/spot.png,spot,0,,0\n"
    (folder / "manifest.csv").write_text(manifest, encoding="utf-8")
    sheet = yaml.safe_load((SOURCE / "instrument.yaml").read_text(encoding="utf-8")) | {"name": f"{stem} {what}"}
    sheet.pop("conditions")
    (folder / "instrument.yaml").write_text(yaml.safe_dump(sheet), encoding="utf-8")
    effects = [{"name": name, "parameters": parameters, "form": {}, "tied": False, "met": True}] if name else []
    return {"seed": seed, "frame": stem, "put_in": what, "light": {"kind": "frame"}, "effects": effects}
