"""model.yaml: written and read again, refused where it is wrong, and simulated as a dataset."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from spotcheck import dataset, frames, simulation, store
from spotcheck.cli import main
from spotcheck.errors import InputError
from spotcheck.instrument import read_instrument
from spotcheck.model.chain import Law
from spotcheck.model.effects import vocabulary
from spotcheck.model.extended import Extended, Site, Spot, no_model, read_model, text_of
from spotcheck.model.sensor import SensorModel
from tests.library.conftest import HEADER
from tests.library.effect_cases import GHOST, of, present
from tests.library.test_exposed import SCATTERED, STEADY

SENSOR = SensorModel(0.11, 8.0, 40.0, np.inf, 20.0, 1023.0)
EXPOSURES, SIDE = (1e-4, 3e-4, 9e-4), 48
INSTRUMENT = "name: three times\ncrop_px: 48\nsensor: {bit_depth: 10, pixel_pitch_m: 5.5e-6}\n"
LAW = Law(0.8, 11.0, 600.0)
CENTRES = {(0.0, 0): (70.25, 61.5), (0.0, 1): (73.0, 60.0), (90.0, 0): (68.5, 66.0), (90.0, 1): (71.0, 58.25)}
SPOTS = {Site(a, None, r, ()): Spot(*xy) for (a, r), xy in CENTRES.items()}
PLAIN = Extended(LAW, 9e-4, 3e-4, 130, 150, (), SPOTS)


def extended(*cases, **changes) -> Extended:
    """A model with effects."""
    return PLAIN._replace(present=tuple(present(cases)), **changes)


def design(base: Path, instrument: str = INSTRUMENT, header: str = HEADER, more: str = "") -> dataset.Dataset:
    """Two angles, two sites each, three exposures; no frames."""
    rows = [f"frames/{a:g}_{r}_{t:g}.tif,spot,{a:g},{t:g},{r}{more}" for a, r in CENTRES for t in EXPOSURES]
    base.mkdir(parents=True, exist_ok=True)
    (base / "manifest.csv").write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    (base / "instrument.yaml").write_text(instrument, encoding="utf-8")
    return dataset.load(base)


def simulated(found: dataset.Dataset, model: Extended, out: Path, sensor: SensorModel = SENSOR, seed: int = 3):
    """Run the stage; what comes back is the file of expectations."""
    path = out.with_suffix(".nc")
    simulation.simulate_extended(found, model, sensor, out, path, name="model.yaml", seed=seed, code="c", inputs=[])
    with store.read(path) as ds:
        return ds.load()


# The file.

EVERY = [*STEADY, *SCATTERED.values()]


@pytest.mark.parametrize("name", vocabulary())
def test_what_is_written_is_read(name, tmp_path):
    """Every effect, every form that the tests of frames draw: names, forms and all that acts, to nine digits."""
    for case in [case for case in EVERY if case.name == name]:
        text = text_of(extended(case), 'a "name": of frames', "named")
        (tmp_path / "model.yaml").write_text(text, encoding="utf-8")
        own = read_model(tmp_path / "model.yaml")
        assert text_of(own, 'a "name": of frames', "named") == text
        assert own._replace(present=()) == PLAIN
        (again,) = own.present
        assert (again.effect.name, again.form) == (case.name, case.form)
        acting = {key: value for key, value in again.named().items() if not math.isnan(value)}
        assert acting == {key: pytest.approx(case.values[key], rel=1e-8) for key in acting}
        idle = {p.name for p in again.effect.parameters if p.inner} & set(again.effect.idle.get(case.form, ()))
        assert set(case.values) - idle == set(acting)


def test_order_and_units(tmp_path):
    """Effects stay in the order in which they were added; the unit of every parameter stands beside it."""
    model = extended(
        of("smear", fraction=0.01), GHOST, of("background_gradient", "light", level=3, slope=2, direction=40)
    )
    (tmp_path / "m.yaml").write_text(text := text_of(model, "x", "ambiguous"), encoding="utf-8")
    names = [own.effect.name for own in read_model(tmp_path / "m.yaml").present]
    assert names == ["smear", "ghost_reflection", "background_gradient"]
    for line in ("slope: 2  # DN per 100 px", "dx: 31  # px", "fraction: 0.01", "direction: 40  # deg"):
        assert f"      {line}\n" in text
    assert yaml.safe_load(text)["law"] == {"p1_px": 0.8, "p2_px": 11.0, "peak_dn": 600.0}


def test_spots_without_a_law(tmp_path):
    """Each frame has its own; conditions and what was not recorded come back."""
    spots = {
        Site(None, None, 0, (("z_m", 0.05),)): Spot(10.5, 20.25, 400.0, 6.5),
        Site(45.0, 1e-5, 2, (("z_m", -1.0),)): Spot(11.0, 19.0, 0.0, 7.0),
    }
    model = PLAIN._replace(law=None, spots=spots)
    (tmp_path / "m.yaml").write_text(text_of(model, "x", "consistent"), encoding="utf-8")
    assert read_model(tmp_path / "m.yaml") == model


BAD = {
    "no file": (None, ["m.yaml", "is no file"]),
    "no YAML": (("law:", "law: ["), ["m.yaml line", "must be YAML"]),
    "unknown key": (("frame:", "farme:"), ["unknown key farme", "known keys here: schema"]),
    "unknown key in a section": (("p1_px", "p1_m"), ["unknown key law.p1_m", "p1_px, p2_px, peak_dn"]),
    "another schema": (("schema: 1", "schema: 2"), ["key schema is 2", "must be one of 1"]),
    "missing section": (("frame: {rows_px: 130, columns_px: 150}\n", ""), ["key frame is missing"]),
    "missing number": (("  p2_px: 11\n", ""), ["key law.p2_px is missing"]),
    "no number": (("p2_px: 11", "p2_px: wide"), ["key law.p2_px is 'wide'", "must be a number"]),
    "negative peak": (("peak_dn: 600", "peak_dn: -600"), ["law.peak_dn is -600", "above 0"]),
    "unknown effect": (("name: smear", "name: smaer"), ["effects.0.name is smaer", "no effect", "row_noise, smear"]),
    "keys of another": (("name: ghost_reflection", "name: smear"), ["effects.1.parameters has no key dx in smear"]),
    "missing parameter": (("      dy: -17  # px\n", ""), ["effects.1.parameters.dy is missing", "fraction, dx, dy"]),
    "unknown parameter": (("dy: -17", "dz: -17"), ["effects.1.parameters has no key dz", "fraction, dx, dy"]),
    "text for a parameter": (("dy: -17", "dy: up"), ["effects.1.parameters.dy is 'up'", "a number"]),
    "missing form": (("    form: power\n", ""), ["effects.2: saturation lacks its form", "sharp, soft, power"]),
    "unknown form": (("form: power", "form: round"), ["effects.2.form is round", "sharp, soft, power"]),
    "form where there is none": (("name: smear", "form: any\n    name: smear"), ["effects.0.form is any", "no forms"]),
    "infinite": (("p2_px: 11", "p2_px: .inf"), ["m.yaml", "no number to reckon with"]),
    "spot twice": (("repeat: 1, x_px: 73", "repeat: 0, x_px: 73"), ["spots.1 stands twice"]),
    "spot without a place": ((", x_px: 73", ""), ["key spots.1.x_px is missing"]),
    "spot with a width of its own": ((", x_px: 73", ", sigma_px: 4, x_px: 73"), ["spots.1 has", "which the law gives"]),
    "no law": (("law:\n  p1_px: 0.8\n  p2_px: 11\n", "law_:\n"), ["unknown key law_"]),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_gets_one_sentence(case, tmp_path):
    """File and key, what is wrong, what would be right."""
    change, words = BAD[case]
    model = extended(of("smear", fraction=0.01), GHOST, of("saturation", "power", level=500.0, knee=0.1))
    text = text_of(model, "x", "named")
    if change is not None:
        text = text.replace("  peak_dn: 600  # at the longest exposure, before effects", "  peak_dn: 600")
        assert change[0] in text
        (tmp_path / "m.yaml").write_text(text.replace(*change, 1), encoding="utf-8")
    with pytest.raises(InputError) as raised:
        read_model(tmp_path / "m.yaml")
    said = str(raised.value)
    assert said.startswith("m.yaml") and "\n" not in said
    assert all(word in said for word in words), said


def test_an_effect_twice(tmp_path):
    """One place in the chain, one strength."""
    text = text_of(extended(of("smear", fraction=0.01), of("smear", fraction=0.02)), "x", "named")
    (tmp_path / "m.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="effect smear stands twice"):
        read_model(tmp_path / "m.yaml")


def test_no_model_says_why(tmp_path):
    """Where nothing could be tested there is a file that says so, and cannot be simulated."""
    (tmp_path / "m.yaml").write_text(no_model("x: y", "there is no usable spot frame"), encoding="utf-8")
    with pytest.raises(InputError, match=r"^m.yaml: holds no model: there is no usable spot frame$"):
        read_model(tmp_path / "m.yaml")


MISFITS = {
    "above its bound": (extended(of("smear", fraction=7.0)), "", ["fraction of smear is 7", "from 0 to 5"]),
    "below its bound": (extended(of("beam_ellipticity", ratio=0.5, direction=0)), "", ["ratio", "0.5", "from 1 to 4"]),
    "bound of the design": (extended(of("shutter_offset", offset=-8e-5)), "", ["-8e-05 s", "from -5e-05 to 5e-05"]),
    "bound of the sensor": (extended(of("excess_read_noise", total=3.0)), "", ["total", "3 e-", "from 8"]),
    "law for free spots": (PLAIN, "model: {photon_budget: free}\n", ["has a law", "budget free"]),
    "small frame": (PLAIN._replace(rows=40), "", ["150 × 40 px", "crop_px is 48"]),
    "no width": (PLAIN._replace(law=Law(3.0, 12.0, 600.0)), "", ["0_0_0.0001.tif", "width", "above 0"]),
}


@pytest.mark.parametrize("case", MISFITS)
def test_a_model_that_does_not_fit(case, tmp_path):
    """Values outside their bounds, a baseline that the instrument does not have: one sentence, and no file."""
    model, more, words = MISFITS[case]
    with pytest.raises(InputError) as raised:
        simulated(design(tmp_path / "in", INSTRUMENT + more), model, tmp_path / "out")
    assert str(raised.value).startswith("model.yaml: ")
    assert all(word in str(raised.value) for word in words), raised.value
    assert not (tmp_path / "out.nc").exists() and not (tmp_path / "out" / simulation.STACK).exists()


# The simulated folder.


def test_the_simulated_folder_keeps_the_contract(tmp_path, capsys):
    """`check` and `ingest` take it; design, bits and sensor are those that were simulated, in a window of all spots."""
    found = design(tmp_path / "in")
    out = simulated(found, extended(of("smear", fraction=0.01)), tmp_path / "out")
    main(["check", str(tmp_path / "out")])
    main(["ingest", str(tmp_path / "out"), "--output", str(tmp_path / "frames.nc")])
    assert "12 spot" in capsys.readouterr().out
    again = dataset.load(tmp_path / "out")
    assert [(f.angle_deg, f.exposure_s, f.repeat) for f in again.frames] == [
        (f.angle_deg, f.exposure_s, f.repeat) for f in found.frames
    ]
    own = read_instrument(tmp_path / "out" / "instrument.yaml").sensor
    assert (own.bit_depth, own.gain_dn_per_e, own.read_noise_e, own.black_level_dn) == (10, 0.11, 8.0, 20.0)
    # 68 − 48 = 20 to 73 + 48 + 2; the frame's 130 rows end before 66 + 48 + 2.
    assert frames.read(again, again.frames[0]).shape == (66 + 48 + 1 - 10, 73 + 48 + 1 - 20)
    assert (out.attrs["window_left_px"], out.attrs["window_top_px"], out.attrs["effects"]) == (20, 10, "smear")


def test_equal_seeds_give_equal_folders(tmp_path):
    """Byte by byte; another seed gives other frames and the same expectation."""
    found, model = design(tmp_path / "in"), extended(SCATTERED["speckle"], SCATTERED["power_fluctuation"])
    kept = [simulated(found, model, tmp_path / name, seed=seed) for name, seed in (("a", 3), ("b", 3), ("c", 4))]
    stacks = [(tmp_path / name / simulation.STACK).read_bytes() for name in "abc"]
    assert stacks[0] == stacks[1] != stacks[2]
    np.testing.assert_array_equal(kept[0]["mean_reading"], kept[2]["mean_reading"])


def test_frames_scatter_about_what_is_expected(tmp_path):
    """Every crop of every frame: its sum within five standard errors of the expectation's (false alarm 6e-7 each)."""
    found = design(tmp_path / "in")
    out = simulated(found, extended(GHOST._replace(values={"fraction": 0.1, "dx": 12.0, "dy": 5.0})), tmp_path / "out")
    again = dataset.load(tmp_path / "out")
    for index, row in again.cells():
        own = out.isel(dict(zip(("angle", "exposure", "repeat"), index, strict=True)))
        left, top = int(own["left"]) - out.attrs["window_left_px"], int(own["top"]) - out.attrs["window_top_px"]
        crop = frames.read(again, row)[top : top + SIDE, left : left + SIDE].astype(float)
        want = own["mean_reading"].values.astype(float)
        variance = 0.11 * (want - 20) + 0.11**2 * 64 + 1 / 12
        assert crop.sum() == pytest.approx(want.sum(), abs=5 * np.sqrt(variance.sum()))
        x, y = CENTRES[row.angle_deg, row.repeat]
        assert abs(left + out.attrs["window_left_px"] + SIDE // 2 - x) <= 0.5
        assert abs(top + out.attrs["window_top_px"] + SIDE // 2 - y) <= 0.5


def test_light_follows_the_order_of_acquisition(tmp_path):
    """Laser drift: the peak of the last frame is 1 + total of what it would be; the middle's where the order is
    unknown."""
    drift = extended(of("laser_drift", total=0.3))
    for known, last in ((True, 1.3), (False, 1.15)):
        found = design(tmp_path / f"in{known}", INSTRUMENT + f"order_known: {str(known).lower()}\n")
        ratio = (
            simulated(found, drift, tmp_path / "out")["amplitude"]
            / simulated(found, PLAIN, tmp_path / "p")["amplitude"]
        )
        assert float(ratio.isel(angle=1, exposure=2, repeat=1)) == pytest.approx(last, rel=1e-12)


def test_sites_that_the_model_does_not_know(tmp_path):
    """Lie where the others lie on average; with no spot at all in the frame's middle."""
    found = design(tmp_path / "in")
    first = {site: spot for site, spot in SPOTS.items() if site.angle_deg == 0}
    out = simulated(found, PLAIN._replace(spots=first), tmp_path / "out")
    assert int(out["left"].isel(angle=1, exposure=0, repeat=0)) == round((70.25 + 73) / 2) - SIDE // 2
    out = simulated(found, PLAIN._replace(spots={}), tmp_path / "out")
    assert set(out["left"].values.ravel()) == {round(149 / 2) - SIDE // 2}


def test_without_a_law_each_frame_has_its_own_spot(tmp_path):
    """A frame without one stays dark; conditions tell frames apart."""
    text = INSTRUMENT + "conditions: [z_m]\nmodel: {photon_budget: free}\n"
    found = design(tmp_path / "in", text, f"{HEADER},z_m", ",0.25")
    spots = {
        Site(a, t, r, (("z_m", 0.25),)): Spot(70.0, 60.0, 300.0 + 10 * k, 5.0 + k)
        for k, (a, r, t) in enumerate([(0.0, 0, 1e-4), (90.0, 1, 9e-4)])
    }
    out = simulated(found, PLAIN._replace(law=None, spots=spots), tmp_path / "out").isel(z_m=0)
    assert [float(out[name].isel(angle=1, exposure=2, repeat=1)) for name in ("amplitude", "sigma")] == [310.0, 6.0]
    assert float(out["mean_light"].isel(angle=0, exposure=0, repeat=0).max()) == pytest.approx(300.0)
    assert float(out["mean_light"].isel(angle=0, exposure=1, repeat=0).max()) == 0


def test_the_command(tmp_path, capsys):
    """`simulate --model` end to end; what it cannot do ends in one sentence and status 2."""
    found = design(tmp_path / "in")
    model = tmp_path / "model.yaml"
    model.write_text(text_of(extended(of("smear", fraction=0.01)), "x", "named"), encoding="utf-8")
    sensor = store.grid(found).drop_vars([axis.name for axis in found.axes])
    for name, value in SENSOR._asdict().items():
        sensor[name] = ((), value, {"units": "1", "long_name": name})
    store.write(sensor, tmp_path / "sensor.nc", code="c")
    rest = ["--sensor", str(tmp_path / "sensor.nc"), "--seed", "5", "--folder", str(tmp_path / "out")]
    rest += ["--output", str(tmp_path / "out.nc")]
    main(["simulate", str(found.folder), "--model", str(model), *rest])
    assert "12 frames simulated" in capsys.readouterr().out
    by_hand = simulated(found, read_model(model), tmp_path / "hand", seed=5)
    with store.read(tmp_path / "out.nc") as ds:
        np.testing.assert_array_equal(ds["mean_reading"], by_hand["mean_reading"])
    assert (tmp_path / "out" / simulation.STACK).read_bytes() == (tmp_path / "hand" / simulation.STACK).read_bytes()
    bad = tmp_path / "bad.yaml"
    bad.write_text(model.read_text(encoding="utf-8").replace("smear", "smaer"), encoding="utf-8")
    calls = (
        (["--model", str(bad)], "bad.yaml: effects.0.name is smaer"),
        (["--model", str(tmp_path / "none.yaml")], "none.yaml: is no file"),
        ([], "give --calibration and --fits, or --model"),
        (["--model", str(model), "--fits", "fits.nc"], "give either it"),
        (["--model", str(model), "--seed", "-1"], "--seed: is -1"),
    )
    for words, sentence in calls:
        with pytest.raises(SystemExit) as stopped:
            main(["simulate", str(found.folder), *rest, *words])
        assert stopped.value.code == 2
        said = capsys.readouterr().err
        assert said.startswith("spotcheck: ") and said.count("\n") == 1 and sentence in said, said
