"""What files say of their frames: names, tags, OME-XML, ImageJ, EXIF, texts beside them."""

import json
import time
from pathlib import PurePath

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from spotcheck.dataset.metadata import file_names, key_values, log_tables, units
from spotcheck.dataset.metadata.entry import MetadataEntry, resolve_entries
from spotcheck.dataset.metadata.readers import read_metadata

STACK = np.zeros((3, 16, 20), np.uint16)
NAMES = {
    "100us": {"exposure_s": 1e-4},
    "t=1.5ms": {"exposure_s": 1.5e-3},
    "1p5ms": {"exposure_s": 1.5e-3},
    "12,5 µs": {"exposure_s": 1.25e-5},
    "t=4e-3s": {"exposure_s": 4e-3},
    "2.5E+2us_r1": {"exposure_s": 2.5e-4, "repeat": 1},
    "003_5ms": {"exposure_s": 5e-3},
    "img_3_5ms": {"exposure_s": 5e-3},
    "r3_5ms": {"repeat": 3, "exposure_s": 5e-3},
    "2026-01-31_5ms": {"date": "2026-01-31", "exposure_s": 5e-3},
    "10_100us": {"exposure_s": 1e-4},
    "45deg": {"angle_deg": 45.0},
    "theta-30": {"angle_deg": 30.0},
    "z_176mm": {"z_m": 0.176},
    "t-168mm": {"z_m": 0.168},
    "z-0.5m": {"z_m": 0.5},
    "z=-0.5m": {"z_m": -0.5},
    "beam_-5mm": {"z_m": -0.005},
    "2ms_-5mm": {"exposure_s": 2e-3, "z_m": -0.005},
    "45deg-5mm": {"angle_deg": 45.0, "z_m": 0.005},
    "a090_r3_t900us": {"exposure_s": 9e-4, "repeat": 3},
    "dark_100ms_07": {"kind": "dark", "exposure_s": 0.1, "number": 7},
    "flat (12)": {"kind": "flat", "number": 12},
    "HeNe_632.8nm_z12.5mm": {"laser.wavelength_m": 6.328e-7, "z_m": 0.0125},
    "beam_20260131_093000_2ms": {"date": "2026-01-31T09:30:00", "exposure_s": 2e-3},
    "img_0042": {"number": 42},
    "r2_beam_7": {"repeat": 2, "number": 7},
    "z18_beam_7": {"number": 7},
    "t=3x10^-3s": {"exposure_s": 3e-3},
    "z_p25mm": {"z_m": 0.025},
    "z_minus25mm": {"z_m": -0.025},
    "theta_30_2ms": {"angle_deg": 30.0, "exposure_s": 2e-3},
    "theta=-30": {"angle_deg": -30.0},
    "x_2_500um": {},
    "x_m2mm": {},
}


def said(labels) -> dict:
    """Values by column, of what was understood."""
    return {label.column: label.value for label in labels if label.column and label.value is not None}


@pytest.mark.parametrize("name", NAMES)
def test_names(name):
    """Numbers with units, words and running numbers, and nothing else."""
    assert said(file_names.parse_name(name)) == NAMES[name]


@pytest.mark.parametrize(
    ("path", "inner_path", "wanted"),
    [
        ("scan.h5", "/dark", {"kind": "dark"}),
        ("scan.h5", "/entry/45deg/250us_03", {"angle_deg": 45.0, "exposure_s": 2.5e-4, "number": 3}),
        ("z_20mm/run.nxs", "/entry/instrument/detector/data", {"z_m": 0.02}),
        ("dark_and_flat.h5", "/flat", {"kind": "flat"}),
        ("scan_0012.h5", "/entry/data_000001", {"number": 12}),
    ],
)
def test_names_inside_hdf5(path, inner_path, wanted):
    """Datasets are named as files are, and groups as folders; two names that contradict each other are a conflict."""
    agreed, conflicts = resolve_entries(file_names.parse_path(PurePath(path), inner_path))
    assert (said(agreed.values()), conflicts) == (wanted, {})
    agreed, conflicts = resolve_entries(file_names.parse_path(PurePath("dark_3ms.h5"), "/flat_5ms"))
    assert not agreed and set(conflicts) == {"kind", "exposure_s"}


