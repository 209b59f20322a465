"""What was learned of an instrument, written into a file that another dataset uses."""

import json
import shutil
from dataclasses import asdict, replace

import numpy as np
import pytest
import xarray as xr

from spotcheck.characterization.sensor_choice import SHEET, SOURCES, read_standard_errors
from spotcheck.cli import main, run
from spotcheck.cli.pipeline import judge_dataset
from spotcheck.dataset.instrument import BadPixels, Instrument, Sensor, read_instrument
from spotcheck.errors import InputError
from spotcheck.export.bad_pixels import find_bad_pixels
from spotcheck.export.instrument_file import write_instrument_file
from spotcheck.export.learned_values import LearnedValue, collect_learned_values
from spotcheck.export.value_choice import choose_values
from spotcheck.fitting.crop_fits import fit_crops
from spotcheck.io import store
from spotcheck.io.schema import find_violation
from spotcheck.model.baseline import Baseline
from spotcheck.model.conditions import FrameConditions, crop_grid
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.effect_file import EXAMPLE
from spotcheck.model.effects import built_in
from spotcheck.model.forward import SENSOR_STAGES, ExpectedReading, ForwardModel
from spotcheck.model.light_shape import LightShape
from spotcheck.model.model_writer import LightFile, write_light
from spotcheck.sensor import SensorModel
from tests.reference.numpy_chain import draw
from tests.samples.small_datasets import SENSOR, crops_of, gaussian, loaded, noisy

# Effects.


GRID = crop_grid(range(48), range(44), 48, 44)
FRAME = FrameConditions(GRID, 23.3, 20.6, 1e-3, 1e-3, 1e-3, peak_dn=640.0, sigma_px=8.0)


def moments(effects: tuple[AppliedEffect, ...], sensor: SensorModel) -> ExpectedReading:
    """Return mean and variance of the readings of a spot as bright as the starting values of effects expect."""
    return ForwardModel(Baseline(0.0, "free", False, 1e-3), sensor, None, effects).expected(FRAME)


@pytest.mark.parametrize("name", built_in())
def test_instrument_keys_of_an_effect_do_what_it_does(name):
    """Of every effect and variant: a sensor with the keys reads, without the effect, as with it.

    The keys are those of an instrument file. Mean to a thousandth of a DN and variance to one percent: both tables are
    interpolated. An effect that acts on shape or light has none.
    """
    effect = built_in()[name]
    start = (effect.starts(EXAMPLE) or [(1.0,) * len(effect.parameters)])[0]
    has_keys = []
    for variant in effect.variants:
        applied = AppliedEffect(effect, variant, tuple(map(float, start)))
        keys = {key.partition(".")[2]: value for key, value in applied.instrument_keys(SENSOR).items()}
        if "full_scale_dn" in keys:
            # A converter stops at a whole number.
            applied = applied.with_value("level", round(applied.parameters["level"]))
            keys = {key.partition(".")[2]: value for key, value in applied.instrument_keys(SENSOR).items()}
        assert find_violation({"sensor": keys}, "instrument") is None
        if keys:
            has_keys.append(variant)
            by_effect, by_sensor = moments((applied,), SENSOR), moments((), replace(SENSOR, **keys))
            assert by_effect.mean == pytest.approx(by_sensor.mean, abs=1e-3)
            assert by_effect.variance == pytest.approx(by_sensor.variance, rel=1e-2, abs=1e-3)
    assert bool(has_keys) == (effect.instrument_keys is not None)
    # Behind the pixels' own gains: effects on shape or light have no key.
    assert not has_keys or set(effect.stages) & set(SENSOR_STAGES[1:])


# Choices.

SHEET_OF = Instrument(
    sensor=Sensor(gain_dn_per_e=0.11, read_noise_e=13.0, black_level_dn=20.0, black_level_dn_stderr=0.5),
    given_keys=frozenset({"sensor.gain_dn_per_e", "sensor.read_noise_e", "sensor.black_level_dn"}),
)
FLATS, SPOTS = "flats and darks (sensor.nc)", "spots (sensor.nc)"
NO_EFFICIENCY = "key sensor.quantum_efficiency is 1.2; it must be at most 1"


