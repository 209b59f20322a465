"""model.yaml and light.nc of a verdict: what they hold, and that `spotcheck simulate` runs them."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spotcheck.discrepancy.extended_model import FinalModel, build_extended_model, fit_exposure_law, fit_final_model
from spotcheck.discrepancy.findings import Findings, LearnedLight, NamedEffect, ParameterValue
from spotcheck.discrepancy.laws import LawSearch
from spotcheck.discrepancy.spot_measurements import measure_spots
from spotcheck.errors import InputError
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.effects import vocabulary
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light import ExposureLaw
from spotcheck.model.light_shape import LIGHT, LightShape, read_light
from spotcheck.model.model_file import ExtendedModel, Site, read_model, reason_without_model
from spotcheck.model.model_writer import LightFile, model_text, no_model_text, write_light, write_no_light
from tests.model.test_extended import SIDE, design, simulated
from tests.samples import drawn_frames as drawing
from tests.samples.drawn_frames import DrawnFrames, draw_frames, draw_numbers, lay_out
from tests.samples.model_files import applied
from tests.samples.models_of_frames import (
    BASELINE,
    DEPARTURES,
    SCALES,
    SENSOR,
    fit_drawn,
    frame_set,
    search_of,
    starting_spots,
    true_spots,
)

SHAPE = LightShape(0.4, np.random.default_rng(3).normal(0, 0.02, (21, 21)))
LEARNED = LearnedLight(SHAPE, 0.06, 0.001, (0.1, 0.2, 0.7), 1.1, 0.9, 30.0, 0.0, "6 % of the light lies elsewhere")
# The effect that stands for a learned light.
OF_LIGHT = next(effect for effect in vocabulary().values() if not effect.stages)


# The files.


def written(model: ExtendedModel, folder) -> ExtendedModel:
    """Return a model after a stay in its files."""
    if model.lights:
        write_light(model.lights, LightFile(folder / LIGHT, "set", "code"))
    (folder / "model.yaml").write_text(model_text(model, "set", "named"), encoding="utf-8")
    return read_model(folder / "model.yaml")


def test_files_without_a_model_say_why(tmp_path):
    """The reason can be read, and neither file is taken for a model or a light."""
    reason = 'no "spot": in any frame'
    (tmp_path / "model.yaml").write_text(no_model_text("set", reason), encoding="utf-8")
    assert reason_without_model(tmp_path / "model.yaml") == reason
    write_no_light("the declared shape stands", LightFile(tmp_path / LIGHT, "set", "code"))
    with pytest.raises(InputError, match="holds no shape"):
        read_light(tmp_path / LIGHT)


# What a model holds.


def named(effect: AppliedEffect, **reported: float) -> NamedEffect:
    """Return a named effect; `reported` are values that a verdict reports instead of those of the effect."""
    values = {name: ParameterValue(value, 0.0, "1") for name, value in reported.items()}
    return NamedEffect(effect, values, gain=100.0, z=10.0)


@dataclass(frozen=True)
class Case:
    """Drawn frames with what `build_extended_model` takes beside the findings."""

    drawn: DrawnFrames
    rows: list[Any]  # rows of the manifest
    dataset: Any

    def build(self, law: ExposureLaw | None, *effects: NamedEffect, light: LearnedLight | None = None) -> ExtendedModel:
        """Return the extended model with the true spots."""
        baseline = replace(BASELINE, learned=None if light is None else light.shape)
        final = FinalModel(ForwardModel(baseline, SENSOR), true_spots(self.drawn), law)
        findings = Findings(effects=effects, light=light)
        setting = SimpleNamespace(baseline=BASELINE, sensor=SENSOR)
        ready = SimpleNamespace(frames=frame_set(self.drawn), rows=self.rows, setting=setting)
        return build_extended_model(final, findings, ready, self.dataset)


@pytest.fixture(scope="module")
def case() -> Case:
    """Return two angles, three exposures and two repeats."""
    conditions = lay_out(angles_deg=(0.0, 90.0), repeats=2)
    rows = [
        SimpleNamespace(angle_deg=float(np.rad2deg(angle)), exposure_s=float(exposure), repeat=int(repeat), extra={})
        for angle, exposure, repeat in zip(conditions.angle, conditions.exposure_s, conditions.repeat, strict=True)
    ]
    instrument = SimpleNamespace(conditions=(), crop_px=drawing.SIDE)
    dataset = SimpleNamespace(instrument=instrument, exposures=drawing.EXPOSURES_S)
    return Case(draw_frames(1, conditions), rows, dataset)


LAW = ExposureLaw(drawing.P1, drawing.P2, drawing.PEAK)


def test_spots_lie_where_their_frames_do(case: Case):
    """With a law there is one spot for each site, at the mean of its frames; without one, one for each frame."""
    with_law, without = case.build(LAW), case.build(None)
    drawn = case.drawn
    assert len(with_law.spots) == 4 and len(without.spots) == 12
    for frame, row in enumerate(case.rows):
        spot = with_law.spots[Site(row.angle_deg, None, row.repeat, ())]
        assert (spot.x_px, spot.y_px) == pytest.approx((drawn.x[frame], drawn.y[frame]))
        assert spot.peak_dn is None and spot.sigma_px is None
        spot = without.spots[Site(row.angle_deg, row.exposure_s, row.repeat, ())]
        assert (spot.peak_dn, spot.sigma_px) == pytest.approx((drawn.peak_dn[frame], drawn.sigma_px[frame]))
    assert (with_law.longest_s, with_law.reference_s) == pytest.approx((9e-4, 3e-4))
    assert (with_law.rows, with_law.columns) == (drawing.SENSOR_SIDE, drawing.SENSOR_SIDE)


def test_effects_are_as_a_file_takes_them(case: Case):
    """Reported values stand; directions lie within a turn, and values within bounds."""
    model = case.build(
        LAW,
        named(applied("site_variation", width=0.01, brightness=0.02), brightness=0.03),
        named(applied("beam_ellipticity", ratio=0.999, direction=-30.0)),
    )
    assert [a.effect.name for a in model.effects] == ["site_variation", "beam_ellipticity"]
    assert model.effects[0].parameters == {"width": 0.01, "brightness": 0.03}
    assert model.effects[1].parameters == {"ratio": 1.0, "direction": 330.0}


def test_a_learned_light_stands_for_an_effect(case: Case):
    """Its strength and the azimuthal order that has most of it are the effect's; without it there is no light."""
    model = case.build(LAW, light=LEARNED)
    (effect,) = model.effects
    assert effect.effect is OF_LIGHT and effect.values == (0.06, 2.0)
    assert model.lights == (SHAPE,)
    assert case.build(LAW).lights == ()


