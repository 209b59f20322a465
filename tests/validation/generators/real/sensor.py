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
from spotcheck.io.number_text import quantity_text
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
    "dark_noise_dn": ("sigma_y_dark", 1.0, "our line fit over exposure is weighted"),
    "dark_noise": ("sigma_d", 1.0, "as above"),
    "dark_current": ("u_I_mean", 1.0, ""),
    "dark_current_by_variance": ("u_I_var", 1.0, "weighted"),
    "responsivity": ("R", 1.0, ""),
    "quantum_efficiency": ("QE", 0.01, ""),
    "saturation_photons": ("u_p_sat", 1.0, ""),
    "full_well": ("u_e_sat", 1.0, ""),
    "snr_max": ("SNR_max", 1.0, ""),
    "threshold": ("u_e_min", 1.0, "ours is ½ + √(σ² + ¼); theirs is σ + ½ and includes the rounding noise"),
    "dynamic_range": ("DR", 1.0, "follows from the threshold"),
    "linearity_lowest": ("LE_min", 1.0, ""),
    "linearity_highest": ("LE_max", 1.0, ""),
    "dsnu": (
        "DSNU1288",
        1.0,
        "ours uses all darks, theirs one pair; this sensor's noise is correlated, so pairs scatter",
    ),
    "prnu": ("PRNU1288", 1.0, "the pattern of all darks is subtracted"),
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
        rows.append((QUANTITIES[name][2], f"`{ours.symbol}`", quantity_text(ours.value, ours.stderr, unit),
                     f"{theirs:.6g}", f"{apart:.2f}", why))  # fmt: skip
    return "\n".join(
        [
            "# A real sensor", "",
            "`make validate-real` analyses 204 frames of a 12-bit CCD (EMVA 1288 reference set 001), flats and darks "
            "in pairs. The table compares our results with those of the package `emva1288` 1.0.2, the standard's "
            "reference implementation, on the same frames.",
            "",
            *markdown(("quantity", "symbol", "ours", "emva1288", "difference / standard error",
                       "reason for the difference"), rows), "",
            "## Verdict", "",
            f"Status `{said['status']}`. {said['sentence']}", "",
            "## Simulated effects in real frames", "",
            "A known effect was added to the readings of the same flats. For `shutter_offset` the exposures in the "
            "manifest were changed instead, and the photon numbers were removed.", "",
            *levels.lines(verdicts), "",
            "The added effect is always among the named ones. `shutter_offset` is confounded with a pedestal: at these "
            "levels only shot noise distinguishes them. The value of `dark_offset` includes the intercept of the faint "
            "levels (see below), which is too small to be named alone. The saturation level is that before the "
            "nonlinearity, without the black level; the nonlinearity changes the level at which readings stop.", "",
            "## Dependence on the fit range", "",
            "For a linear sensor, gain and intercept do not depend on the fitted levels. Here they do, because the "
            "response is nonlinear:", "",
            *markdown(("fitted up to, of saturation", "levels", "K [DN/e-]", "intercept of the response [DN]"),
                      by_range), "",
            "## Gain from spots instead of flats", "",
            "Without flats the gain is estimated from spots: from the differences of neighbouring pixels or, if the "
            "material has speckle, of two exposures of one site. The table gives the loss of accuracy for simulated "
            "frames of known gain:", "",
            *markdown(by_spots.columns, by_spots.rows), "",
            by_spots.note, "",
        ]
    )  # fmt: skip