@pytest.mark.parametrize(
    ("key", "value", "stderr", "source", "overrules", "is_adopted", "reason"),
    [
        ("gain_dn_per_e", 0.112, 0.001, FLATS, False, False, "agrees with the sheet within 2.0 errors"),
        ("gain_dn_per_e", 0.114, 0.001, FLATS, False, True, "contradicts the sheet by 4.0 errors"),
        ("gain_dn_per_e", 0.2, 0.001, SPOTS, False, False, "spots alone do not overrule a sheet"),
        ("gain_dn_per_e", 0.2, np.nan, FLATS, False, False, "its error is not known"),
        ("read_noise_e", 15.0, 0.1, "excess (verdict.json)", True, True, "contradicts the sheet"),
        ("black_level_dn", 20.2, 0.1, FLATS, False, True, "known better than the sheet states"),
        ("black_level_dn", 20.2, 0.9, FLATS, False, False, "agrees with the sheet within 0.2 errors"),
        ("dark_current_e_per_s", 70.0, 9.0, SPOTS, False, True, "the sheet does not say"),
        ("quantum_efficiency", 1.2, 0.1, FLATS, False, False, NO_EFFICIENCY),
    ],
)
def test_what_a_sheet_states_gives_way(key, value, stderr, source, overrules, is_adopted, reason):
    """Where it says nothing, is contradicted beyond three errors, or is known worse; never to spots alone."""
    learned = LearnedValue(f"sensor.{key}", value, stderr, "1", source, overrules, is_from_spots=source == SPOTS)
    (choice,) = choose_values([learned], SHEET_OF)
    assert (choice.is_adopted, choice.reason) == (is_adopted, reason)


# The whole way.


@pytest.fixture(scope="module")
def judged(shelf, tmp_path_factory):
    """Results folder of the flats that the API page speaks of."""
    results = tmp_path_factory.mktemp("judged")
    judge_dataset(shelf / "my-flats", results)
    return results / "my-flats"


def test_from_flats_to_a_dataset_of_spots(judged, tmp_path, capsys):
    """What flats tell is written, and a dataset of spots that is based on the file uses it with its errors.

    The camera's numbers, which the flats were drawn with, lie within 4.5 errors of what is used (false alarm 7e-6)."""
    main(["adopt", str(judged), "--to", str(tmp_path / "cameras" / "camera.yaml")])
    assert "sensor.gain_dn_per_e" in capsys.readouterr().out
    camera = SensorModel(0.3, 9.0, black_level_dn=30.0, full_scale_dn=4095.0)
    images = [noisy(gaussian(64, 900.0, 31.5, 32.2, 4.0), k, camera) for k in range(3)]
    data = loaded(tmp_path / "spots", images, "{based_on: ../cameras/camera.yaml, crop_px: 48}")
    main(["check", str(data.folder)])
    files = {name: str(tmp_path / f"{name}.nc") for name in ("frames", "sensor")}
    run(["ingest", str(data.folder), "--output", files["frames"]])
    crops_of(data)
    inputs = ["--frames", files["frames"], "--crops", str(data.folder / "crops.nc")]
    run(["sensor", str(data.folder), *inputs, "--output", files["sensor"]])
    with store.read(files["sensor"]) as used:
        for name, truth in (("gain_dn_per_e", 0.3), ("read_noise_e", 9.0), ("black_level_dn", 30.0)):
            value, error = float(used[name]), float(used[f"{name}_stderr"])
            assert used[name].attrs["source"] == "camera.yaml, on which instrument.yaml is based"
            assert 0 < error < 0.1 * truth and abs(value - truth) < 4.5 * error
            assert float(used[f"{name}_by"].sel(source=SHEET)) == value
        assert min(read_standard_errors(used)) > 0


