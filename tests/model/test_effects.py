"""The vocabulary of effects: the dataset contract's words, strengths at which nothing happens, one file an effect."""

import ast
import importlib
import sys

import numpy as np
import pytest

from spotcheck.cli import main
from spotcheck.io.provenance import list_sources
from spotcheck.model import effects
from spotcheck.model.effect_file import EXAMPLE
from spotcheck.model.effects import vocabulary
from spotcheck.model.forward import LAW_PARAMETERS
from spotcheck.model.stage import Stage
from spotcheck.report.pages import effects as page
from tests.samples.effect_cases import (
    ELLIPSES,
    FRAMES,
    FRINGES,
    GHOST,
    HALO,
    MEAN_EXAMPLE,
    PEDESTALS,
    SCALES,
    SENSOR,
    expected_of,
    knowing,
    model_light,
    model_of,
    of,
    title,
    written,
)
from tests.samples.small_datasets import ROOT

# The contract's table and "keys under parameters", with its units; constants of a variant are not among them. Behind
# them are two effects that the contract does not have.
CONTRACT = {
    "saturation": {"level": "DN"},
    "nonlinearity": {"q": "1"},
    "black_clipping": {"threshold": "DN"},
    "dark_offset": {"level": "DN"},
    "background_gradient": {"level": "DN", "slope": "DN per 100 px", "direction": "deg"},
    "super_gaussian": {"n": "1"},
    "scatter_halo": {"fraction": "1", "radius": "px"},
    "fibre_anisotropy": {"ratio": "1"},
    "beam_ellipticity": {"ratio": "1", "direction": "deg"},
    "angle_reflectance": {"d": "1", "gamma0": "deg"},
    "photon_budget": {"q": "1"},
    "shutter_offset": {"offset": "s"},
    "spread_law": {"exponent": "1"},
    "motion_blur": {"speed": "px/s", "direction": "deg"},
    "interference_fringes": {"d": "1", "period": "px", "direction": "deg"},
    "ghost_reflection": {"fraction": "1", "dx": "px", "dy": "px"},
    "speckle": {"contrast": "1", "grain": "px"},
    "excess_read_noise": {"total": "e-"},
    "power_fluctuation": {"rms": "1"},
    "laser_drift": {"total": "1"},
    "pointing_jitter": {"rms": "px"},
    "fixed_pattern": {"prnu": "1", "hot_pixels": "1"},
    "row_noise": {"rms": "DN"},
    "smear": {"fraction": "1"},
    "beam_profile": {"power": "1", "order": "1"},
    "site_variation": {"brightness": "1", "width": "1"},
}
every_effect = pytest.mark.parametrize("name", CONTRACT)
every_scale = pytest.mark.parametrize("scales", SCALES.values(), ids=SCALES)


def test_the_vocabulary_is_the_contracts():
    """Names in the contract's order, numbered from 1."""
    assert list(vocabulary()) == list(CONTRACT)
    assert [effect.number for effect in vocabulary().values()] == list(range(1, len(CONTRACT) + 1))
    assert all(name == effect.name for name, effect in vocabulary().items())


@every_effect
def test_an_effect_is_well_formed(name):
    """Keys and units are the contract's; and what the rest of the library relies on."""
    effect = vocabulary()[name]
    assert {p.name: p.unit for p in effect.parameters if not p.is_variant_specific} == CONTRACT[name]
    # The strength is one that a person is told.
    assert not effect.parameters[0].is_variant_specific
    assert effect.sentence[0].islower() and not effect.sentence.endswith(".")
    assert len({variant.value for variant in effect.variants}) == len(effect.variants) > 0
    assert set(effect.replaces) <= set(LAW_PARAMETERS)
    # A shape is learned, not fitted.
    assert bool(list(effect.starts(EXAMPLE))) == bool(effect.stages) == (name != "beam_profile")
    for variant in effect.variants:
        assert {p.name for p in effect.parameters_of(variant)} >= set(CONTRACT[name])


@every_scale
@every_effect
def test_bounds_hold_the_starts(name, scales):
    """One value a parameter, all within the bounds, which are in order; and the strength has room on either side."""
    effect = vocabulary()[name]
    low, high = effect.bounds(scales).T
    assert np.all(low < high)
    for start in effect.starts(scales):
        assert len(start) == len(effect.parameters)
        assert np.all(low <= start) and np.all(start <= high), (start, low, high)


