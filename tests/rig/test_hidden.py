"""Blind test cases: what they promise about frames, files, strength and meaning, from the contract's formulas alone.

Random checks have fixed seeds; each states the chance that a correct program fails it with another seed.
"""

import csv
import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
import tifffile
import yaml
from scipy import optimize

from rig import hidden
from rig.errors import RigError
from rig.hidden import fields, lights, registry, sensors, strength
from rig.hidden.chain import expose, moments
from rig.hidden.world import World

ALL = np.arange(264)
Y, X = np.mgrid[0:264, 0:264].astype(float)
CENTRE = 131.5


@pytest.fixture
def coarse(monkeypatch):
    """Strengths judged on few pixels: for tests that want many cases, not exact strengths."""
    monkeypatch.setattr(strength, "_PIXELS", 12_000)


def generator(*seed):
    return np.random.Generator(np.random.SFC64(list(seed)))


def plain_light(case, shot, top_hat=None):
    """The contract's baseline in DN without black level, written anew."""
    model, base = case.instrument["model"], case.truth["base"]

    def laws(t):
        p_b = base["p1"] * math.log(t) + base["p2"]
        sigma = p_b + laser_px(case.instrument)
        return sigma, (p_b / sigma) ** 2 if model["photon_budget"] == "spot_area" else t / sigma**2

    scale = base["peak_dn"] / max(laws(row["exposure_s"])[1] for row in case.manifest)
    sigma, peak = laws(shot.exposure_s)
    light = np.exp(-((X - shot.x_px) ** 2 + (Y - shot.y_px) ** 2) / (2 * sigma**2))
    if model["top_hat"] if top_hat is None else top_hat:
        light = np.minimum(light, math.exp(-1 / 4))
    return scale * peak * light


def laser_px(instrument):
    if "laser" not in instrument or "optics" not in instrument:
        return 0.0
    laser, optics = instrument["laser"], instrument["optics"]
    sigma_m = (laser["fwhm_x_m"] + laser["fwhm_y_m"]) / 2 / 2.3548
    magnification = optics["focal_length_m"] / optics["working_distance_m"]
    return magnification * sigma_m / instrument["sensor"]["pixel_pitch_m"]


def plain_moments(case, shot):
    """Mean [DN] and variance [DN^2] of a reading that neither the zero nor full scale cuts."""
    sensor = case.instrument["sensor"]
    gain = sensor["gain_dn_per_e"]
    electrons = plain_light(case, shot) / gain + sensor["dark_current_e_per_s"] * shot.exposure_s
    variance = gain**2 * (electrons + sensor["read_noise_e"] ** 2) + 1 / 12
    return gain * electrons + sensor["black_level_dn"], variance


def calm(case, **changes):
    """A case's baseline, changed."""
    return dataclasses.replace(case.world.base, **changes)


# Cases and their frames


def test_equal_seeds_give_equal_cases_and_frames(coarse):
    kind = "one:speckle:strong"
    one, two, other = (hidden.draw_case(seed, kind, "one_site") for seed in (5, 5, 6))
    assert (one.truth, one.instrument, one.manifest) == (two.truth, two.instrument, two.manifest)
    assert one.truth != other.truth
    first, second, third = ([frame for _, frame in hidden.frames(case)] for case in (one, two, other))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    assert not np.array_equal(first[0], third[0])
    assert not np.array_equal(first[0], first[1])


@pytest.mark.parametrize("budget", ["spot_area", "linear"])
@pytest.mark.parametrize("top_hat", [False, True])
def test_frames_of_none_have_the_contracts_mean_and_variance(budget, top_hat):
    # A black level and noise above 0.6 DN keep clip and rounding out of the expectation.
    def fits(case):
        sensor = case.instrument["sensor"]
        noise = sensor["gain_dn_per_e"] * sensor["read_noise_e"]
        loud = 0.7 < noise < sensor["black_level_dn"] / 6
        return loud and case.instrument["model"] == {"photon_budget": budget, "top_hat": top_hat}

    case = next(c for c in (hidden.draw_case(seed, "none", "three_repeats") for seed in range(1000)) if fits(c))
    assert case.truth["effects"] == []
    scores, levels = [], []
    for shot, (row, frame) in zip(case.shots, hidden.frames(case), strict=True):
        assert row["exposure_s"] == pytest.approx(shot.exposure_s)
        mean, variance = plain_moments(case, shot)
        scores.append((frame - mean) / np.sqrt(variance))
        levels.append(mean)
    score, level = np.concatenate(scores).ravel(), np.concatenate(levels).ravel()
    # In 12 bins of brightness, mean and variance to five standard errors: chance of a false alarm 1.4e-5.
    edges = np.quantile(level, np.linspace(0, 1, 13))
    for low, high in itertools.pairwise(edges):
        z = score[(level >= low) & (level <= high)]
        assert abs(z.mean()) < 5 / math.sqrt(z.size)
        assert abs((z**2).mean() - 1) < 5 * math.sqrt(2.1 / z.size)


