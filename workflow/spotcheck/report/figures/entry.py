"""Entry of a figure: its name, title, group in the report, required results and drawing function."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from spotcheck.report.figures.results import Results
from spotcheck.report.figures.style import Drawing


class Category(Enum):
    """Groups of figures, in the order in which the report shows them."""

    SET_UP = "Set-up"
    CALIBRATION = "Calibration"
    IMAGES = "Images"
    METRICS = "Metrics"
    BOUNDS = "Bounds"
    RESIDUALS = "Residuals"
    MISSING = "What is missing"  # effects that the model lacks; shown beside the verdict
    SENSOR = "Sensor"
    BEAM = "Beam"


@dataclass(frozen=True)
class Entry:
    """A figure of the report."""

    name: str  # file name without suffix
    title: str  # heading
    category: Category  # group in the report
    needs: tuple[str, ...]  # netCDF results that must exist, as paths in the results folder without suffix
    draw: Callable[[Results], Drawing]  # drawing function; raises `Unavailable` if the results do not support it
    paper: str | None = None  # corresponding figure of the paper, such as "Fig. 7"; None if there is none


# Values of `Entry.needs` that several modules share.
FRAMES = ("crops", "fits", "simulated")  # measured frames with their fitted spots, and mean simulated light
PAIR = ("crops", "fits", "simulated/crops", "simulated/fits")  # measured and simulated frames with their fitted spots
EXTENDED = (*PAIR, "extended/crops", "extended/fits")  # the same, and frames simulated by the extended model
METRICS = ("metrics", "simulated")  # quality metrics of the frames, and the simulation
VERDICT = ("discrepancy",)  # residuals on which the verdict is based
