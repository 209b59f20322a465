"""What a user has who installed the wheel alone; `make wheel` runs this in an environment of its own."""

import importlib.util
from pathlib import Path

import numpy as np

import spotcheck

# What the workflow needs and the library does not, and the rig, which is a package of its own.
UNWANTED = ("snakemake", "papermill", "ipykernel", "rig")


def main() -> None:
    """Fit a spot, characterise a sensor; raise where the wheel is not by itself or a value is not what was drawn."""
    assert "site-packages" in Path(spotcheck.__file__).parts
    assert [name for name in UNWANTED if importlib.util.find_spec(name)] == []

    camera = spotcheck.SensorModel(0.25, 12, black_level_dn=40, full_scale_dn=4095, quantum_efficiency=0.6)
    y, x = np.mgrid[:64, :64]
    image = camera.draw(12_000 * np.exp(-((x - 31.3) ** 2 + (y - 30.8) ** 2) / (2 * 7.0**2)), rng=1)
    fit = spotcheck.fit_spots(image, camera)
    print(fit)
    # Five standard errors: a false alarm in two million.
    assert fit.status == "ok" and abs(fit.sigma_mean - 7.0) < 5 * fit.sigma_mean_stderr < 0.1

    rng, photons = np.random.default_rng(1), np.linspace(1000, 20_000, 12)
    bright = [camera.draw(np.full((2, 64, 64), light), rng) for light in photons]
    dark = [camera.draw(np.zeros((2, 64, 64)), rng) for _ in photons]
    found = spotcheck.characterise_sensor(bright, dark, exposure_s=1e-3, photons=photons, bit_depth=12)
    print(found)
    assert abs(found["gain"].value - 0.25) < 5 * found["gain"].stderr < 0.025
    print(f"spotcheck {spotcheck.__version__} from {Path(spotcheck.__file__).parent}: all as drawn")


if __name__ == "__main__":
    main()
