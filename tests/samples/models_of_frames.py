"""Drawn frames as records of `spotcheck.discrepancy`, with the model from which their fits start.

It stands beside `drawn_frames`, which must not import the package.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.frames import Design, FrameParameters, FrameSet, select_pixels
from spotcheck.discrepancy.joint_fit import FreeParameter, JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.laws import LawSearch
from spotcheck.discrepancy.spot_measurements import SpotMeasurements, measure_spots
from spotcheck.model.baseline import Baseline
from spotcheck.model.effect import AppliedEffect, EffectScales
from spotcheck.model.effects import vocabulary
from spotcheck.model.forward import ForwardModel
from spotcheck.sensor import SensorModel
from tests.samples import drawn_frames as drawing
from tests.samples.drawn_frames import Conditions, DrawnCamera, DrawnFrames, DrawnLight, DrawnNumbers

LONGEST_S, SHORTEST_S = max(drawing.EXPOSURES_S), min(drawing.EXPOSURES_S)
SENSOR = SensorModel(drawing.GAIN, drawing.READ_NOISE_E, black_level_dn=drawing.BLACK, full_scale_dn=drawing.FULL_SCALE)
BASELINE = Baseline(laser_px=0.0, photon_budget="linear", top_hat=False, longest_s=LONGEST_S)
SCALES = EffectScales(
    sigma_px=drawing.P1 * np.log(LONGEST_S) + drawing.P2,
    peak_dn=drawing.PEAK,
    full_scale_dn=drawing.FULL_SCALE,
    crop_px=drawing.SIDE,
    shortest_s=SHORTEST_S,
    read_noise_e=drawing.READ_NOISE_E,
    gain_dn_per_e=drawing.GAIN,
    # d ln σ/d ln t = P1/σ at the middle exposure.
    width_exponent=0.114,
    longest_s=LONGEST_S,
)


def design_of(conditions: Conditions) -> Design:
    """Return the conditions as the package has them."""
    exposures = np.unique(conditions.exposure_s)
    return Design(
        **vars(conditions),
        longest_s=float(exposures.max()),
        reference_s=float(np.exp(np.mean(np.log(exposures)))),
        has_exposures=True,
        has_order=True,
    )


def frame_set(drawn: DrawnFrames) -> FrameSet:
    """Return the drawn frames as the package has them."""
    design, side = design_of(drawn.conditions), drawing.SENSOR_SIDE
    return FrameSet(drawn.readings, drawn.left, drawn.top, design, side, side)


def true_spots(drawn: DrawnFrames) -> FrameParameters:
    """Return the spots with which the frames were drawn."""
    return FrameParameters(np.log(drawn.peak_dn), np.log(drawn.sigma_px), drawn.x, drawn.y)


def starting_spots(drawn: DrawnFrames) -> FrameParameters:
    """Return spots off the truth by what a fit of single frames might leave: 2 % and 0.1 px."""
    rng = np.random.default_rng(3)
    errors = np.array([0.02, 0.02, 0.1, 0.1])[:, None] * rng.standard_normal((4, len(drawn.x)))
    return FrameParameters(*(true_spots(drawn).as_rows() + errors))


def apply_effect(name: str, form: str | None = None, **values: float) -> AppliedEffect:
    """Return an effect of the vocabulary with values."""
    return vocabulary()[name].apply(values, form)


def starting_model(drawn: DrawnFrames, *effects: AppliedEffect, sensor: SensorModel = SENSOR) -> JointModel:
    """Return a model with a free read noise and effects, near the truth."""
    forward = ForwardModel(replace(BASELINE, photon_budget="free"), sensor)
    noise = FreeParameter("", "read_noise_e", 0.5 * sensor.read_noise_e, 3 * sensor.read_noise_e)
    model = JointModel(forward, starting_spots(drawn), design_of(drawn.conditions), (noise,))
    for applied in effects:
        model = model.with_effect(applied, SCALES)
    return model


@dataclass(frozen=True)
class Departure:
    """A departure of drawn frames from the plain model."""

    light: DrawnLight  # with which the frames are drawn
    camera: DrawnCamera  # with which they are read
    start: AppliedEffect  # the effect that it is, with values from which a fit starts
    truth: dict[str, float]  # true parameters of the effect


DEPARTURES = {
    "ellipse": Departure(
        DrawnLight(ratio=1.02, direction_deg=30.0),
        DrawnCamera(),
        apply_effect("beam_ellipticity", ratio=1.01, direction=0.0),
        {"ratio": 1.02, "direction": 30.0},
    ),
    "clip": Departure(
        DrawnLight(),
        DrawnCamera(clip_dn=450.0),
        # From above the light that is clipped, a fit leads away to where a clip does nothing.
        apply_effect("saturation", "sharp", level=420.0),
        {"level": 450.0},
    ),
    "pedestal": Departure(
        DrawnLight(pedestal_dn=0.6), DrawnCamera(), apply_effect("dark_offset", "light", level=1.0), {"level": 0.6}
    ),
    "bend": Departure(DrawnLight(), DrawnCamera(bend=0.1), apply_effect("nonlinearity", q=0.02), {"q": 0.1}),
}


def fit_drawn(drawn: DrawnFrames, *effects: AppliedEffect) -> JointFit:
    """Fit drawn frames by a model with effects, from `starting_model`."""
    model = starting_model(drawn, *effects)
    return fit_jointly(model, select_pixels(frame_set(drawn), model.spots))


def search_of(numbers: DrawnNumbers) -> LawSearch:
    """Return the search for laws of drawn numbers."""
    nowhere = np.zeros(len(numbers.log_peak))
    spots = FrameParameters(numbers.log_peak, numbers.log_sigma, nowhere, nowhere)
    measurements = SpotMeasurements(design_of(numbers.conditions), spots, numbers.covariance)
    return LawSearch(measurements, ForwardModel(BASELINE, SENSOR), SCALES)


def fit_law(fitted: DrawnFrames, effects: Sequence[AppliedEffect] = (), laws: Sequence[str] = ()) -> ForwardModel:
    """Return the model with effects and laws, given by their names, that was fitted to frames."""
    fit = fit_drawn(fitted, *effects)
    assert fit.has_converged
    search = LawSearch(measure_spots(fit), ForwardModel(BASELINE, fit.model.forward.sensor), SCALES)
    found = search.fit([vocabulary()[name] for name in laws])
    return ForwardModel(BASELINE, SENSOR, found.law, (*fit.model.forward.effects, *found.effects))