def test_nothing_is_overwritten_or_made_up(judged, shelf, tmp_path, capsys):
    """Without `--to` a table; a file that is there stays; a folder without results is refused."""
    main(["adopt", str(judged)])
    assert "nothing is written" in capsys.readouterr().out
    (tmp_path / "camera.yaml").write_text("name: mine\n", encoding="utf-8")
    with pytest.raises(InputError, match="is already there; name a new file"):
        run(["adopt", str(judged), "--to", str(tmp_path / "camera.yaml")])
    assert (tmp_path / "camera.yaml").read_text(encoding="utf-8") == "name: mine\n"
    for base in (shelf / "my-flats", tmp_path / "nowhere"):
        with pytest.raises(InputError, match="holds no results of a dataset"):
            run(["adopt", str(base)])


def test_flats_need_no_verdict(judged, tmp_path, capsys):
    """What they measured is adopted as with one, and what is missing is said; results without a number are refused."""
    bare = shutil.copytree(judged, tmp_path / "bare")
    (bare / "verdict.json").unlink()
    kept = {}
    for results in (judged, bare):
        run(["adopt", str(results)])
        table = capsys.readouterr().out
        kept[results] = [line for line in table.splitlines() if "(transfer.nc)" in line]
    assert kept[bare] == kept[judged] != []
    assert "there is no verdict yet" in table
    for path in bare.glob("*.nc"):
        path.unlink()
    with pytest.raises(InputError, match="says nothing about the instrument; run the workflow on"):
        run(["adopt", str(bare)])


def test_the_file_is_that_of_the_instrument(judged, shelf, tmp_path):
    """What the sheet states beside stays, what belongs to the dataset does not go in, and equal results give equal
    files."""
    for name in ("a.yaml", "b.yaml"):
        run(["adopt", str(judged), "--to", str(tmp_path / name)])
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()
    made = read_instrument(tmp_path / "a.yaml")
    assert made.sensor.bit_depth == 12 and made.name is None
    learned, _ = collect_learned_values(judged, read_instrument(shelf / "my-flats" / "instrument.yaml"))
    errors = {f"sensor.{name}_stderr" for name in ("gain_dn_per_e", "read_noise_e", "black_level_dn")}
    assert made.given_keys == {value.key for value in learned} | {"sensor.bit_depth"} | errors


def named(name, form, *rivals, **parameters):
    """An effect of a verdict: value, error and unit of each parameter."""
    told = {key: dict(zip(("value", "stderr", "unit"), own, strict=True)) for key, own in parameters.items()}
    return {"name": name, "form": form, "candidates": [name, *rivals], "parameters": told}


def test_effects_and_light_of_a_verdict(tmp_path):
    """An effect goes in with its error carried over, in the sensor's numbers that were learned beside it; a rival, a
    form without a key and lights of several poses stay out with the reason; one light is copied beside the file."""
    effects = [
        named("saturation", "sharp", level=(440.0, 2.2, "DN")),
        named("excess_read_noise", "", "row_noise", total=(17.0, 0.4, "e-")),
        named("dark_offset", "light", level=(3.0, 0.1, "DN")),
    ]
    sheet = {"name": "gain_dn_per_e", "unit": "DN/e-", "source": "data sheet", "found": 0.22, "stderr": 0.001}
    sheet["contradicts"] = True
    verdict = {"effects": effects, "sheet": [sheet], "light": {"words": "6 % of its power lies elsewhere"}}
    results, given = tmp_path / "results", Instrument(sensor=Sensor(gain_dn_per_e=0.11), given_keys=frozenset())
    results.mkdir()
    (results / "verdict.json").write_text(json.dumps(verdict), encoding="utf-8")
    sensor = xr.Dataset({name: ((), value) for name, value in asdict(SENSOR).items()})
    for name in asdict(SENSOR):
        sensor[name].attrs.update(units="1", long_name=name, infinite="none is")
        for part in ("by", "by_stderr"):
            sensor[f"{name}_{part}"] = ("source", [np.nan] * 3, {"units": "1", "long_name": name})
    sensor["source"] = ("source", list(SOURCES), {"units": "1", "long_name": "source"})
    store.write(sensor.assign_attrs(title="t", dataset="d"), results / "sensor.nc", code="c")
    shape = LightShape(0.25, np.zeros((6, 6)))
    for count in (2, 1):
        write_light([shape] * count, LightFile(results / "light.nc", "d", code="c"))
        learned, left = collect_learned_values(results, given)
        own = {one.key: one for one in learned}
        assert (own["sensor.gain_dn_per_e"].value, own["sensor.full_well_e"].value) == (0.22, pytest.approx(2000))
        assert own["sensor.full_well_e"].stderr == pytest.approx(2.2 / 0.22)
        why = {result.name: result.reason for result in left}
        assert why["excess_read_noise"] == "it may as well be row_noise"
        assert why["dark_offset"] == "no key of an instrument file holds it"
        assert ("light" in why) == (count == 2) and ("light.profile" in own) == (count == 1)
    choices = choose_values(learned, given)
    assert all(choice.is_adopted for choice in choices)
    write_instrument_file(tmp_path / "camera.yaml", choices, left, given, results)
    made = read_instrument(tmp_path / "camera.yaml")
    assert made.light.profile == str(tmp_path / "camera-light.nc")
    assert (made.sensor.full_well_e, made.sensor.gain_dn_per_e_stderr) == (2000, 0.001)
    assert "excess_read_noise" in (tmp_path / "camera.yaml").read_text(encoding="utf-8")