def test_the_base_stays_within_its_ranges(coarse):
    seen = []
    for seed in range(60):
        case = hidden.draw_case(seed, "none")
        base, full = case.world.base, case.world.base.full_scale
        sigmas = [base.spread(t) + base.laser_px for t in base.exposures_s]
        assert 13.9 < min(sigmas) <= max(sigmas) < 36.1
        assert 1 <= base.p1 <= 8
        brightest = max(plain_light(case, shot).max() for shot in case.shots[:3])
        assert 0.39 * full < brightest < 0.851 * full
        assert base.laser_px == pytest.approx(laser_px(case.instrument))
        noise = math.sqrt(base.gain * brightest + (base.gain * base.read_noise) ** 2)
        assert brightest + base.black_level + 4.5 * noise < full
        seen.append((base.photon_budget, base.top_hat, base.black_level > 0, base.bit_depth))
    assert {s[0] for s in seen} == {"spot_area", "linear"} and {s[3] for s in seen} == {10, 12}
    assert {s[1] for s in seen} == {s[2] for s in seen} == {True, False}


@pytest.mark.parametrize("name", [name for name, effect in registry.VOCABULARY.items() if not effect.scatters])
def test_moments_are_those_of_the_draws(coarse, name):
    case = hidden.draw_case(3, f"one:{name}:strong")
    shot = case.shots[2]
    mean, variance = moments(case.world, case.world.view(shot, ALL, ALL))
    frames = np.stack([expose(case.world, shot, generator(3, k)) for k in range(6)]).astype(float)
    # Without pixels that hardly ever leave 0; five standard errors, chance of a false alarm 1e-6 a case.
    lively = variance > 0.2
    z = (frames - mean)[:, lively] / np.sqrt(variance[lively])
    kurtosis = (z**4).mean()
    assert abs((z**2).mean() - 1) < 5 * math.sqrt((kurtosis - 1) / z.size) + 0.01
    assert abs(z.mean()) < 5 / math.sqrt(z.size) + 0.003


# Strength


def plain_frame(kind):
    """The first case of a single frame without a top hat and far above 0; with its frame and its effect."""
    for seed in range(200):
        case = hidden.draw_case(seed, kind, "single_frame")
        if case.world.base.black_level > 25 and not case.world.base.top_hat:
            return case, case.shots[0], case.truth["effects"][0]
    raise AssertionError(kind)


def test_strength_of_a_pedestal_is_that_of_a_dense_fit():
    # One frame, no top hat: width, peak and centre are fitted, the pedestal's own mean and variance remain.
    case, shot, effect = plain_frame("one:dark_offset:strong")
    _, variance = plain_moments(case, shot)
    light = plain_light(case, shot)
    dx, dy = X - shot.x_px, Y - shot.y_px
    tangents = np.stack([light, light * (dx**2 + dy**2), light * dx, light * dy])
    window = np.s_[12:252, 12:252]
    root = 1 / np.sqrt(variance[window]).ravel()
    matrix = tangents[(slice(None), *window)].reshape(4, -1).T * root[:, None]
    offset = effect["parameters"]["level"] * root
    left = offset - matrix @ np.linalg.lstsq(matrix, offset, rcond=None)[0]
    assert effect["snr"] == pytest.approx(np.linalg.norm(left), rel=0.02)


def test_strength_of_flanks_is_that_of_a_nonlinear_fit():
    case, shot, effect = plain_frame("one:super_gaussian:faint")
    base, n = case.world.base, effect["parameters"]["n"]
    sigma = base.spread(500e-6) + base.laser_px
    window = np.s_[12:252:2, 12:252:2]
    x, y = X[window], Y[window]
    rho2 = ((x - shot.x_px) ** 2 + (y - shot.y_px) ** 2) / sigma**2
    truth = base.peak_dn * np.exp(-((rho2 / 2) ** n))
    deviation = np.sqrt(plain_moments(case, shot)[1][window])

    def misfit(p):
        model = p[0] * np.exp(-((x - p[2]) ** 2 + (y - p[3]) ** 2) / (2 * p[1] ** 2))
        return ((truth - model) / deviation).ravel()

    fit = optimize.least_squares(misfit, [base.peak_dn, sigma, shot.x_px, shot.y_px], x_scale="jac")
    assert effect["snr"] == pytest.approx(2 * math.sqrt(2 * fit.cost), rel=0.03)


