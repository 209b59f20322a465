"""Parts of the report: sentences of every state, packing of frames, reasons in the table, colours of the style."""

import base64
import re
import zlib

import numpy as np
import pytest

from spotcheck.report.dataset_page import evidence, frame_packing, frame_remarks
from spotcheck.report.dataset_page.frame_remarks import Deviation
from spotcheck.report.dataset_page.gap import plot_gap
from spotcheck.report.dataset_page.summary import number_keys, summarize
from spotcheck.report.figures import style
from spotcheck.report.pages import TEMPLATES
from spotcheck.report.pages.citations import Citations
from spotcheck.report.views import rms_residual
from spotcheck.sensor import SensorModel
from spotcheck.sensor.model import noise_line
from tests.samples.findings_cases import KINDS, whole
from tests.samples.small_datasets import ROOT

# What the first sentence of each state must say, and what is said of the next measurement.
SAID = {
    "agree": ("agrees with the model within the noise", "No further measurement is needed; more"),
    "one": (
        "the signal stops at a level, below the converter's full scale (saturation, level 521 ± 5 DN)",
        "No further",
    ),
    "four": ("and 3 more effects were detected", "0.6 % of the peak remains unexplained"),
    "light": ("the light does not have the declared shape: 6 % of its power lies elsewhere", "No further"),
    "pair": ("either ", "Measure next: 12 frames at an exposure of 1.8 ms and 22.5°"),
    "three": ("these frames cannot separate them", "which would separate ghost_reflection from scatter_halo"),
    "unknown": ("no known effect explains the difference", "the residual is largest in row 96"),
    "not assessed": ("Nothing could be tested: there is no usable spot frame", "before that is corrected"),
    "not converged": ("No effect is named: the fits behind the effects did not converge", "before the fits converge"),
    "flats": ("The measured levels disagree with a linear sensor", "No further"),
}


@pytest.mark.parametrize("kind", SAID)
def test_every_state_is_said_aloud(kind):
    """The verdict, and what to measure next, also where no measurement is advised."""
    sentences, (verdict, following) = summarize(whole(kind)), SAID[kind]
    assert verdict in sentences.verdict and following in sentences.advice
    if kind == "pair":
        assert "No measurement is known" in summarize(whole(kind) | {"advice": []}).advice


@pytest.mark.parametrize("kind", KINDS)
def test_three_sentences_at_most(kind):
    """Each of them one sentence, with nothing left of what is not known."""
    for text in summarize(whole(kind)):
        assert text == "" or text.endswith(".")
        assert not re.search(r"\. [A-Z]|None|nan|\.\.", text), text


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("one", "less than once in ten thousand measurements (p < 0.0001)"),
        ("agree", "in 32 % of such measurements (p = 0.32)"),
        ("one, weak", "no disagreement (p = 0.2), but tests of single effects do, and"),
        ("unknown, no test", "(p = 0.32), but the residual exceeds the tolerance."),
    ],
)
def test_how_sure_has_its_number(kind, said):
    """Where the overall test finds nothing, single effects are significant, or the residual exceeds the tolerance."""
    assert said in summarize(whole(kind)).significance


def test_flats_say_their_gain_first():
    """By the straight line, and with what was added where anything was; each with the key of its number."""
    plain, bent = (whole(kind) for kind in ("agree", "one"))
    gains = {"straight_line": (0.28, 0.0014), "gain_dn_per_e": (0.2908, 6e-4)}
    for verdict in (plain, bent):
        verdict["levels"] = {name: dict(zip(("value", "stderr"), gain, strict=True)) for name, gain in gains.items()}
    text = summarize(plain).significance
    assert text.endswith("; the gain K is 0.2800 ± 0.0014 DN/e-, by a straight line (EMVA 1288).")
    assert "the gain K is 0.2908 ± 0.0006 DN/e- with this effect; a straight" in summarize(bent).significance
    assert number_keys(bent)["0.2908 ± 0.0006 DN/e-"] == "verdict.levels.gain_dn_per_e"


def test_the_gap_is_shown_where_there_is_one():
    gap = plot_gap(whole("four"))
    assert gap is not None
    # Of 81.0 − 1.00 four fifths are closed.
    assert [(number.name, number.text) for number in gap.numbers] == [
        ("before", "81.0"), ("after", "17.0"), ("noise floor", "1.00")
    ]  # fmt: skip
    assert (gap.closed, gap.on) == ("80 %", "held-out repeats")
    assert plot_gap(whole("one, nothing held out")) is None


