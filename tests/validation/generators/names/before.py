"""Sets of the rig on which the engine before was scored, and what became of each: from the repository's history, as the
file went with that engine."""

import json
import lzma
import subprocess
from functools import cache
from typing import Any

import numpy as np

from tests.validation.protocol import Job
from tests.validation.records import ROOT

# The last commit that has the file.
COMMIT, FILE = "0ae5e06", "tests/validation/published.jsonl.xz"
# Jobs of it carry this before their kind.
WORD = "before"


@cache
def rows() -> dict[int, dict[str, Any]]:
    """Records by seed; none where the history is not there, as in a shallow clone."""
    command = ["git", "show", f"{COMMIT}:{FILE}"]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, check=False)
    if found.returncode:
        return {}
    lines = lzma.decompress(found.stdout).decode().splitlines()[1:]
    return {own["job"]["seed"]: own for own in map(json.loads, lines)}


def jobs(seed: int) -> list[Job]:
    """All of them, in an order that a seed gives."""
    known = list(rows().values())
    order = np.random.default_rng(seed).permutation(len(known))
    jobs = [known[k]["job"] for k in order]
    return [Job(0, own["seed"], f"{WORD}:{own['kind']}", own["design"], own["budget"]) for own in jobs]
