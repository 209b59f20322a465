"""The first look: what it says of drawn images, by function and by command, and on real ones."""

import json
import re
import webbrowser
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

import spotcheck
from spotcheck.cli import COMMANDS, main
from spotcheck.cli import open as opening
from spotcheck.dataset.metadata.file_names import natural_sort_key
from spotcheck.errors import InputError
from spotcheck.io.formats import files
from spotcheck.quicklook.images import open_images
from spotcheck.sensor import SensorModel
from tests.conftest import SHARED

SENSOR = SensorModel(0.25, 6.0, black_level_dn=20, full_scale_dn=4095)
# A beam of M² 1.3: waist, its place, wavelength and pitch [m].
WAIST, PLACE, WAVELENGTH, PITCH, M2 = 120e-6, 0.21, 632.8e-9, 8e-6, 1.3
POSITIONS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35)


def drawn(sigma=(20.0, 14.0), peak_e=9000, seed=1, shape=(300, 320), sensor=SENSOR) -> np.ndarray:
    """An image of a Gaussian along x and y, by the sensor's exact law."""
    y, x = np.indices(shape)
    x, y = (x - shape[1] / 2 - 1.3) / sigma[0], (y - shape[0] / 2 + 1.4) / sigma[1]
    return sensor.draw(peak_e * np.exp(-(x**2 + y**2) / 2), rng=seed)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """A folder with images of the beam whose names say z, the last number without leading zeros."""
    folder = tmp_path_factory.mktemp("scan")
    for seed, z in enumerate(POSITIONS):
        radius = WAIST * np.sqrt(1 + ((z - PLACE) * M2 * WAVELENGTH / (np.pi * WAIST**2)) ** 2)
        sigma = radius / 2 / PITCH
        tifffile.imwrite(folder / f"z_{1000 * z:g}mm.tif", drawn((sigma, sigma), seed=seed))
    return folder


def off(value: float, error: float, true: float) -> float:
    """By how many of its standard errors a number is off. Four are exceeded by chance once in 16,000."""
    assert error > 0
    return abs(value - true) / error


def test_widths_gain_and_noise_of_one_image():
    """All within four of their errors of what the image was drawn with, widths known to a percent, the gain to 15 %."""
    (one,), (camera,) = (found := spotcheck.look(drawn())).images, found.cameras
    for own, true in (("major", 80.0), ("minor", 56.0)):
        assert off(getattr(one.moments, own), getattr(one.moments, f"{own}_stderr"), true) < 4
        fitted, error = getattr(one.fit, f"sigma_{own}"), getattr(one.fit, f"sigma_{own}_stderr")
        assert off(4 * fitted, 4 * error, true) < 4 and error < 0.01 * fitted
    assert off(camera.gain.value, camera.gain.stderr, SENSOR.gain_dn_per_e) < 4
    # Texture too faint to be seen counts as error.
    assert camera.gain.stderr < 0.15 * SENSOR.gain_dn_per_e
    assert camera.black_level_dn == pytest.approx(20, abs=1) and one.clipping.pixels == 0
    assert "a Gaussian within the noise" in repr(found) and "elliptical" in repr(found)


def test_a_clipped_image_says_what_that_does():
    """Where the light stops, in how many pixels, and that the fit still finds the width."""
    sensor = replace(SENSOR, full_scale_dn=1023)
    image = drawn(sensor=sensor)
    (one,) = (found := spotcheck.look(image)).images
    assert one.clipping.level_dn == 1023 and one.clipping.pixels == np.count_nonzero(image == 1023) > 100
    assert off(one.fit.sigma_major, one.fit.sigma_major_stderr, 20) < 4
    # What the closed form says is what the moments show, within their error.
    excess = one.moments.major / one.clip_widening
    assert off(excess, one.moments.major_stderr, 80) < 4 and one.clip_widening > 1.02
    assert f"{one.clipping.pixels} px at 1023 DN" in repr(found)