# Numbers without a unit, and lengths and times of something else.
SILENT = ["exp_900", "z18", "f50mm", "x_3mm", "delay_10us", "b_000_c", "speckle", "45degree5", ""]
# Perhaps the end of a fraction or of a decimal number.
AMBIGUOUS = ["1-400s", "1_250s", "exp_3_5ms", "t_4_25ms", "3_5mm", "2-5ms", "1,000us"]
# Names whose numbers have several readings, with the column, the text and the question.
QUESTIONS = {
    "exp_0_003s": ("exposure_s", "exp_0_003s", "0.003 or 3?"),
    "z_0_075m": ("z_m", "z_0_075m", "0.075 or 75?"),
    "spot_0_025deg": ("angle_deg", "0_025deg", "0.025 or 25?"),
    "t_0_0007s": ("exposure_s", "t_0_0007s", "0.0007 or 7?"),
    "exp_3_5ms": ("exposure_s", "exp_3_5ms", "3.5 or 5?"),
    "exp3_000us": ("exposure_s", "exp3_000us", "3.000, 3000 or 0?"),
    "exp_2,000us": ("exposure_s", "exp_2,000us", "2.000 or 2000?"),
    "exp 4 000us": ("exposure_s", "exp 4 000us", "4000 or 0?"),
    "exp_4'000us": ("exposure_s", "exp_4'000us", file_names.OPEN_EXPRESSION),
    "1-400s": ("exposure_s", "1-400s", "1.400, 1400, 1/400 or 400?"),
    "z_m25mm": ("z_m", "z_m25mm", "-25 or 25?"),
    "exp=-3ms": ("exposure_s", "exp=-3ms", "-3 or 3?"),
    "t=3^-2s": ("exposure_s", "t=3^-2s", file_names.OPEN_EXPRESSION),
    "t=4x10-3s": ("exposure_s", "t=4x10-3s", file_names.OPEN_EXPRESSION),
    "t=4e_3s": ("exposure_s", "t=4e_3s", file_names.OPEN_EXPRESSION),
    "theta_67_5": ("angle_deg", "theta_67_5", "67.5 or 67?"),
    "exp_2_5": ("exposure_s", "exp_2_5", "2.5 or 2?"),
}


@pytest.mark.parametrize("name", QUESTIONS)
def test_names_with_several_readings_are_asked_about(name):
    """One entry, without a value, quotes the whole number and lists its readings."""
    found = [entry for entry in file_names.parse_name(name) if entry.column != "kind"]
    assert [(entry.column, entry.text, entry.question) for entry in found] == [QUESTIONS[name]]
    assert found[0].value is None and not found[0].number


@pytest.mark.parametrize("name", [*SILENT, *AMBIGUOUS])
def test_names_that_say_nothing(name):
    """Nothing is taken from them."""
    assert said(file_names.parse_name(name)) == {}


@pytest.mark.parametrize(
    ("cells", "wanted"),
    [
        (["700", "2,000"], [None, None]),
        (["1,000.5", "1,5"], [None, None]),
        (["2,000", "1,500.5"], [2e-3, 1.5005e-3]),
        (["3,000", "1,000,000"], [3e-3, 1.0]),
        (["1,250", "1,5"], [1.25e-6, 1.5e-6]),
        (["0,125", "2,375"], [1.25e-7, 2.375e-6]),
        (["700", "2000"], [7e-4, 2e-3]),
    ],
)
def test_commas_are_decided_from_the_column(cells, wanted):
    """A comma separates thousands or decimals in a whole column; an undecidable column has no values, and says so."""
    entries = read_exposures(cells, ",")
    assert [entry.value for entry in entries] == wanted
    assert all((units.UNDECIDABLE_SEPARATOR in entry.text) == (entry.value is None) for entry in entries)


