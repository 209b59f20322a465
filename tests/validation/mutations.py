# ruff: noqa: E501 - a fault is easier to read in one line
"""Mutation check: faults that the quick tests of their package must catch.

`python -m tests.validation.mutations [--only sensor]` puts one fault after another into a copy of the library, runs the
quick tests of its package until the first failure, and prints which faults were caught. At least 38 of 40 must be. The
place of a fault is where its package has the text, in whichever file and however its lines are broken.
"""

import argparse
import os
import re
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

    package: str
    right: str  # text that occurs once in the package
    wrong: str  # text that replaces it


FAULTS = (
    Fault("io", "return digits - 1 - math.floor", "return digits - math.floor"),
    Fault("io", "3 * math.floor(math.log10(abs(value)) / 3)", "3 * math.ceil(math.log10(abs(value)) / 3)"),
    Fault("dataset", "numbers[2::3]", "numbers[1::3]"),
    Fault("dataset", "return EXPOSURE_TOLERANCE * distinct", "return 10 * EXPOSURE_TOLERANCE * distinct"),
    Fault("dataset", "* Decimal(factor)", "/ Decimal(factor)"),
    Fault("dataset", "- instrument.sensor.value_shift_bits) - 1", "- instrument.sensor.value_shift_bits)"),
    Fault("crops", "top, left = spot.row - side // 2, spot.column - side // 2", "top, left = spot.row - side // 2, spot.row - side // 2"),
    Fault("crops", "return int(block_row) * side + side // 2, int(block_column)", "return int(block_row) * side, int(block_column)"),
    Fault("crops", "return bits & -bits or 1", "return bits or 1"),
    Fault("sensor", "return limited - curvature * limited * limited", "return limited + curvature * limited * limited"),
    Fault("sensor", "square = deviation**2", "square = abs(deviation)"),
    Fault("sensor", "square_slope - 2 * shift * shift_slope", "square_slope - shift * shift_slope"),
    Fault("model", "return p1 * np.log(exposure_s) + p2", "return p1 * np.log10(exposure_s) + p2"),
    Fault("model", "return 1.2 * (1 + magnification)", "return 1.2 * (1 - magnification)"),
    Fault("model", "PIXEL_VARIANCE = 1 / 12", "PIXEL_VARIANCE = 1 / 6"),
    Fault("model", "half_square = (dx * dx + dy * dy)", "half_square = (dx * dx - dy * dy)"),
    Fault("model", "return exposure_s / sigma**2", "return exposure_s / sigma"),
    Fault("characterization", "noise_dn.value**2 - ROUNDING_VARIANCE", "noise_dn.value**2 + ROUNDING_VARIANCE"),
    Fault("characterization", "(difference - np.nanmean(difference)) ** 2, axis=1) / 2", "(difference - np.nanmean(difference)) ** 2, axis=1)"),
    Fault("characterization", "root = np.sqrt(noise**2 + 0.25)", "root = np.sqrt(noise**2 + 1.25)"),
    Fault("fitting", "return (z / mean_e - 1) ** 2", "return (z / mean_e + 1) ** 2"),
    Fault("fitting", "return radius, square_stderr / (2 * radius)", "return radius, square_stderr / radius"),
    Fault("fitting", "widths[is_known] - laser_px, 1)", "widths[is_known] + laser_px, 1)"),
    Fault("fitting", "widths.major**2 - widths.minor**2) / total", "widths.minor**2 - widths.major**2) / total"),
    Fault("metrics", "image >= (1 - PEAK_WITHIN) * maximum", "image >= (1 + PEAK_WITHIN) * maximum"),
    Fault("metrics", "np.nanstd(image, dtype=np.float64)) / mean", "np.nanvar(image, dtype=np.float64)) / mean"),
    Fault("metrics", "abs(value - self.measured)", "value - self.measured"),
    Fault("discrepancy", "np.linalg.slogdet(total)[1] + y @ inverse @ y", "np.linalg.slogdet(total)[1] - y @ inverse @ y"),
    Fault("discrepancy", "posterior = 1 / (information + 1 / variance)", "posterior = 1 / (information - 1 / variance)"),
    Fault("discrepancy", "np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12", "np.array([-1.0, -8.0, 0.0, 8.0, 1.0]) / 12"),
    Fault("discrepancy", "p2=float(mean_sigma_px - self.forward.baseline.laser_px)", "p2=float(mean_sigma_px)"),
    Fault("export", "signal = image - sensor.black_level_dn - maps.offset_dn", "signal = image - sensor.black_level_dn + maps.offset_dn"),
    Fault("export", "ratio = previous.value / gain", "ratio = gain / previous.value"),
    Fault("paper", "return sensor_width(results) / magnification(results)", "return sensor_width(results) * magnification(results)"),
    Fault("paper", "_chi2_of_residual(emulator, transform(observed) - emulator.mean(point))", "_chi2_of_residual(emulator, transform(observed) + emulator.mean(point))"),
    Fault("quicklook", "value=step_dn * scaled_gain.value", "value=scaled_gain.value"),
    Fault("quicklook", "return [(4 * sigma, 4 * stderr)", "return [(2 * sigma, 4 * stderr)"),
    Fault("report", "other.value - reference.value", "reference.value - other.value"),
    Fault("report", "count - 1, np.nan))", "count, np.nan))"),
    Fault("cli", 'if len(dataset.spots) < len(dataset.frames):', 'if len(dataset.spots) <= len(dataset.frames):'),
)  # fmt: skip


