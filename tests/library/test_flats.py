"""Flats without spots, drawn by closed forms: what is linear is consistent, what was put in is named, and a misfit that
no effect explains names nothing."""

import numpy as np
import pytest

from spotcheck.estimate.levels import Level, Spatial, with_common_drift
from spotcheck.estimate.photon_transfer import transfer_of
from spotcheck.old_engine.conclude.flats import detected, judge_flats
from spotcheck.old_engine.model.effect import NEEDS, Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.observe.flats import Series, hidden, series_of
from spotcheck.old_engine.search.flats import (
    ASTRAY,
    Wide,
    deviance_of,
    fit_levels,
    holding_of,
    scatter_of,
    standard_of,
    widths,
)
from spotcheck.old_engine.verdict.document import document
from spotcheck.old_engine.verdict.sentence import sentence
from spotcheck.old_engine.verdict.written import breach_of_verdict, rounded

FULL, GAIN, BLACK, NOISE, TOP, LONGEST = 4095.0, 0.3, 30.0, 9.0, 3600.0, 6e-3
SHAPE = (480, 640)
PIXELS = SHAPE[0] * SHAPE[1]
DARK = (GAIN * NOISE) ** 2
# The lamp's drift between frames, as a part of its light.
DRIFT = 4e-4


def levels(seed, *, bend=0.0, late=0.0, power=0.0, offset=0.0, lamp=0.0, wave=0.0, count=30):
    """Two frames of each level, means and variances drawn by their laws, with errors from the drift between frames as
    `levels_of` has them. `bend`: y − q y²/full scale; `late` [s]; light with a `power` of exposure more, an `offset`
    [DN] of stray light, a `lamp` that scatters from level to level; a `wave` [DN] in the response."""
    rng = np.random.default_rng(seed)
    out = []
    for t in np.linspace(2e-4, LONGEST, count):
        light = TOP * ((t + late) / LONGEST) ** (1 + power) * (1 + lamp * rng.standard_normal()) + offset
        slope = 1 - 2 * bend * light / FULL
        mean = light - bend * (light**2 + GAIN * light) / FULL + wave * np.sin(6 * np.pi * light / FULL)
        for kind, signal, own in (("dark", 0.0, DARK), ("flat", mean, slope**2 * (GAIN * light + DARK))):
            own += 1 / 12
            drift = DRIFT * signal + np.sqrt(own / PIXELS)
            frames = BLACK + signal + drift * rng.standard_normal(2)
            spread = own * np.sqrt(2 / PIXELS)
            out.append(
                Level(kind, float(t), float(t * 1e6) if kind == "flat" else 0.0, 2, float(frames.mean()),
                      float(np.std(frames, ddof=1) / np.sqrt(2)), own + spread * rng.standard_normal(), float(spread),
                      0.0, 0.0, Spatial(0.0, 0.0, 0.0, 0.0), SHAPE)
            )  # fmt: skip
    # One level at the converter's end says where saturation is.
    return with_common_drift(
        [*out, out[-1]._replace(exposure_s=8e-3, photons=8000.0, mean=FULL, variance=0.0, at_full=1.0)]
    )


def series(seed, **changes) -> Series:
    own = series_of(transfer_of(levels(seed, **changes), FULL), FULL)
    assert own is not None
    return own


def verdict(seed, without=("saturation",), **changes):
    """The document with its sentence; it keeps the contract. Without what has six forms and three starts of each, but
    where it matters: most of the time goes there."""
    effects = [e for e in vocabulary().values() if e.name not in without]
    judgement = judge_flats(transfer_of(levels(seed, **changes), FULL), FULL, effects)
    out = document(judgement, "flats")
    out["sentence"] = sentence(out)
    assert breach_of_verdict(rounded(out)) is None
    return out


def present(name, *values, form=""):
    return Present(vocabulary()[name], form, values)


@pytest.mark.parametrize("lamp", [0.0, 5e-3])
def test_false_alarms_of_detection(lamp):
    """100 sets of linear flats; more than 4 below 1 % (11 below 5 %) would come by chance once in 300 (200) times. A
    lamp that scatters by ten times what two frames say is no alarm. Nor are p-values all near 1."""
    p = []
    for seed in range(100):
        own = series(seed, lamp=lamp, count=24)
        fit = fit_levels(own, ())
        p.append(detected(own, fit, standard_of(own, fit.slopes[0], scatter_of(own, fit))).p_value)
    assert np.sum(np.array(p) < 0.01) <= 4 and np.sum(np.array(p) < 0.05) <= 11
    assert 0.3 < np.median(p) < 0.8


