"""Two small dataset folders that page and examples of the public names speak of, and what tests of these share."""

from pathlib import Path

import numpy as np
import tifffile

from spotcheck.sensor import SensorModel

CAMERA = SensorModel(0.11, 8.0, black_level_dn=20.0, full_scale_dn=1023.0)
SHEET = "{bit_depth: 10, gain_dn_per_e: 0.11, read_noise_e: 8.0, black_level_dn: 20}"
EXPOSURES = (1e-4, 3e-4, 9e-4)
LAW = {"p1_px": 1.2, "p2_px": 14.0, "peak_dn": 600.0}
HEADER = "file,kind,angle_deg,exposure_s,repeat"


def design(base: Path, sensor: str = SHEET, more: str = "", exposures=EXPOSURES, crop_px: int = 48) -> Path:
    """Two angles, three sites each; no frames."""
    base.mkdir(parents=True)
    rows = [f"frames/{a}_{r}_{t}.tif,spot,{a},{t},{r}" for a in (0, 90) for r in range(3) for t in exposures]
    (base / "manifest.csv").write_text("\n".join([HEADER, *rows]) + "\n", encoding="utf-8")
    text = f"name: my frames\ncrop_px: {crop_px}\nsensor: {sensor}\n{more}"
    (base / "instrument.yaml").write_text(text, encoding="utf-8")
    return base


def levels() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Twenty levels of light and as many darks of a 12-bit sensor that saturates, two frames each; exposures [s] and
    photons."""
    camera = SensorModel(0.3, 9.0, black_level_dn=30.0, full_scale_dn=4095.0, quantum_efficiency=0.5)
    rng, photons = np.random.default_rng(5), 1500.0 * np.arange(1, 21)
    dark = np.stack([camera.draw(np.zeros((2, 48, 64)), rng) for _ in photons])
    return np.stack([camera.draw(np.full((2, 48, 64), own), rng) for own in photons]), dark, photons / 1.5e6, photons


def write_levels(base: Path, bright, dark, exposures, photons, instrument: str) -> Path:
    """Write frames [level, frame, row, column] of flats and darks; each level has an exposure [s] and photons."""
    (base / "frames").mkdir(parents=True, exist_ok=True)
    rows = [f"{HEADER},photons_per_px"]
    for kind, stack in (("dark", dark), ("flat", bright)):
        for k, (images, exposure, own) in enumerate(zip(stack, exposures, photons, strict=True)):
            for repeat, image in enumerate(images):
                tifffile.imwrite(base / f"frames/{kind}{k}_{repeat}.tif", image)
                light = own if kind == "flat" else ""
                rows.append(f"frames/{kind}{k}_{repeat}.tif,{kind},,{float(exposure)!r},{repeat},{light}")
    (base / "manifest.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (base / "instrument.yaml").write_text(instrument, encoding="utf-8")
    return base


def flats(base: Path) -> Path:
    """The same as a dataset folder."""
    return write_levels(base, *levels(), "name: my flats\nsensor: {bit_depth: 12}\n")
