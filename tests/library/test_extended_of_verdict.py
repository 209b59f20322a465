"""model.yaml of a verdict of the old engine: written by its copies, read and simulated by the library."""

from pathlib import Path

import numpy as np
import pytest

from spotcheck import dataset
from spotcheck.model.model_file import ExtendedModel, Site, read_model
from spotcheck.old_engine.boundary import new_sensor
from spotcheck.old_engine.conclude.judge import judge
from spotcheck.old_engine.conclude.judgement import Judgement
from spotcheck.old_engine.model.effect import COMPONENTS
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.model.extended import Extended as OldExtended
from spotcheck.old_engine.model.extended import Site as OldSite
from spotcheck.old_engine.model.extended import read_model as old_model
from spotcheck.old_engine.model.extended import text_of
from spotcheck.old_engine.model.light_file import LIGHT, written_light
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.observe.frames import Setting
from spotcheck.old_engine.observe.shots import Shot
from spotcheck.old_engine.verdict.document import document
from spotcheck.old_engine.verdict.extended import extended_of
from tests.library import small_set as small
from tests.library.judgements import found
from tests.library.test_extended import simulated

KNOWN = [vocabulary()[name] for name in ("ghost_reflection", "saturation", "beam_profile")]


# One angle of three sites: what effects and law ask of a design, and soon judged.
FEW: dict = {"angles": [0.0], "seed": 5}


def judged(light: small.Light, **design) -> tuple[Judgement, np.ndarray, Setting, list[Shot]]:
    """The judgement of small frames by a few effects, their truth and setting."""
    shots, truth, setting = small.frames(light, **design)
    return judge(shots, setting, KNOWN), truth, setting, shots


@pytest.fixture(scope="module")
def agreed() -> tuple[Judgement, np.ndarray, Setting, list[Shot]]:
    """Frames in which nothing is missing."""
    return judged(small.plain, **FEW)


def written(model: OldExtended, base: Path) -> ExtendedModel:
    """A model after a stay in its file, in which it says the same."""
    if model.lights:
        written_light(model.lights, base / LIGHT, title="t", dataset="x", code="c")
    (base / "model.yaml").write_text(text := text_of(model, "x", "named"), encoding="utf-8")
    assert text_of(old_model(base / "model.yaml"), "x", "named") == text
    return read_model(base / "model.yaml")


@pytest.mark.slow
def test_a_ghost_in_crops_that_end_early():
    """Two angles: the shape's nodes reach beyond the crop, where nothing holds it."""
    own = judged(small.ghost)[0]
    assert [one.own.effect.name for one in own.found] == ["ghost_reflection"]


def test_the_model_of_a_verdict(tmp_path):
    """Effects with the verdict's own values, the law that goes with them (peak within 1 %, width at either exposure
    within 0.1 px), and centres of all sites."""
    own, truth, setting, shots = judged(small.ghost, **FEW)
    model = written(extended_of(own, setting, small.dataset(tmp_path / "set").instrument, KNOWN), tmp_path)
    (effect,), (told,) = model.effects, document(own, "x")["effects"]
    assert effect.parameters == {name: pytest.approx(entry["value"]) for name, entry in told["parameters"].items()}
    assert told["name"] == "ghost_reflection" and effect.values[0] == pytest.approx(0.06, abs=0.003)
    assert model.law is not None and model.law.peak_dn == pytest.approx(small.LAW.peak, rel=0.01)
    for t in small.EXPOSURES:
        width = small.LAW.p1 * np.log(t) + small.LAW.p2
        assert model.law.p1 * np.log(t) + model.law.p2 == pytest.approx(width, abs=0.1)
    assert (model.rows, model.columns, model.longest_s) == (small.SIDE, small.SIDE, 4e-4)
    for shot, (x, y) in zip(shots, truth[:, 2:], strict=True):
        spot = model.spots[Site(shot.angle_deg, None, shot.repeat, ())]
        assert (spot.x_px, spot.y_px) == (pytest.approx(x, abs=0.1), pytest.approx(y, abs=0.1))


def test_a_verdict_that_names_nothing_has_the_declared_model(agreed, tmp_path):
    """Its law as the frames fit it, without effects and light; what unseen frames refuted is left out as well."""
    own, _, setting, _ = agreed
    instrument = small.dataset(tmp_path / "set").instrument
    for each in (own, own._replace(found=(found("smear", 0.01),), beyond=("smear",))):
        model = written(extended_of(each, setting, instrument, KNOWN), tmp_path)
        assert model.effects == () and model.lights == ()
        assert own.shift.before is not None and model.law is not None
        assert (model.law.p1, model.law.p2) == pytest.approx(own.shift.before, abs=1e-3)
        assert model.law.peak_dn == pytest.approx(small.LAW.peak, rel=0.01)


