"""Rival worlds: light, limits and speckle against closed forms; emulator and choice against known answers."""

from dataclasses import asdict

import numpy as np
import pytest

from spotcheck.paper.rivals import inference, predictions, summaries, worlds
from spotcheck.report.figures import rivals, style
from tests.validation.rivals import format_table

WORLDS = {world.name: world for world in worlds.WORLDS}
RNG_SEED = 3


def test_every_world_has_six_parameters():
    """So that none is preferred for its freedom."""
    assert len(WORLDS) >= 5 and {len(world.parameters) for world in worlds.WORLDS} == {6}


def test_speckle_is_fully_developed_before_pixels_average_it():
    """Mean 1; a contrast between that of independent grains in a pixel and 1 (a grain is wider than a pixel)."""
    pattern = worlds.draw_speckle(np.random.default_rng(RNG_SEED))
    assert pattern.shape == (worlds.SIDE, worlds.SIDE) and pattern.mean() == pytest.approx(1.0)
    assert 0.7 < pattern.std() < 1.0 and pattern.min() >= 0


def test_limits_of_the_sensor():
    """A clip stops at its level, a knee of high order nearly so, and a last slope adds its share of the electrons."""
    rng, electrons = np.random.default_rng(RNG_SEED), np.array([[1e3, 1e6]])
    values = {"level": 770.0, "level_scatter": 1e-9, "order": 20.0, "last_slope": 1e-3}
    level_e = 770.0 / worlds.GAIN_DN_PER_E
    assert WORLDS["gaussian clip"].limit(electrons, values, rng)[0] == pytest.approx([1e3, level_e], rel=1e-6)
    assert WORLDS["soft knee"].limit(electrons, values, rng)[0] == pytest.approx([1e3, level_e], rel=1e-3)
    assert WORLDS["multiple slope"].limit(electrons, values, rng)[0, 1] == pytest.approx(level_e + 1e3, rel=1e-9)


def test_a_clipped_gaussian_of_constant_width_grows_with_the_exposure():
    """Without scatter all sites are alike, and the widths of the fitted spots rise, as p1 ln t + p2 does."""
    values = {"width": 9.0, "peak": 9e3, "level": 770.0, "level_scatter": 0.01, "brightness_sd": 0.01, "contrast": 0.05}
    found = summaries.summarise_readings(WORLDS["gaussian clip"].draw(values, np.random.default_rng(RNG_SEED)))
    numbers = dict(zip((summary.name for summary in summaries.SUMMARIES), found, strict=True))
    assert 1.5 < numbers["p1"] < 3.5 and numbers["p1_sd"] < 0.1
    # All sites reach the level: maxima differ by its scatter and the read noise alone, a few per cent.
    assert numbers["maximum_spread"] < 0.02 * numbers["maximum_smallest"]


def test_the_emulator_finds_the_parameters_of_a_known_function():
    """Summaries whose logarithms are quadratic in two parameters, with noise of 1 %: the optimum within 0.02."""
    rng = np.random.default_rng(RNG_SEED)
    size = len(summaries.SUMMARIES)
    linear, bent = rng.normal(0, 1, (6, size)), rng.normal(0, 0.3, (6, size))
    # So large that no summary counts as the least share of the printed one.
    unit = 100 * summaries.PRINTED

    def simulate(points: np.ndarray, key: int) -> np.ndarray:
        noise = np.random.default_rng([RNG_SEED, key]).normal(0, 0.01, (len(points), size))
        return unit * np.exp(points @ linear + points**2 @ bent + noise)

    truth = np.array([0.4, 0.6, 0.5, 0.3, 0.7, 0.55])
    observed = unit * np.exp(truth @ linear + truth**2 @ bent)
    emulator = inference.build_emulator(WORLDS["growth"], simulate, observed, (RNG_SEED,))
    fit = inference.fit_world(emulator, observed)
    assert fit.point == pytest.approx(truth, abs=0.02) and fit.chi2 < 1 and emulator.has_converged


def test_a_world_is_chosen_only_if_it_is_decisively_more_likely():
    assert inference.choose_world({"a": -10.0, "b": -13.1}) == "a"
    assert inference.choose_world({"a": -10.0, "b": -12.9}) is None