@pytest.mark.parametrize("kind", ["TIFF", "big-endian TIFF", ".npy", "HDF5"])
def test_a_mean_of_frames_is_an_image_and_no_frame(kind, tmp_path):
    """Floating-point numbers below zero too, which a look takes from a file as from an array; no reading is one."""
    mean = np.mean([drawn(seed=seed) for seed in range(4)], axis=0).astype(np.float32) - 22
    path = tmp_path / {".npy": "a.npy", "HDF5": "a.h5"}.get(kind, "a.tif")
    if kind == ".npy":
        np.save(path, mean)
    elif kind == "HDF5":
        with h5py.File(path, "w") as file:
            file["mean"] = mean
    else:
        tifffile.imwrite(path, mean, byteorder=">" if kind.startswith("big") else "<")
    given = f"{path}#/mean" if kind == "HDF5" else path
    (one,), (array,) = spotcheck.look(given).images, spotcheck.look(mean).images
    assert (one.fit.sigma_major, one.moments.major) == (array.fit.sigma_major, array.moments.major)
    assert off(one.fit.sigma_major, one.fit.sigma_major_stderr, 20) < 4
    for ask in (files.list_pages, lambda *own: files.read_pixels(own[0], 0, own[1])):
        with pytest.raises(spotcheck.InputError, match="floating-point pixels, such as a mean of frames; it"):
            ask(Path(given), "a")


def test_errors_of_a_light_that_is_no_gaussian():
    """Which width a Gaussian has that is fitted to a spot with a halo depends on the weights, and its error says by how
    much; of a spot without one it is that of the noise."""
    y, x = np.indices((200, 220))
    square = ((x - 110.3) / 16) ** 2 + ((y - 99.1) / 12) ** 2
    errors = []
    for halo in (0.0, 0.1):
        image = SENSOR.draw(9000 * (np.exp(-square / 2) + halo * np.exp(-square / 12)), rng=3)
        (one,) = spotcheck.look(image).images
        apart = abs(spotcheck.fit_spots(image, weighting="equal").sigma_major - one.fit.sigma_major)
        errors.append(one.fit.sigma_major_stderr)
        assert apart < (1 if halo else 5) * errors[-1]
    assert errors[1] > 20 * errors[0]


@pytest.mark.parametrize("factor", [1 / 4095, 1e-6, 1e9])
def test_numbers_in_any_unit_tell_the_same(factor):
    """As parts of the brightest pixel, less a background, or as large numbers.

    Rounding to another step changes the estimates of gain and noise. Over eight seeds that moved a fit by 0.13 of its
    errors and the errors by 4.5 % (rms); four times that is allowed.
    """
    image = drawn(seed=2).astype(float)
    found, scaled = spotcheck.look(image), spotcheck.look(factor * (image - 21.3))
    (own,), (other,) = found.images, scaled.images
    for name, times in (("sigma_major", 1.0), ("x_centre", 1.0), ("amplitude", factor)):
        value, error = (getattr(own.fit, key) * times for key in (name, f"{name}_stderr"))
        assert getattr(other.fit, name) == pytest.approx(value, abs=0.5 * error)
        assert getattr(other.fit, f"{name}_stderr") == pytest.approx(error, rel=0.18)
    assert other.clipping.highest_dn == pytest.approx(factor * (own.clipping.highest_dn - 21.3))
    gain = found.cameras[0].gain
    assert scaled.cameras[0].gain.value == pytest.approx(factor * gain.value, abs=factor * gain.stderr)
    assert "a Gaussian within the noise" in repr(scaled)


def test_without_a_gain_errors_still_hold():
    """A spot too small for its noise to tell the gain: the errors of 60 fits are those of their scatter. The scatter of
    60 has an error of 9 %, and 4 of those are allowed: chance exceeds them once in 16,000."""
    z = []
    for seed in range(60):
        found = spotcheck.look(drawn((4.0, 3.0), 900, seed, (64, 72), SensorModel(0.5, 5, 0, np.inf, 20, 1023)))
        assert found.cameras[0].gain is None and "unknown: in no image does the noise grow" in repr(found)
        fit = found.images[0].fit
        z.append([(fit.sigma_major - 4) / fit.sigma_major_stderr, (fit.x_centre - 37.3) / fit.x_centre_stderr])
    assert np.all(np.abs(np.std(z, axis=0, ddof=1) - 1) < 0.37)


