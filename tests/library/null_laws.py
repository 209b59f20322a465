"""Null laws that all tests of a session share, whichever worker they run in."""

from pathlib import Path

from spotcheck.discrepancy.calibration import Kind, canonical, digest_of, stored
from spotcheck.discrepancy.detect import Null
from spotcheck.discrepancy.shots import Design
from tests.conftest import alone

# The fewest null sets that can tell one in a hundred.
NULLS, SEED = 110, 20210


def null_law(laws: Path, design: Design, kind: Kind) -> Null:
    """The null law of a design, made by the first test that asks for it."""
    with alone(laws / f"{digest_of(canonical(design), kind, NULLS, SEED)}.lock"):
        return stored(laws, design, kind, NULLS, SEED)
