"""Pixels that are no readings: swapped bytes and false colours are refused, and sound images are not."""

import matplotlib
import numpy as np
import pytest
import tifffile
from PIL import Image

import spotcheck
from spotcheck.cli import main
from spotcheck.errors import InputError
from spotcheck.io.formats import files
from spotcheck.io.formats.colour import Colour
from spotcheck.quicklook.images import open_images
from spotcheck.quicklook.text_report import list_cautions


def draw_spot(bits: int, seed: int = 0, peak: float = 0.7, shape: tuple[int, int] = (90, 110)) -> np.ndarray:
    """Return a noisy spot whose peak is a part of the range of the converter."""
    rng = np.random.default_rng(seed)
    y, x = np.indices(shape)
    full = 2**bits - 1
    light = full * (0.05 + peak * np.exp(-((x - 47.2) ** 2 / 400 + (y - 51.9) ** 2 / 250)))
    noise = rng.normal(0, 1, shape) * np.sqrt(2.0 + 0.02 * light)
    return np.clip(np.rint(light + noise), 0, full).astype(np.uint16 if bits > 8 else np.uint8)


def draw_flat(mean: float) -> np.ndarray:
    """Return a flat with shot noise at a gain of 0.3 DN/e-."""
    return np.rint(0.3 * np.random.default_rng(5).poisson(mean / 0.3, (60, 70))).astype(np.uint16)


SWAPPED = {
    "10 bits": draw_spot(10),
    "12 bits": draw_spot(12),
    "14 bits": draw_spot(14),
    "a flat": draw_flat(1540),
}
eight = draw_spot(8).astype(np.uint16)
SOUND = {
    "16 bits": draw_spot(16),
    "12 bits": draw_spot(12),
    "a flat": draw_flat(500),
    "8 bits, left-aligned": eight << 8,
    "8 bits, left-aligned, with an offset": (eight << 8) + 7,
    "8 bits over the range of 16": eight * 257,
    "faint 8 bits over the range of 16": draw_spot(8, peak=0.15).astype(np.uint16) * 257,
    "10 bits, left-aligned": draw_spot(10) << 6,
    "8 bits": eight,
    "faint": draw_spot(12, peak=0.01) // 8,
    "faint, high black level": draw_spot(12, peak=0.001) // 8 + 1024,
    "a ramp": np.arange(10_000, dtype=np.uint16).reshape(100, 100),
    "two values": np.where(draw_spot(8) > 60, 65280, 3).astype(np.uint16),
}


@pytest.mark.parametrize("kind", SWAPPED)
@pytest.mark.parametrize("suffix", ["tif", "npy", "pgm", "pgm of its own white"])
def test_swapped_bytes_are_refused(kind, suffix, tmp_path):
    """In each format, with what to do; the image in the right order is read."""
    pixels = SWAPPED[kind]
    white = 65535 if suffix == "pgm" else int(pixels.max())
    path = tmp_path / f"a.{suffix[:3]}"
    for stored, is_refused in ((pixels.byteswap(), True), (pixels, False)):
        match suffix:
            case "tif":
                tifffile.imwrite(path, stored, photometric="minisblack")
            case "npy":
                np.save(path, stored)
            case _:
                path.write_bytes(b"P5 %d %d %d\n" % (*pixels.shape[::-1], white) + stored.astype(">u2").tobytes())
        if is_refused:
            with pytest.raises(InputError, match=r"a.*: has its high and low bytes swapped: .*; save it"):
                files.read_pixels(path, 0, "a")
        else:
            np.testing.assert_array_equal(files.read_pixels(path, 0, "a"), pixels)
    with pytest.raises(InputError, match="image 0: has its high and low bytes swapped"):
        open_images(pixels.byteswap())


@pytest.mark.parametrize("kind", SOUND)
def test_sound_values_are_read(kind):
    """Whatever lattice their values form."""
    assert len(open_images(SOUND[kind])[0]) == 1


def colour(red, green, blue) -> np.ndarray:
    """Return an RGB image of 8 bits."""
    return np.clip(np.rint(np.stack([red, green, blue], axis=-1)), 0, 255).astype(np.uint8)


def noisy(light: np.ndarray, seed: int, noise: float = 1.2) -> np.ndarray:
    """Return a channel with noise."""
    return light + np.random.default_rng(seed).normal(0, noise, light.shape)


