"""Effects of the user's own files and a narrower vocabulary: what is checked, what is kept apart, what is told."""

import argparse
import hashlib
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

from spotcheck.cli import effect_options as options
from spotcheck.cli import main
from spotcheck.dataset import folder as dataset
from spotcheck.discrepancy.written import breach_of_verdict
from spotcheck.errors import InputError
from spotcheck.io.schema import find_violation, read_keys
from spotcheck.model import effects
from spotcheck.model.effect_file import read_effect
from spotcheck.model.effects import Choice, built_in, vocabulary
from spotcheck.model.stage import Stage
from spotcheck.report.dataset_page.evidence import tabulate_evidence
from spotcheck.report.pages import TEMPLATES
from spotcheck.report.pages.citations import Citations
from tests.samples.effect_cases import MEAN_EXAMPLE as SOUND
from tests.samples.effect_cases import RANDOM_EXAMPLE as RANDOM
from tests.samples.effect_cases import knowing, written
from tests.samples.findings_cases import whole
from tests.samples.small_datasets import ROOT, folder


def changed(old: str, new: str, text: str = SOUND) -> str:
    """The page's example with one change."""
    assert text.count(old) == 1, old
    return text.replace(old, new)


def more(field: str) -> str:
    """The page's example with a field more."""
    return changed("    starts=", f"    {field},\n    starts=")


FALL_OFF = "return light_dn * np.maximum(1 - a * r2 / 100**2, 0.0)"
FAULTS = {
    "syntax": (changed("EFFECT = Effect(", "EFFECT = Effect(("), ["own.py line 15:", "was never closed", "can be run"]),
    "no text": (b"\xff\xfe\x00".decode("latin-1"), ["own.py", "it must be Python"]),
    "raises": (changed("import numpy as np", "import numpy as np\n\nfirst = 1 / 0"),
               ["own.py line 5: ZeroDivisionError: division by zero", "can be run without an error"]),
    "leaves": ("import sys\nsys.exit(3)\n", ["own.py line 2: SystemExit: 3"]),
    "nothing": ("x = 1\n", ["defines no EFFECT", "EFFECT = Effect(name=…"]),
    "a dictionary": ("EFFECT = {'name': 'own'}\n", ["EFFECT is of type dict", "spotcheck.model.effect.Effect"]),
    "name": (changed('name="vignetting"', 'name="Vignetting 2"'), ["name is 'Vignetting 2'", "small letters"]),
    "reserved name": (changed('name="vignetting"', 'name="all"'), ["name is 'all'", "not all"]),
    "sentence": (changed("frame's centre\",", "frame's centre.\","), ["sentence is", "without a full stop"]),
    "stage": (changed("Stage.MODULATION", '"modulation"'), ["'modulation' must be a member of Stage"]),
    "number": (more("number=-1"), ["number is -1", "leave it out"]),
    "one parameter without a comma": (changed("1.0),),", "1.0)),"), ["parameters is", "a tuple of Parameter"]),
    "parameter twice": (changed("1.0),),", '1.0), Parameter("a", "1", 0.0, 1.0)),'), ["'a' must be", "stands once"]),
    "unit": (changed('"a", "1"', '"a", ""'), ["the unit of a is ''", "1 for none"]),
    "bounds": (changed("0.0, 1.0", "1.0, 0.0"), ["a goes from 1 to 0", "lowest must be below"]),
    "bounds that raise": (changed("0.0, 1.0", "0.0, lambda s: s.size"), ["bounds raise AttributeError"]),
    "keys that raise": (more("instrument_keys=lambda sensor: {}"), ["instrument_keys raises TypeError", "sensor.key"]),
    "another key": (more('instrument_keys=lambda sensor, variant, a: {"sensor.bits": a}'),
                    ["instrument_keys names sensor.bits", "no key of instrument.yaml"]),
    "strength of a variant": (changed("0.0, 1.0)", "0.0, 1.0, is_variant_specific=True)"),
                              ["must be the strength", "cannot be specific to a variant"]),
    "variants as a tuple": (changed("{Only.ONLY: (Step(Stage.MODULATION, fall_off),)}", "(1,)"), ["must be a dict"]),
    "variant that is no member": (changed("{Only.ONLY:", '{"only":'), ["'only' must be a member of an Enum"]),
    "steps without a comma": (changed("fall_off),)}", "fall_off))}"), ["a tuple of Step or RandomStep"]),
    "no steps": (changed("(Step(Stage.MODULATION, fall_off),)", "()"), ["a tuple of Step or RandomStep"]),
    "needs as a word": (more('needs=("sun")'), ["needs is 'sun'", "a tuple of Need"]),
    "need": (more('needs=("sun",)'), ["needs is ('sun',)", "a tuple of Need"]),
    "replaces": (more('replaces=("p3",)'), ["('p3',)", "p1, p2, peak_dn"]),
    "law": (more('law_of="colour"'), ["law_of is 'colour'", "brightness, width"]),
    "shape": (changed(FALL_OFF, "return np.ones(7)"), ["function", "a = 0.01", "broadcast"]),
    "not a number": (changed(FALL_OFF, "return np.log(-1 - r2)"), ["NaN", "finite numbers", "a = 0.01"]),
    "decreases": (changed("(frame, light_dn, *", "(light_dn, *").replace("MODULATION", "WELL").replace(
        SOUND[SOUND.index("    pixels ="):SOUND.index("    return")], "").replace(
            FALL_OFF, "return light_dn - 150 * a * np.maximum(light_dn - 500, 0)"),
                  ["returns less for a larger signal at a = 0.01", "never decrease"]),
    "random response": (changed("frame, peak_dn, factor", "peak_dn, factor", RANDOM).replace("BRIGHTNESS", "RESPONSE"),
                        ["a RandomStep cannot act at the stage response", "make it a Step"]),
    "vanishes": (changed("np.maximum(1 -", "np.maximum(1.3 -"), ["vanishes_at is 0", "still changes readings"]),
    "start out of bounds": (changed("[(0.01,)]", "[(2.0,)]"), ["starts gives (2.0,)", "outside the bounds of a"]),
    "draws too much": (changed("1 + rms * rng", "1 + 10 * rms * rng", RANDOM), ["deviation 0.2", "has 1 and 0.02"]),
    "draws about another mean": (changed("1 + rms * rng", "2 + rms * rng", RANDOM), ["the mean 2", "both must agree"]),
    "weights": (changed("[0.5, 0.5]", "[0.5, 0.6]", RANDOM), ["weights whose sum is 1.1"]),
    "draws several": (changed("(-1.0, 1.0))", "(-1.0, 1.0), 5)", RANDOM), ["function", "rms = 0.02", "broadcast"]),
    "parameter of another name": (changed("light_dn, *, a)", "light_dn, *, b)"), ["takes b, which is no parameter"]),
    "argument of another stage": (changed("Stage.MODULATION", "Stage.COORDINATES"), ["f(frame, dx, dy, *, a)"]),
    "starts too long": (changed("[(0.01,)]", "[(0.01, 2.0)]"), ["starts gives (0.01, 2.0)", "a number for a"]),
    "starts that are no list": (changed("[(0.01,)]", "0.01"), ["starts raises TypeError", "list of tuples"]),
    "no starts": (changed("[(0.01,)]", "[]"), ["starts gives none"]),
    "name of another": (changed('name="vignetting"', 'name="smear"'), ["is called smear, as another is"]),
    "number of another": (more("number=3"), ["number 3 is that of black_clipping"]),
    "special case that is no effect": (more('special_cases=("smaer",)'),
                                       ["special_cases names smaer, which is no effect", "row_noise, smear"]),
}  # fmt: skip