VANISHED = [
    of("nonlinearity", q=0.0),
    *(of("black_clipping", variant, threshold=0.0) for variant in ("subtracted", "dead zone")),
    *(of("dark_offset", variant, level=0.0) for variant in ("light", "electronic")),
    of("super_gaussian", n=1.0),
    *(case.changed(fraction=0.0) for case in (*HALO, GHOST)),
    *(case.changed(ratio=1.0) for case in ELLIPSES[:3]),
    of("angle_reflectance", d=0.0, gamma0=30.0),
    of("photon_budget", q=0.0),
    of("shutter_offset", offset=0.0),
    of("motion_blur", speed=0.0, direction=10.0),
    *(case.changed(d=0.0) for case in FRINGES),
    of("excess_read_noise", total=SENSOR.read_noise_e),
    of("laser_drift", total=0.0),
    of("laser_drift", "settling", total=0.0, rate=2.0),
    of("smear", fraction=0.0),
    *(of(name, rms=0.0) for name in ("power_fluctuation", "pointing_jitter", "row_noise")),
    of("speckle", contrast=0.0, grain=2.0),
    of("fixed_pattern", prnu=0.0, hot_pixels=0.0),
    of("site_variation", brightness=0.0, width=0.0),
]


@pytest.mark.parametrize("case", VANISHED, ids=title)
def test_an_effect_without_strength_changes_nothing(case):
    """Mean and variance of every reading, to rounding. `vanishes_at` is that strength, within its bounds; NaN where it
    depends on the sensor."""
    plain, without = (expected_of(cases, frames=FRAMES[:3]) for cases in ([], [case]))
    # ρ² is kept above 2e-12, so that its logarithm is finite; weights of paths and of quadratures sum to 1 to rounding.
    np.testing.assert_allclose(without, plain, rtol=1e-10, atol=1e-10)
    effect = vocabulary()[case.name]
    strength = case.values[effect.parameters[0].name]
    low, high = effect.bounds(SCALES["the paper's"])[0]
    assert low <= strength <= high
    assert effect.vanishes_at == strength or np.isnan(effect.vanishes_at)


