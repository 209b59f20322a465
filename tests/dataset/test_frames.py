"""Reading frames: every container of the contract, and what is refused with which words."""

import numpy as np
import pytest
import tifffile
from PIL import Image

from spotcheck.dataset import folder as dataset
from spotcheck.dataset import frames
from spotcheck.errors import InputError
from tests.samples.small_datasets import HEADER, folder, loaded

RAMP = np.arange(20 * 30, dtype=np.uint16).reshape(20, 30)  # 0 … 599: needs ten bits, and differs in every pixel


def one(base, name: str, instrument: str = "crop_px: 8", page: str = "") -> dataset.Dataset:
    """A dataset of one frame whose file is already there."""
    return dataset.load(folder(base, [f"frames/{name},spot,0,1e-4,0,{page}"], instrument, HEADER + ",page"))


def place(base, name: str):
    """Path of an image of the dataset, its folder made."""
    (base / "frames").mkdir(exist_ok=True)
    return base / "frames" / name


def assert_reads(base, name: str, expected: np.ndarray, bits: int, instrument: str = "crop_px: 8") -> None:
    """Header and pixels of the one frame."""
    ds = one(base, name, instrument)
    assert frames.check_formats(ds)[:2] == (expected.shape, bits)
    pixels = frames.read_image(ds, ds.frames[0])
    assert pixels.dtype.kind == "u"
    np.testing.assert_array_equal(pixels, expected)


LOSSLESS = {"compression": "jpeg2000", "compressionargs": {"reversible": True, "level": 0}}
TIFFS = [
    *({}, {"byteorder": ">"}, {"bigtiff": True}, {"tile": (16, 16)}, {"rowsperstrip": 7}, LOSSLESS),
    *({"compression": name} for name in ("zlib", "zstd", "packbits")),
    {"compression": "zlib", "predictor": True},
]
# Files of 16 bit that other programs and cameras write, by suffix and writer.
WRITERS = {
    **{f"TIFF {options}": ("tif", lambda path, o=options: tifffile.imwrite(path, RAMP, **o)) for options in TIFFS},
    "TIFF of Pillow": ("tif", lambda path: Image.fromarray(RAMP).save(path, compression="tiff_lzw")),
    "PNG": ("png", lambda path: Image.fromarray(RAMP).save(path)),
    "text PGM": ("pgm", lambda path: path.write_text("P2\n30 20\n1023\n" + "\n".join(map(str, RAMP.ravel())))),
}


@pytest.mark.parametrize(("suffix", "write"), WRITERS.values(), ids=WRITERS)
def test_containers(tmp_path, suffix, write):
    """Lossless ones, whatever the layout of their pixels."""
    write(place(tmp_path, f"a.{suffix}"))
    assert_reads(tmp_path, f"a.{suffix}", RAMP, 16)


@pytest.mark.parametrize(
    ("suffix", "write"), [("tif", tifffile.imwrite), ("png", lambda path, pixels: Image.fromarray(pixels).save(path))]
)
def test_frames_of_8_bit(tmp_path, suffix, write):
    """They keep their depth."""
    write(place(tmp_path, f"a.{suffix}"), RAMP.astype(np.uint8))
    assert_reads(tmp_path, f"a.{suffix}", RAMP.astype(np.uint8), 8)


def test_pages_of_a_stack(tmp_path):
    """Each page by its number; one beyond the last is refused."""
    stack = np.stack([RAMP, RAMP + 1, RAMP + 2])
    tifffile.imwrite(place(tmp_path, "a.tif"), stack, photometric="minisblack")
    for page in range(3):
        ds = one(tmp_path, "a.tif", page=str(page))
        np.testing.assert_array_equal(frames.read_image(ds, ds.frames[0]), stack[page])
    with pytest.raises(InputError, match=r"a\.tif, page 3: page is 3, but the file has 3; pages count from 0"):
        frames.check_formats(one(tmp_path, "a.tif", page="3"))