@pytest.fixture(autouse=True)
def the_librarys_again():
    """A command chooses the vocabulary of its process, which here is that of all tests."""
    yield
    effects.choose(Choice())


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_wrong_with_a_file_is_said_in_one_sentence(name, tmp_path):
    """With its path, where Python knows it the line, what is wrong and what would be right; the vocabulary stays."""
    text, words = FAULTS[name]
    path = tmp_path / "own.py"
    path.write_bytes(text.encode("latin-1" if name == "no text" else "utf-8"))
    with pytest.raises(InputError) as caught:
        effects.choose(Choice((str(path),)))
    said = str(caught.value)
    assert said.startswith(str(tmp_path)) and "\n" not in said, said
    assert all(word in said for word in words), said
    assert dict(vocabulary()) == built_in() and [p.name for p in tmp_path.iterdir()] == ["own.py"]


@pytest.mark.parametrize("name", [name for name, effect in built_in().items() if effect.stages])
def test_files_of_the_library_pass_the_check(name):
    """The one that a user's file passes; an effect whose shape is learned has no steps that could be checked."""
    effect, _ = read_effect(Path(effects.__file__).parent / f"{name}.py")
    assert effect.name == name and effect.number == built_in()[name].number


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        (Choice(("lab/none.py",)), ["lab/none.py: is no file", "defines EFFECT"]),
        (Choice(("workflow",)), ["workflow: is no file"]),
        (Choice(only=("smear",), without=("row_noise",)), ["both only and without"]),
        (Choice(only=("smaer",)), ["only names smaer", "no effect", "row_noise, smear"]),
        (Choice(without=("smear", "smaer")), ["without names smaer", "no effect", "row_noise, smear"]),
        (Choice(without=tuple(built_in())), ["names every effect", "leave at least one"]),
    ],
)
def test_a_choice_that_makes_no_sense(choice, words):
    """One sentence."""
    with pytest.raises(InputError) as caught:
        effects.choose(choice)
    assert all(word in str(caught.value) for word in words), caught.value