def unpacked(text: str, layers: dict[str, frame_packing.Layer]) -> dict[str, np.ndarray]:
    """Integers of each layer by the steps that frames.js takes."""
    whole = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    size, out = whole.size // len(layers), {}
    for k, (name, own) in enumerate(layers.items()):
        low, high = whole[k * size : (k + 1) * size].reshape(2, -1).astype(np.uint16)
        values = (low | (high << 8)).reshape(own.readings.shape)
        for _ in range(2 * own.is_smooth):
            values = np.cumsum(values, axis=1, dtype=np.uint16)
        out[name] = values + out[own.base] if own.base else values
    return out


@pytest.mark.parametrize("full_scale", (255, 1023, 65535))
def test_frames_come_back(full_scale):
    """Measured readings exactly, gaps as such, means to half a step."""
    rng = np.random.default_rng(5)
    measured = rng.integers(0, full_scale + 1, (40, 40)).astype(float)
    smooth = full_scale * np.exp(-((np.arange(40) - 20.0) ** 2) / 50) * np.ones((40, 1))
    step = frame_packing.choose_step(full_scale)
    layers = {
        "measured": frame_packing.Layer(measured, 1.0, False),
        "extended": frame_packing.Layer(smooth, step, True),
        "without x": frame_packing.Layer(0.7 * smooth, step, True, "extended"),
    }
    found = unpacked(frame_packing.pack_layers(layers), layers)
    np.testing.assert_array_equal(found["measured"], measured)
    for name in ("extended", "without x"):
        np.testing.assert_allclose(found[name] * step, layers[name].readings, atol=step / 2)
    measured[3, 4] = np.nan
    gaps = {"measured": frame_packing.Layer(measured, 1.0, False)}
    found = unpacked(frame_packing.pack_layers(gaps), gaps)["measured"]
    assert found[3, 4] == frame_packing.MISSING and np.sum(found == frame_packing.MISSING) == 1


def test_blocks_are_means():
    """Of whole blocks alone, NaN where one of their pixels is."""
    image = np.arange(35.0).reshape(5, 7)
    image[0, 0] = np.nan
    found = frame_packing.block_means(image, 2)
    assert found.shape == (2, 3) and np.isnan(found[0, 0])
    assert found[1, 2] == image[2:4, 4:6].mean()


@pytest.mark.parametrize(("count", "whole"), [(1, 15e6), (96, 15e6), (1000, 40e6), (20_000, 40e6)])
@pytest.mark.parametrize("side", (64, 240))
def test_a_page_stays_small(count, whole, side):
    """Frames that cannot be deflated, of 16 bits and with four models, are thinned until all of them have room, and no
    further."""
    rng = np.random.default_rng(6)
    images = rng.integers(0, 65_536, (2, 5, side, side)).astype(float)

    def packed_size(frame: np.ndarray, block: int) -> int:
        means, step = [frame_packing.block_means(image, block) for image in frame], frame_packing.choose_step(65_535)
        layers = {str(k): frame_packing.Layer(image, step, is_smooth=k > 0) for k, image in enumerate(means)}
        return len(frame_packing.pack_layers(layers))

    def size(block: int) -> float:
        return float(np.mean([packed_size(frame, block) for frame in images]))

    block = frame_packing.choose_block(size, count)
    assert frame_packing.frames_budget(count) == pytest.approx(whole - frame_packing.RESERVED_BYTES, rel=1e-3)
    assert count * size(block) <= frame_packing.frames_budget(count)
    assert block == 1 or count * size(block - 1) > frame_packing.frames_budget(count)


def test_reasons_in_words():
    own = {"brighter": Deviation(0.2, 0.01), "wider": Deviation(-0.05, 0.001), "right": Deviation(3.0, 0.1),
           "down": Deviation(-4.0, 0.1)}  # fmt: skip
    assert frame_remarks.describe_deviations(own) == [
        "20 % brighter and 5 % narrower than predicted by the law", "5 px off its site's centre"
    ]  # fmt: skip
    assert frame_remarks.describe_deviations({"brighter": Deviation(0.2, 0.1), "wider": Deviation(0.001, 1e-6)}) == []
    assert frame_remarks.describe_flags(16, "", 1) == ["1 pixel at full scale"]
    assert frame_remarks.describe_flags(256, "", 0) == ["the pixels are those of another frame"]