@pytest.mark.parametrize(("seed", "lamp"), [(1, 0.0), (2, 0.0), (3, 5e-3)])
def test_linear_flats_are_consistent(seed, lamp):
    """Nothing of the whole vocabulary is named, and K is right within three of its errors."""
    own = verdict(seed, without=(), lamp=lamp)
    assert own["status"] == "consistent" and own["effects"] == []
    gain = own["levels"]["gain_dn_per_e"]
    assert abs(gain["value"] - GAIN) < 3 * gain["stderr"] and gain["stderr"] < 2e-3 * GAIN
    assert "Flats and a linear sensor agree" in own["sentence"] and "K = 0." in own["sentence"]
    assert ("The light scatters" in own["sentence"]) == (lamp > 0)
    # What may still be there is stated, and small.
    limits = {row["effect"]: row["high"] for row in own["limits"]}
    assert 0 < limits["nonlinearity"] < (0.02 if lamp else 2e-3)
    assert {row["effect"] for row in own["not_assessed"]} == {e.name for e in vocabulary().values() if e.flats}


def test_four_times_the_flats_halve_a_limit():
    """As the verdict says: 60 frames tell it, 180 more halve it. The mean of eight pairs of sets, whose ratios
    scatter by 0.37, is off by 0.4 once in 400 times."""
    effect, ratios = [vocabulary()["nonlinearity"]], []
    for seed in range(8):
        rows = [
            document(judge_flats(transfer_of(levels(seed, count=count), FULL), FULL, effect), "flats")["limits"][0]
            for count in (30, 120)
        ]
        assert [(row["frames"], row["more"]) for row in rows] == [(180, ""), (720, "")]
        few, many = (row["high"] - row["low"] for row in rows)
        ratios.append(few / many)
    assert abs(np.mean(ratios) - 2) < 0.4


@pytest.mark.parametrize(
    ("changes", "name", "key", "true"),
    [
        pytest.param({"bend": 0.05, "without": ()}, "nonlinearity", "q", 0.05, marks=pytest.mark.slow),
        ({"bend": -0.01}, "nonlinearity", "q", -0.01),
        ({"bend": 0.03, "lamp": 5e-3}, "nonlinearity", "q", 0.03),
        ({"power": 0.05}, "photon_budget", "q", 0.05),
    ],
)
def test_one_effect_is_named(changes, name, key, true):
    """Alone, with its strength and K within three standard errors, and foretold on unseen levels."""
    own = verdict(21, **changes)
    assert own["status"] == "named" and [e["candidates"] for e in own["effects"]] == [[name]]
    strength, gain = own["effects"][0]["parameters"][key], own["levels"]["gain_dn_per_e"]
    assert abs(strength["value"] - true) < 3 * strength["stderr"] < 0.3 * abs(true)
    assert abs(gain["value"] - GAIN) < 3 * gain["stderr"]
    assert own["gap"]["gain"] > 25 and own["gap"]["closed"] > 0.8 and own["gap"]["on"] == "unseen levels"
    assert "disagree" in own["sentence"] and "With it K = 0." in own["sentence"] and "peak" not in own["sentence"]


@pytest.mark.slow
def test_a_pedestal_is_tied_with_a_late_shutter():
    """A constant more of light at one lamp is a constant more of exposure: both are candidates, beside a bend that is
    certain. Alone the two look like light that grows with another power."""
    own = verdict(23, bend=0.03, offset=24.0)
    assert own["status"] == "ambiguous"
    by = {frozenset(e["candidates"]): e["parameters"] for e in own["effects"]}
    assert set(by) == {frozenset({"nonlinearity"}), frozenset({"dark_offset", "shutter_offset"})}
    q = by[frozenset({"nonlinearity"})]["q"]
    assert abs(q["value"] - 0.03) < 3 * q["stderr"]
    tied = next(iter(by[frozenset({"dark_offset", "shutter_offset"})].values()))
    true = 24.0 if tied["unit"] == "DN" else 24.0 / TOP * LONGEST
    assert tied["value"] == pytest.approx(true, abs=3 * tied["stderr"])
    assert "these levels cannot tell which" in own["sentence"]


def test_what_no_effect_explains_names_nothing():
    """A response that waves by 20 DN: its faint end looks like a pedestal, which would leave most of it. All of the
    wave is said to be left: 20/√2 DN of some 3600."""
    own = verdict(5, wave=20.0)
    assert own["status"] == "unknown" and own["effects"] == []
    assert own["unexplained"]["size"] == pytest.approx(20 / np.sqrt(2) / TOP, rel=0.15)
    assert "something else is at work" in own["sentence"]


def test_what_is_negligible_names_nothing_in_its_place():
    """A bend of 0.003 is certain, but nothing that matters; a soft knee of six forms would do as well, and is no name
    either."""
    rest = ("black_clipping", "dark_offset", "photon_budget", "shutter_offset")
    own = verdict(1, without=rest, bend=0.003)
    assert own["status"] == "unknown" and own["effects"] == []
    assert "It would be explained by nonlinearity, too small to matter." in own["sentence"]


