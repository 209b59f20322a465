"""The score table, from records made by hand."""

import numpy as np
import pytest
from scipy import stats

from tests.validation.generators.light import generator, page, reading, score
from tests.validation.intervals import wilson


def put_in(name, met=True, tied=False, **parameters):
    """What a truth says of one effect."""
    return {"name": name, "form": {}, "parameters": parameters, "met": met, "tied": tied}


def entry(name, *rivals, **parameters):
    """What a verdict says of one effect; parameters as (value, error)."""
    own = {key: {"value": value, "stderr": error, "unit": "1"} for key, (value, error) in parameters.items()}
    return {"name": name, "candidates": [name, *rivals], "parameters": own, "gap_closed": 0.5}


def record(kind, hidden=(), said=(), design="default", status="named", closed=None, seconds=10.0, **truth):
    """A record of a judged set; the light is what the kind says, a Gaussian if it does not."""
    light = "real" if "real" in kind.replace(":", " ").split() else "gauss"
    verdict = {"status": status, "effects": list(said), "gap": {"closed": closed}}
    job = {"number": 0, "seed": 51_000_000, "kind": kind, "design": design}
    truth = {"light": {"kind": light}, "effects": list(hidden), "base": {"frames": 96}, **truth}
    return {"job": job, "truth": truth, "verdict": verdict, "outcome": "judged", "cpu_seconds": seconds,
            "memory_mb": 300.0}  # fmt: skip


def row(records, name):
    """The row whose name begins so."""
    return next(own for own in score.tabulate(records) if own.name.startswith(name))


GAUSS, REAL = "strong gauss:smear:gauss:50", "strong real:smear:real:50"


@pytest.mark.parametrize(
    "said, on_gauss, on_real",
    [
        ([entry("smear")], True, True),
        # A shape beside it, and one that could stand in its place, are nothing false where the light is no Gaussian.
        ([entry("smear", "beam_profile"), entry("beam_profile")], False, True),
        ([entry("smear", "saturation")], False, False),
        ([entry("smear"), entry("saturation")], False, False),
        ([entry("saturation", "smear")], False, False),
        ([], False, False),
    ],
)
def test_every_effect_is_named_alone_and_nothing_else(said, on_gauss, on_real):
    assert reading.is_right(record(GAUSS, [put_in("smear")], said)) is on_gauss
    assert reading.is_right(record(REAL, [put_in("smear")], said)) is on_real
    both = [put_in("smear"), put_in("speckle") | {"on_top": True}]
    assert reading.is_right(record(REAL, both, [*said, entry("speckle")])) is on_real
    assert not reading.is_right(record(REAL, both, said))


def test_a_name_that_the_beam_gets_without_the_effect_is_not_false():
    """Such a set asks for its unaltered beam, others do not."""
    right = record(REAL, [put_in("smear")], [entry("smear"), entry("beam_profile")])
    more = record(REAL, [put_in("smear")], [entry("smear"), entry("saturation")])
    plain = record("nothing::real:0", [], [entry("saturation")])
    assert [generator.unaltered(known) for known in (right, plain)] == [None, None]
    assert generator.unaltered(more).kind == "unaltered:strong real:smear:real"
    assert not reading.is_right(more) and not reading.is_right(more | {"unaltered": ["beam_profile"]})
    assert reading.is_right(more | {"unaltered": ["saturation"]})


def test_no_verdict_in_time_or_converged_is_right():
    truth, said = [put_in("smear")], [entry("smear")]
    late = record(GAUSS, truth, said, seconds=201.0)
    stopped = record(GAUSS, truth, said, status="not_converged")
    broken = record(GAUSS, truth) | {
        "verdict": None,
        "outcome": "error",
        "error": "ValueError: no",
        "cpu_seconds": None,
    }
    patience = broken | {"error": "TimeoutError: longer than 220 s"}
    rows = [late, stopped, broken, patience]
    assert row(rows, "Gaussian light, one effect at 50").shown.startswith("0 of 4")
    assert row(rows, "tracebacks").shown == "1" and row(rows, "verdicts with values").shown == "1"
    assert all(page.describe(own) for own in rows) and not page.describe(record(GAUSS, truth, said))