@pytest.mark.parametrize(
    ("cells", "separator", "wanted_us"),
    [
        (["700", "3.000"], ";", None),
        (["4.000", "3.000"], ";", None),
        (["700", "3.000"], "\t", None),
        (["4.000", "3.000"], "\t", [4.0, 3.0]),
        (["700", "3.000"], ",", [700.0, 3.0]),
        (["0.700", "3.000"], ";", [0.7, 3.0]),
        (["3.000", "2.50E+00"], ";", [3.0, 2.5]),
        (["3.000", "1.250.000"], ";", [3000.0, 1.25e6]),
        (["700,5", "3.000", "1.250,25"], ";", [700.5, 3000.0, 1250.25]),
        (["700.5", "3,000"], ",", [700.5, 3000.0]),
        (["0.5", "2,5"], ";", [0.5, 2.5]),
        (["0.5", "2,5", "3.000"], ";", None),
    ],
)
def test_points_are_decided_from_the_column(cells, separator, wanted_us):
    """As commas are; between commas, and between tabs where each number has one, points are decimal."""
    values = [entry.value for entry in read_exposures(cells, separator)]
    assert values == ([None] * len(cells) if wanted_us is None else pytest.approx([1e-6 * us for us in wanted_us]))


def read_exposures(cells, separator):
    """Return the entries of a table with these exposures in µs."""
    lines = [f"file{separator}Exposure (us)", *(f'{k}.tif{separator}"{cell}"' for k, cell in enumerate(cells))]
    return [rows[0].entries[0] for rows in log_tables.parse_table("\n".join(lines), "log.csv").values()]


@pytest.mark.parametrize(
    ("key", "value", "column", "wanted"),
    [
        ("ExposureTime", "1/200 s", "exposure_s", 0.005),
        ("Exposure-ms", "10", "exposure_s", 0.01),
        ("exposureTimeUs", 250, "exposure_s", 2.5e-4),
        ("Exposure (µs)", "2,5", "exposure_s", 2.5e-6),
        ("Exposure (µs)", "2,500", "exposure_s", None),
        ("exposure_s", "1e-3", "exposure_s", 1e-3),
        ("ExposureTime", "100", "exposure_s", None),
        ("ExposureTime", "3 mm", "exposure_s", None),
        ("ZPositionUm", "1500", "z_m", 1.5e-3),
        ("angle", "45", "angle_deg", 45.0),
        ("gain_dn_per_e", "0.25", "sensor.gain_dn_per_e", 0.25),
        ("Gain", "12", "sensor.gain_dn_per_e", None),
        ("DateTime", "2026:13:01 00:00:00", "date", None),
        ("Temperature", "20", None, None),
    ],
)
def test_keys(key, value, column, wanted):
    """The unit stands behind the number or in the key; without it a number says nothing."""
    found = key_values.parse_pair(key, str(value), "here")
    assert (found.column, found.value) == (column, pytest.approx(wanted, rel=1e-15) if wanted else wanted)


def test_tags_of_a_tiff(tmp_path):
    """ExposureTime and DateTime, and the keys of a description."""
    tags = [(33434, 5, 1, (1, 1000), True)]
    more = {"datetime": "2026:01:02 03:04:05", "description": "Exposure-ms: 10\nz = 5 mm; foo=3"}
    tifffile.imwrite(tmp_path / "a_100us.tif", STACK[0], photometric="minisblack", extratags=tags, **more)
    found = read_metadata(tmp_path / "a_100us.tif")
    assert MetadataEntry("exposure_s", 1e-3, "0.001 s", "TIFF tag 33434 ExposureTime") in found
    assert MetadataEntry("date", "2026-01-02T03:04:05", "2026:01:02 03:04:05", "TIFF tag 306 DateTime") in found
    assert MetadataEntry("z_m", 5e-3, "z = 5 mm", "TIFF tag 270 ImageDescription") in found
    assert MetadataEntry(None, None, "foo = 3", "TIFF tag 270 ImageDescription") in found
    taken, conflicts = resolve_entries(found)
    assert "exposure_s" not in taken and taken["z_m"].value == 5e-3
    assert ", but ".join(map(str, conflicts["exposure_s"])) == (
        "TIFF tag 33434 ExposureTime says '0.001 s', but TIFF tag 270 ImageDescription says 'Exposure-ms = 10'"
    )


