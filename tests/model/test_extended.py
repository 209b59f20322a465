"""The extended model: what does not fit is refused, and a simulated dataset is what the model says."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from spotcheck.cli import main
from spotcheck.dataset import folder as dataset
from spotcheck.dataset import frames
from spotcheck.dataset.instrument import read_instrument
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.model import simulation
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.light import ExposureLaw
from spotcheck.model.model_file import ExtendedModel, Site, Spot, read_model
from spotcheck.sensor import SensorModel
from tests.samples.model_files import applied, model_text
from tests.samples.small_datasets import HEADER

SENSOR = SensorModel(0.11, 8.0, 40.0, np.inf, 20.0, 1023.0)
EXPOSURES, SIDE = (1e-4, 3e-4, 9e-4), 48
INSTRUMENT = "name: three times\ncrop_px: 48\nsensor: {bit_depth: 10, pixel_pitch_m: 5.5e-6}\n"
LAW = ExposureLaw(0.8, 11.0, 600.0)
CENTRES = {(0.0, 0): (70.25, 61.5), (0.0, 1): (73.0, 60.0), (90.0, 0): (68.5, 66.0), (90.0, 1): (71.0, 58.25)}
SPOTS = {Site(a, None, r, ()): Spot(*xy) for (a, r), xy in CENTRES.items()}
PLAIN = ExtendedModel(LAW, 9e-4, 3e-4, 130, 150, (), SPOTS)
GHOST = applied("ghost_reflection", fraction=0.12, dx=31.0, dy=-17.0)
SMEAR = applied("smear", fraction=0.01)


def with_effects(*effects: AppliedEffect, **changes) -> ExtendedModel:
    """Return the plain model with effects."""
    return replace(PLAIN, effects=effects, **changes)


def design(base: Path, instrument: str = INSTRUMENT, header: str = HEADER, more: str = "") -> dataset.Dataset:
    """Two angles, two sites each, three exposures; no frames."""
    rows = [f"frames/{a:g}_{r}_{t:g}.tif,spot,{a:g},{t:g},{r}{more}" for a, r in CENTRES for t in EXPOSURES]
    base.mkdir(parents=True, exist_ok=True)
    (base / "manifest.csv").write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    (base / "instrument.yaml").write_text(instrument, encoding="utf-8")
    return dataset.load(base)


def simulated(found: dataset.Dataset, model: ExtendedModel, out: Path, sensor: SensorModel = SENSOR, seed: int = 3):
    """Run the stage; what comes back is the file of expectations."""
    path = out.with_suffix(".nc")
    simulation.simulate_extended(found, model, sensor, simulation.Destination(out, path, seed, "c", []), "model.yaml")
    with store.read(path) as ds:
        return ds.load()


# A model that does not fit.

MISFITS = {
    "above its bound": (with_effects(applied("smear", fraction=7.0)), "", ["fraction of smear is 7", "from 0 to 5"]),
    "below its bound": (
        with_effects(applied("beam_ellipticity", ratio=0.5, direction=0)),
        "",
        ["ratio", "0.5", "from 1 to 4"],
    ),
    "bound of the design": (
        with_effects(applied("shutter_offset", offset=-8e-5)),
        "",
        ["-8e-05 s", "from -5e-05 to 5e-05"],
    ),
    "bound of the sensor": (with_effects(applied("excess_read_noise", total=3.0)), "", ["total", "3 e-", "from 8"]),
    "law for free spots": (PLAIN, "model: {photon_budget: free}\n", ["has a law", "budget free"]),
    "small frame": (replace(PLAIN, rows=40), "", ["150 × 40 px", "crop_px is 48"]),
    "no width": (replace(PLAIN, law=ExposureLaw(3.0, 12.0, 600.0)), "", ["0_0_0.0001.tif", "width", "above 0"]),
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
    out = simulated(found, with_effects(SMEAR), tmp_path / "out")
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
    assert frames.read_image(again, again.frames[0]).shape == (66 + 48 + 1 - 10, 73 + 48 + 1 - 20)
    assert (out.attrs["window_left_px"], out.attrs["window_top_px"], out.attrs["effects"]) == (20, 10, "smear")


def test_equal_seeds_give_equal_folders(tmp_path):
    """Byte by byte; another seed gives other frames and the same expectation."""
    found, model = (
        design(tmp_path / "in"),
        with_effects(applied("speckle", contrast=0.2, grain=3.0), applied("power_fluctuation", rms=0.03)),
    )
    kept = [simulated(found, model, tmp_path / name, seed=seed) for name, seed in (("a", 3), ("b", 3), ("c", 4))]
    stacks = [(tmp_path / name / simulation.STACK).read_bytes() for name in "abc"]
    assert stacks[0] == stacks[1] != stacks[2]
    np.testing.assert_array_equal(kept[0]["mean_reading"], kept[2]["mean_reading"])


def test_light_follows_the_order_of_acquisition(tmp_path):
    """Laser drift: the peak of the last frame is 1 + total of what it would be; the middle's where the order is
    unknown."""
    drift = with_effects(applied("laser_drift", total=0.3))
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
    out = simulated(found, replace(PLAIN, spots=first), tmp_path / "out")
    assert int(out["left"].isel(angle=1, exposure=0, repeat=0)) == round((70.25 + 73) / 2) - SIDE // 2
    out = simulated(found, replace(PLAIN, spots={}), tmp_path / "out")
    assert set(out["left"].values.ravel()) == {round(149 / 2) - SIDE // 2}


def test_without_a_law_each_frame_has_its_own_spot(tmp_path):
    """A frame without one stays dark; conditions tell frames apart."""
    text = INSTRUMENT + "conditions: [z_m]\nmodel: {photon_budget: free}\n"
    found = design(tmp_path / "in", text, f"{HEADER},z_m", ",0.25")
    spots = {
        Site(a, t, r, (("z_m", 0.25),)): Spot(70.0, 60.0, 300.0 + 10 * k, 5.0 + k)
        for k, (a, r, t) in enumerate([(0.0, 0, 1e-4), (90.0, 1, 9e-4)])
    }
    out = simulated(found, replace(PLAIN, law=None, spots=spots), tmp_path / "out").isel(z_m=0)
    assert [float(out[name].isel(angle=1, exposure=2, repeat=1)) for name in ("amplitude", "sigma")] == [310.0, 6.0]
    assert float(out["mean_light"].isel(angle=0, exposure=0, repeat=0).max()) == pytest.approx(300.0)
    assert float(out["mean_light"].isel(angle=0, exposure=1, repeat=0).max()) == 0


def test_the_command(tmp_path, capsys):
    """`simulate --model` end to end; what it cannot do ends in one sentence and status 2."""
    found = design(tmp_path / "in")
    model = tmp_path / "model.yaml"
    model.write_text(model_text(with_effects(SMEAR)), encoding="utf-8")
    sensor = store.make_grid(found).drop_vars([axis.name for axis in found.axes])
    for field in fields(SENSOR):
        name = field.name
        sensor[name] = ((), getattr(SENSOR, name), {"units": "1", "long_name": name})
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
        (["--model", str(model), "--fits", "fits.nc"], "leave out --calibration and --fits"),
        (["--model", str(model), "--seed", "-1"], "--seed: is -1"),
    )
    for words, sentence in calls:
        with pytest.raises(SystemExit) as stopped:
            main(["simulate", str(found.folder), *rest, *words])
        assert stopped.value.code == 2
        said = capsys.readouterr().err
        assert said.startswith("spotcheck: ") and said.count("\n") == 1 and sentence in said, said