def main() -> None:
    """Run the tests of each fault, print the table, and fail if too few were caught."""
    parser = argparse.ArgumentParser(prog="python -m tests.validation.mutations", description=__doc__)
    parser.add_argument("--only", default="", help="only faults of packages whose names start so")
    chosen = [fault for fault in FAULTS if fault.package.startswith(parser.parse_args().only)]
    caught = 0
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "workflow"
        shutil.copytree(ROOT / "workflow", copy, ignore=shutil.ignore_patterns("__pycache__"))
        places = [find_places(fault, copy / "spotcheck") for fault in chosen]
        lost = [f"{fault.package}: {fault.right!r} occurs {len(found)} times; renew the fault"
                for fault, found in zip(chosen, places, strict=True) if len(found) != 1]  # fmt: skip
        if lost:
            sys.exit("\n".join(lost))
        for fault, (place,) in zip(chosen, places, strict=True):
            is_caught, reason = run_tests_with(fault, place, copy)
            caught += is_caught
            print(f"{'caught' if is_caught else 'MISSED':7} {fault.package}: {fault.wrong}  {reason}", flush=True)
    print(f"{caught} of {len(chosen)} faults caught")
    if len(chosen) == len(FAULTS) and caught < REQUIRED:
        sys.exit(1)


def find_places(fault: Fault, library: Path) -> list[tuple[Path, re.Match[str]]]:
    """Return each place of the text of a fault in its package, with any white space between its words and signs."""
    pattern = re.compile(r"\s*".join(map(re.escape, re.findall(r"\w+|[^\w\s]", fault.right))))
    files = sorted((library / fault.package).rglob("*.py"))
    return [(path, found) for path in files for found in pattern.finditer(path.read_text(encoding="utf-8"))]


def run_tests_with(fault: Fault, place: tuple[Path, re.Match[str]], copy: Path) -> tuple[bool, str]:
    """Return whether the quick tests of the package of a fault fail with it, and the first failure."""
    path, found = place
    right = found.string
    path.write_text(right[: found.start()] + fault.wrong + right[found.end() :], encoding="utf-8")
    options = ["-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", f"tests/{fault.package}"]
    try:
        environment = os.environ | {"PYTHONPATH": str(copy), "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run([sys.executable, "-m", "pytest", *options], cwd=ROOT, env=environment,
                              capture_output=True, text=True, timeout=TIMEOUT_S)  # fmt: skip
    except subprocess.TimeoutExpired:
        return True, "the tests hang"
    finally:
        path.write_text(right, encoding="utf-8")
    failures = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return done.returncode != 0, failures[0].split(" - ")[0] if failures else ""


if __name__ == "__main__":
    main()