def test_the_model_of_a_verdict_can_be_simulated(case: Case, tmp_path):
    """What is built, written and read gives frames whose spots have its peak and place."""
    named_effects = [named(applied("power_fluctuation", rms=0.02)), named(applied("smear", fraction=0.01))]
    model = written(case.build(LAW, *named_effects), tmp_path)
    found = design(tmp_path / "design")
    ds = simulated(found, model, tmp_path / "simulated")
    for site, spot in model.spots.items():
        crop = ds.sel(angle=site.angle_deg, repeat=site.repeat, exposure=9e-4)
        # The smear takes at most 1 % of the light of a column elsewhere.
        assert float(crop["amplitude"]) == pytest.approx(LAW.peak_dn, rel=1e-6)
        light = crop["mean_light"].values
        centre = np.average(np.arange(SIDE), weights=light.sum(axis=0)) + float(crop["left"])
        assert centre == pytest.approx(spot.x_px, abs=0.02)


# The law beside named laws.


def test_the_law_beside_fitted_laws_is_that_of_their_fit():
    """With laws at their best values the law of the exposure is the one of the joint fit."""
    search = search_of(draw_numbers(5, lay_out(), peak_factor=1 + 0.05 * np.cos(2 * lay_out().angle)))
    fit = search.fit([vocabulary()["angle_reflectance"]])
    law = fit_exposure_law(search, fit.effects)
    assert (law.p1, law.p2, law.peak_dn) == pytest.approx((fit.law.p1, fit.law.p2, fit.law.peak_dn), rel=1e-4)


def test_the_law_without_laws_is_the_true_one():
    """Errors are 5e-4 px, 4e-3 px and 2e-3 by design; limits are some 5 of them (false-alarm rate below 1e-5)."""
    law = fit_exposure_law(search_of(draw_numbers(5, lay_out())), ())
    assert law.p1 == pytest.approx(drawing.P1, abs=0.01)
    assert law.p2 == pytest.approx(drawing.P2, abs=0.1)
    assert law.peak_dn == pytest.approx(drawing.PEAK, rel=0.015)


