"""The page of a real CCD: our numbers beside those of the package `emva1288`, and what the verdict says."""

import contextlib
import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from spotcheck.characterization.emva_quantities import QUANTITIES
from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.cli import main as command
from spotcheck.io import store
from spotcheck.io.plus_minus import plus_minus
from spotcheck.report.dataset_page.tables import tabulate_ranges
from tests.validation.benchmarks import gain
from tests.validation.generators.real import levels
from tests.validation.generators.real.emva import reference
from tests.validation.generators.real.levels import SOURCE
from tests.validation.table import markdown

# Light of the level at half of saturation, where both take the pattern.
HALF = 14667.0
# Ours → theirs, the factor to our unit, and why they differ where they do.
BESIDE = {
    "gain": ("K", 1.0, ""),
    "dark_noise_dn": ("sigma_y_dark", 1.0, "our line over exposure is weighted"),
    "dark_noise": ("sigma_d", 1.0, "as above"),
    "dark_current": ("u_I_mean", 1.0, ""),
    "dark_current_by_variance": ("u_I_var", 1.0, "weighted"),
    "responsivity": ("R", 1.0, ""),
    "quantum_efficiency": ("QE", 0.01, ""),
    "saturation_photons": ("u_p_sat", 1.0, ""),
    "full_well": ("u_e_sat", 1.0, ""),
    "snr_max": ("SNR_max", 1.0, ""),
    "threshold": ("u_e_min", 1.0, "ours is ½ + √(σ² + ¼), theirs σ + ½ with the noise of rounding"),
    "dynamic_range": ("DR", 1.0, "follows from the threshold"),
    "linearity_lowest": ("LE_min", 1.0, ""),
    "linearity_highest": ("LE_max", 1.0, ""),
    "dsnu": (
        "DSNU1288",
        1.0,
        "ours is that of all darks, theirs of one pair: this sensor's noise is correlated, so pairs scatter",
    ),
    "prnu": ("PRNU1288", 1.0, "less the pattern of all darks"),
}


def page(verdicts: dict[str, dict[str, Any]]) -> str:
    """The page, of verdicts by what was put in ("": nothing)."""
    with tempfile.TemporaryDirectory() as base:
        frames, transfer = (str(Path(base, name)) for name in ("frames.nc", "transfer.nc"))
        with contextlib.redirect_stdout(io.StringIO()):
            command(["ingest", str(SOURCE), "--output", frames])
            command(["transfer", str(SOURCE), "--frames", frames, "--output", transfer])
        with store.read(transfer) as ds:
            own = read_quantities(ds)
            by_range = tabulate_ranges(ds)
    said = verdicts[""]
    other, by_spots = reference(SOURCE, HALF), gain.measure().tables[0]
    rows = []
    for name, (key, factor, why) in BESIDE.items():
        ours, theirs = own[name], other[key] * factor
        unit = "" if ours.unit == "1" else ours.unit
        apart = abs(ours.value - theirs) / ours.stderr if np.isfinite(ours.stderr) and ours.stderr > 0 else np.nan
        rows.append((QUANTITIES[name][2], f"`{ours.symbol}`", plus_minus(ours.value, ours.stderr, unit),
                     f"{theirs:.6g}", f"{apart:.2f}", why))  # fmt: skip
    return "\n".join(
        [
            "# A real sensor", "",
            "204 frames of a 12-bit CCD (EMVA 1288 reference set 001), flats and darks in pairs, by `make "
            "validate-real`; beside them the package `emva1288` 1.0.2, the standard's reference implementation, on the "
            "same frames.",
            "",
            *markdown(("quantity", "symbol", "ours", "emva1288", "apart, in standard errors", "why"), rows), "",
            "## What the verdict says", "",
            f"Status `{said['status']}`. {said['sentence']}", "",
            "## With an effect put in", "",
            "The same flats with a known effect put into their readings (the shutter's into their list, the light left "
            "out of it):", "",
            *levels.lines(verdicts), "",
            "What was put in is always among the names; the shutter's is tied with a pedestal, from which at these "
            "levels only shot noise tells it. An offset holds the intercept that faint levels have anyway (see below), "
            "too small to be named alone. A level is that before the bend, black level taken off: what is bent ends at "
            "a level of its own.", "",
            "## Up to which level?", "",
            "On a linear sensor gain and intercept would not depend on the levels that are fitted. Here they do, "
            "because the response bends:", "",
            *markdown(("up to, of saturation", "levels", "K [DN/e-]", "intercept of the response [DN]"), by_range), "",
            "## Spots instead of flats", "",
            "Without flats the gain comes from spots: from what neighbouring pixels do not share, or, where the "
            "material has speckle, two exposures of one site. What that costs, on simulated frames of known gain:", "",
            *markdown(by_spots.columns, by_spots.rows), "",
            by_spots.note, "",
        ]
    )  # fmt: skip
