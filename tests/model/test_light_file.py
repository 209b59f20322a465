"""light.nc: written and read again, refused where it is wrong, named by model.yaml and instrument.yaml, simulated."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr

from spotcheck.cli import main
from spotcheck.dataset import folder as dataset
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.model.baseline import build_baseline
from spotcheck.model.design import simulate_dataset
from spotcheck.model.light_shape import LIGHT, LightShape, read_light, read_lights
from spotcheck.model.model_file import ExtendedModel, read_model
from spotcheck.model.model_writer import LightFile, write_light
from spotcheck.model.simulation import STACK
from tests.model.test_extended import (
    CENTRES,
    EXPOSURES,
    INSTRUMENT,
    LAW,
    PLAIN,
    SENSOR,
    SIDE,
    design,
    simulated,
    with_effects,
)
from tests.samples.model_files import applied, model_text
from tests.samples.splines import along

# No symmetry, and a third of the peak, so that no axis can stand for another.
SHAPE = LightShape(0.4, np.random.default_rng(3).normal(0, 0.02, (21, 21)) + 0.1 * np.eye(21, k=3))
PROFILE = applied("beam_profile", power=0.06, order=3)


def put(path: Path, shape: LightShape = SHAPE) -> Path:
    """Write the file of a shape and return its path."""
    write_light([shape], LightFile(path, "d", "c", attributes={"power": 0.06}))
    return path


def by_scipy(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Σ c b(v) b(u) at columns u and rows v [row, column]."""
    across, along_u = (along(places, SHAPE.step, 21) for places in (v, u))
    return across @ SHAPE.coefficients @ along_u.T


def test_what_is_written_is_read(tmp_path):
    """To the last digit; the map is the surface at its own coordinates, rows downwards; what describes it stands by."""
    own = read_light(put(tmp_path / LIGHT))
    assert own.step == SHAPE.step
    np.testing.assert_array_equal(own.coefficients, SHAPE.coefficients)
    with store.read(tmp_path / LIGHT) as ds:
        assert ds["s"].dims == ("light", "v", "u") and ds.attrs["power"] == 0.06 and ds.attrs["code_version"] == "c"
        np.testing.assert_allclose(ds["s"].values[0], by_scipy(ds["u"].values, ds["v"].values), atol=1e-7)


def test_structure_between_the_nodes_is_read_again(tmp_path):
    """It is part of the light at every place, also beside a light without one."""
    finer = LightShape(0.1, np.random.default_rng(4).normal(0, 0.01, (15, 15)))
    both = LightShape(SHAPE.step, SHAPE.coefficients, finer)
    write_light([both, SHAPE], LightFile(tmp_path / LIGHT, "d", "c"))
    u, v = np.linspace(-1, 1, 9)[None, :], np.linspace(-1, 1, 7)[:, None]
    for found, put_in in zip(read_lights(tmp_path / LIGHT), (both, SHAPE), strict=True):
        np.testing.assert_array_equal(found(u, v), put_in(u, v))
    np.testing.assert_array_equal(both(u, v), SHAPE(u, v) + finer(u, v))


def changed(**values):
    """A file with other values of some variables."""

    def change(path: Path) -> None:
        with store.read(put(path)) as ds:
            ds = ds.load()
        for name, value in values.items():
            ds[name] = ds[name].copy(data=value) if np.ndim(value) else ds[name] * 0 + value
        store.write(ds, path, code="c")

    return change


def other(path: Path) -> None:
    """A result of another kind."""
    own = {"units": "1", "long_name": "x"}
    store.write(xr.Dataset({"x": ("x", [1.0], own)}, attrs={"title": "T", "dataset": "d"}), path, code="c")


def narrow(path: Path) -> None:
    """A surface with fewer columns than rows."""
    with store.read(put(path)) as ds:
        ds = ds.load().isel(node_u=slice(1, None))
    store.write(ds, path, code="c")


