"""model.yaml: every effect is read as it was written, and what is wrong gets one sentence."""

import math
from dataclasses import replace

import pytest

from spotcheck.errors import InputError
from spotcheck.model.effect_file import EXAMPLE
from spotcheck.model.effects import vocabulary
from spotcheck.model.model_file import Site, Spot, read_model, reason_without_model
from tests.model.test_extended import GHOST, PLAIN, with_effects
from tests.samples.model_files import applied, model_text

VARIANTS = [(effect, variant) for effect in vocabulary().values() for variant in effect.variants if effect.stages]


@pytest.mark.parametrize(
    ("effect", "variant"), VARIANTS, ids=[f"{effect.name}-{variant.value}" for effect, variant in VARIANTS]
)
def test_what_is_written_is_read(effect, variant, tmp_path):
    """Every variant of every effect: names, variants and numbers to nine digits.

    Values lie a third of the way between the bounds; angles have none.
    """
    values = {}
    for parameter, (low, high) in zip(effect.parameters, effect.bounds(EXAMPLE), strict=True):
        if parameter in effect.parameters_of(variant):
            values[parameter.name] = low + (high - low) / 3 if math.isfinite(high - low) else 33.7
    text = model_text(with_effects(applied(effect.name, variant.value, **values)))
    (tmp_path / "model.yaml").write_text(text, encoding="utf-8")
    again = read_model(tmp_path / "model.yaml")
    assert model_text(again) == text
    assert replace(again, effects=()) == PLAIN
    (own,) = again.effects
    assert (own.effect, own.variant) == (effect, variant)
    known = {name: value for name, value in own.parameters.items() if not math.isnan(value)}
    assert known == {name: pytest.approx(value, rel=1e-8) for name, value in values.items()}


MODELS = {
    "effects in another order than the vocabulary's": with_effects(
        applied("smear", fraction=0.01), GHOST, applied("background_gradient", "light", level=3, slope=2, direction=40)
    ),
    "a spot for each frame": replace(
        PLAIN, law=None, spots={
            Site(None, None, 0, (("z_m", 0.05),)): Spot(10.5, 20.25, 400.0, 6.5),
            Site(45.0, 1e-5, 2, (("z_m", -1.0),)): Spot(11.0, 19.0, 0.0, 7.0),
        },
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_order_sites_and_conditions_come_back(name, tmp_path):
    (tmp_path / "m.yaml").write_text(model_text(MODELS[name]), encoding="utf-8")
    assert read_model(tmp_path / "m.yaml") == MODELS[name]


BAD = {
    "no file": (None, ["m.yaml", "is no file"]),
    "no YAML": (("law:", "law: ["), ["m.yaml line", "must be YAML"]),
    "unknown key": (("frame:", "farme:"), ["unknown key farme", "known keys here: schema"]),
    "unknown key in a section": (("p1_px", "p1_m"), ["unknown key law.p1_m", "p1_px, p2_px, peak_dn"]),
    "another schema": (("schema: 1", "schema: 2"), ["key schema is 2", "must be one of 1"]),
    "missing section": (("frame: {rows_px: 130, columns_px: 150}\n", ""), ["key frame is missing"]),
    "missing number": (("  p2_px: 11\n", ""), ["key law.p2_px is missing"]),
    "no number": (("p2_px: 11", "p2_px: wide"), ["key law.p2_px is 'wide'", "must be a number"]),
    "negative peak": (("peak_dn: 600", "peak_dn: -600"), ["law.peak_dn is -600", "above 0"]),
    "unknown effect": (("name: smear", "name: smaer"), ["effects.0.name is smaer", "no effect", "row_noise, smear"]),
    "keys of another": (("name: ghost_reflection", "name: smear"), ["effects.1: smear needs", "fraction, not frac"]),
    "missing parameter": (("      dy: -17  # px\n", ""), ["effects.1: ghost_reflection needs", "dy, not fraction, dx"]),
    "unknown parameter": (("dy: -17", "dz: -17"), ["effects.1: ghost_reflection needs", "dy, not fraction, dx, dz"]),
    "text for a parameter": (("dy: -17", "dy: up"), ["effects.1.parameters.dy is 'up'", "a number"]),
    "an effect twice": (
        ("  - name: ghost", "  - name: smear\n    parameters: {fraction: 0.02}\n  - name: ghost"),
        ["effect smear stands twice"],
    ),
    "missing form": (("    form: power\n", ""), ["effects.2: the form of saturation is missing", "sharp, soft"]),
    "unknown form": (("form: power", "form: round"), ["effects.2: the form of saturation is round", "sharp, soft"]),
    "form where there is none": (
        ("name: smear", "form: any\n    name: smear"), ["effects.0: the form of smear is any", "leave it out"]
    ),
    "infinite": (("p2_px: 11", "p2_px: .inf"), ["m.yaml", "not a finite number"]),
    "spot twice": (("repeat: 1, x_px: 73", "repeat: 0, x_px: 73"), ["spots.1 stands twice"]),
    "spot without a place": ((", x_px: 73", ""), ["key spots.1.x_px is missing"]),
    "spot with a width of its own": (
        (", x_px: 73", ", sigma_px: 4, x_px: 73"), ["spots.1 has", "which the law gives"]
    ),
    "no law": (("law:\n  p1_px: 0.8\n  p2_px: 11\n", "law_:\n"), ["unknown key law_"]),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_gets_one_sentence(case, tmp_path):
    """File and key, what is wrong, what would be right."""
    change, words = BAD[case]
    saturation = applied("saturation", "power", level=500.0, knee=0.1)
    text = model_text(with_effects(applied("smear", fraction=0.01), GHOST, saturation))
    if change is not None:
        assert change[0] in text
        (tmp_path / "m.yaml").write_text(text.replace(*change, 1), encoding="utf-8")
    with pytest.raises(InputError) as raised:
        read_model(tmp_path / "m.yaml")
    said = str(raised.value)
    assert said.startswith("m.yaml") and "\n" not in said
    assert all(word in said for word in words), said


def test_no_model_says_why(tmp_path):
    """A file without a model says why, and cannot be simulated."""
    (tmp_path / "m.yaml").write_text("schema: 1\nwhy_not: there is no usable spot frame\n", encoding="utf-8")
    assert reason_without_model(tmp_path / "m.yaml") == "there is no usable spot frame"
    with pytest.raises(InputError, match=r"^m.yaml: holds no model: there is no usable spot frame$"):
        read_model(tmp_path / "m.yaml")