def test_own_effects_come_last(tmp_path):
    """Numbered in the order of the files, behind the library's; a number of one's own is kept where it is free."""
    first, second, third = (
        written(tmp_path, name, text.replace('name="', f'{number}name="'))
        for name, text, number in (
            ("b", SOUND, ""),
            ("a", RANDOM, ""),
            ("c", SOUND.replace("vig", "big"), "number=40, "),
        )
    )
    last = len(built_in())
    with knowing(first, second, third):
        assert list(vocabulary()) == [*built_in(), "vignetting", "mode_hopping", "bignetting"]
        assert [own.number for own in vocabulary().values()] == [*range(1, last + 3), 40]
    with knowing(second, only=["mode_hopping", "smear"]):
        assert list(vocabulary()) == ["smear", "mode_hopping"]
    assert dict(vocabulary()) == built_in()


def test_a_file_may_hold_what_it_needs(tmp_path):
    """Helpers and classes of its own beside the effect."""
    more = "from dataclasses import dataclass\n\n\n@dataclass\nclass Lens:\n    a: float = 0.1\n\n\n"
    doc, rest = SOUND.split("\n\n", 1)
    with knowing(written(tmp_path, "own", f"{doc}\n\n{more}{rest}")):
        assert vocabulary()["vignetting"].stages == (Stage.MODULATION,)


def test_the_record_of_a_vocabulary(tmp_path):
    """Nothing for the library's own; else names, files and digests of what was added, and what was left out."""
    assert effects.describe_vocabulary() == {}
    path = written(tmp_path, "lens", SOUND)
    digest = hashlib.sha256(SOUND.encode()).hexdigest()
    with knowing(path, without=["row_noise", "smear"]):
        assert effects.describe_vocabulary() == {
            "own": [{"name": "vignetting", "file": "lens.py", "sha256": digest}],
            "left_out": ["row_noise", "smear"],
        }
    with knowing(path, only=["smear"]):
        # An effect of one's own may be left out as well.
        assert (
            effects.describe_vocabulary()["own"] == [] and effects.describe_vocabulary()["left_out"][-1] == "vignetting"
        )


def test_processes_that_are_started_know_the_same_effects(tmp_path):
    """Also where a process starts from nothing, as on macOS and Windows."""
    with knowing(written(tmp_path, "lens", SOUND), without=["smear"]):
        start = {"initializer": effects.choose, "initargs": (effects.chosen(),)}
        with ProcessPoolExecutor(1, mp_context=get_context("spawn"), **start) as pool:
            assert pool.submit(effects.describe_vocabulary).result() == effects.describe_vocabulary() != {}


# Files of results.


def test_a_verdict_says_which_vocabulary_it_had(tmp_path):
    """It may name effects from files of this vocabulary, but none that the vocabulary does not have."""
    document = whole("one")
    document["effects"][0] |= {"name": "vignetting", "candidates": ["vignetting"]}
    with knowing(written(tmp_path, "lens", SOUND), without=["smear"]):
        document |= options.describe_difference()
        assert breach_of_verdict(document) is None
        assert [effect["name"] for effect in document["vocabulary"]["own"]] == ["vignetting"]
        assert document["vocabulary"]["left_out"] == ["smear"]
    assert "vignetting" in breach_of_verdict(document)
    assert options.describe_difference() == {}


def test_the_report_says_which_vocabulary_it_had(tmp_path):
    """In a paragraph beside the verdict; none where it was the library's."""

    def text(own: dict) -> str:
        evidence = tabulate_evidence(own, Citations(tmp_path))
        return TEMPLATES.get_template("dataset_page/evidence.html").render(evidence=evidence)

    assert "standard vocabulary" not in text(whole("unknown"))
    with knowing(written(tmp_path, "lens", SOUND), without=["smear", "row_noise"]):
        told = text(whole("unknown") | options.describe_difference())
    digest = hashlib.sha256(SOUND.encode()).hexdigest()[:16]
    assert (
        "This run did not use the standard vocabulary of effects."
        f" Added: <code>vignetting</code> of lens.py (SHA-256 {digest}…)."
        " Excluded: <code>row_noise</code>, <code>smear</code>." in told
    )