def test_p_values_are_ranks_among_realisations():
    realisations = np.tile(np.arange(1.0, 100.0)[:, None], (1, len(summaries.SUMMARIES)))
    found = inference.p_values(realisations, np.full(len(summaries.SUMMARIES), 50.0))
    limits = np.array([summary.is_limit for summary in summaries.SUMMARIES])
    assert (found[~limits] == 1.0).all() and (found[limits] == 0.51).all()
    assert inference.p_values(realisations, np.full(len(summaries.SUMMARIES), 0.0))[0] == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("profile", "ratio"),
    [
        (lambda r: np.exp(-(r**2) / 200), np.sqrt(np.log(5) / np.log(1.25))),
        (lambda r: np.exp(-r / 10), np.log(5) / np.log(1.25)),
    ],
)
def test_profiles_are_told_apart_by_their_ratio_of_radii(profile, ratio):
    """√(ln 5/ln 1.25) = 2.69 for a Gaussian, its square 7.2 for an exponential; rings blur it by some per cent."""
    radius = np.hypot(*(np.indices((worlds.SIDE, worlds.SIDE)) - worlds.SIDE / 2))
    assert predictions.measure_profile_ratio(1e3 * profile(radius)) == pytest.approx(ratio, rel=0.1)


def test_frames_to_separate_two_predictions():
    """Means 1 apart with a standard deviation of 1 each: 25 · 2 frames for five standard errors."""
    first, second = (predictions.Prediction("x", "px", mean, 1.0) for mean in (0.0, 1.0))
    assert predictions.count_frames_to_separate(first, second) == 50
    assert predictions.count_frames_to_separate(first, first) == np.inf
    assert predictions.list_separations([[first], [second]]) == [[0.0, 50.0], [50.0, 0.0]]


def stored_record() -> dict:
    """A stored result with made-up numbers: two worlds, of which the first is preferred."""
    prediction_names = (
        *(f"{name}, exposure of {time} µs" for name in ("fitted width", "largest reading") for time in (10, 30)),
        "largest reading, 900 µs behind a filter of 1 %",
        "radius at 20 % over radius at 80 % of the profile, exposure of 30 µs",
    )
    world = {
        "title": "made up",
        "chi2_fitted": 3.0,
        "log_score": -10.0,
        "mean": summaries.PRINTED.tolist(),
        "sd": (0.1 * summaries.PRINTED).tolist(),
        "p_values": np.linspace(0.001, 1, len(summaries.SUMMARIES)).tolist(),
        "photon_gain": 40.0,
        "predictions": [{"experiment": name, "unit": "px", "mean": 5.0, "sd": 1.0} for name in prediction_names],
    }
    names = ("growth", "gaussian clip")
    recovery = {name: {**dict.fromkeys(names, 0), "cannot tell": 5, name: 15} for name in names}
    return {
        "summaries": [asdict(summary) for summary in summaries.SUMMARIES],
        "worlds": {names[0]: world, names[1]: world | {"log_score": -20.0}},
        "preferred": names[0],
        "recovery": recovery,
        "frames_to_separate": [[0, 4], [4, 0]],
    }


def test_figures_and_table_of_a_stored_result_say_what_it_holds(tmp_path):
    record = stored_record()
    captions = {}
    for name, draw in rivals.DRAWINGS:
        with style.house_style():
            drawing = draw(record)
            style.save_drawing(drawing, tmp_path, name)
        captions[name] = drawing.caption
    assert len(captions) <= 4 and all((tmp_path / f"{name}.svg").stat().st_size for name in captions)
    assert "The print prefers: growth" in captions["rivals-scores"]
    rows = zip(record["worlds"]["growth"]["p_values"], record["summaries"], strict=True)
    held_out = [p for p, summary in rows if not summary["is_fitted"]]
    assert f"Missed of {len(held_out)}: growth {sum(p < 0.05 for p in held_out)}" in captions["rivals-held-out"]
    assert "| growth: made up | 3 | -10 | " in format_table(record) and "| 15, 0, 5 |" in format_table(record)
