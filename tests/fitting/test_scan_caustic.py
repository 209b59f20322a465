"""The caustic by second moments: that of `look`, first if the light is not Gaussian, and absent where frames cut it."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

import spotcheck
from spotcheck.cli import main
from spotcheck.io import store

WAVELENGTH, PITCH, SIDE, Z = 1.06e-6, 5e-6, 200, np.linspace(-0.02, 0.034, 10)
# Fraction of the power in a wing twice as wide as the core: its second moment is 1 + 3 · 0.2 = 1.6 times the core's.
WING = 0.2
# M² of the core.
CORE_M2 = 1.1


def run_caustic(base: Path, wing: float, side: int = SIDE) -> tuple[Path, list[Path]]:
    """Make a scan of a round beam with a wing, and return caustic.nc and its frames."""
    waist = 40e-6
    rayleigh = np.pi * waist**2 / (CORE_M2 * WAVELENGTH)
    y, x = np.mgrid[:side, :side] - (side - 1) / 2 - 0.3
    images, rows = [], ["file,kind,angle_deg,exposure_s,repeat,z_m"]
    for k, z in enumerate(Z):
        sigma = waist * np.hypot(1, (z - 0.004) / rayleigh) / 2 / PITCH
        core, broad = (np.exp(-(x**2 + y**2) / (2 * (width * sigma) ** 2)) / width**2 for width in (1, 2))
        light = 600 * ((1 - wing) * core + wing * broad)
        rng = np.random.default_rng(k)
        images.append(base / f"{k}.tif")
        tifffile.imwrite(images[-1], np.rint(40 + rng.poisson(light) + rng.normal(0, 2, light.shape)).astype(np.uint16))
        rows.append(f"{k}.tif,spot,,,0,{z}")
    (base / "manifest.csv").write_text("\n".join(rows) + "\n")
    (base / "instrument.yaml").write_text(
        f"crop_px: 60\nconditions: [z_m]\nlaser: {{wavelength_m: {WAVELENGTH}}}\nmodel: {{photon_budget: free}}\n"
        f"sensor: {{pixel_pitch_m: {PITCH}, bit_depth: 10, black_level_dn: 40, gain_dn_per_e: 1, read_noise_e: 2}}\n"
    )
    files = {name: str(base / f"{name}.nc") for name in ("frames", "crops", "sensor", "fits", "caustic")}
    options = {
        "ingest": ("frames", ()), "crop": ("crops", ("frames",)), "sensor": ("sensor", ("frames", "crops")),
        "fit": ("fits", ("crops", "sensor")), "caustic": ("caustic", ("fits",)),
    }  # fmt: skip
    for command, (output, inputs) in options.items():
        given = [part for name in inputs for part in (f"--{name}", files[name])]
        main([command, str(base), *given, "--output", files[output]])
    return Path(files["caustic"]), images


@pytest.mark.parametrize(("wing", "first"), [(WING, "moments"), (0.0, "fit")])
def test_second_moments_are_those_of_look(tmp_path, wing, first):
    """Within four standard errors of the truth: one scan of 16,000 misses by chance."""
    path, images = run_caustic(tmp_path, wing)
    look = spotcheck.look(images, z_m=Z, pixel_pitch_m=PITCH, wavelength_m=WAVELENGTH)
    (beam,) = look.beams[0].caustics.values()
    with store.read(path) as ds:
        assert list(ds["estimator"].values) == [first, "fit" if first == "moments" else "moments"]
        mean = ds.sel(estimator="moments", axis="mean")
        assert (float(mean["m2"]), float(mean["m2_stderr"])) == pytest.approx((beam.m2, beam.m2_stderr), rel=1e-6)
        assert abs(float(mean["m2"]) - CORE_M2 * (1 + 3 * wing)) < 4 * float(mean["m2_stderr"])
        # The fit is of the light near the core.
        assert CORE_M2 * 0.97 < float(ds["m2"].sel(estimator="fit", axis="mean")) < CORE_M2 * (1 + 1.5 * wing + 0.03)
        assert store.remarks_of(ds) == []


def test_frames_that_cut_the_area_of_integration_leave_the_fit(tmp_path):
    """The file says why, and no remark asks for what the frames cannot give."""
    path, _ = run_caustic(tmp_path, 0.0, side=62)
    with store.read(path) as ds:
        assert list(ds["estimator"].values) == ["fit"] and store.remarks_of(ds) == []
        assert "second moments: a caustic needs usable spots" in ds.attrs["missing"]
        assert "area of integration" in ds.attrs["missing"]