def test_stages_must_know_the_same_effects(tmp_path):
    """What was found with one vocabulary is not taken up with another, nor after an edit of the file."""
    path = written(tmp_path, "lens", SOUND)
    with knowing(path, without=["smear"]):
        saved = options.describe_difference()
        options.check_same_vocabulary(saved, "verdict.json")
    options.check_same_vocabulary({}, "verdict.json")
    for files, without in (((), ()), ((path,), ()), ((), ("smear",))):
        with (
            knowing(*files, without=without),
            pytest.raises(InputError, match=r"verdict\.json: was found with .*vignetting of lens\.py .*without smear"),
        ):
            options.check_same_vocabulary(saved, "verdict.json")
    path.write_text(SOUND + "\n", encoding="utf-8")
    with knowing(path, without=["smear"]), pytest.raises(InputError, match="the same --effects"):
        options.check_same_vocabulary(saved, "verdict.json")


# Configuration and command line.


def test_the_keys_of_the_configuration():
    """Both may be missing; both are in config.yaml, as the library's vocabulary; wrong ones are refused."""
    given = read_keys(ROOT / "config" / "config.yaml")
    assert options.read_choice(given) == Choice() == options.read_choice({})
    for own in (
        {"effects": ["lab/coma.py"]},
        {"vocabulary": {"only": ["smear"]}},
        {"vocabulary": {"without": ["smear"]}},
    ):
        assert find_violation(given | own, "config") is None
    del given["effects"], given["vocabulary"]
    assert find_violation(given, "config") is None
    for own in ({"effects": "lab/coma.py"}, {"effects": [""]}, {"vocabulary": {"with": ["smear"]}},
                {"vocabulary": {"only": []}}, {"vocabulary": ["smear"]}):  # fmt: skip
        assert find_violation(given | own, "config"), own


def test_the_command_line_says_what_the_configuration_says():
    """The words of `options`, parsed, are the choice again; there are none for the library's vocabulary."""
    parser = argparse.ArgumentParser()
    options.add_options(parser)
    for config in ({}, {"effects": ["a b.py", "c.py"], "vocabulary": {"without": ["smear"]}},
                   {"vocabulary": {"only": ["smear", "speckle"]}}):  # fmt: skip
        choice = options.read_choice(config)
        args = parser.parse_args(options.list_options(choice))
        assert Choice(tuple(args.effects), tuple(args.only), tuple(args.without)) == choice
    assert options.list_options(Choice()) == []


def test_a_dataset_brings_no_code(tmp_path):
    """Frames may come from anyone: their folder adds nothing to the vocabulary."""
    own = folder(tmp_path, ["frames/a.tif,spot,0,1e-4,0"], "{crop_px: 60, effects: [own.py]}")
    written(own, "own", SOUND)
    with pytest.raises(InputError, match=r"instrument\.yaml.*effects"):
        dataset.load(own)


STAGES = {
    "judge": ["set", "--crops", "c", "--sensor", "s", "--pictures", "p", "--model", "m", "--light", "l", "--output",
              "o"],
    "flats": ["set", "--frames", "f", "--output", "o"],
    "simulate": ["set", "--sensor", "s", "--seed", "1", "--folder", "f", "--output", "o"],
    "report": ["--dataset", "set", "--results", "r", "--output", "o"],
    "effects": ["--output", "o"],
}  # fmt: skip


@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_that_knows_effects_can_be_told_of_others(stage, capsys):
    """And checks them before anything else; one sentence, status 2."""
    for more, words in (
        (["--effects", "lab/none.py"], "lab/none.py: is no file"),
        (["--only", "smaer"], "only names smaer"),
        (["--without", "smaer"], "without names smaer"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main([stage, *STAGES[stage], *more])
        assert stopped.value.code == 2 and words in capsys.readouterr().err


def test_the_page_with_an_effect_of_ones_own(tmp_path, capsys):
    """Behind the library's, without a link into it; the library's vocabulary is back with the next command."""
    out, path = tmp_path / "effects.md", written(tmp_path, "hops", RANDOM)
    main(["effects", "--output", str(out), "--effects", str(path), "--without", "smear"])
    text = out.read_text(encoding="utf-8")
    assert f"{len(built_in())} effects" in capsys.readouterr().out
    assert f"\n## {len(built_in()) + 1}. mode_hopping\n\nThe laser jumps" in text and "drawn for each frame" in text
    assert "## 24." not in text
    main(["effects", "--output", str(out)])
    assert dict(vocabulary()) == built_in() and "mode_hopping\n\nThe" not in out.read_text(encoding="utf-8")
