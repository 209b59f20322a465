"""What a figure of the report is: name and title, where it stands, what it needs, and the function that draws it."""

from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

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
    MISSING = "What is missing"  # beside the verdict, above all others
    SENSOR = "Sensor"
    BEAM = "Beam"


class Entry(NamedTuple):
    """A figure: file name, title, category, results that it needs (by name without suffix), drawing function, and the
    figure of the paper that it stands for, such as "Fig. 7"."""

    name: str
    title: str
    category: Category
    needs: tuple[str, ...]
    draw: Callable[[Results], Drawing]
    paper: str | None = None


# What several families need: measured and simulated frames, their metrics, the data of a verdict.
PAIR = ("crops", "fits", "simulated/crops", "simulated/fits")
METRICS = ("metrics", "simulated")
VERDICT = ("discrepancy",)
