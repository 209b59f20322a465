"""What a user has who installed the wheel alone; `make wheel` runs this in an environment of its own."""

import importlib.util
from importlib import metadata
from pathlib import Path

import numpy as np

import spotcheck

CHECKOUT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Raise where something is missing, or there that should not be."""
    assert CHECKOUT / "workflow" not in Path(spotcheck.__file__).parents, "the checkout's library, not the wheel's"
    unwanted = [name for name in ("snakemake", "papermill", "ipykernel", "rig") if importlib.util.find_spec(name)]
    assert not unwanted, f"the wheel brings {', '.join(unwanted)}"

    rng = np.random.default_rng(1)
    y, x = np.mgrid[:80, :80]
    light = 600 * np.exp(-((x - 40.2) ** 2 + (y - 38.7) ** 2) / (2 * 9.0**2)) / 0.11
    image = np.clip(np.rint(0.11 * (rng.poisson(light) + 13 * rng.standard_normal(light.shape)) + 20), 0, 1023)
    sensor = spotcheck.SensorModel(gain_dn_per_e=0.11, read_noise_e=13, black_level_dn=20, full_scale_dn=1023)
    fits = spotcheck.fit_spots([image], sensor)
    assert abs(fits.sigma_mean[0] - 9.0) < 5 * fits.sigma_mean_stderr[0] < 0.5

    levels = np.linspace(500, 30_000, 15)
    bright = [[np.rint(0.11 * rng.poisson(level, (64, 64)) + 20) for _ in range(2)] for level in levels]
    dark = [np.rint(0.11 * 13 * rng.standard_normal((64, 64)) + 20) for _ in range(2)]
    print(fits, bright, dark)

    print(f"spotcheck {metadata.version('spotcheck')}: fits a spot and characterises a sensor without the workflow")


if __name__ == "__main__":
    main()