@pytest.mark.parametrize("order", ["XYZCT", "XYTCZ"])
def test_planes_of_ome(tmp_path, order):
    """Each page has what its own plane says, in whichever order the planes lie."""
    planes = [(z, t) for z in range(2) for t in range(3)]
    listed = "".join(
        f'<Plane TheZ="{z}" TheC="0" TheT="{t}" ExposureTime="{t + 1}" ExposureTimeUnit="ms" PositionZ="{z}"'
        ' PositionZUnit="mm" DeltaT="30"/>'
        for z, t in planes
    )
    # The first axis of the order runs fastest.
    planes.sort(key=lambda plane: plane[::-1] if order == "XYZCT" else plane)
    xml = (
        '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0">'
        f'<AcquisitionDate>2026-01-31T09:30:00</AcquisitionDate><Pixels DimensionOrder="{order}" SizeX="20" SizeY="16"'
        ' SizeZ="2" SizeC="1" SizeT="3" SignificantBits="12" PhysicalSizeX="3.45"><TiffData IFD="0" PlaneCount="6"/>'
        f"{listed}</Pixels></Image></OME>"
    )
    with tifffile.TiffWriter(tmp_path / "a.tif") as out:
        for k in range(6):
            out.write(STACK[0], photometric="minisblack", description=xml if k == 0 else None, metadata=None)
    found = read_metadata(tmp_path / "a.tif")
    for page, (z, t) in enumerate(planes):
        taken, conflicts = resolve_entries(found, page)
        assert not conflicts
        assert taken["exposure_s"].value == pytest.approx((t + 1) * 1e-3, rel=1e-15)
        assert (taken["z_m"].value, taken["sensor.bit_depth"].value) == (z * 1e-3, 12)
        assert taken["date"].value == "2026-01-31T09:30:30"
    assert "PhysicalSizeX = 3.45 µm" in [label.text for label in found if label.column is None]


def test_imagej(tmp_path):
    """The block of Info, and the label of each slice."""
    own = {"Info": "Exposure = 20 ms\nWavelength=633 nm", "Labels": ["z=1 mm", "z=2 mm", "z=3 mm"]}
    tifffile.imwrite(tmp_path / "a.tif", STACK, imagej=True, metadata=own)
    found = read_metadata(tmp_path / "a.tif")
    wanted = {"exposure_s": 0.02, "laser.wavelength_m": 6.33e-7, "z_m": 3e-3}
    assert said(resolve_entries(found, 2)[0].values()) == wanted


def test_png(tmp_path):
    """EXIF and texts."""
    info, exif = PngImagePlugin.PngInfo(), Image.Exif()
    info.add_text("Comment", "angle = 30 deg")
    exif[34665], exif[271] = {33434: 1 / 64}, "Maker"
    Image.fromarray(STACK[0]).save(tmp_path / "a.png", pnginfo=info, exif=exif)
    found = read_metadata(tmp_path / "a.png")
    assert said(found) == {"angle_deg": 30.0, "exposure_s": 1 / 64}
    assert MetadataEntry(None, None, "Make = Maker", "EXIF Make") in found


KEYS_BESIDE = {"camera": {"ExposureTime_us": 100, "sensor": {"pixel pitch (um)": 3.45}}}
BESIDE = {
    "own names": {"a.json": json.dumps(KEYS_BESIDE), "a.pgm.txt": "z: 3 mm\n", "a.yaml": "angle_deg: 30\n"},
    "text and attribute": {
        "a.xml": '<?xml version="1.0"?><Frame><ExposureTime unit="ms">0.1</ExposureTime><Stage z="3 mm"/></Frame>'
    },
    "keys as attributes": {
        "a.xml": '<a><Property name="Exposure" value="100 us"/><Property key="z" value="3 mm"/></a>'
    },
    "namespace": {"a.xml": '<m:Info xmlns:m="urn:m"><m:Exposure_us>100</m:Exposure_us><m:Z_mm>3</m:Z_mm></m:Info>'},
}