def test_errors_follow_the_light():
    """Standardised, a mean and a variance that the light moves together have unit covariance: by the matrix itself."""
    own, wide = series(3), Wide(7.0, 2.0, 1.5)
    fit = fit_levels(own, ())
    by_light = fit.slopes[0]
    made = standard_of(own, by_light, wide)
    for k in (0, 15, 29 - 1):
        e, v = own.errors[:, k]
        light = (wide.mean**2 - 1) * e**2
        along = by_light[1, k] / by_light[0, k]
        covariance = np.array([[wide.mean**2 * e**2 + wide.off_dn**2, along * light],
                               [along * light, (wide.variance * v) ** 2 + along**2 * light]])  # fmt: skip
        units = np.zeros((2, 2, len(own.light)))
        units[0, 0], units[1, 1] = 1.0, 1.0
        linear = made(units)[:, :, k].T
        # Where light moves the mean fully, all but a hundredth of its scatter is told.
        np.testing.assert_allclose(linear @ covariance @ linear.T, np.eye(2), atol=0.03)


def test_widths_come_back():
    """Of 3000 levels with errors from 0.1 to 10 DN, widened by 3 and by 2 DN: within a step of the grid; and 1 and
    nothing where there is nothing."""
    rng = np.random.default_rng(4)
    count = 3000
    errors = np.stack([np.geomspace(0.1, 10, count), np.ones(count)])
    own = series(3)._replace(light=np.ones(count), errors=errors, unseen=np.zeros(count, bool))
    still = np.zeros((2, count))
    noise = rng.standard_normal((2, count))
    found = widths(own, noise * np.sqrt(np.stack([9 * errors[0] ** 2 + 4, 4 * errors[1] ** 2])), still, 0.0)
    assert (
        found.mean == pytest.approx(3, rel=0.1)
        and 1.5 < found.off_dn < 2.8
        and found.variance == pytest.approx(2, 0.05)
    )
    found = widths(own, noise * errors, still, 0.0)
    assert found.mean < 1.05 and found.off_dn < 0.15 and found.variance < 1.05


def test_consistency_by_its_law():
    """Of true bends Q is χ² of one less than its cells: its mean over 40 sets within three standard errors, and a bend
    in means alone, which noise contradicts, is far off."""
    q, cells = [], 0
    for seed in range(40):
        own = series(seed, bend=0.03)
        fit = fit_levels(own, [present("nonlinearity", 0.03)])
        told = holding_of(own, fit, fit_levels(own, ()), 0)
        q.append(told.q)
        cells = told.cells
        assert told.holds
    assert abs(np.mean(q) - (cells - 1)) < 3 * np.sqrt(2 * (cells - 1) / 40)
    own = series(1, bend=0.1)
    straight = series(1)
    own = own._replace(values=np.stack([own.values[0], straight.values[1]]))
    fit = fit_levels(own, [present("nonlinearity", 0.1)])
    assert not holding_of(own, fit, fit_levels(own, ()), 0).holds


def test_unseen_levels_tell():
    """A bend of a hundredth always makes them likelier; one that is not there in at most half of 20 sets, and never by
    more than chance."""
    gains = {}
    for bend in (0.01, 0.0):
        gains[bend] = []
        for seed in range(20):
            own = series(seed, bend=bend)
            plain, bent = fit_levels(own, ()), fit_levels(own, [present("nonlinearity", 0.01)])
            gains[bend].append(deviance_of(own, plain, own.unseen) - deviance_of(own, bent, own.unseen))
    assert min(gains[0.01]) > 10
    assert np.sum(np.array(gains[0.0]) > 0) <= 14 and max(gains[0.0]) < 9


def test_light_without_noise():
    """Where noise does not grow with the light, as where readings stop below full scale, K comes to an end."""
    own = series(5)
    still = np.stack([own.values[0], 0 * own.values[1]])
    fit = fit_levels(own._replace(values=still), ())
    assert fit.model.sensor.gain_dn_per_e == pytest.approx(own.model.sensor.gain_dn_per_e / ASTRAY, rel=1e-3)


def test_too_few_levels():
    """Said, and nothing else."""
    own = verdict(24, count=3)
    assert own["status"] == "not_assessed" and "levels" not in own
    assert "fewer than 6 levels" in own["sentence"] or "noise" in own["sentence"]


def test_lamps_that_change_hide_the_shutter():
    """Light that does not go with the exposure: no law of exposure can be told."""
    own = [level._replace(photons=level.photons * (1 + 0.3 * np.sin(k))) if level.kind == "flat" else level
           for k, level in enumerate(levels(25))]  # fmt: skip
    changed = series_of(transfer_of(own, FULL), FULL)
    assert changed is not None and not changed.timed
    of = vocabulary()
    assert hidden(of["shutter_offset"], changed) == hidden(of["photon_budget"], changed) == NEEDS["exposure"]
    assert hidden(of["nonlinearity"], changed) == "" == hidden(of["shutter_offset"], series(25))