# The model behind a verdict.


@dataclass(frozen=True)
class Analysed:
    """Frames of an ellipse with what stands for their analysis."""

    drawn: DrawnFrames
    analysis: Any


@pytest.fixture(scope="module")
def analysed() -> Analysed:
    """Return six repeats of an ellipse, of which two are held out, with the fit of the others."""
    departure = DEPARTURES["ellipse"]
    drawn = draw_frames(7, lay_out(angles_deg=(0.0, 60.0), repeats=6), departure.light, departure.camera)
    frames = frame_set(drawn)
    searched, unseen = np.flatnonzero(~frames.held_out()), np.flatnonzero(frames.held_out())
    fit = fit_drawn(drawn.select(searched), departure.start)
    assert fit.has_converged
    prepared = SimpleNamespace(
        frames=frames.select(searched),
        unseen=frames.select(unseen),
        unseen_spots=starting_spots(drawn).select(unseen),
        setting=SimpleNamespace(baseline=BASELINE, sensor=SENSOR),
    )
    search = LawSearch(measure_spots(fit), ForwardModel(BASELINE, SENSOR), SCALES)
    selected = SimpleNamespace(fit=fit)
    return Analysed(drawn, SimpleNamespace(prepared=prepared, selected=selected, shape=None, search=search))


def test_held_out_frames_have_their_spots(analysed: Analysed):
    """All frames lie where they were drawn: errors are 0.01 px and 2e-3, limits five of them (4e-5 in 144 numbers)."""
    fit = analysed.analysis.selected.fit
    findings = Findings(effects=tuple(named(effect) for effect in fit.model.forward.effects))
    final = fit_final_model(analysed.analysis, findings, frame_set(analysed.drawn))
    truth = true_spots(analysed.drawn)
    for found, drawn, limit in zip(final.spots.as_rows(), truth.as_rows(), (0.02, 0.01, 0.06, 0.06), strict=True):
        assert np.abs(found - drawn).max() < limit
    assert final.law is not None and final.law.p2 == pytest.approx(drawing.P2, abs=0.05)
    assert [a.effect.name for a in final.forward.effects] == ["beam_ellipticity"]


def test_an_effect_that_is_not_named_leaves_the_model(analysed: Analysed):
    """Then the frames are fitted anew without it; a round spot of the same area has another width nowhere by 1 %."""
    frames = frame_set(analysed.drawn)
    final = fit_final_model(analysed.analysis, Findings(), frames)
    assert final.forward.effects == () and final.law is not None
    searched = ~frames.held_out()
    before = analysed.analysis.selected.fit.model.spots.log_sigma
    np.testing.assert_allclose(final.spots.log_sigma[searched], before, atol=0.01)
    assert np.abs(final.spots.log_sigma[searched] - before).max() > 0


def test_static_shapes_stand_for_a_learned_light(analysed: Analysed):
    """If a learned light is explained by an ellipse, the model has the declared light with that ellipse."""
    original = analysed.analysis
    ellipse = original.selected.fit.model.forward.effects[0]
    forward = replace(original.selected.fit.model.forward, effects=(), baseline=replace(BASELINE, learned=SHAPE))
    model = SimpleNamespace(
        forward=forward, effect_names=(), grid=object(), spots=original.selected.fit.model.spots
    )  # fmt: skip
    analysis = SimpleNamespace(
        **vars(original) | {
            "selected": SimpleNamespace(fit=SimpleNamespace(model=model)),
            "shape": SimpleNamespace(effects=(ellipse,)),
        }
    )  # fmt: skip
    final = fit_final_model(analysis, Findings(effects=(named(ellipse),)), frame_set(analysed.drawn))
    assert final.forward.baseline.learned is None and final.forward.effects == (ellipse,)
    truth = true_spots(analysed.drawn)
    assert np.abs(final.spots.log_peak - truth.log_peak).max() < 0.02
    # A learned light that a verdict keeps stays in the model, and the spots are those of its fit.
    kept = fit_final_model(analysis, Findings(light=LEARNED), frame_set(analysed.drawn))
    searched = ~frame_set(analysed.drawn).held_out()
    assert kept.forward.baseline.learned is SHAPE
    np.testing.assert_array_equal(kept.spots.x[searched], model.spots.x)