@pytest.mark.parametrize("kind", BESIDE)
def test_files_beside(tmp_path, kind):
    """Of an image's own name, with or without its ending; XML with its keys in each of three ways."""
    for name, content in {"a.pgm": "P5 1 1 255\n0", **BESIDE[kind]}.items():
        (tmp_path / name).write_text(content)
    more = {"sensor.pixel_pitch_m": 3.45e-6, "angle_deg": 30.0} if kind == "own names" else {}
    assert said(read_metadata(tmp_path / "a.pgm")) == {"exposure_s": 1e-4, "z_m": 3e-3} | more


@pytest.mark.parametrize(("mark", "name"), [(",", "log.csv"), (";", "list.CSV"), ("\t", "log.tsv")])
def test_a_table_of_the_folder(tmp_path, mark, name):
    """A row for each image, by its name or its path; of a stack for each page. Another's rows and a table without names
    say nothing, nor does the manifest."""
    rows = ["File name|Exposure (ms)|z [mm]|note", "data\\a.tif|0.1|3|", "b.tif|0.2|4|x"]
    rows += [f"c.tif|0.3|{k}|" for k in range(3)]
    (tmp_path / name).write_text("\n".join(["# by hand", *rows, ""]).replace("|", mark))
    (tmp_path / "other.csv").write_text("x,exposure\na.tif,9 s\n")
    (tmp_path / "manifest.csv").write_text("file,exposure_s\na.tif,9\n")
    for image, pixels in (("a.tif", STACK[0]), ("c.tif", STACK), ("d.tif", STACK[0])):
        tifffile.imwrite(tmp_path / image, pixels, photometric="minisblack", metadata=None)
    assert said(read_metadata(tmp_path / "a.tif")) == {"exposure_s": 1e-4, "z_m": 3e-3}
    assert said(read_metadata(tmp_path / "d.tif")) == {}
    found = read_metadata(tmp_path / "c.tif")
    assert [resolve_entries(found, page)[0]["z_m"].value for page in range(3)] == pytest.approx([0.0, 1e-3, 2e-3])


def test_the_list_of_an_emva_measurement(tmp_path):
    """Exposures in ns and photons a pixel, for the images of that name in the folder below."""
    (tmp_path / "EMVA1288_Data.txt").write_text(
        "v 3.0\nn 12 4 3\nb 40000.0 120.0\ni images\\b_1.png\nd 50000\ni images\\d_1.png\n"
    )
    for name in ("b_1.png", "d_1.png"):
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.fromarray(STACK[0]).save(tmp_path / "images" / name)
    flat, dark = (said(resolve_entries(read_metadata(tmp_path / "images" / f"{k}_1.png"))[0].values()) for k in "bd")
    assert flat == {"kind": "flat", "exposure_s": 4e-5, "photons_per_px": 120.0, "sensor.bit_depth": 12, "number": 1}
    assert dark == {"kind": "dark", "exposure_s": 5e-5, "sensor.bit_depth": 12, "number": 1}


def test_folders_count_below_the_root(tmp_path):
    """And those above it do not."""
    path = tmp_path / "45deg" / "100us" / "0001.pgm"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"P5 1 1 255\n0")
    assert said(read_metadata(path, tmp_path)) == {"angle_deg": 45.0, "exposure_s": 1e-4, "number": 1}
    assert said(read_metadata(path)) == {"number": 1}