@pytest.mark.parametrize("name", ["speckle", "power_fluctuation", "pointing_jitter", "row_noise", "fixed_pattern"])
def test_components_of_variance_are_in_the_model(name, agreed, tmp_path):
    """With the values that the verdict reports, whatever they are, and readable again."""
    own, _, setting, _ = agreed
    told = COMPONENTS.get(vocabulary()[name].component, len(vocabulary()[name].parameters))
    own = own._replace(found=(found(name, *[0.5, 1.2][:told]),))
    model = written(extended_of(own, setting, small.dataset(tmp_path / "set").instrument, KNOWN), tmp_path)
    values, (effect,) = document(own, "x")["effects"][0]["parameters"], model.effects
    assert values and {key: effect.parameters[key] for key in values} == {
        key: pytest.approx(entry["value"]) for key, entry in values.items()
    }


def test_the_model_of_spots_without_a_law(tmp_path):
    """Without exposures: peak and width of every frame."""
    own, truth, setting, shots = judged(small.plain, exposures=[None], angles=[None])
    instrument = small.dataset(tmp_path / "set", [None], [None]).instrument
    model = written(extended_of(own, setting, instrument, KNOWN), tmp_path)
    assert model.law is None and len(model.spots) == len(shots)
    for shot, (peak, sigma, *_) in zip(shots, truth, strict=True):
        spot = model.spots[Site(None, None, shot.repeat, ())]
        assert (spot.peak_dn, spot.sigma_px) == (pytest.approx(peak, rel=0.02), pytest.approx(sigma, rel=0.02))


@pytest.mark.parametrize("dark", [False, True])
def test_sites_that_were_kept_unseen(dark, tmp_path):
    """Of six repeats the third and the sixth: their centres come from their own frames under the model that was found,
    and are left out where those frames show no spot."""
    shots, truth, setting = small.frames(small.ghost, **(FEW | {"repeats": 6}))
    if dark:
        blank = np.full((small.SIDE, small.SIDE), small.SENSOR.black_level_dn)
        shots = [s._replace(pixels=lambda: blank) if s.repeat in (2, 5) else s for s in shots]
    own = judge(shots, setting, KNOWN)
    assert [one.own.effect.name for one in own.found] == ["ghost_reflection"] and own.light is None
    spots = extended_of(own, setting, small.dataset(tmp_path / "set", [0.0], repeats=6).instrument, KNOWN).spots
    assert {site.repeat for site in spots} == ({0, 1, 3, 4} if dark else set(range(6)))
    for shot, (x, y) in zip(shots, truth[:, 2:], strict=True):
        spot = spots.get(OldSite(0.0, None, shot.repeat, ()))
        # Single fits without the ghost lie 0.7 px off.
        assert spot is None or np.hypot(spot.x_px - x, spot.y_px - y) < 0.2


def excess(found: dataset.Dataset, model: ExtendedModel, shots: list[Shot], sensor: SensorModel, out: Path) -> float:
    """Mean square of measured less expected readings [DN²] over what noise brings: blocks of 5 × 5 px."""
    ds = simulated(found, model, out, new_sensor(sensor))
    at = {(f.angle_deg, f.exposure_s, f.repeat): index for index, f in found.cells()}
    inner, left = slice(5, -5), []
    for shot in shots:
        own = ds.isel(dict(zip(("angle", "exposure", "repeat"), at[shot[:3]], strict=True)))
        dx, dy = shot.left - int(own["left"]), shot.top - int(own["top"])
        assert max(abs(dx), abs(dy)) <= 5
        expected = np.roll(own["mean_reading"].values.astype(float), (-dy, -dx), (0, 1))[inner, inner]
        blocks = (shot.pixels()[inner, inner] - expected).reshape(10, 5, 10, 5).mean(axis=(1, 3))
        light = np.maximum(expected - sensor.black_level_dn, 0)
        variance = sensor.gain_dn_per_e * light + (sensor.gain_dn_per_e * sensor.read_noise_e) ** 2 + 1 / 12
        left.append(np.mean(blocks**2) - variance.mean() / 25)
    return float(np.mean(left))


def lobes(dx, dy, angle, exposure, sigma, spot):
    """A beam with three lobes."""
    u, v = dx / sigma, dy / sigma
    return spot * (1 + 0.05 * (u**3 - 3 * u * v * v) * np.exp(-(u * u + v * v) / 8))


def clipped(image, rng):
    """Readings that stop at 400 DN above black."""
    return np.minimum(image, 412.0)


@pytest.mark.parametrize(
    ("drawn", "name"),
    [({"light": small.ghost}, "ghost_reflection"), ({"light": small.plain, "after": clipped}, "saturation"),
     ({"light": lobes}, "beam_profile")],
)  # fmt: skip
def test_the_extended_simulation_comes_closer_to_the_frames(drawn, name, tmp_path):
    """Measured less simulated frames shrinks to a tenth of its square at the most, against the declared model as the
    frames fit it, through the file."""
    design = {"angles": [0.0], "exposures": [None], "repeats": 4}
    own, _, setting, shots = judged(**drawn, **design)
    found = small.dataset(tmp_path / "set", **design)
    assert [row["name"] for row in document(own, "x")["effects"]] == [name] and own.fits is not None
    declared = own._replace(found=(), light=None, fits=own.fits._replace(after=own.fits.before))
    before, after = (
        excess(found, written(extended_of(each, setting, found.instrument, KNOWN), tmp_path), shots, setting.sensor,
               tmp_path / "out")
        for each in (declared, own)
    )  # fmt: skip
    assert abs(after) < before / 10, (before, after)