def test_a_folder_gives_m2_by_the_names_of_its_files(scan):
    """Images in the order of z, not of letters; M² and waist of both methods within four errors."""
    found = spotcheck.look(scan, pixel_pitch_m=PITCH, wavelength_m=WAVELENGTH)
    assert [one.z_m for one in found.images] == pytest.approx(POSITIONS)
    assert [own.method for own in found.beams] == ["second moments", "Gaussian fit"]
    for own, known in zip(found.beams, (0.05, 0.005), strict=True):
        assert not own.reason and not own.left_out
        for beam in own.caustics.values():
            assert off(beam.m2, beam.m2_stderr, M2) < 4 and beam.m2_stderr < known * M2
            assert off(beam.waist_radius, beam.waist_radius_stderr, WAIST) < 4
    assert "z: from the file name" in found.remarks


@pytest.mark.parametrize(
    ("names", "question"),
    [
        (("z_2_5mm", "z_3_5mm"), "file name says 'z_2_5mm': 2.5 or 5? (2 images)"),
        (("z_0mm", "z_m4mm"), "file name says 'z_m4mm': -4 or 4?"),
        (("z12", "z18"), "file name says 'z12': which unit? (2 images)"),
        (("z_12mm", "z_18mm"), None),
        (("z12", "a"), "file name says 'z12': which unit?"),
        (("z12",), None),
    ],
)
def test_positions_that_are_not_used_are_named(names, question, tmp_path):
    """With the question that they leave open."""
    for name in names:
        tifffile.imwrite(tmp_path / f"{name}.tif", drawn((6, 6), shape=(60, 60)))
    remarks = [one for one in spotcheck.look(tmp_path).remarks if "z is not used" in one]
    wanted = f"z is not used where it is unclear: {question}; give the positions of all images by --z for M²"
    assert remarks == ([wanted] if question else [])


def test_a_hyphen_is_a_minus_beside_names_without_one(tmp_path):
    """As `new-dataset` reads it; without such names it separates."""
    for folder, names, positions in (
        ("both", ("z-3mm", "z0mm"), [-3e-3, 0.0]),
        ("one", ("z-3mm", "z-4mm"), [3e-3, 4e-3]),
    ):
        (tmp_path / folder).mkdir()
        for name in names:
            tifffile.imwrite(tmp_path / folder / f"{name}.tif", drawn((6, 6), shape=(60, 60)))
        assert sorted(image.z_m for image in spotcheck.look(tmp_path / folder).images) == positions


@pytest.mark.parametrize(("factor", "is_flagged"), [(0.5, True), (1.0, False)])
def test_m2_below_one_is_flagged(scan, factor, is_flagged):
    """Half of the pitch, as of a binning that nothing states, gives a quarter of M² 1.3, which no beam can have."""
    report = str(spotcheck.look(scan, pixel_pitch_m=factor * PITCH, wavelength_m=WAVELENGTH)).replace("\n  ", " ")
    assert ("which no beam can have" in report) is is_flagged
    assert ("the pixel pitch (4e-06 m)" in report) is is_flagged


def test_positions_that_are_given_go_before_those_of_names(scan):
    """And there must be one for each."""
    files = sorted(scan.iterdir(), key=lambda path: natural_sort_key(path.name))
    found = spotcheck.look(files, z_m=[2 * z for z in POSITIONS])
    assert [one.z_m for one in found.images] == pytest.approx([2 * z for z in POSITIONS])
    assert found.beams == () and "M² needs the wavelength and the pixel pitch" in found.remarks
    with pytest.raises(spotcheck.InputError, match="2 positions, but the number of images is 7; give one for each"):
        spotcheck.look(files, z_m=[0.1, 0.2])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--z", "1,two"], "argument --z: is 'two'; it must be a number in m, or with a unit as in 3 mm"),
        (["--pixel-um", "3.75 s"], "argument --pixel-um: is '3.75 s'; it must be a number in µm, or with a unit"),
        (["--pixel-um", "0"], "pixel pitch: is 0 m; it must be above 0 and below 1 m"),
    ],
)
def test_lengths_that_are_none_are_refused(words, said, scan, capsys):
    """With the option and the unit that were typed."""
    with pytest.raises(SystemExit) as end:
        main(["look", str(next(scan.iterdir())), *words])
    assert end.value.code == 2 and said in capsys.readouterr().err