@pytest.mark.parametrize(
    ("text", "pitch_um"),
    [
        ("Pixel size = 4.8 um\nBinning = 3x3", 14.4),
        ("PixelSize: 2.4 µm; BinningHorizontal: 4; BinningVertical: 4", 9.6),
        ('{"camera": {"pixel_pitch_um": 5.5, "binning": [2, 2]}}', 11.0),
        ('{"Binning": "2", "SensorPixelSize": "6.5 um", "PixelSizeUm": 13}', 13.0),
        ("<a><PixelSize unit='um'>3.2</PixelSize><Binning>2 × 2</Binning></a>", 6.4),
        ("Pixel size = 4.8 um\nBinning = 1x1", 4.8),
        ("Pixel size = 4.8 um\nBinning = off", 4.8),
        ("Pixel size = 4.8 um\nBinning = by the driver", 4.8),
        # Pixels that are not square have no pitch, and sources that disagree give none.
        ("Pixel size = 4.8 um\nBinning = 2x1", None),
        ("PixelSize = 4.8 um\nXBinning = 2\nYBinning = 1", None),
        ("Pixel size = 4.8 um\nBinning = 2x1\nbin = 2", None),
    ],
)
def test_pixel_pitch_includes_the_binning(text, pitch_um):
    """The pitch of the image is that of the sensor times the binning, whatever the keys and their order."""
    agreed, _ = resolve_entries(key_values.parse_text(text, "here"))
    entry = agreed.get("sensor.pixel_pitch_m")
    assert (entry and entry.value) == (pitch_um and pytest.approx(1e-6 * pitch_um))


@pytest.mark.parametrize("pages", [(0,), (0, 2)])
def test_what_the_first_page_says_alone_is_of_all(tmp_path, pages):
    """Else each page speaks for itself."""
    with tifffile.TiffWriter(tmp_path / "a.tif") as out:
        for k, pixels in enumerate(STACK):
            text = f"exposure = {k + 1} ms" if k in pages else None
            out.write(pixels, photometric="minisblack", metadata=None, description=text)
    found = [said(resolve_entries(read_metadata(tmp_path / "a.tif"), k)[0].values()) for k in range(3)]
    assert found == ([{"exposure_s": 1e-3}] * 3 if pages == (0,) else [{"exposure_s": 1e-3}, {}, {"exposure_s": 3e-3}])


HOSTILE = {
    "a.txt": "a=" + "x " * 400_000 + "y\n" + "Exposure=" + " " * 100_000 + "1\n",
    "a.json": "[" * 100_000,
    "a.yaml": "a: &a [*a]",
    "a.xml": '<!DOCTYPE l [<!ENTITY a "Exposure = 1 s">]><Exposure>&a;</Exposure>',
    "a.pgm.xml": "<a>" * 100_000,
    "log.csv": "file,exposure\n" + '"' * 500_000,
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_texts_end_soon(tmp_path, name):
    """In labels, or in one that says what could not be read; these take milliseconds, a quadratic search minutes."""
    (tmp_path / "a.pgm").write_bytes(b"P5 1 1 255\n0")
    (tmp_path / name).write_text(HOSTILE[name])
    before = time.process_time()
    assert said(read_metadata(tmp_path / "a.pgm")) == {}
    assert time.process_time() - before < 5
    assert not log_tables.TableReader().find_tables(tmp_path)


PIECES = st.sampled_from(
    "1 1e999 - _ = : . , / 0 us mm nm deg ° z exp dark 2026 0131 { } [ ExposureTime date angle (ms) e5 p r".split(" ")
) | st.sampled_from([" ", "\n", "\0", '"', "\u0663", "9" * 30])


@given(st.lists(PIECES | st.text(max_size=3), max_size=12).map("".join))
def test_any_text_is_read_or_not(text):
    """Whatever a name or a text holds: numbers are finite, and nothing is raised."""
    for label in [*file_names.parse_name(text), *key_values.parse_text(text, "here")]:
        assert label.value is None or not isinstance(label.value, float) or np.isfinite(label.value)


def test_control_characters_are_not_repeated():
    """A terminal would obey them, and YAML refuses them in comments."""
    entry = key_values.parse_pair("no\x1b[2Jte", "a\x85b", "\x07.csv")
    assert (entry.text, entry.source) == ("no [2Jte = a b", " .csv")


def test_entities_are_not_followed(tmp_path):
    """Ten lines of XML that stand for more than memory holds."""
    laughs = '<!DOCTYPE l [<!ENTITY a "ha">]><OME>&a;</OME>'
    tifffile.imwrite(tmp_path / "a.tif", STACK[0], description=f"<?xml version='1.0'?>{laughs}", metadata=None)
    assert ["TIFF tags", "cannot be read (it declares entities, which are not read)"] in [
        [label.source, label.text] for label in read_metadata(tmp_path / "a.tif")
    ]
