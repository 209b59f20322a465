"""Equal frames and code give an equal verdict, whatever the number of cores."""

from pathlib import Path

import pytest

from spotcheck.cli import main
from tests.library.test_bad_cases import CASES, written

# Few null sets, with an alpha that they reach: the law is made twice.
NULLS = ["--simulations", "20", "--seed", "1", "--tolerance", '{"alpha": 0.1}']


def judged(folder: Path, out: Path, workers: int) -> dict[str, bytes]:
    """Every file of a verdict and its null law, by name."""
    at = {name: str(out / name) for name in ("frames.nc", "crops.nc", "sensor.nc", "findings.json", "gap.nc")}
    at |= {name: str(out / name) for name in ("advice.json", "discrepancy.nc", "model.yaml", "verdict.json")}
    out.mkdir()
    seen = ["--crops", at["crops.nc"], "--sensor", at["sensor.nc"]]
    found = [*seen, "--findings", at["findings.json"]]
    for command, *options in (
        ["ingest", "--output", at["frames.nc"]],
        ["crop", "--frames", at["frames.nc"], "--output", at["crops.nc"]],
        ["sensor", "--crops", at["crops.nc"], "--frames", at["frames.nc"], "--output", at["sensor.nc"]],
        ["discrepancy", *seen, *NULLS, "--calibrations", str(out / "laws"), "--workers", str(workers),
         "--output", at["findings.json"]],
        ["verify", *found, "--output", at["gap.nc"]],
        ["advise", *found, "--output", at["advice.json"]],
        ["verdict", *found, "--gap", at["gap.nc"], "--advice", at["advice.json"], "--pictures", at["discrepancy.nc"],
         "--model", at["model.yaml"], "--output", at["verdict.json"]],
    ):  # fmt: skip
        main([command, str(folder), *options])
    files = [path for path in out.rglob("*") if path.is_file() and ".runs" not in path.parts]
    return {str(path.relative_to(out)): path.read_bytes() for path in files}


@pytest.mark.slow
def test_equal_frames_give_equal_verdicts(tmp_path):
    """Byte by byte, of null sets drawn by one process and by two, with an effect named."""
    folder = written(CASES["a copy beside the only spot"](), tmp_path)
    one, two = (judged(folder, tmp_path / f"{workers}", workers) for workers in (1, 2))
    assert one.keys() == two.keys() and len(one) == 10
    assert b"ghost_reflection" in one["verdict.json"]
    for name, content in one.items():
        assert content == two[name], name