grey = draw_spot(8, shape=(200, 240))
smooth = np.outer(np.hanning(200), np.hanning(240)) * 400 + 4
COLOURS = {
    "grey": colour(grey, grey, grey),
    "a tint": colour(0.9 * grey, 0.55 * grey + 12, 0.2 * grey),
    "one channel": colour(grey, 0 * grey, 0 * grey),
    "crosstalk, clipped": colour(*(noisy(part * smooth, seed) for seed, part in enumerate((1, 0.5, 0.2)))),
    "faint": colour(*(noisy(0.05 * part * smooth, seed, 0.6) for seed, part in enumerate((1, 0.5, 0.4)))),
    "no noise to speak of": colour(*(noisy(part * smooth, seed, 0.2) for seed, part in enumerate((0.6, 0.5, 0.2)))),
    "grey with a red mark": colour(*(np.where(np.indices(grey.shape)[0] == 9, mark, grey) for mark in (255, 0, 0))),
    "few pixels": np.random.default_rng(1).integers(0, 255, (12, 20, 3), np.uint8),
}


@pytest.mark.parametrize("name", COLOURS)
def test_channels_of_a_camera_are_read(name, tmp_path):
    """Also where they are proportional to each other."""
    Image.fromarray(COLOURS[name]).save(tmp_path / "a.png")
    np.testing.assert_array_equal(files.read_pixels(tmp_path / "a.png", 0, "a", Colour("green")), COLOURS[name][..., 1])
    assert len(open_images(tmp_path)[0]) == 1


SCALES = ["viridis", "winter", "jet", "hsv", "magma", "inferno", "turbo", "seismic", "cubehelix"]


@pytest.mark.parametrize("name", SCALES)
@pytest.mark.parametrize(("bits", "peak"), [(8, 0.7), (16, 0.7), (8, 0.35)])
def test_false_colours_are_refused(name, bits, peak, tmp_path):
    """Scales of colours as programs use them, also with a mark in another colour."""
    image = matplotlib.colormaps[name](draw_spot(8, 4, peak, (200, 240)))[..., :3]
    image[3] = 1.0, 1.0, 1.0
    pixels = np.rint(image * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb")
    with pytest.raises(InputError, match=r"a\.tif: is in false colours: .*; save the image"):
        open_images(tmp_path)
    with pytest.raises(InputError, match="false colours"):
        files.read_pixels(tmp_path / "a.tif", 0, "a.tif", Colour("red"))


def test_a_dataset_of_swapped_frames_is_refused_by_every_command(tmp_path, capsys):
    """`new-dataset` writes nothing, names a file once, and leaves it out beside sound ones; `check` refuses it."""
    swapped = np.stack([draw_spot(12, seed) for seed in range(3)]).byteswap()
    tifffile.imwrite(tmp_path / "a.tif", swapped, photometric="minisblack")
    with pytest.raises(SystemExit):
        main(["new-dataset", str(tmp_path)])
    assert capsys.readouterr().err.count("high and low bytes swapped") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]
    tifffile.imwrite(tmp_path / "b.tif", draw_spot(12, 4), photometric="minisblack")
    main(["new-dataset", str(tmp_path)])
    assert capsys.readouterr().out.count("a.tif: has its high and low bytes swapped") == 1
    manifest = (tmp_path / "manifest.csv").read_text()
    assert "b.tif" in manifest and "a.tif" not in manifest
    (tmp_path / "instrument.yaml").write_text("crop_px: 60")
    main(["check", str(tmp_path)])
    (tmp_path / "manifest.csv").write_text("file,kind,angle_deg,exposure_s,repeat,page\na.tif,spot,,,0,1\n")
    with pytest.raises(SystemExit) as refused:
        main(["check", str(tmp_path)])
    assert refused.value.code == 2 and "high and low bytes swapped" in capsys.readouterr().err


@pytest.mark.parametrize("shift", [0, 4], ids=["16 bits", "12 bits, left-aligned"])
def test_a_look_tells_swapped_bytes_from_no_spot(shift):
    image = draw_spot(16 - shift) << shift
    for readings, said in ((image, False), (image.byteswap(), True), (draw_flat(1540) << shift, False)):
        (one,) = spotcheck.look(readings).images
        assert any("bytes are swapped" in text for text in list_cautions(one)) == said
        assert (one.fit is None) == (said or readings.shape == (60, 70))