def test_strength_of_scatter_is_the_log_likelihood_ratio():
    # 4000 rows whose means have variance s^2 + 1/F: twice the log ratio is s^2 F - ln(1 + s^2 F) on average.
    information, s = 240 / 1.7, 0.1
    means = generator(1).normal(0.0, math.sqrt(s**2 + 1 / information), 4000)
    ratio = means**2 * information - means**2 / (s**2 + 1 / information) - math.log(1 + s**2 * information)
    error = ratio.std() / math.sqrt(ratio.size)
    assert abs(ratio.mean() - strength.evidence(s**2 * information)) < 4 * error  # chance of a false alarm 6e-5


def test_excess_noise_and_power_have_their_analytic_strength():
    noise = hidden.draw_case(4, "one:excess_read_noise:mid", "single_frame")
    base = noise.world.base
    _, variance = moments(World(base), World(base).view(noise.shots[0], ALL[12:252], ALL[12:252]))
    total = noise.truth["effects"][0]["parameters"]["total"]
    if base.black_level > 0:
        ratio = 1 + base.gain**2 * (total**2 - base.read_noise**2) / variance
        assert noise.truth["effects"][0]["snr"] == pytest.approx(math.sqrt((ratio - 1 - np.log(ratio)).sum()), rel=0.02)
    power = hidden.draw_case(4, "one:power_fluctuation:strong", "one_site")
    s = power.truth["effects"][0]["parameters"]["rms"]
    total = 0.0
    for shot in power.shots:
        light, (_, variance) = plain_light(power, shot), plain_moments(power, shot)
        total += strength.evidence(s**2 * (light**2 / variance).sum())
    assert power.truth["effects"][0]["snr"] == pytest.approx(math.sqrt(total * 2 / 3), rel=0.05)


@pytest.mark.parametrize("level, low, high", [("faint", 5, 15), ("strong", 100, 1000)])
def test_strengths_reach_their_level(coarse, level, low, high):
    for name in hidden.EFFECTS:
        case = hidden.draw_case(2, f"one:{name}:{level}")
        (effect,) = case.truth["effects"]
        assert effect["name"] == name
        assert 0.95 * low < effect["snr"] < 1.05 * high, effect
        json.dumps(case.truth, allow_nan=False)


# Kinds and designs


@pytest.mark.slow
def test_every_effect_is_drawn_in_the_designs_that_show_it(coarse):
    laws = {"photon_budget", "shutter_offset", "spread_law"}
    impossible = {
        "default": set(),
        "two_exposures": {"spread_law"},
        "one_site": {"angle_reflectance"},
        "one_exposure": laws | {"pointing_jitter"},
        "single_frame": laws | {"pointing_jitter", "angle_reflectance", "power_fluctuation", "laser_drift"},
    }
    for design, hidden_there in impossible.items():
        # All effects of the default design are drawn in the tests above.
        for name in hidden.EFFECTS if design != "default" else ():
            kind = f"one:{name}:strong"
            if name in hidden_there:
                with pytest.raises(ValueError, match="not possible in this design"):
                    hidden.draw_case(1, kind, design)
            else:
                row, frame = next(hidden.frames(hidden.draw_case(1, kind, design)))
                assert frame.shape == (264, 264) and frame.dtype == np.uint16 and row["kind"] == "spot"
    assert hidden.draw_case(1, "one:shutter_offset:mid", "two_exposures").world.base.photon_budget == "linear"


@pytest.mark.parametrize(
    "kind, design, message",
    [
        *((kind, "default", "is no kind") for kind in ("one", "one:dust:strong", "two:smear:strong", "one:smear:huge")),
        ("none", "no_grid", "there are default"),
        ("one:spread_law:mid", "two_exposures", "not possible"),
    ],
)
def test_what_cannot_be_drawn_is_refused(kind, design, message):
    with pytest.raises(ValueError, match=message):
        hidden.draw_case(1, kind, design)


