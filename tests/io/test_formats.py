"""Image files as cameras and programs write them: what changes a number is obeyed or refused by its name."""

import struct
import zlib

import numpy as np
import pytest
import tifffile
from PIL import Image, PngImagePlugin

from spotcheck.errors import InputError
from spotcheck.io.formats import files

RAMP = (np.arange(20 * 32, dtype=np.uint16) * 6).reshape(20, 32)  # 0 … 3834: needs twelve bits
SMALL = RAMP.astype(np.uint8)


def saved(folder, content: bytes, name: str = "a.tif"):
    """A file of that content."""
    (folder / name).write_bytes(content)
    return folder / name


def tiff(folder, pixels: np.ndarray = RAMP, **options):
    """A TIFF file."""
    tifffile.imwrite(folder / "a.tif", pixels, **({"photometric": "minisblack"} | options))
    return folder / "a.tif"


def with_tag(path, code: int, value: int):
    """The file with another value in a tag of its first directory."""
    with tifffile.TiffFile(path, mode="r+") as own:
        own.pages[0].tags[code].overwrite(value)
    return path


def renamed(path, code: int, other: int):
    """The file with the number of a tag of type SHORT changed: tifffile does not write every tag as it is told."""
    old, new = (struct.pack("<HHI", own, 3, 1) for own in (code, other))
    content = path.read_bytes()
    assert content.count(old) == 1
    path.write_bytes(content.replace(old, new))
    return path


def refusal(path) -> str:
    """What both the header's and the pixels' reader say."""
    said = []
    for reader in (lambda: files.list_pages(path, "a"), lambda: files.read_pixels(path, 0, "a")):
        with pytest.raises(InputError) as caught:
            reader()
        said.append(str(caught.value))
    assert said[0] == said[1] and "\n" not in said[0]
    return said[0]


