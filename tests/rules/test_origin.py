"""The rules that `spotcheck explain` names, beside those that Snakemake plans."""

import json
from pathlib import Path

from spotcheck.report.provenance.rules import find_rule, list_outputs
from tests.conftest import ROOT, snakemake
from tests.rules.test_datasets import SAMPLE, flats

__all__ = ["flats"]


def test_rules_are_those_of_the_snakefile(flats, tmp_path):
    """Every file that Snakemake plans and a subcommand says it writes, of spots and of flats alone."""
    results = tmp_path / "results"
    names = json.dumps([str(ROOT / "data" / "virtual-rig"), str(SAMPLE), str(flats)])
    run = snakemake("--summary", "all", "verdict", config={"datasets": names, "results": results})
    assert run.returncode == 0, run.stderr
    rows = [line.split("\t") for line in run.stdout.splitlines()]
    head = next(row for row in rows if row[0] == "output_file")
    planned = {Path(row[0]): row[head.index("rule")] for row in rows if len(row) == len(head) and row != head}
    own = {path: rule for path, rule in planned.items() if path.is_relative_to(results)}
    for path in own:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    told = {}
    for path in own:
        folder = results / path.relative_to(results).parts[0]
        if rule := find_rule(folder, path.relative_to(folder).as_posix()):
            told[path] = rule.name
    assert told == {path: own[path] for path in told}
    # Each rule whose numbers can be asked for was among them.
    rules = {"ingest", "crop", "transfer", "sensor", "fit", "calibrate", "simulate", "metrics", "bounds", "caustic"}
    rules |= {"precision", "judge", "flats", "paper", "ingest_simulated", "fit_simulated", "extended"}
    assert rules <= set(told.values())
    assert {path.name for path in own if path.suffix == ".nc"} <= {
        name for options in list_outputs().values() for names in options for name in names
    }