def test_designs_have_the_frames_that_they_promise():
    counts = {design: len(hidden.draw_case(0, "none", design).manifest) for design in hidden.DESIGNS}
    assert list(counts.values()) == [96, 64, 96, 36, 32, 3, 1]
    case = hidden.draw_case(0, "none", "eight_angles")
    assert len({row["file"] for row in case.manifest}) == 96
    assert {row["angle_deg"] for row in case.manifest} == {0, 22.5, 45, 67.5, 90, 112.5, 135, 157.5}
    places = {(s.angle_deg, s.repeat): (s.x_px, s.y_px) for s in case.shots}
    assert all(places[s.angle_deg, s.repeat] == (s.x_px, s.y_px) for s in case.shots)


# Files


def test_files_hold_the_frames_and_no_truth(tmp_path):
    case = hidden.draw_case(7, "one:smear:strong", "one_site")
    folder, truth = tmp_path / "set", tmp_path / "truth" / "set.json"
    hidden.write(case, folder, truth)
    with (folder / "manifest.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == ["file", "kind", "angle_deg", "exposure_s", "repeat"]
    assert [row["file"] for row in rows] == [row["file"] for row in case.manifest]
    for row, frame in hidden.frames(case):
        assert np.array_equal(tifffile.imread(folder / row["file"]), frame)
    assert yaml.safe_load((folder / "instrument.yaml").read_text()) == case.instrument
    assert json.loads(truth.read_text()) == case.truth
    written = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert written == {"manifest.csv", "instrument.yaml", *(row["file"] for row in rows)}
    assert not any("smear" in path.read_text() for path in (folder / "manifest.csv", folder / "instrument.yaml"))
    with pytest.raises(RigError, match="must not lie in"):
        hidden.write(case, folder, folder / "frames" / "truth.json")


# Meaning


def still(base, *effect, **changes):
    """Noise-free light of a middle shot under an effect."""
    case = hidden.draw_case(1, "none")
    shot = dataclasses.replace(case.shots[1], x_px=CENTRE, y_px=CENTRE, **changes)
    world = World(base, *effect)
    view = world.view(shot, ALL, ALL)
    return world.light(view), view


def spread_of(light):
    """Second moments [px^2]: xx, xy, yy."""
    x, y = X - (light * X).sum() / light.sum(), Y - (light * Y).sum() / light.sum()
    return tuple((light * a * b).sum() / light.sum() for a, b in ((x, x), (x, y), (y, y)))


def test_directions_run_from_x_towards_y_downwards():
    base = calm(hidden.draw_case(1, "none"), top_hat=False, p1=0.0, p2=15.0, laser_px=0.0)
    shapes = registry.VOCABULARY
    plain, _ = still(base)
    ellipse, _ = still(base, shapes["beam_ellipticity"](math.log(1.44), direction=90.0))
    xx, xy, yy = spread_of(ellipse)
    assert yy / xx == pytest.approx(1.44**2, rel=1e-3)
    assert xx * yy == pytest.approx(15.0**4, rel=1e-3)  # area unchanged
    moved, _ = still(base, shapes["motion_blur"](20.0 / 300e-6, direction=45.0))
    xx, xy, yy = spread_of(moved)
    assert xx == pytest.approx(15.0**2 + 20.0**2 / 24, rel=1e-3) and xy == pytest.approx(20.0**2 / 24, rel=1e-2)
    assert moved.sum() == pytest.approx(plain.sum(), rel=1e-6)
    turned = shapes["fibre_anisotropy"](math.log(1.2), sense=-1.0, zero_deg=45.0)
    assert spread_of(still(base, turned, angle_deg=45.0)[0])[0] > 15.5**2  # long axis at -45 + 45 = 0: along x
    slope = lights.BackgroundGradient(2.0, "light", direction=90.0, lift=3.0)
    pedestal = still(base, slope)[0] - plain
    assert pedestal[231, 5] - pedestal[131, 5] == pytest.approx(2.0) and pedestal[0].std() < 1e-9
    assert pedestal.mean() == pytest.approx(6.0)


def test_ghost_halo_and_fringes_start_from_the_spot():
    base = calm(hidden.draw_case(1, "none"), top_hat=True)
    plain, view = still(base)
    peak = view.state.peak
    assert plain.max() == pytest.approx(peak * math.exp(-0.25))
    ghost = registry.VOCABULARY["ghost_reflection"](0.1, 30.0, 0.0)
    # The ghost copies the spot, top hat and all; the halo is a part of A, not of the plateau.
    copy = np.roll(plain, 30, axis=1)
    assert np.allclose((still(base, ghost)[0] - plain)[:, 60:200], 0.1 * copy[:, 60:200])
    halo = lights.ScatterHalo(0.05, 60.0, "exponential")
    radius = np.hypot(X - CENTRE, Y - CENTRE)
    assert np.allclose(still(base, halo)[0] - plain, 0.05 * peak * np.exp(-radius / 60.0))
    fringes = lights.InterferenceFringes(0.3, period=20.0, direction=0.0)
    assert np.allclose(still(base, fringes)[0], plain * (1 + 0.3 * np.cos(2 * np.pi * (X - CENTRE) / 20.0)))


def test_smear_adds_a_part_of_each_column():
    electrons = generator(2).random((264, 264))
    _, view = still(calm(hidden.draw_case(1, "none")))
    smeared = sensors.Smear(0.1).electrons(electrons, view)
    assert np.allclose(smeared.sum(axis=0), 1.1 * electrons.sum(axis=0))
    assert np.allclose((smeared - electrons).std(axis=0), 0, atol=1e-12)


@pytest.mark.parametrize("order", [0.0, 6.0])
def test_saturation_stops_at_its_level(order):
    base = calm(hidden.draw_case(1, "none"), top_hat=False, black_level=20.0, gain=0.1, read_noise=0.0, bit_depth=10)
    base = dataclasses.replace(base, peak_dn=900.0)
    clip = sensors.Saturation(900.0 / 500.0, 900.0, 0.1, "before read noise", order)
    frame = expose(World(base, clip), hidden.draw_case(1, "none").shots[2], generator(1))
    assert clip.parameters() == {"level": 500.0}
    assert frame.max() == 520 if order == 0 else 505 < frame.max() < 520


def test_black_clipping_takes_away_or_silences():
    base = calm(hidden.draw_case(1, "none"), black_level=0.0, gain=0.1, read_noise=10.0)
    shot = hidden.draw_case(1, "none").shots[2]
    plain = expose(World(base), shot, generator(1)).astype(int)
    lower = expose(World(base, sensors.BlackClipping(7.0, "subtraction")), shot, generator(1))
    dead = expose(World(base, sensors.BlackClipping(7.5, "dead zone")), shot, generator(1))
    assert np.array_equal(lower, np.maximum(plain - 7, 0))
    assert np.array_equal(dead, np.where(plain >= 8, plain, 0))


@pytest.mark.parametrize("patterns", [0, 1, 4])
def test_speckle_has_its_contrast_and_grain(patterns):
    grain = 7.0
    maps = [fields.speckle(9, site, grain, patterns) for site in range(12)]
    assert np.mean([m.var() for m in maps]) == pytest.approx(1.0, abs=0.06)
    covariance = np.mean([np.fft.ifft2(np.abs(np.fft.fft2(m - m.mean())) ** 2).real[0] for m in maps], axis=0)
    covariance /= covariance[0]
    half = np.interp(0.5, covariance[8::-1], np.arange(8, -1, -1))
    assert 2 * half == pytest.approx(grain, rel=0.08)
    assert maps[0].min() >= -math.sqrt(max(patterns, 1)) or patterns == 0
    assert not np.array_equal(maps[0], maps[1])


def test_scatter_has_its_size():
    case = hidden.draw_case(1, "none")
    shots, base = case.shots, case.world.base
    for seed in range(3):
        power = registry.VOCABULARY["power_fluctuation"].draw(generator(seed), base, shots).at(0.02)
        gains = [power.brightness(shot) for shot in shots]
        # 96 frames: four standard errors, chance of a false alarm 6e-5 each.
        assert np.std(gains) == pytest.approx(0.02, rel=4 / math.sqrt(2 * 96))
        jitter = registry.VOCABULARY["pointing_jitter"].draw(generator(seed), base, shots).at(0.5)
        assert np.std([jitter.shift(shot) for shot in shots]) == pytest.approx(0.5, rel=4 / math.sqrt(4 * 96))
        drift = registry.VOCABULARY["laser_drift"].draw(generator(seed), base, shots).at(0.1)
        run = np.array([drift.brightness(shot) for shot in shots])
        assert run[0] == 1.0 and abs(run[-1] - 1) == pytest.approx(0.1)
        assert (np.diff(run) > 0).all() or (np.diff(run) < 0).all()
