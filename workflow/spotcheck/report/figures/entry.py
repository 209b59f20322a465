"""Entry of a figure in the report."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from spotcheck.report.figures.results import Results
from spotcheck.report.figures.style import Drawing


class Category(Enum):
    """Groups of figures, in the order in which the report shows them."""

    GLANCE = "At a glance"
    SET_UP = "Set-up"
    CALIBRATION = "Calibration"
    IMAGES = "Images"
    METRICS = "Metrics"
    BOUNDS = "Bounds"
    RESIDUALS = "Residuals"
    MISSING = "What is missing"  # shown beside the verdict
    SENSOR = "Sensor"
    BEAM = "Beam"


@dataclass(frozen=True)
class Entry:
    """A figure of the report."""

    name: str  # file name without suffix
    title: str  # heading
    category: Category  # group in the report
    needs: tuple[str, ...]  # results that the figure reads, by name without suffix
    draw: Callable[[Results], Drawing]  # drawing function
    paper: str | None = None  # corresponding figure of the paper, such as "Fig. 7"; None if there is none


# Results that several families need: measured and simulated frames, their metrics, the data of a verdict.
PAIR = ("crops", "fits", "simulated/crops", "simulated/fits")
METRICS = ("metrics", "simulated")
VERDICT = ("discrepancy",)