def test_effects_that_never_vanish_say_so():
    """Saturation goes away as its level rises; a power law never is the logarithm."""
    missing = set(CONTRACT) - {case.name for case in VANISHED}
    assert missing == {"saturation", "background_gradient", "spread_law", "beam_profile"}
    assert np.isinf(vocabulary()["saturation"].vanishes_at) and np.isnan(vocabulary()["spread_law"].vanishes_at)
    # Tables without an end are interpolated at other nodes: 1e-4 of the noise.
    far = expected_of([of("saturation", "sharp", level=1e9)])
    np.testing.assert_allclose(far, expected_of([]), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("variant", ["light", "electronic"])
def test_a_gradient_without_slope_is_a_dark_offset(variant):
    """The contract's "simplest wins" needs the two to be one there, and nothing at level 0. Tables of whole offsets
    stand a quarter of the noise apart, and cubics between them are off by 1e-3 of its rounding."""
    for level in (0.0, 12.0):
        flat = expected_of([of("background_gradient", variant, slope=0.0, level=level, direction=40.0)])
        plain = expected_of([of("dark_offset", variant, level=level)])
        np.testing.assert_allclose(flat, plain, rtol=1e-5 if variant == "electronic" else 1e-11)


# One effect, one file.

EFFECTS_PAGE = ROOT / "workflow" / "docs" / "effects.md"


@pytest.fixture
def vignetting(tmp_path):
    """The page's own example, as a file of the user's."""
    _, first, _ = EFFECTS_PAGE.read_text(encoding="utf-8").split("```python\n")
    with knowing(written(tmp_path, "vignetting", first.split("```")[0])):
        yield vocabulary()["vignetting"]


def test_a_new_file_is_a_new_effect(vignetting):
    """The example as it stands: last in the vocabulary, with bounds and a start, and at its place in the chain."""
    assert list(vocabulary()) == [*CONTRACT, "vignetting"]
    (start,) = vignetting.starts(SCALES["the paper's"])
    low, high = vignetting.bounds(SCALES["the paper's"]).T
    assert np.all(low <= start) and np.all(start <= high)
    case = of("vignetting", a=0.3)
    pixels, others = FRAMES[0].pixels, [HALO[1], GHOST]
    factor = np.maximum(1 - 0.3 * ((pixels.x - 209.5) ** 2 + (pixels.y - 149.5) ** 2) / 100**2, 0)
    np.testing.assert_allclose(model_light([*others, case]), model_light(others) * factor, rtol=1e-12)
    # A pedestal does not pass the lens.
    np.testing.assert_allclose(model_light([case, PEDESTALS[0]]), model_light([case]) + 17.0, rtol=1e-12)
    assert (model_light([of("vignetting", a=1.0)]) == 0).any()


def test_a_new_effect_can_be_fitted(vignetting):
    """Means of its own making give its strength back through `jacobian`, by Gauss–Newton from its start."""
    frame, truth = FRAMES[2], expected_of([of("vignetting", a=0.08)], frames=FRAMES[2:3])[0, 0]
    (a,) = vignetting.starts(SCALES["the paper's"])[0]
    for _ in range(6):
        model = model_of([of("vignetting", a=a)])
        now, (slope, _) = model.expected(frame), model.jacobian(frame, ["vignetting.a"])
        a += np.sum(slope[0] * (truth - now.mean) / now.variance) / np.sum(slope[0] ** 2 / now.variance)
    assert a == pytest.approx(0.08, rel=1e-6)


def test_a_file_in_the_folder_is_an_effect_of_the_library(tmp_path, monkeypatch):
    """Without any list that names it; in its place by number."""
    written(tmp_path, "vignetting", MEAN_EXAMPLE.replace('name="vig', f'number={len(CONTRACT) + 1},\n    name="vig'))
    monkeypatch.setattr(effects, "__path__", [*effects.__path__, str(tmp_path)])
    effects.built_in.cache_clear()
    importlib.invalidate_caches()
    try:
        assert list(effects.built_in()) == [*CONTRACT, "vignetting"]
    finally:
        monkeypatch.undo()
        vars(effects).pop("vignetting")
        sys.modules.pop(f"{effects.__name__}.vignetting")
        effects.built_in.cache_clear()


# Quantities of EMVA 1288, which bear the names of effects → where they are named.
EMVA = {
    "dark_offset": {
        *(f"characterization/{name}.py" for name in ("contradictions", "derived_quantities", "emva_quantities")),
        *(f"characterization/{name}.py" for name in ("photon_transfer", "sensor_choice")),
        *("discrepancy/flat_levels.py", "report/figures/photon_transfer.py"),
    },
    "saturation": {"characterization/transfer_data.py", "report/figures/photon_transfer.py"},
}


def test_no_effect_is_named_outside_its_file():
    """What the library knows of an effect stands in its file alone; an effect may say which ones it contains."""
    library = ROOT / "workflow" / "spotcheck"
    named: dict[str, set[str]] = {}
    for path in library.rglob("*.py"):
        own = vocabulary().get(path.stem) if path.parent.name == "effects" else None
        allowed = {own.name, *own.special_cases} if own else set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and node.value in CONTRACT and node.value not in allowed:
                named.setdefault(node.value, set()).add(path.relative_to(library).as_posix())
    assert named == EMVA


def test_the_page_is_up_to_date(tmp_path, capsys):
    """workflow/docs/effects.md is what `spotcheck effects` writes."""
    main(["effects", "--output", str(tmp_path / "effects.md")])
    assert (tmp_path / "effects.md").read_text(encoding="utf-8") == EFFECTS_PAGE.read_text(encoding="utf-8")
    assert f"{len(CONTRACT)} effects" in capsys.readouterr().out


def test_the_page_says_it_all():
    """Every effect with number and sentence, every parameter with its unit, every variant, every stage; links that lead
    somewhere; what a bound depends on in words."""
    text = EFFECTS_PAGE.read_text(encoding="utf-8")
    assert all(f"\n| {stage.title} | " in text for stage in Stage)
    for effect in vocabulary().values():
        section = text[text.index(f"## {effect.number}. [{effect.name}]") :].split("\n## ")[0]
        assert effect.sentence[1:] in section
        assert all(f"{stage.title} ({stage.value.action}" in section for stage in effect.stages)
        assert all(f"| `{p.name}` | {p.unit} |" in section for p in effect.parameters)
        assert all(f"`{variant.value}`" in section for variant in effect.variants if variant.value)
    for target in [part.split(")")[0] for part in text.split("](")[1:]]:
        assert (EFFECTS_PAGE.parent / target).exists(), target
    assert "| `offset` | s | −0.5 × shortest exposure | 0.5 × shortest exposure |" in text
    assert "1000 × (read noise + 1)" in text


def test_bounds_in_words():
    """Sums in products keep their brackets; what is more than arithmetic is said to come from the data."""
    assert page.describe_bound(0.25) == "0.25" and page.describe_bound(-np.inf) == "any"
    assert page.describe_bound(lambda c: -c.crop_px / 4) == "−crop / 4"
    assert page.describe_bound(lambda c: 2 - (c.crop_px + 1) * 3) == "2 − (crop + 1) × 3"
    assert page.describe_bound(lambda c: 1 / (c.peak_dn - c.full_scale_dn)) == "1 / (peak − full scale)"
    assert page.describe_bound(lambda c: c.peak_dn - (c.crop_px - 1)) == "peak − (crop − 1)"
    assert page.describe_bound(lambda c: max(c.peak_dn, 3.0)) == "set by the data"


def test_code_digests_follow_the_effects():
    """Effects are found, not imported by name, and an edit of one must re-run what used it all the same."""
    covered = {path.name for path in list_sources("spotcheck.cli.effects")}
    missing = [name for name in CONTRACT if f"{name}.py" not in covered]
    assert missing == []