BAD = {
    "none": (lambda path: None, "is no file"),
    "a folder": (lambda path: path.mkdir(), "is no file"),
    "text": (lambda path: path.write_text("u v s"), "holds no shape"),
    "another result": (other, "holds no shape"),
    "no square": (narrow, "make no shape"),
    "no numbers": (changed(coefficients=np.full((1, 21, 21), np.nan)), "make no shape"),
    "no step": (changed(step=0.0), "make no shape"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_gets_one_sentence(case, tmp_path):
    """With its name, what is wrong and what would be right."""
    make, words = BAD[case]
    make(tmp_path / LIGHT)
    with pytest.raises(InputError) as caught:
        read_light(tmp_path / LIGHT)
    said = str(caught.value)
    assert said.startswith("light.nc: ") and words in said and "\n" not in said and ("name a" in said or "must" in said)


# model.yaml.


def model_file(folder: Path, model: ExtendedModel, edit: tuple[str, str] = ("", "")) -> Path:
    """The file of a model, with its light beside it."""
    if model.lights:
        put(folder / LIGHT)
    path = folder / "model.yaml"
    path.write_text(model_text(model).replace(*edit), encoding="utf-8")
    return path


def test_a_model_names_its_light(tmp_path):
    """Text, effect and surface come back."""
    path = model_file(tmp_path, with_effects(PROFILE, lights=(SHAPE,)))
    own = read_model(path)
    assert model_text(own) == path.read_text(encoding="utf-8")
    assert "\nlight: light.nc\n" in path.read_text(encoding="utf-8") and own.effects == (PROFILE,)
    (light,) = own.lights
    np.testing.assert_array_equal(light.coefficients, SHAPE.coefficients)
    assert read_model(model_file(tmp_path, PLAIN)).lights == ()


@pytest.mark.parametrize(
    ("cases", "lights", "edit", "words"),
    [
        ([PROFILE], (), ("", ""), "key light is missing; beam_profile needs the file of its shape"),
        ([], (SHAPE,), ("", ""), "key light names light.nc, but no effect stands for its shape"),
        ([PROFILE], (SHAPE,), ("light.nc", "none.nc"), "none.nc: is no file"),
        ([PROFILE], (SHAPE,), ("light: light.nc", "light: 3"), "key light is 3; it must be text"),
    ],
)
def test_a_model_without_the_light_that_it_needs(cases, lights, edit, words, tmp_path):
    """One sentence."""
    path = model_file(tmp_path, with_effects(*cases, lights=lights), edit)
    with pytest.raises(InputError) as caught:
        read_model(path)
    assert words in str(caught.value) and "\n" not in str(caught.value)


# Simulated frames.


def spot(centre: tuple[float, float], exposure: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Light A (B + s) [row, column] of a spot by numpy and scipy alone, under the law t/σ²."""

    def width(t):
        return LAW.p1 * np.log(t) + LAW.p2

    u, v = ((own - at) / width(exposure) for own, at in zip((x, y), centre, strict=True))
    peak = LAW.peak_dn * exposure / width(exposure) ** 2 * width(EXPOSURES[-1]) ** 2 / EXPOSURES[-1]
    return peak * (np.exp(-(u[None, :] ** 2) / 2) * np.exp(-(v[:, None] ** 2) / 2) + by_scipy(u, v))


def follows(folder: Path, ds: xr.Dataset) -> None:
    """Every frame's mean light is that by hand, and its readings scatter about it as shot and read noise do: 12 frames,
    χ² of each within 5 standard deviations (false alarm 1e-5)."""
    stack = tifffile.imread(folder / STACK)
    left, top = ds.attrs["window_left_px"], ds.attrs["window_top_px"]
    rows = [(angle, repeat, t) for angle, repeat in CENTRES for t in EXPOSURES]
    for frame, (angle, repeat, t) in zip(stack, rows, strict=True):
        own = ds.sel(angle=angle, repeat=repeat, exposure=t)
        x, y = (int(own[name]) + np.arange(float(SIDE)) for name in ("left", "top"))
        want = spot(CENTRES[angle, repeat], t, x, y)
        np.testing.assert_allclose(own["mean_light"], want, atol=1e-4)
        gain, read = SENSOR.gain_dn_per_e, SENSOR.gain_dn_per_e * SENSOR.read_noise_e
        mean = want + gain * SENSOR.dark_current_e_per_s * t + SENSOR.black_level_dn
        seen = frame[int(y[0]) - top :, int(x[0]) - left :][:SIDE, :SIDE]
        bright = want > 0
        chi2 = ((seen - mean) ** 2 / (gain * np.maximum(want, 0) + read**2 + 1 / 12))[bright]
        assert abs(chi2.sum() - chi2.size) < 5 * np.sqrt(2 * chi2.size)


def test_simulated_frames_follow_the_model(tmp_path):
    """A learned light in model.yaml, by the command's own function."""
    found = design(tmp_path / "set")
    model = read_model(model_file(tmp_path, with_effects(PROFILE, lights=(SHAPE,))))
    follows(tmp_path / "out", simulated(found, model, tmp_path / "out"))


def test_simulated_frames_follow_the_instrument(tmp_path):
    """A profile in instrument.yaml, which a simulated folder takes along, so that it can be judged in turn."""
    (tmp_path / "reference").mkdir()
    put(tmp_path / "reference" / LIGHT)
    found = design(tmp_path / "set", INSTRUMENT + "light: {profile: ../reference/light.nc}\n")
    follows(tmp_path / "out", simulated(found, PLAIN, tmp_path / "out"))
    again = dataset.load(tmp_path / "out")
    assert again.instrument.light.profile == str(tmp_path / "out" / LIGHT)
    learned = build_baseline(again.instrument, again.exposures).learned
    assert learned is not None
    np.testing.assert_array_equal(learned.coefficients, SHAPE.coefficients)


def test_a_model_replaces_the_instruments_profile(tmp_path):
    """The shape of model.yaml is the whole one beside the Gaussian."""
    put(tmp_path / "other.nc", LightShape(SHAPE.step, -SHAPE.coefficients))
    found = design(tmp_path / "set", INSTRUMENT + "light: {profile: ../other.nc}\n")
    follows(tmp_path / "out", simulated(found, with_effects(PROFILE, lights=(SHAPE,)), tmp_path / "out"))


# instrument.yaml.


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "light: {profile: none.nc}",
            "instrument.yaml: key light.profile names 'none.nc', which is not there; it must",
        ),
        ("light: {profile: ''}", "key light.profile names '', which is not there"),
        ("light: {profile: frames}", "key light.profile names 'frames', which is not there"),
        ("light: {profile: 'a{b}.nc'}", "key light.profile is 'a{b}.nc'; it must be a path without braces"),
        ("light: {profile: 3}", "key light.profile is 3; it must be text"),
        ("light: {shape: light.nc}", "unknown key light.shape; known keys here: profile"),
        ("profile: light.nc", "key profile stands outside its section; put it under `light:`"),
        ("light: {profile: text.nc}", "text.nc: holds no shape of a light; name a light.nc"),
    ],
)
def test_a_bad_profile_is_said_before_anything_runs(text, words, tmp_path, capsys):
    """By `spotcheck check`, in one sentence."""
    simulate_dataset(
        design(tmp_path / "set").folder, tmp_path / "drawn", p1_px=0.8, p2_px=11, peak_dn=600, sensor=SENSOR
    )
    (tmp_path / "drawn" / "text.nc").write_text("s", encoding="utf-8")
    with (tmp_path / "drawn" / "instrument.yaml").open("a", encoding="utf-8") as stream:
        stream.write(text + "\n")
    with pytest.raises(SystemExit) as stopped:
        main(["check", str(tmp_path / "drawn")])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1 and words in said


def test_without_a_profile_nothing_is_known():
    """An empty section is none."""
    assert build_baseline(dataset.Instrument(), []).learned is None
