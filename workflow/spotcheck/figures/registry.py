"""The one table of figures: name, title, place in the paper, category, inputs, function. Its order is the page's."""

from collections.abc import Callable
from typing import NamedTuple

from spotcheck.figures import (
    bounds,
    caustic,
    discrepancy,
    images,
    located,
    metric_plots,
    overview,
    photon_transfer,
    precision,
    profiles,
    propagation,
    residuals,
    setup,
)
from spotcheck.figures.results import Results
from spotcheck.figures.style import Drawing


class Entry(NamedTuple):
    """A figure: file name, title, figure of the paper or None, category, results that it needs, drawing function."""

    name: str
    title: str
    paper: str | None
    category: str
    needs: tuple[str, ...]
    draw: Callable[[Results], Drawing]


PAIR = ("crops", "fits", "simulated/crops", "simulated/fits")
MISSED = ("crops", "fits", "simulated")
METRICS = ("metrics", "simulated")
MISSING = ("discrepancy",)
FLATS = ("transfer",)
CALIBRATION, IMAGES, QUALITY, PRECISION, GAP, BEAM = "Calibration", "Images", "Metrics", "Bounds", "Residuals", "Beam"
SENSOR = "Sensor"
# The report shows these beside the verdict.
VERDICT = "What is missing"

FIGURES = (
    Entry("overview", "At a glance", None, IMAGES, PAIR, overview.draw),
    Entry("fig05", "Optical set-up", "Fig. 5", "Set-up", ("frames",), setup.draw),
    Entry("fig07", "Beam propagation parameters", "Fig. 7", CALIBRATION, ("calibration",), propagation.draw),
    Entry("fig08a", "Simulated spot", "Fig. 8a", IMAGES, PAIR, images.simulated),
    Entry("fig08b", "Measured spot", "Fig. 8b", IMAGES, PAIR, images.measured),
    Entry("fig08c", "Measured and simulated spot superposed", "Fig. 8c", IMAGES, PAIR, images.superposition),
    Entry("fig09a", "Peak signal-to-noise ratio", "Fig. 9a", QUALITY, ("metrics", "sensor"), metric_plots.psnr),
    Entry("fig09b", "Speckle contrast", "Fig. 9b", QUALITY, METRICS, metric_plots.contrast),
    Entry("fig10a", "Plateau: largest reading", "Fig. 10a", QUALITY, METRICS, metric_plots.maximum),
    Entry("fig10b", "Amplitude of the fitted Gaussian", "Fig. 10b", QUALITY, METRICS, metric_plots.amplitude),
    Entry("fig11", "Width of the fitted Gaussian", "Fig. 11", QUALITY, METRICS, metric_plots.width),
    Entry("fig12", "Sum of all readings", "Fig. 12", QUALITY, METRICS, metric_plots.total),
    Entry("fig13a", "Bounds over exposure time", "Fig. 13a", PRECISION, ("bounds",), bounds.over_exposure),
    Entry("fig13b", "Bounds over photons", "Fig. 13b", PRECISION, ("bounds",), bounds.over_photons),
    Entry("precision", "How precisely a frame measures", None, PRECISION, ("precision",), precision.draw),
    Entry("residuals", "Residual images", None, GAP, MISSED, residuals.images),
    Entry("residual-profiles", "Radial profiles and their residual", None, GAP, MISSED, profiles.draw),
    Entry("missing-where", "Where simulation and measurement disagree", None, VERDICT, MISSING, located.where),
    Entry("missing-evidence", "How well each effect explains it", None, VERDICT, MISSING, located.evidence),
    Entry("missing-residuals", "Residual before and after", None, VERDICT, MISSING, discrepancy.residuals),
    Entry("missing-gap", "The gap by condition", None, VERDICT, MISSING, discrepancy.gap),
    Entry("photon-transfer", "Photon transfer", None, SENSOR, FLATS, photon_transfer.transfer),
    Entry("response", "Response and linearity", None, SENSOR, FLATS, photon_transfer.response),
    Entry("signal-to-noise", "Signal-to-noise ratio", None, SENSOR, FLATS, photon_transfer.ratio),
    Entry("dark", "Without light", None, SENSOR, FLATS, photon_transfer.dark),
    Entry("pattern", "Pattern of the sensor", None, SENSOR, FLATS, photon_transfer.pattern),
    Entry("caustic", "Caustic of the beam", None, BEAM, ("caustic",), caustic.draw),
)