@pytest.mark.parametrize(("highest", "bits"), [(255, 8), (65535, 16), (1023, 16), (4095, 16), (127, 8)])
@pytest.mark.parametrize("comment", ["", "# camera\n", "# two\n# lines: 3 4 5\n"])
def test_pgm(tmp_path, highest, bits, comment):
    """Binary PGM: the values are those of the file, whatever maxval its header states."""
    pixels = RAMP.astype(int) % (highest + 1)
    data = pixels.astype(">u2" if bits == 16 else "u1").tobytes()
    place(tmp_path, "a.pgm").write_bytes(f"P5\n{comment}30 20\n{highest}\n".encode() + data)
    assert_reads(tmp_path, "a.pgm", pixels, bits)


def test_left_aligned_container(tmp_path):
    """Ten bits in the upper end of sixteen."""
    tifffile.imwrite(place(tmp_path, "a.tif"), RAMP << 6)
    text = "crop_px: 8\nsensor: {bit_depth: 10, value_shift_bits: 6}"
    assert_reads(tmp_path, "a.tif", RAMP, 16, text)


@pytest.mark.parametrize(
    ("sensor", "highest"),
    [
        ("{bit_depth: 10}", 1023),
        ("{}", 65535),
        ("{bit_depth: 10, value_shift_bits: 6}", 1023),
        ("{value_shift_bits: 6}", 1023),
    ],
)
def test_full_scale_of_16_bit(tmp_path, sensor, highest):
    """Largest reading after the shift: 2^bits − 1, or what the container leaves."""
    ds = loaded(tmp_path, [RAMP], f"crop_px: 8\nsensor: {sensor}")
    assert frames.get_full_scale(ds.instrument, 16) == highest


# A reading, section `sensor` of instrument.yaml, and what is said of both, by the headers or else by the pixels.
BITS = [
    (1024, "{bit_depth: 10}", r"^frames/f0\.tif: holds the value 1024, above the 1023.*value_shift_bits"),
    (5, "{value_shift_bits: 4}", "low bits set"),
    (0, "{value_shift_bits: 15, bit_depth: 2}", r"^instrument\.yaml: .* ask for 17 bits, but the frames hold 16"),
    (0, "{bit_depth: 10, value_shift_bits: 7}", "17 bits, but the frames hold 16"),
]


@pytest.mark.parametrize(("value", "sensor", "words"), BITS)
def test_bits_that_contradict_the_frames(tmp_path, value, sensor, words):
    """The value, the limit, and the remedies."""
    ds = loaded(tmp_path, [np.full((20, 30), value, np.uint16)], f"crop_px: 8\nsensor: {sensor}")
    with pytest.raises(InputError, match=words):
        frames.check_formats(ds)
        frames.read_image(ds, ds.frames[0])


def test_a_wrong_key_is_named_with_its_file(tmp_path):
    """The shared sheet, where the dataset's own has no such key."""
    (tmp_path / "camera.yaml").write_text("sensor: {bit_depth: 12}", encoding="utf-8")
    ds = loaded(tmp_path / "own", [RAMP.astype(np.uint8)], "{crop_px: 8, based_on: ../camera.yaml}")
    with pytest.raises(InputError, match=r"^camera\.yaml: sensor\.bit_depth .* but the frames hold 8"):
        frames.check_formats(ds)


