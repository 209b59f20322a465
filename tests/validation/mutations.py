# ruff: noqa: E501 - a fault is easier to read in one line
"""Mutation check: faults that the quick tests of their package must catch.

`python -m tests.validation.mutations [--only sensor]` puts one fault after another into a copy of the library, runs the
quick tests of its package until the first failure, and prints which faults were caught. At least 38 of 40 must be.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from tests.samples.small_datasets import ROOT

REQUIRED = 38
# Longest time of the tests of a fault [s]; a fault that makes them hang counts as caught.
TIMEOUT_S = 900


class Fault(NamedTuple):
    """A fault in one line of the library."""

    file: str  # path below workflow/spotcheck
    right: str  # text that occurs once in the file
    wrong: str  # text that replaces it


FAULTS = (
    # io
    Fault("io/number_text.py", "return digits - 1 - math.floor", "return digits - math.floor"),
    Fault("io/number_text.py", "3 * math.floor(math.log10(abs(value)) / 3)", "3 * math.ceil(math.log10(abs(value)) / 3)"),
    # dataset
    Fault("dataset/conditions.py", "numbers[2::3]", "numbers[1::3]"),
    Fault("dataset/conditions.py", "return EXPOSURE_TOLERANCE * distinct", "return 10 * EXPOSURE_TOLERANCE * distinct"),
    Fault("dataset/metadata/units.py", "* Decimal(factor)", "/ Decimal(factor)"),
    Fault("dataset/frames.py", "- instrument.sensor.value_shift_bits) - 1", "- instrument.sensor.value_shift_bits)"),
    # crops
    Fault("crops/spotfinding.py", "top, left = spot.row - side // 2, spot.column - side // 2", "top, left = spot.row - side // 2, spot.row - side // 2"),
    Fault("crops/spotfinding.py", "return int(block_row) * side + side // 2, int(block_column)", "return int(block_row) * side, int(block_column)"),
    Fault("crops/full_scale.py", "return bits & -bits or 1", "return bits or 1"),
    # sensor
    Fault("sensor/response.py", "return limited - curvature * limited * limited", "return limited + curvature * limited * limited"),
    Fault("sensor/codes.py", "fourth - 3 * variance**2", "fourth - variance**2"),
    Fault("sensor/distribution.py", "square_slope - 2 * shift * shift_slope", "square_slope - shift * shift_slope"),
    # model
    Fault("model/propagation.py", "return p1 * np.log(exposure_s) + p2", "return p1 * np.log10(exposure_s) + p2"),
    Fault("model/optics.py", "return 1.2 * (1 + magnification)", "return 1.2 * (1 - magnification)"),
    Fault("model/spot.py", "PIXEL_VARIANCE = 1 / 12", "PIXEL_VARIANCE = 1 / 6"),
    Fault("model/light.py", "half_square = (dx * dx + dy * dy)", "half_square = (dx * dx - dy * dy)"),
    Fault("model/baseline.py", "return exposure_s / sigma**2", "return exposure_s / sigma"),
    # characterization
    Fault("characterization/derived_quantities.py", "noise_dn.value**2 - ROUNDING_VARIANCE", "noise_dn.value**2 + ROUNDING_VARIANCE"),
    Fault("characterization/levels.py", "(difference - np.nanmean(difference)) ** 2, axis=1) / 2", "(difference - np.nanmean(difference)) ** 2, axis=1)"),
    Fault("characterization/derived_quantities.py", "root = np.sqrt(noise**2 + 0.25)", "root = np.sqrt(noise**2 + 1.25)"),
    # fitting
    Fault("fitting/fisher.py", "return (z / mean_e - 1) ** 2", "return (z / mean_e + 1) ** 2"),
    Fault("fitting/hyperbola.py", "return radius, square_stderr / (2 * radius)", "return radius, square_stderr / radius"),
    Fault("fitting/width_law.py", "widths[is_known] - laser_px, 1)", "widths[is_known] + laser_px, 1)"),
    Fault("fitting/beam_axes.py", "widths.major**2 - widths.minor**2) / total", "widths.minor**2 - widths.major**2) / total"),
    # metrics
    Fault("metrics/crop_metrics.py", "image >= (1 - PEAK_WITHIN) * maximum", "image >= (1 + PEAK_WITHIN) * maximum"),
    Fault("metrics/crop_metrics.py", "np.nanstd(image, dtype=np.float64)) / mean", "np.nanvar(image, dtype=np.float64)) / mean"),
    Fault("metrics/model_comparison.py", "abs(value - self.measured)", "value - self.measured"),
    # discrepancy
    Fault("discrepancy/mixed_model.py", "np.linalg.slogdet(total)[1] + y @ inverse @ y", "np.linalg.slogdet(total)[1] - y @ inverse @ y"),
    Fault("discrepancy/validation.py", "posterior = 1 / (information + 1 / variance)", "posterior = 1 / (information - 1 / variance)"),
    Fault("discrepancy/residual_sums.py", "np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12", "np.array([-1.0, -8.0, 0.0, 8.0, 1.0]) / 12"),
    Fault("discrepancy/laws.py", "p2=float(mean_sigma_px - self.forward.baseline.laser_px)", "p2=float(mean_sigma_px)"),
    # export
    Fault("export/frame_correction.py", "signal = image - sensor.black_level_dn - maps.offset_dn", "signal = image - sensor.black_level_dn + maps.offset_dn"),
    Fault("export/learned_values.py", "ratio = previous.value / gain", "ratio = gain / previous.value"),
    # paper
    Fault("paper/derived.py", "return sensor_width(results) / magnification(results)", "return sensor_width(results) * magnification(results)"),
    Fault("paper/rivals/inference.py", "residual = (transform(observed) - emulator.mean(point))[IS_FITTED]", "residual = (transform(observed) + emulator.mean(point))[IS_FITTED]"),
    # quicklook
    Fault("quicklook/camera.py", "value=step_dn * scaled_gain.value", "value=scaled_gain.value"),
    Fault("quicklook/image_analysis.py", "return [(4 * sigma, 4 * stderr)", "return [(2 * sigma, 4 * stderr)"),
    # report
    Fault("report/comparison/changes.py", "other.value - reference.value", "reference.value - other.value"),
    Fault("report/figures/series.py", "count - 1, np.nan))", "count, np.nan))"),
    # cli
    Fault("cli/pipeline.py", 'if len(dataset.spots) < len(dataset.frames):', 'if len(dataset.spots) <= len(dataset.frames):'),
)  # fmt: skip


def main() -> None:
    """Run the tests of each fault, print the table, and fail if too few were caught."""
    parser = argparse.ArgumentParser(prog="python -m tests.validation.mutations", description=__doc__)
    parser.add_argument("--only", default="", help="only faults of files that start so")
    chosen = [fault for fault in FAULTS if fault.file.startswith(parser.parse_args().only)]
    caught = 0
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "workflow"
        shutil.copytree(ROOT / "workflow", copy, ignore=shutil.ignore_patterns("__pycache__"))
        for fault in chosen:
            is_caught, reason = run_tests_with(fault, copy)
            caught += is_caught
            print(f"{'caught' if is_caught else 'MISSED':7} {fault.file}: {fault.wrong}  {reason}", flush=True)
    print(f"{caught} of {len(chosen)} faults caught")
    if len(chosen) == len(FAULTS) and caught < REQUIRED:
        sys.exit(1)


def run_tests_with(fault: Fault, copy: Path) -> tuple[bool, str]:
    """Return whether the quick tests of the package of a fault fail with it, and the first failure."""
    path, package = copy / "spotcheck" / fault.file, fault.file.partition("/")[0]
    right = path.read_text(encoding="utf-8")
    if right.count(fault.right) != 1:
        sys.exit(f"{fault.file}: {fault.right!r} occurs {right.count(fault.right)} times; renew the fault")
    path.write_text(right.replace(fault.right, fault.wrong), encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-m",
        "not slow",
        "-p",
        "no:cacheprovider",
        f"tests/{package}",
    ]
    try:
        environment = os.environ | {"PYTHONPATH": str(copy), "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return True, "the tests hang"
    finally:
        path.write_text(right, encoding="utf-8")
    failures = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return done.returncode != 0, failures[0].split(" - ")[0] if failures else ""


if __name__ == "__main__":
    main()