def test_the_place_where_most_is_left():
    """Four pixels of 50 DN in a noise of 1 DN, seen from the centre; noise alone is not worth a word (of 576 blocks one
    passes 6 standard deviations once in a million frames)."""
    noise = np.random.default_rng(2).standard_normal((48, 48))
    variance = np.ones((48, 48))
    assert frame_remarks.describe_residual(noise, variance, (23.5, 23.5)) == ""
    noise[10:12, 40:42] = 50.0
    said = frame_remarks.describe_residual(noise, variance, (23.5, 23.5))
    assert said == "largest residual 17 px to the right and 13 px above the centre: +50 DN"


def test_what_is_left_is_in_units_of_the_noise():
    """Shot, read and rounding noise by their formula (EMVA 1288): K (µ − black) + (K σ)² + 1/12."""
    sensor = SensorModel(0.11, 13.0, black_level_dn=12.0, full_scale_dn=1023.0)
    line, mean = noise_line(sensor), np.full((200, 200), 400.0)
    variance = 0.11 * (400 - 12) + (0.11 * 13) ** 2 + 1 / 12
    np.testing.assert_allclose(line.variance(mean)[0, 0], variance, rtol=1e-6)
    measured = mean + np.sqrt(variance) * np.random.default_rng(1).standard_normal(mean.shape)
    rms, over = rms_residual(measured, mean, line)
    # Of 40,000 pixels: 0.35 % is one standard deviation.
    assert rms == pytest.approx(np.sqrt(variance), rel=0.02) and over == pytest.approx(1, rel=0.02)


def test_a_number_without_a_result_is_plain(tmp_path):
    """Marked where a result holds it, and escaped in any case."""
    citations = Citations(tmp_path)
    assert citations.cite("p < 0.1", "verdict.detection.p_value") == "p &lt; 0.1"
    assert citations.cite_in("a < b and 3 px", {"3 px": "fits.nothing"}) == "a &lt; b and 3 px"


def test_colours_are_those_of_the_figures():
    """page.css repeats them for a light ground."""
    text = (ROOT / "workflow/spotcheck/report/pages/page.css").read_text(encoding="utf-8").upper()
    for name, own in (("MEASURED", style.MEASURED), ("SIMULATED", style.SIMULATED), ("ACCENT", style.ACCENT)):
        assert f"--{name}: {own.upper()}" in text


@pytest.mark.parametrize("kind", KINDS)
def test_every_verdict_has_its_tables(tmp_path, kind):
    """A row for each effect, the learned shape too, which has no cells; no value is missing in words of the program."""
    verdict, citations = whole(kind), Citations(tmp_path)
    content = evidence.tabulate_evidence(verdict, citations)
    assert [row["name"] for row in content["effects"]] == [effect["name"] for effect in verdict["effects"]]
    tests = [effect["evidence"]["consistency"] for effect in verdict["effects"]]
    assert [row["cells"] for row in content["effects"]] == ["–" if test is None else test["cells"] for test in tests]
    assert (evidence.compare_data_sheet(verdict) is None) == (not verdict["sheet"])
    text = TEMPLATES.get_template("dataset_page/evidence.html").render(evidence=content)
    assert not re.search(r"\bNone\b|\bnan\b", text)


def test_a_number_is_marked_where_it_stands_alone(monkeypatch, tmp_path):
    """Not within another, and once."""
    citations = Citations(tmp_path)
    monkeypatch.setattr(citations, "_describe", lambda key: "of " + key)
    marked = citations.cite_in("p < 0.0001 of 10 in order 0. At 0 DN.", {"0": "order"})
    assert marked.startswith("p &lt; 0.0001 of 10 in order <span") and marked.endswith(">0</span>. At 0 DN.")


def test_counts_are_no_numbers_of_the_verdict():
    """The order of a learned shape, a whole number, is not taken for how many effects more there are."""
    verdict = whole("light and one")
    shape = next(effect for effect in verdict["effects"] if effect["name"] == "beam_profile")
    keys = number_keys(verdict)
    assert f"{shape['parameters']['order']['value']:.0f}" not in keys
    assert "verdict.effects.beam_profile.power" in keys.values()
