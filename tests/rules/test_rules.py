"""Every rule says what it takes, makes, logs, measures and needs, in one order; and calls the command line."""

import re
import subprocess
from pathlib import Path

import pytest

from tests.conftest import ROOT, SNAKEMAKE, environment

ORDER = ["name", "input", "output", "log", "benchmark", "wildcard_constraints", "retries", "threads", "resources",
         "params", "message", "shell"]  # fmt: skip
REQUIRED = {"message", "output", "log", "benchmark", "threads", "resources", "shell"}
FILES = sorted((ROOT / "workflow" / "rules").glob("*.smk"))


def rules(path: Path) -> dict[str, list[str]]:
    """Rule → its blocks in the order in which they stand."""
    parts = re.split(r"^( *)rule ?(\w*):\n", path.read_text(), flags=re.MULTILINE)[1:]
    found = zip(parts[::3], parts[1::3], parts[2::3], strict=True)
    return {name: re.findall(rf"^{indent}    (\w+):", text, re.MULTILINE) for indent, name, text in found}


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_blocks(path):
    """Log, benchmark, threads and resources each, in one order."""
    for name, blocks in rules(path).items():
        assert set(blocks) >= REQUIRED, name
        assert blocks == sorted(blocks, key=ORDER.index), name


def test_snakemake_has_no_other_advice():
    """`snakemake --lint` asks for nothing but an environment for each rule.

    Rules call the commands of the environment that runs the Snakefile, which requirements.lock pins for all of them.
    """
    command = [*SNAKEMAKE, "--lint"]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment(), check=False)
    advice = {line.strip() for line in found.stderr.splitlines() if line.startswith("    * ")}
    assert advice == {"* Specify a conda environment or container for each rule.:"}, found.stderr


def test_rules_call_the_command_line():
    """No rule runs Python of its own: a person can copy the line and run it."""
    text = "\n".join(path.read_text() for path in FILES)
    assert not re.search(r"^\s+(run|script|notebook):", text, re.MULTILINE)


def test_no_stage_reads_the_truth():
    """What the rig put in is named by the rule that makes it, and by no other rule or notebook. That no module of the
    library names it is a test of tests/project/test_architecture.py."""
    for path in [*FILES, ROOT / "Snakefile", *(ROOT / "notebooks").glob("*.ipynb")]:
        assert path.name == "expose.smk" or "truth.json" not in path.read_text(), path


def test_snakefile_is_short():
    """The Snakefile is a table of contents."""
    assert len((ROOT / "Snakefile").read_text().splitlines()) < 60
