"""What frames read beside their crops: the law of its statistic without anything there, and what stands out."""

from functools import partial

import numpy as np
import pytest

from spotcheck.discrepancy.calibration import Kind
from spotcheck.discrepancy.cells import Setting
from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.extend import Tolerance, investigate
from spotcheck.discrepancy.locate import where
from spotcheck.discrepancy.look import look_at
from spotcheck.discrepancy.sentence import sentence
from spotcheck.discrepancy.shots import Blocks, Shot
from spotcheck.discrepancy.surround import LEFT, surround_of
from spotcheck.discrepancy.verdict import Judgement, prepared, verdict_json
from spotcheck.frames import reduce_frame
from spotcheck.model.baseline import Baseline
from spotcheck.model.sensor import SensorModel
from tests.library.null_laws import null_law
from tests.library.small_verdict import present

FRAME, CROP, BLOCK, SIGMA = 384, 96, 64, 12.0
SENSOR = SensorModel(0.11, 10.0, black_level_dn=3.0, full_scale_dn=1023.0)
KIND = Kind(CROP, 10, "free", False)


def shots_of(rng, beside=0.0, bend=0.0, repeats=2, rows=0.0, hot=0):
    """Frames of 384 px with a spot in the middle, at two angles; light of a source beside the crop [DN]; a response
    that bends; rms of the rows' own offsets [DN]; hot pixels, the same in every frame."""
    y, x = np.mgrid[:FRAME, :FRAME].astype(float)
    spikes = np.zeros(FRAME**2)
    spikes[rng.choice(FRAME**2, hot, replace=False)] = 150.0
    corner = (FRAME - CROP) // 2
    out = []
    for angle in (0.0, 45.0):
        for repeat in range(repeats):
            x0, y0 = FRAME / 2 + rng.uniform(-1, 1, 2)
            light = 600 * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * SIGMA**2))
            light += beside * np.exp(-((x - 60) ** 2 + (y - 200) ** 2) / (2 * 20.0**2))
            signal = 0.11 * (rng.poisson(light / 0.11) + rng.normal(0, 10.0, light.shape))
            signal -= bend * np.maximum(signal, 0) ** 2 / 1023
            signal += rows * rng.standard_normal((FRAME, 1)) + spikes.reshape(x.shape)
            frame = np.clip(np.rint(3.0 + signal), 0, 1023)
            crop = frame[corner : corner + CROP, corner : corner + CROP]
            blocks = Blocks(reduce_frame(frame.astype(np.uint16)).block_mean, BLOCK)
            shot = Shot(angle, 3e-4, repeat, len(out), (), corner, corner, partial(np.array, crop))
            out.append(shot._replace(beside=lambda blocks=blocks: blocks))
    return out


def opened(shots):
    setting = Setting(Baseline(0.0, "free", False, 3e-4), SENSOR, float(FRAME), ((FRAME - 1) / 2,) * 2)
    return (*prepared(shots, setting, KIND), setting)


def around_of(shots):
    chosen, design, base, setting = opened(shots)
    look = look_at(chosen, design, base, setting)
    return look, surround_of(chosen, look, account(look, ()))


@pytest.mark.slow
def test_without_anything_there_it_is_a_normal_number():
    """Of 80 sets mean and standard deviation are 0 and 1 within three standard errors (0.34, 0.24): a false alarm in
    200. Null laws draw it from this law instead of from whole frames."""
    rng = np.random.default_rng(31)
    found = np.array([around_of(shots_of(rng))[1].statistic for _ in range(80)])
    assert abs(found.mean()) < 0.34 and abs(found.std(ddof=1) - 1) < 0.24


def test_a_source_beside_the_crop_stands_out_on_its_side():
    look, around = around_of(shots_of(np.random.default_rng(32), beside=8.0))
    assert around.statistic > 20 and around.off() > 0.2
    rows = where(look, account(look, ()), 0.01, around=around)
    assert rows[0]["block"] == "surround" and rows[0]["bin"]["quantity"] == "blocks left of the crops"


@pytest.mark.parametrize(
    "own, options",
    [(present("row_noise", 1.0), {"rows": 1.0}), (present("fixed_pattern", 0.0, 200.0), {"hot": 200})],
)
def test_what_an_effect_brings_to_the_whole_frame_is_no_surprise_beside_the_crops(own, options):
    """Rows scatter and pixels are hot there too: with that in the model the statistic is a normal number (of 12 sets
    the mean is within four standard errors of 0, 1.2; a false alarm in 16,000)."""
    rng = np.random.default_rng(34)
    found = np.array([with_and_without(shots_of(rng, **options), own) for _ in range(12)])
    assert found[:, 0].min() > 4
    assert abs(found[:, 1].mean()) < 1.2


def test_a_source_is_seen_beside_rows_that_scatter():
    shots = shots_of(np.random.default_rng(35), beside=8.0, rows=1.0)
    assert with_and_without(shots, present("row_noise", 1.0))[1] > 8


def with_and_without(shots, own):
    chosen, design, base, setting = opened(shots)
    look = look_at(chosen, design, base, setting)
    return [surround_of(chosen, look, account(look, effects)).statistic for effects in ((), (own,))]


def test_frames_without_their_surroundings_have_none():
    shots = [s._replace(beside=None) for s in shots_of(np.random.default_rng(33))]
    assert around_of(shots)[1] is None
    small = [s._replace(beside=lambda: Blocks(np.zeros((2, 2)), 48), left=0, top=0) for s in shots]
    assert around_of(small)[1] is None


@pytest.mark.slow
@pytest.mark.parametrize(("bend", "names"), [(0.0, []), (0.12, ["nonlinearity"])])
def test_a_verdict_says_that_it_does_not_explain_the_frames(bend, names, laws):
    """Crops that agree, or of which a name explains all, beside a source that no crop shows: `unknown`, with the name
    kept."""
    shots = shots_of(np.random.default_rng(34), beside=40.0, bend=bend, repeats=4)
    chosen, design, base, setting = opened(shots)
    found = investigate(chosen, design, base, setting, null_law(laws, design, KIND), Tolerance())
    verdict = verdict_json(Judgement(found, None, [], ""), "beside", Tolerance())
    assert verdict["status"] == "unknown" and [own["name"] for own in verdict["effects"]] == names
    verdict["where"] = where(found.look, found.base, 0.01, found.detection, found.around)
    assert any(row["block"] == "surround" for row in verdict["where"])
    text = sentence(verdict)
    assert LEFT in text and "blocks left of the crops" in text
    assert ("beside them on the frames is not" in text) == bool(names)