def test_lengths_may_have_their_unit(scan, tmp_path, capsys):
    """As people write them; metres that were meant as millimetres are remarked on."""
    files = sorted(map(str, scan.iterdir()), key=natural_sort_key)[:2]
    main(["look", *files, "--json", "--z", "495mm,0.58", "--pixel-um", "3.75um", "--wavelength-nm", "0.633 µm"])
    told = json.loads(capsys.readouterr().out)
    assert [one["z_m"] for one in told["images"]] == [0.495, 0.58]
    assert (told["pixel_pitch_m"], told["wavelength_m"]) == (3.75e-6, 6.33e-7)
    assert {"pixel pitch 3.75 µm: as given", "wavelength 633 nm: as given"} <= set(told["remarks"])
    far = spotcheck.look(files, z_m=[495, 580])
    assert "z goes from 495 to 580 m, which is implausibly long: is it in mm?" in far.remarks


def test_a_width_does_not_depend_on_the_other_images():
    """Each image's noise grows from its own rim: under one sensor, images with more stray light beside it leave a fit
    where it was, within a tenth of its error."""
    alone = drawn(seed=5)
    brighter = [drawn(seed=k, sensor=replace(SENSOR, black_level_dn=20.0 + 15 * k)) for k in (6, 7)]
    (one,), (same, *_) = spotcheck.look(alone).images, spotcheck.look([alone, *brighter]).images
    (width, error), (other, _) = one.fit_value("sigma_major"), same.fit_value("sigma_major")
    assert abs(width - other) < 0.1 * error
    assert spotcheck.look([alone, *brighter]).cameras[0].black_level_dn == pytest.approx(20, abs=1)


def test_stacks_arrays_and_what_is_none(tmp_path):
    """Every page is an image; what is no image ends in a sentence."""
    tifffile.imwrite(tmp_path / "two.tif", np.stack([drawn(seed=1), drawn(seed=2)]), photometric="minisblack")
    names = [one.name for one in spotcheck.look([tmp_path / "two.tif", drawn()]).images]
    assert names == ["two.tif page 0", "two.tif page 1", "image 1"]
    (tmp_path / "empty").mkdir()
    for given, said in (
        (tmp_path / "empty", "holds no image"),
        (tmp_path / "none.tif", "no such file"),
        (np.zeros(5), "each must be numbers"),
        (np.full((9, 9), np.nan), "no pixel that was measured"),
        ([], "none is given"),
    ):
        with pytest.raises(spotcheck.InputError, match=said):
            spotcheck.look(given)


@pytest.mark.parametrize("suffix", ["npy", "tif"])
@pytest.mark.parametrize("empty", [(1,), (0, 3), tuple(range(1, 9)), tuple(range(9))])
def test_an_empty_page_costs_one_page(suffix, empty, tmp_path):
    """The others of the stack are opened, and each page that is not is named, or counted where they are many."""
    stack = np.ones((9, 12, 16), np.float32)
    stack[list(empty)] = np.inf
    path = tmp_path / f"run.{suffix}"
    np.save(path, stack) if suffix == "npy" else tifffile.imwrite(path, stack, photometric="minisblack")
    if len(empty) == len(stack):
        with pytest.raises(InputError, match="page 0: has no pixel that was measured"):
            open_images(path)
        return
    found, errors = open_images(path)
    assert [image.page for image in found] == [page for page in range(len(stack)) if page not in empty]
    named = [f"run.{suffix} page {page}: has no pixel that was measured; leave it out" for page in empty[:5]]
    assert errors[: len(named)] == named
    more = [f"run.{suffix}: 3 more pages cannot be read; leave them out"]
    assert errors[len(named) :] == (more if len(empty) > len(named) else [])