def test_what_the_shape_hides_or_was_not_reached():
    tied = [put_in("super_gaussian", tied=True)]
    kind = "strong real:super_gaussian:real:50"
    for said, right in (([entry("beam_profile")], True), ([entry("super_gaussian")], True), ([], False),
                        ([entry("beam_profile"), entry("smear")], False)):  # fmt: skip
        assert reading.is_right(record(kind, tied, said)) is right
    # On a Gaussian the shape is known.
    assert not reading.is_right(record("shape:super_gaussian:gauss:50", tied, [entry("beam_profile")]))
    weak = record(GAUSS, [put_in("smear", met=False)])
    assert row([weak], "Gaussian light, one effect at 50").sets == 0


def test_wrong_names():
    plain = [record("nothing::real:0", [], [entry("beam_profile")]), record("nothing::gauss:0", [], [entry("smear")])]
    assert row(plain, "nothing put in").shown.startswith("1 of 2")
    for mechanism, name, wrong in (("dust", "beam_profile", 0), ("dust", "super_gaussian", 1),
                                   ("focus_scatter", "site_variation", 0), ("dust", "site_variation", 1)):  # fmt: skip
        own = record(f"outside:{mechanism}:gauss:50", [put_in(f"outside:{mechanism}")], [entry(name)])
        assert row([own], "outside the vocabulary").shown.startswith(f"{wrong} of 1")


def test_no_row_is_met_by_verdicts_that_did_not_come():
    """Where nothing was put in, a verdict that did not converge or came late is wrong as well; without sets no row is
    met."""
    plain = record("nothing::gauss:0", [], status="consistent")
    late, stopped = plain | {"cpu_seconds": 201.0}, record("nothing::gauss:0", [], status="not_converged")
    assert row([plain, late, stopped], "nothing put in").shown.startswith("2 of 3")
    assert page.describe(late) and page.describe(stopped) and not page.describe(plain)
    assert all(own.met is None for own in score.tabulate([]))


def test_real_frames_are_held_against_the_frame_as_it_is():
    def frame(what, name, said):
        hidden = [put_in(name)] if name else []
        return record(f"frame:{what}", hidden, said, "frame 1", frame="t-1", light={"kind": "frame"})

    plain = frame("as it is", "", [entry("dark_offset")])
    clip = frame("clip 0.9", "saturation", [entry("saturation"), entry("dark_offset"), entry("beam_profile")])
    assert row([plain, clip], "real frames, clip").shown == "1 of 1"
    assert row([clip], "real frames, clip").shown == "0 of 1"


def test_the_default_dataset_needs_its_clip_level():
    names = ("saturation", "speckle")
    for level, right in ((757.0, True), (766.0, False)):
        said = [entry("saturation", level=(level, 0.3)), entry("speckle"), entry("angle_reflectance")]
        own = record("default dataset:", [put_in(name, level=757.1) for name in names], said,
                     light={"kind": "rig"}, allowed=["angle_reflectance"])  # fmt: skip
        assert reading.is_right(own) is right


def test_pulls_and_gap():
    truth = [put_in("background_gradient", level=3.0, slope=1.0, direction=359.0)]
    said = [entry("background_gradient", level=(3.2, 0.1), slope=(1.0, 0.1), direction=(1.0, 2.0))]
    own = record(GAUSS, truth, said)
    assert reading.pulls(own) == pytest.approx({"background_gradient.level": 2.0, "background_gradient.slope": 0.0,
                                                "background_gradient.direction": 1.0})  # fmt: skip
    assert row([own], "95 %").shown.startswith("2 of 3")
    law = record("strong gauss:laser_drift:gauss:50", [put_in("laser_drift")], [entry("laser_drift")], closed=0.9)
    assert row([own, law, law], "sets with a law").sets == 2 and row([law], "sets with a law").met is False


def test_wilsons_interval_is_where_a_normal_test_of_the_share_does_not_reject():
    for hits, count in ((0, 20), (7, 30), (150, 150)):
        for end in wilson(hits, count):
            if 0 < end < 1:
                z = (hits / count - end) / np.sqrt(end * (1 - end) / count)
                assert abs(z) == pytest.approx(stats.norm.isf(0.025), rel=1e-9)


def test_a_row_is_met_unless_its_interval_excludes_what_is_required():
    right, wrong = record(GAUSS, [put_in("smear")], [entry("smear")]), record(GAUSS, [put_in("smear")])
    assert row([right] * 37 + [wrong] * 3, "Gaussian light, one effect at 50").met is True
    assert row([right] * 30 + [wrong] * 10, "Gaussian light, one effect at 50").met is False
    assert row([], "Gaussian light, one effect at 50").met is None
    text = page.as_markdown([right] * 30 + [wrong] * 10, "abc")
    assert text.count("missed smear") == 10 and "| **short** |" in text
