"""What files held when they were last looked at: content counts, and stamps only save reading it again."""

import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from spotcheck.cli import main
from spotcheck.crops.cropping import crop_spots
from spotcheck.crops.ingest import ingest_frames
from spotcheck.dataset import file_cache, frames
from spotcheck.errors import InputError
from spotcheck.io import provenance, store
from tests.samples.small_datasets import gaussian, loaded

CROP = "crop_px: 40\n"
OLD_S = 1_600_000_000


@pytest.fixture
def pair(tmp_path) -> tuple[Path, Path]:
    """Two files of one size and one age, and of different content."""
    paths = tmp_path / "a.tif", tmp_path / "b.tif"
    for path, text in zip(paths, ("one", "two"), strict=True):
        path.write_text(text)
        os.utime(path, (OLD_S, OLD_S))
    return paths


def settled(look: file_cache.FileRecord) -> file_cache.FileRecord:
    """A look at a file that was left alone for long; here it was made just now."""
    return replace(look, is_final=True)


@pytest.mark.parametrize(
    "overwrite", [shutil.copy2, lambda a, b: Path(a).replace(b)], ids=["cp -p, rsync -t --inplace", "mv, rsync -t"]
)
def test_another_content_of_equal_size_and_age_is_seen(pair, overwrite):
    own, other = pair
    before = settled(file_cache.record_file(own))
    time.sleep(0.02)  # disks count time in steps of 4 ms
    overwrite(str(other), str(own))
    after = file_cache.record_file(own, before)
    assert (after.size, after.mtime_ns) == (before.size, before.mtime_ns)
    assert after.sha256 != before.sha256


def test_a_touched_file_has_the_same_digest(pair):
    own, _ = pair
    before = settled(file_cache.record_file(own))
    own.touch()
    after = file_cache.record_file(own, before)
    assert after.sha256 == before.sha256 and after.mtime_ns != before.mtime_ns


def test_a_file_left_alone_is_not_read(pair, monkeypatch):
    own, _ = pair
    before = settled(file_cache.record_file(own))
    monkeypatch.setattr(provenance, "file_digest", None)
    assert file_cache.record_file(own, before) is before


def test_a_file_that_was_just_written_is_read_again(pair):
    """A second change within the same step of the disk's clock bears the same stamps."""
    own, _ = pair
    before = file_cache.record_file(own)
    assert not before.is_final
    own.write_text("six")
    forged = replace(before, mtime_ns=own.stat().st_mtime_ns, ctime_ns=own.stat().st_ctime_ns)
    assert file_cache.record_file(own, forged).sha256 != before.sha256


def test_memory_is_kept_and_never_trusted_blindly(pair, tmp_path):
    """What cannot be read of it is as if it were not there; equal looks are not written again."""
    memory = tmp_path / "seen.json"
    found = file_cache.record_files([*pair, tmp_path / "gone.tif"], file_cache.read_cache(memory))
    assert list(found) == [str(path) for path in pair]
    file_cache.write_cache(found, memory)
    assert file_cache.read_cache(memory) == found
    before = memory.stat()
    file_cache.write_cache(found, memory)
    assert memory.stat().st_mtime_ns == before.st_mtime_ns
    for broken in ("", "[1]", '{"a.tif": [1, 2]}', "{"):
        memory.write_text(broken)
        assert file_cache.record_files(pair, file_cache.read_cache(memory)) == found


def spot_frames(count: int = 3) -> list[np.ndarray]:
    """Frames with a spot, each brighter than the last."""
    return [np.round(20 + gaussian(64, 300 + 50 * k, 30.0, 33.0, 5.0)).astype(np.uint16) for k in range(count)]


def overwriting(monkeypatch, path: Path, when: str) -> None:
    """Let another program overwrite a frame, and give it its old times back, once the file named `when` was read."""
    read, status = frames.read_image, path.stat()

    def spoiled(dataset, frame):
        pixels = read(dataset, frame)
        if frame.file.endswith(when):
            time.sleep(0.02)
            tifffile.imwrite(path, spot_frames(7)[-1])
            os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
        return pixels

    monkeypatch.setattr(frames, "read_image", spoiled)


@pytest.mark.parametrize("when", ["f1.tif", "f2.tif"])
def test_a_frame_that_changes_while_it_is_ingested_is_refused(tmp_path, monkeypatch, when):
    """Or its digest would stand beside other pixels."""
    own = loaded(tmp_path / "d", spot_frames(), CROP)
    overwriting(monkeypatch, own.folder / "frames" / "f1.tif", when)
    with pytest.raises(InputError, match=r"^frames/f1\.tif: has changed while it was read; run again"):
        ingest_frames(own)


def test_a_frame_that_changed_after_ingest_is_refused(tmp_path, capsys):
    """By the command, with one sentence; an earlier result stays."""
    own = loaded(tmp_path / "d", spot_frames(), CROP)
    table, result = tmp_path / "out" / "frames.nc", tmp_path / "out" / "crops.nc"
    main(["ingest", str(own.folder), "--output", str(table)])
    main(["crop", str(own.folder), "--frames", str(table), "--output", str(result)])
    before = result.read_bytes()
    shutil.copy(own.folder / "frames" / "f0.tif", own.folder / "frames" / "f2.tif")
    with pytest.raises(SystemExit) as stopped:
        main(["crop", str(own.folder), "--frames", str(table), "--output", str(result)])
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert said == "spotcheck: frames/f2.tif: has changed since it was ingested; run again when nothing writes to it\n"
    assert result.read_bytes() == before


def test_a_frame_that_changes_while_it_is_cropped_is_refused(tmp_path, monkeypatch):
    own = loaded(tmp_path / "d", spot_frames(), CROP)
    table = ingest_frames(own)
    overwriting(monkeypatch, own.folder / "frames" / "f0.tif", "f2.tif")
    with pytest.raises(InputError, match=r"^frames/f0\.tif: has changed since it was ingested"):
        crop_spots(own, table, tmp_path / "crops.nc", code="c", inputs=[])
    assert not (tmp_path / "crops.nc").exists()


def test_frames_as_they_were_are_cropped(tmp_path):
    """Touched, they are what they were."""
    own = loaded(tmp_path / "d", spot_frames(), CROP)
    table = ingest_frames(own)
    (own.folder / "frames" / "f1.tif").touch()
    crop_spots(own, table, tmp_path / "crops.nc", code="c", inputs=[])
    with store.read(tmp_path / "crops.nc") as ds:
        assert ds.sizes["repeat"] == 3