def test_the_channel_of_a_colour_image_that_reads_most(tmp_path):
    """Red of a red laser, and it is said."""
    image = drawn(sensor=replace(SENSOR, full_scale_dn=255, gain_dn_per_e=0.02))
    tifffile.imwrite(tmp_path / "a.tif", np.stack([image, image // 9, image // 20], axis=-1).astype(np.uint8))
    found = spotcheck.look(tmp_path / "a.tif")
    assert off(found.images[0].fit.sigma_major, found.images[0].fit.sigma_major_stderr, 20) < 4
    assert "colour images: only the brightest channel is used, red" in repr(found)


@pytest.mark.parametrize("image", [np.zeros((1, 1)), np.full((40, 50), 255, np.uint8), np.eye(30)])
def test_an_image_without_a_spot_is_told(image, tmp_path):
    """In words, in JSON and on the page; numbers of its unknown camera are None, under the keys of a known one."""
    found, several = spotcheck.look(image), spotcheck.look([image, drawn()])
    assert "nothing stands out of the noise" in repr(found)
    assert re.search(rf"^image 0 +{found.images[0].clipping.pixels}$", repr(several), re.MULTILINE)
    unknown, known = found.to_dict()["cameras"][0], spotcheck.look(drawn()).to_dict()["cameras"][0]
    assert set(known) == set(unknown) and unknown["read_noise_stderr_e"] is None
    assert found.to_dict()["images"][0]["gaussian_fit"] is None
    assert "nothing stands out" in found.write(tmp_path).read_text(encoding="utf-8")


def test_json_alone_on_stdout(scan, tmp_path, monkeypatch, capsys):
    """One document of plain numbers with units in the keys; nothing is written unless a folder is named."""
    monkeypatch.chdir(tmp_path)
    words = ["look", str(scan), "--wavelength-nm", "632.8", "--pixel-um", "8", "--json"]
    main(words)
    said = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert list(tmp_path.iterdir()) == [] and said["page"] is None
    first = said["images"][0]
    assert first["second_moments"]["d4sigma_major_m"] == pytest.approx(
        8e-6 * first["second_moments"]["d4sigma_major_px"]
    )
    assert {"sigma_major_px", "sigma_major_stderr_px", "sigma_major_m", "amplitude_dn"} <= set(first["gaussian_fit"])
    (mean,) = said["beams"]["gaussian_fit"]["axes"].values()
    assert off(mean["m2"], mean["m2_stderr"], M2) < 4
    main([*words, "--output", "there"])
    assert json.loads(capsys.readouterr().out)["page"] == "there/look.html"
    assert (tmp_path / "there" / "look.html").exists() and (tmp_path / "there" / "look.png").exists()


def test_the_command_prints_a_table_and_writes_a_page(scan, tmp_path, monkeypatch, capsys):
    """A row an image; the page in a folder of its own, whole in one file; what is missing in one sentence."""
    monkeypatch.chdir(tmp_path)
    before = sorted(scan.iterdir())
    main(["look", str(scan)])
    said = capsys.readouterr().out
    assert all(path.name in said for path in before)
    assert "for M² add your --wavelength-nm and --pixel-um" in said and "look/look.html" in said
    page = (tmp_path / "look" / "look.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64") == len(POSITIONS) and "http:" not in page and "https:" not in page
    assert sorted(scan.iterdir()) == before
    assert sorted(path.name for path in (tmp_path / "look").iterdir()) == ["look.html", "look.png"]


def test_images_are_not_written_between(tmp_path, monkeypatch, capsys):
    """Where the images lie in a folder that is called like the page's, another one is asked for."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "look").mkdir()
    tifffile.imwrite(tmp_path / "look" / "a.tif", drawn())
    with pytest.raises(SystemExit) as ended:
        main(["look", "look"])
    assert ended.value.code == 2 and "name another folder for the page with --output" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "look").iterdir()] == ["a.tif"]


def test_help_leads_there(capsys):
    """The first command that help names, and what it says to whoever is new."""
    with pytest.raises(SystemExit):
        main(["--help"])
    said = capsys.readouterr().out
    assert next(iter(COMMANDS)) == "look" and "New here? spotcheck look IMAGE…" in said


def test_open(tmp_path, monkeypatch, capsys):
    """The page of results, or of the dataset's results; where it is; and what makes one where there is none."""
    asked: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: bool(asked.append(address)))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "manifest.csv").touch()
    with pytest.raises(spotcheck.InputError, match=r"has no page yet; run `snakemake .*dataset=mine`"):
        opening.find_page(Path("mine"))
    (tmp_path / "results" / "mine").mkdir(parents=True)
    page = tmp_path / "results" / "mine" / "report.html"
    page.touch()
    for place in ("mine", "results/mine", "results/mine/report.html"):
        main(["open", place])
        assert asked.pop() == page.as_uri()
        said = capsys.readouterr().out
        assert "results/mine/report.html" in said and "no browser was found" in said
    (tmp_path / "images").mkdir()
    with pytest.raises(spotcheck.InputError, match="`spotcheck look images` makes one"):
        opening.find_page(Path("images"))
    with pytest.raises(spotcheck.InputError, match="no such folder"):
        opening.find_page(tmp_path / "nowhere")


@pytest.mark.skipif(not (SHARED / "data" / "hene-zscan").exists(), reason="needs ../shared/data/hene-zscan")
def test_nine_images_of_a_real_beam(tmp_path):
    """Nothing known but wavelength and pitch: a width with its error for each, z from the names, M² by both methods.

    A HeNe laser's fundamental mode has M² of little more than 1; where the frame holds the whole area of the standard
    its second moments must find no less. Both waists lie where the light is narrowest, between 495 and 770 mm.
    """
    folder = SHARED / "data" / "hene-zscan" / "frames"
    found = spotcheck.look(folder, pixel_pitch_m=3.75e-6, wavelength_m=632.8e-9)
    assert [round(1e3 * one.z_m) for one in found.images] == [168, 210, 280, 348, 414, 495, 580, 666, 770]
    assert all(one.has_reliable_fit and one.moments.is_measured for one in found.images)
    moments, fits = found.beams
    assert moments.left_out == tuple(f"t-{z}mm.pgm" for z in (168, 210, 280, 348))
    for beam in moments.caustics.values():
        assert beam.m2 > 1 - 3 * beam.m2_stderr and beam.m2 < 1.3 + 3 * beam.m2_stderr and beam.m2_stderr < 0.2
    for beam in (*moments.caustics.values(), *fits.caustics.values()):
        assert 0.495 < beam.waist_position < 0.77 and beam.m2_stderr > 0
    assert found.write(tmp_path).stat().st_size < 3e6


def test_a_broken_file_does_not_end_the_look_at_others(tmp_path):
    """It is named with the reason, and what is printed fits a terminal; a name without a file is refused, and so are
    positions by an order in which one is missing."""
    image = drawn()
    for name in ("a.tif", "b.tif"):
        tifffile.imwrite(tmp_path / name, image)
    (tmp_path / "cut.tif").write_bytes((tmp_path / "a.tif").read_bytes()[:-2000])
    (tmp_path / "notes.png").write_text("spot at noon", encoding="utf-8")
    found = spotcheck.look(tmp_path)
    assert [one.name for one in found.images] == ["a.tif", "b.tif"]
    assert [text.split(":")[:2] for text in found.remarks[:2]] == [["left out", " cut.tif"], ["left out", " notes.png"]]
    assert max(map(len, str(found).splitlines())) <= 100
    with pytest.raises(spotcheck.InputError, match=r"c\.tif: no such file"):
        spotcheck.look([tmp_path / "a.tif", tmp_path / "c.tif"])
    with pytest.raises(spotcheck.InputError, match=r"cut\.tif: .* without it the order of --z is in doubt"):
        spotcheck.look(tmp_path, z_m=[0.1, 0.2, 0.3, 0.4])
    with pytest.raises(spotcheck.InputError, match=r"notes\.png"):
        spotcheck.look(tmp_path / "notes.png")