def test_pixels_that_frame_after_frame_leaves_out_are_bad(tmp_path):
    """A hot pixel of the sensor and a column are, wherever the crops lie; what hits one frame alone is not."""
    images, rng = [], np.random.default_rng(3)
    for k in range(4):
        x, y = 50 + 4 * k, 48 - 3 * k
        image = draw(gaussian(100, 500.0, x, y, 5.0), 1e-4, SENSOR, rng)
        image[52, 44] = 900
        image[:, 60] = 1000
        images.append(image)
    images[1][40, 47] = 800
    data = loaded(tmp_path / "data", images, "{crop_px: 60}")
    crops = crops_of(data)
    found = find_bad_pixels(fit_crops(crops, SENSOR), crops, SENSOR)
    assert found == (BadPixels(columns=(60,), pixels=((44, 52),)), 4)


# Files below files.


def test_keys_of_a_shared_file_hold_where_there_is_none(tmp_path):
    """The dataset's own keys win, section by section; paths are those from each file's own folder."""
    (tmp_path / "lab").mkdir()
    write_light([LightShape(0.25, np.zeros((6, 6)))], LightFile(tmp_path / "lab" / "light.nc", "d", code="c"))
    shared = "{crop_px: 64, sensor: {gain_dn_per_e: 0.2, read_noise_e: 9}, light: {profile: light.nc}}"
    (tmp_path / "lab" / "camera.yaml").write_text(shared, encoding="utf-8")
    own = "{based_on: lab/camera.yaml, sensor: {read_noise_e: 11}}"
    (tmp_path / "instrument.yaml").write_text(own, encoding="utf-8")
    made = read_instrument(tmp_path / "instrument.yaml")
    assert (made.sensor.gain_dn_per_e, made.sensor.read_noise_e, made.crop_px) == (0.2, 11.0, 64)
    assert made.light.profile == str(tmp_path / "lab" / "light.nc")
    assert {"sensor.gain_dn_per_e", "sensor.read_noise_e", "crop_px"} < made.given_keys


@pytest.mark.parametrize(
    ("shared", "said"),
    [
        (None, "instrument.yaml: key based_on names 'camera.yaml', which is not there"),
        ("{based_on: instrument.yaml}", "names camera.yaml, which has such a key itself"),
        ("{sensor: {bits: 9}}", "camera.yaml: unknown key sensor.bits"),
    ],
)
def test_shared_files_that_cannot_be_used(shared, said, tmp_path):
    """One sentence that names the file that is wrong."""
    (tmp_path / "instrument.yaml").write_text("based_on: camera.yaml\n", encoding="utf-8")
    if shared:
        (tmp_path / "camera.yaml").write_text(shared, encoding="utf-8")
    with pytest.raises(InputError, match=said):
        read_instrument(tmp_path / "instrument.yaml")