REFUSED = {
    "float": ("tif", RAMP.astype(np.float32), ".*floating-point.*one channel of 8 to 16 bit unsigned"),
    "signed": ("tif", RAMP.astype(np.int16), ".*int16.*one channel of 8 to 16 bit unsigned"),
    "32 bit": ("tif", RAMP.astype(np.uint32), ".*uint32.*one channel of 8 to 16 bit unsigned"),
    "RGBA": ("png", None, r"has RGB colour and transparency \(PNG colour type 6\); it must be one channel"),
    "LA": ("png", None, r"has a channel of transparency \(PNG colour type 4\); it must be one channel"),
    "P": ("png", None, r"has a palette of colours \(PNG colour type 3\); it must be one channel"),
    "1": ("png", None, "holds 1 bit pixels; it must be one channel"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_other_pixels_are_refused(tmp_path, kind):
    """What the file holds, and what it must hold; a PNG in one of Pillow's modes."""
    suffix, pixels, words = REFUSED[kind]
    path = place(tmp_path, f"a.{suffix}")
    if pixels is None:
        Image.new(kind, (30, 20)).save(path)
    else:
        tifffile.imwrite(path, pixels)
    with pytest.raises(InputError, match=rf"a\.{suffix}: {words}"):
        frames.check_formats(one(tmp_path, path.name))


@pytest.mark.parametrize("part", [0.0, 0.02, 0.5, 0.95])
def test_a_tiff_cut_short_shows_in_its_header(tmp_path, part):
    """At any length, without decoding a pixel."""
    path = place(tmp_path, "a.tif")
    tifffile.imwrite(path, np.tile(RAMP, (4, 4)))
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(InputError, match=r"a\.tif: .*cut short; copy the file again"):
        frames.check_formats(one(tmp_path, "a.tif"))


@pytest.mark.parametrize("name", ["a.png", "a.pgm"])
def test_other_images_cut_short(tmp_path, name):
    """At the latest when decoded; a name that lies about its content at once."""
    path = place(tmp_path, name)
    Image.fromarray(RAMP).save(path)
    path.write_bytes(path.read_bytes()[:-200])
    ds = one(tmp_path, name)
    with pytest.raises(InputError, match="copy the file again"):
        frames.read_image(ds, ds.frames[0])
    path.write_bytes(b"no image at all")
    with pytest.raises(InputError, match="cannot be read as an image"):
        frames.check_formats(one(tmp_path, name))


def test_frames_of_one_dataset_are_alike(tmp_path):
    """Another size, another depth, a crop that is larger than the frame, a page of a PNG."""
    with pytest.raises(InputError, match=r"f1\.tif: 29 × 20 px, but frames/f0\.tif has 30 × 20 px"):
        frames.check_formats(loaded(tmp_path / "size", [RAMP, RAMP[:, :-1]], "crop_px: 8"))
    with pytest.raises(InputError, match=r"f1\.tif: 8 bit, but frames/f0\.tif has 16 bit"):
        frames.check_formats(loaded(tmp_path / "depth", [RAMP, RAMP.astype(np.uint8)], "crop_px: 8"))
    with pytest.raises(InputError, match="crop_px is 21, but the frames have 30 × 20 px; it must be at most 20"):
        frames.check_formats(loaded(tmp_path / "crop", [RAMP], "crop_px: 21"))
    Image.fromarray(RAMP).save(place(tmp_path, "a.png"))
    with pytest.raises(InputError, match="page is 1, but the file has 1; pages count from 0"):
        frames.check_formats(one(tmp_path, "a.png", page="1"))


@pytest.mark.parametrize("shape", [(20, 30), (64, 64), (200, 130), (129, 191)])
def test_block_and_line_means(shape):
    """Against means taken block by block; the remainder at the right and lower border is left out."""
    pixels = np.random.default_rng(1).integers(0, 65536, shape, dtype=np.uint16)
    got = frames.reduce_frame(pixels)
    side = min(64, *shape)
    want = [
        [pixels[r : r + side, c : c + side].astype(float).mean() for c in range(0, shape[1] - side + 1, side)]
        for r in range(0, shape[0] - side + 1, side)
    ]
    # Whole numbers below 2^53 add without rounding: only the division rounds.
    np.testing.assert_allclose(got.block_mean, want, rtol=1e-14)
    np.testing.assert_allclose(got.row_mean, [r.astype(float).mean() for r in pixels], rtol=1e-13)
    np.testing.assert_allclose(got.column_mean, [c.astype(float).mean() for c in pixels.T], rtol=1e-13)
    assert got.block_mean.shape == tuple(frames.count_blocks(n, shape) for n in shape)