def read(path, page: int = 0) -> np.ndarray:
    """Pixels of a page."""
    return files.read_pixels(path, page, "a")


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (16, np.uint16), (12, np.uint16)])
def test_min_is_white_is_turned_round(tmp_path, bits, dtype):
    """A stored 0 is the brightest reading of as many bits as are stored (TIFF 6.0, PhotometricInterpretation 0)."""
    pixels = (RAMP.astype(int) % 2**bits).astype(dtype)
    options = {} if bits == 8 * pixels.itemsize else {"bitspersample": bits}
    path = tiff(tmp_path, (2**bits - 1 - pixels.astype(int)).astype(dtype), photometric="miniswhite", **options)
    assert files.list_pages(path, "a") == [((20, 32), bits, False, "")]
    np.testing.assert_array_equal(read(path), pixels)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_packed_bits(tmp_path, bits):
    """Samples that are no whole bytes, packed by hand: big-endian bits, rows padded to whole bytes."""
    pixels = RAMP[:, :31] % 2**bits
    rows = ["".join(f"{v:0{bits}b}" for v in row) for row in pixels]
    packed = b"".join(int(row.ljust(-(-len(row) // 8) * 8, "0"), 2).to_bytes(-(-len(row) // 8)) for row in rows)
    path = tiff(tmp_path, pixels.astype(np.uint16), bitspersample=bits)
    assert packed in path.read_bytes()
    assert files.list_pages(path, "a") == [((20, 31), bits, False, "")]
    np.testing.assert_array_equal(read(path), pixels)


@pytest.mark.parametrize(("turn", "stored"), [(2, RAMP[:, ::-1]), (3, RAMP[::-1, ::-1]), (4, RAMP[::-1])])
def test_mirrored_rows_are_turned_back(tmp_path, turn, stored):
    """The first stored row is the lower one, the first column the right one, or both (TIFF 6.0, Orientation)."""
    path = tiff(tmp_path, stored, extratags=[(274, 3, 1, turn, True)])
    np.testing.assert_array_equal(read(path), RAMP)


TAGS = {
    "palette": (lambda f: tiff(f, SMALL, photometric="palette", colormap=np.zeros((3, 256), np.uint16)), "PALETTE"),
    "colour filters": (lambda f: with_tag(tiff(f), 262, 32803), "raw frame behind colour filters"),
    "rows as columns": (lambda f: tiff(f, extratags=[(274, 3, 1, 6, True)]), "Orientation is 6"),
    "lowest bit first": (lambda f: renamed(tiff(f, extratags=[(65000, 3, 1, 2, True)]), 65000, 266), "FillOrder is 2"),
    "a curve": (lambda f: tiff(f, extratags=[(291, 3, 4, (0, 9, 99, 999), True)]), "GrayResponseCurve"),
    "a channel of alpha": (lambda f: tiff(f, np.stack([RAMP] * 2, -1), extrasamples=["unassalpha"]), "2 channels"),
    "planes of colour": (
        lambda f: tiff(f, np.stack([RAMP] * 3), photometric="rgb", planarconfig="separate"),
        "has red, green and blue; sensor.channel in instrument.yaml must say which",
    ),
    "signed": (lambda f: tiff(f, RAMP.astype(np.int16)), "int16 pixels .SampleFormat"),
    "float": (lambda f: tiff(f, RAMP.astype(np.float16)), "float16 pixels .SampleFormat"),
    "four bits": (lambda f: tiff(f, SMALL % 16, bitspersample=4), "BitsPerSample 4"),
    "JPEG": (lambda f: tiff(f, SMALL, compression="jpeg"), "Compression is JPEG"),
    "a volume": (lambda f: tiff(f, np.stack([RAMP] * 2), volumetric=True, tile=(16, 16, 16)), "ImageDepth"),
    "ImageJ's signed numbers": (
        lambda f: tiff(f, imagej=True, metadata={"c0": -32768, "c1": 1, "cf": 0}), "calibration of values by ImageJ",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", TAGS)
def test_tags_that_make_other_numbers_are_named(tmp_path, kind):
    """A sentence with the tag."""
    make, word = TAGS[kind]
    with pytest.raises(InputError, match=word):
        files.list_pages(make(tmp_path), "a")


def test_previews_need_no_row(tmp_path):
    """A reduced copy of another page, in colours as thumbnails are (NewSubfileType 1)."""
    with tifffile.TiffWriter(tmp_path / "a.tif") as out:
        out.write(RAMP, photometric="minisblack", metadata=None)
        out.write(np.zeros((5, 8, 3), np.uint8), photometric="rgb", subfiletype=1, metadata=None)
    assert [page.preview for page in files.list_pages(tmp_path / "a.tif", "a")] == [False, True]


def imagej_of_one_directory(folder, stack: np.ndarray, byteorder: str):
    """An ImageJ stack whose directories end with the first, as above 4 GB."""
    path = tiff(folder, stack, imagej=True, byteorder=byteorder)
    content = bytearray(path.read_bytes())
    at = struct.unpack(byteorder + "I", content[4:8])[0]
    after = at + 2 + 12 * struct.unpack(byteorder + "H", content[at : at + 2])[0]
    content[after : after + 4] = bytes(4)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("kind", ["ImageJ", "tifffile"])
@pytest.mark.parametrize("byteorder", ["<", ">"])
def test_stacks_of_one_directory(tmp_path, kind, byteorder):
    """Pages that one directory stands for, as ImageJ writes above 4 GB: tifffile's own series says which they are."""
    stack = np.stack([RAMP + k for k in range(5)])
    if kind == "ImageJ":
        path = imagej_of_one_directory(tmp_path, stack, byteorder)
    else:
        path = tiff(tmp_path, stack, truncate=True, byteorder=byteorder)
    with tifffile.TiffFile(path) as own:
        assert len(own.pages) == 1 and own.series[0].shape == stack.shape
    assert files.list_pages(path, "a") == [((20, 32), 16, False, "")] * 5
    for page in range(5):
        np.testing.assert_array_equal(read(path, page), stack[page])


@pytest.mark.parametrize(("kept", "word"), [(4, "the stack of 5 images (ImageDescription) is cut short"), (1, "")])
def test_a_stack_of_one_directory_that_is_cut_short(tmp_path, kept, word):
    """Four of five images are refused; one alone was taken out of its stack and is read."""
    path = imagej_of_one_directory(tmp_path, np.stack([RAMP + k for k in range(5)]), "<")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) - (5 - kept) * RAMP.nbytes])
    if word:
        with pytest.raises(InputError) as caught:
            files.list_pages(path, "a")
        assert word in str(caught.value)
    else:
        assert files.list_pages(path, "a") == [((20, 32), 16, False, "")]
        np.testing.assert_array_equal(read(path), RAMP)


def test_pages_in_a_circle_and_pages_cut_off(tmp_path):
    """Neither a hang nor a shorter stack: the last directory leads back to the second, then beyond the file's end."""
    path = tiff(tmp_path, np.stack([RAMP + k for k in range(200)]), metadata=None)
    with tifffile.TiffFile(path) as own:
        own.pages.get(199)
        places = [own.pages.get(k).offset for k in range(200)]
    content = bytearray(path.read_bytes())
    for target, word in ((places[1], "in a circle"), (len(content) + 9, "cut short")):
        count = struct.unpack("<H", content[places[-1] : places[-1] + 2])[0]
        after = places[-1] + 2 + 12 * count
        content[after : after + 4] = struct.pack("<I", target)
        assert word in refusal(saved(tmp_path, content))


def chunk(name: bytes, content: bytes) -> bytes:
    """A chunk of a PNG file."""
    return len(content).to_bytes(4) + name + content + zlib.crc32(name + content).to_bytes(4)


def png_of(columns: int, rows: int, more: bytes = b"", packed: bytes = b"", bits: int = 8) -> bytes:
    """A grey PNG file with chunks before its pixels."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", columns, rows, bits, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + more + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def claiming_tiff(folder, columns: int, rows: int, **options) -> bytes:
    """A TIFF file of a kilobyte whose header claims a size, in one strip."""
    path = tiff(folder, SMALL, rowsperstrip=20, **options)
    for code, value in ((256, columns), (257, rows), (278, rows)):
        with_tag(path, code, value)
    return path.read_bytes()


CLAIMS = {
    "TIFF": claiming_tiff,
    **{
        f"TIFF by {name}": lambda folder, *size, name=name: claiming_tiff(folder, *size, compression=name)
        for name in ("zlib", "lzw", "packbits", "zstd", "lzma")
    },
    "PNG": lambda folder, *size: png_of(*size, packed=zlib.compress(bytes(1000))),
    "PGM": lambda folder, *size: b"P5 %d %d 255\n" % size + bytes(1000),
    "PGM as text": lambda folder, *size: b"P2 %d %d 255\n" % size + b"7 " * 1000,
}


@pytest.mark.parametrize("kind", CLAIMS)
@pytest.mark.parametrize(
    ("columns", "rows", "words"),
    [(100_000, 1_000_000, "claims 100000 × 1000000 px"), (20_000, 20_000, "cut short")],
)
def test_headers_that_claim_too_much(tmp_path, kind, columns, rows, words):
    """Refused before a pixel is decoded: a size that no frame has, or one for which the file is too short.

    Deflate gives 1032 bytes for one at most.
    """
    assert words in refusal(saved(tmp_path, CLAIMS[kind](tmp_path, columns, rows)))


PGM_START = b"P5 32 20 255\n"
# Content and what is said of it, by the readers of the header and of the pixels.
BROKEN = {
    **{f"TIFF of {length} bytes": (b"II*\0\x08\0\0\0"[:length], "cut short") for length in range(2, 9)},
    "a transparent value": (png_of(4, 4, chunk(b"tRNS", b"\0\7")), "its chunk tRNS makes pixels of one value"),
    "a film": (png_of(4, 4, chunk(b"acTL", bytes(8))), "its chunk acTL makes it a film of several images"),
    "no bits": (png_of(4, 4, chunk(b"sBIT", b"\0")), "its chunk sBIT says 0 of 8 bits"),
    "nibbles": (png_of(4, 4, bits=4), "holds 4 bit pixels"),
    "two graymaps": ((PGM_START + SMALL.tobytes()) * 2, "is 653 bytes longer than its header says"),
    "bytes before": (PGM_START + bytes(16) + SMALL.tobytes(), "is 16 bytes longer than its header says"),
    "bytes behind": (PGM_START + SMALL.tobytes() + b"\0", "is 1 bytes longer than its header says"),
    "a header of comments": (b"P5\n" + b"# " * 30_000, "no whole PGM header"),
    "PPM": (b"P6 2 2 255\n" + bytes(12), "is colour (PPM); it must be one channel"),
    "PBM": (b"P4 2 2 255\n" + bytes(12), "is black and white (PBM); it must be one channel"),
}


@pytest.mark.parametrize(("content", "words"), BROKEN.values(), ids=BROKEN)
def test_files_that_are_no_whole_frame(tmp_path, content, words):
    """A sentence that names the chunk or the part."""
    assert words in refusal(saved(tmp_path, content))


@pytest.mark.parametrize(
    "scale",
    [
        lambda v: v << 4,
        lambda v: v << 4 | v >> 8,
        lambda v: np.rint(v * (65535 / 4095)),
    ],
    ids=["shifted", "repeated", "scaled"],
)
def test_significant_bits_of_a_png(tmp_path, scale):
    """Twelve bits in sixteen, by each way of scaling that the standard knows (section 12.4), come back as they were."""
    extra = PngImagePlugin.PngInfo()
    extra.add(b"sBIT", b"\x0c")
    Image.fromarray(scale(RAMP).astype(np.uint16)).save(tmp_path / "a.png", pnginfo=extra)
    assert files.list_pages(tmp_path / "a.png", "a") == [((20, 32), 12, False, "")]
    np.testing.assert_array_equal(read(tmp_path / "a.png"), RAMP)
    Image.fromarray(RAMP).save(tmp_path / "a.png", pnginfo=extra)
    with pytest.raises(InputError, match="sBIT says that 12 of 16 bits hold readings, but the low ones do as well"):
        read(tmp_path / "a.png")


@pytest.mark.parametrize("after", [b"\r\n", b" # taken by hand\n", b"# x\n", b"\n"])
def test_what_stands_between_a_graymap_and_its_header(tmp_path, after):
    """The end of a line of Windows, and comments, are no pixels."""
    path = saved(tmp_path, b"P5\n32 20\n255" + after + SMALL.tobytes(), "a.pgm")
    np.testing.assert_array_equal(read(path), SMALL)


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        (b"-5 1", "holds pixels that are not whole numbers"),
        (b"300 1", "holds the value 300, above its own white of 255"),
        (b"9999999999999999999999 1", "not whole numbers"),
        (b"1", "cut short"),
        (b"7 8 9", "holds 3 numbers where its header says 2"),
        (b"7 # seven\n9\n", None),
    ],
)
def test_pixels_of_text_graymaps(tmp_path, pixels, words):
    """Values do not wrap, and comments between them are skipped."""
    path = saved(tmp_path, b"P2\n2 1\n255\n" + pixels, "a.pgm")
    if words is None:
        assert read(path).tolist() == [[7, 9]]
    else:
        with pytest.raises(InputError, match=words):
            read(path)


@pytest.mark.parametrize("name", ["a.tif", "a.png", "a.pgm", "A.TIF"])
def test_first_bytes_tell_the_format(tmp_path, name):
    """Whatever a file is called."""
    path = tmp_path / name
    for write in (
        lambda: Image.fromarray(RAMP).save(path, "PNG"),
        lambda: tifffile.imwrite(path, RAMP),
        lambda: path.write_bytes(b"P5 32 20 4095\n" + RAMP.astype(">u2").tobytes()),
    ):
        write()
        np.testing.assert_array_equal(read(path), RAMP)


@pytest.mark.parametrize("kind", ["BMP", "JPEG", "GIF", "WebP"])
def test_other_formats_are_called_by_their_names(tmp_path, kind):
    """The true cause, whatever a file is called."""
    Image.fromarray(SMALL).save(tmp_path / "a.tif", kind)
    assert f"is {kind}" in refusal(tmp_path / "a.tif") and "save it as TIFF, PNG or PGM" in refusal(tmp_path / "a.tif")
