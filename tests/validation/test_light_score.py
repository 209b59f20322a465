"""The table of the sets on real light, from records made by hand."""

import numpy as np
import pytest
from scipy import stats

from tests.validation.generators.light import score


def put_in(name, met=True, tied=False, **parameters):
    """What a truth says of one effect."""
    return {"name": name, "form": {}, "parameters": parameters, "met": met, "tied": tied, "known": 60.0, "free": 50.0,
            "wanted": 50.0}  # fmt: skip


def entry(name, *rivals, **parameters):
    """What a verdict says of one effect; parameters as (value, error)."""
    own = {key: {"value": value, "stderr": error, "unit": "1"} for key, (value, error) in parameters.items()}
    return {"name": name, "candidates": [name, *rivals], "parameters": own, "gap_closed": 0.5}


def record(kind, hidden=(), said=(), design="default", p=0.5, limits=None, **truth):
    """A record of a judged set; the light is what the kind says, a Gaussian if it does not."""
    light = next((word for word in kind.split(":") if word in ("real", "drawn")), "gauss")
    verdict = {"status": "named", "detection": {"p_value": p}, "unexplained": {"p_value": p}, "effects": list(said),
               "gap": {"closed": None, "on": "unseen repeats"}, "light": None}  # fmt: skip
    if limits is not None:
        verdict["limits"] = limits
    job = {"number": 0, "seed": 51_000_000, "kind": kind, "design": design, "budget": ""}
    truth = {"light": {"kind": light}, "effects": list(hidden), **truth}
    return {"job": job, "truth": truth, "verdict": verdict, "outcome": "right", "seconds": 1.0}


def found(rows, name):
    """The figure whose name begins so."""
    return next(own for own in score.figures(rows) if own.name.startswith(name))


ONE = "one:smear:real:50"


@pytest.mark.parametrize(
    "said, right",
    [
        ([entry("smear")], True),
        # A shape beside it, and one that could stand in its place, are nothing false where the light is no Gaussian.
        ([entry("smear", "beam_profile"), entry("beam_profile")], True),
        ([entry("smear", "saturation")], False),
        ([entry("smear"), entry("saturation")], False),
        ([entry("saturation", "smear")], False),
        ([], False),
    ],
)
def test_one_effect_is_named_and_nothing_false(said, right):
    assert found([record(ONE, [put_in("smear")], said)], "one effect at 50").value == right
    on_top = [put_in("smear"), put_in("speckle") | {"on_top": True}]
    rows = [record(ONE, on_top, [*said, entry("speckle")])]
    assert found(rows, "one effect at 50").value == right
    assert found(rows, "one effect at 50 times its bound, of these with speckle").sets == 1


def test_a_shape_is_a_name_like_others_on_a_gaussian():
    rows = [record("sheet:gain:smear:+0.05", [put_in("smear")], [entry("smear"), entry("beam_profile")])]
    assert found(rows, "sheet off, one strong").value == 0
    assert found([record("sheet:gain:none:+0.05", [], [entry("dark_offset")])], "sheet off, nothing").value == 1
    assert found([record("outside:dust:gauss:15", [put_in("outside:dust")], [entry("super_gaussian")])],
                 "outside, gauss").value == 1  # fmt: skip
    tied = put_in("outside:dust", tied=True)
    assert found([record("outside:dust:gauss:15", [tied], [entry("beam_profile")])], "outside, gauss").value == 0


def test_what_is_tied_or_was_not_reached_is_counted_elsewhere():
    tied, weak = put_in("smear", tied=True), put_in("smear", met=False)
    rows = [record(ONE, [tied]), record(ONE, [weak]), record("tied:beam_ellipticity:real:50", [tied])]
    assert found(rows, "one effect at 50").sets == 0 and found(rows, "tied").sets == 2
    assert found(rows, "tied").value == 0
    for said, limits in (([], [{"effect": "smear", "why": "light's shape"}]), ([entry("beam_profile")], None),
                         ([entry("smear", "beam_profile")], None)):  # fmt: skip
        assert score.says_tied(record(ONE, [tied], said, limits=limits))
    assert not score.says_tied(record(ONE, [tied], [entry("smear")], limits=[{"effect": "saturation"}]))
    not_there = [
        {"effect": "smear", "value": 0.001, "why": "not there"},
        {"effect": "saturation", "why": "light's shape"},
    ]
    assert not score.says_tied(record(ONE, [tied], limits=not_there))
    assert not score.says_tied(record(ONE, [tied]) | {"verdict": None})


def test_other_rows():
    plain = [record("light:real", [], [entry("beam_profile")]), record("light:drawn", [], [entry("smear")])]
    assert found(plain, "none, light").value == 0.5
    pair = [put_in("smear"), put_in("row_noise")]
    rows = [record("two:smear+row_noise:real:50", pair, said)
            for said in ([entry("smear"), entry("row_noise")], [entry("smear")])]  # fmt: skip
    assert found(rows, "two effects").value == 0.5
    # A failure is counted: it names nothing.
    broken = record(ONE, [put_in("smear")]) | {"verdict": None, "error": "ValueError: no"}
    assert found([broken], "one effect at 50").value == 0 and "ValueError" in score.line(broken)
    assert found([record(ONE) | {"outcome": "passed over"}], "one effect at 50").sets == 0


def test_what_was_put_into_real_frames():
    def own(what, name, said, frame="t-1", **parameters):
        hidden = [put_in(name, **parameters)] if name else []
        return record(f"hene:{what}", hidden, said, f"frame {frame}", frame=frame, put_in=what) | {
            "truth": {"light": {"kind": "frame"}, "effects": hidden, "frame": frame, "put_in": what}
        }

    plain = own("as it is", "", [entry("dark_offset", level=(4.0, 0.1)), entry("speckle")])
    rows = [plain, own("clip 0.7", "saturation", [entry("saturation"), entry("speckle"), entry("dark_offset")]),
            own("clip 0.9", "saturation", [entry("smear")])]  # fmt: skip
    assert found(rows, "real frames, clip").value == 0.5
    assert found(rows, "real frames: a name").value == 0.5
    for level, right in ((10.2, True), (10.5, False), (6.0, False)):
        rise = own("rise 6", "dark_offset", [entry("dark_offset", level=(level, 0.1))], rise=6.0)
        assert found([plain, rise], "real frames, rise").value == right
    # Nothing to hold it against.
    assert found([rise], "real frames, rise").sets == 0
    assert found([plain, own("rise 6", "dark_offset", [], rise=6.0)], "real frames, rise").value == 0


def test_null_p_values():
    rng = np.random.default_rng(1)
    rows = [record("none:gauss", p=p) for p in (np.arange(400) + 0.5) / 400]
    assert found(rows, "null sets: p").verdict() == "ok" and found(rows, "null sets: p").value > 0.99
    assert found(rows, "null sets: false").value == 0.01 and found(rows, "null sets: false").verdict() == "ok"
    rows = [record("none:gauss", p=p) for p in rng.random(400) ** 2]
    assert found(rows, "null sets: p").verdict() == "short" and found(rows, "null sets: false").verdict() == "short"
    assert found([record("none:gauss", p=None)], "null sets: false").value == 1


def test_intervals_cover_and_directions_turn():
    hidden = [put_in("background_gradient", slope=2.0, direction=359.0, level=1.0)]
    said = [entry("background_gradient", slope=(2.3, 0.1), direction=(1.0, 1.5), level=(1.1, 0.1))]
    own = record("one:background_gradient:real:50", hidden, said)
    assert score.pulls(own) == pytest.approx(
        {"background_gradient.slope": 3.0, "background_gradient.direction": 4 / 3, "background_gradient.level": 1.0},
        abs=0.7,
    )
    assert score.pulls(own)["background_gradient.direction"] == pytest.approx(2 / 1.5)
    assert found([own], "95 %").value == pytest.approx(2 / 3)
    blur = record(ONE, [put_in("motion_blur", direction=179.0)], [entry("motion_blur", direction=(1.0, 2.0))])
    assert score.pulls(blur) == {"motion_blur.direction": 1.0}
    soft = [put_in("saturation", level=800.0) | {"form": {"knee": "soft"}}]
    assert not score.pulls(record("one:saturation:real:50", soft, [entry("saturation", level=(700.0, 1.0))]))
    assert "`motion_blur.direction` | 1 |" in score.page([own, blur], "abc")


def test_a_row_is_met_unless_its_interval_excludes_what_it_must_be():
    """Wilson's interval is where a normal test of the share does not reject."""
    for hits, count in ((0, 20), (7, 30), (150, 150)):
        for end in score.wilson(hits, count):
            if 0 < end < 1:
                z = (hits / count - end) / np.sqrt(end * (1 - end) / count)
                assert abs(z) == pytest.approx(stats.norm.isf(0.025), rel=1e-9)
    rows = [record(ONE, [put_in("smear")], [entry("smear")] if k % 10 else []) for k in range(30)]
    must = score.STRONG["default"]
    own = found(rows, "one effect at 50")
    assert own.value == 0.9 and own.interval[1] > must and own.verdict() == "ok"
    rows = [record(ONE, [put_in("smear")], [entry("smear")] if k % 2 else []) for k in range(30)]
    assert found(rows, "one effect at 50").verdict() == "short"
    assert found([], "one effect at 50").verdict() == "not measured"


def test_what_the_suite_before_lost():
    """Of four sets one is lost and one won; a shape beside the truth loses one more."""
    smear = put_in("smear")
    cases = (("right", [entry("smear")]), ("right", [entry("speckle")]), ("unknown", [entry("smear")]),
             ("right", [entry("smear"), entry("beam_profile")]))  # fmt: skip
    rows = [record("before:one:smear:strong", [smear], said, before=then) for then, said in cases]
    loss = found(rows, "sets of the suite before")
    assert loss.sets == 4 and loss.value == pytest.approx(0.25) and loss.verdict() == "ok"
    rows = [record("before:one:smear:strong", [smear], [], before="right") for _ in range(100)]
    assert found(rows, "sets of the suite before").verdict() == "short"
    # Such a truth knows nothing of a light.
    for row in rows:
        del row["truth"]["light"]
    assert score.page(rows, "abc").count("before:one:smear:strong default: right before, unknown now") == 100


def test_the_gap_that_a_shape_closes():
    rows = [record("light:real") for _ in range(20)]
    for row in rows:
        row["verdict"] |= {"light": {"power": 0.05}, "gap": {"closed": 0.9, "on": "unseen repeats"}}
    rows[0]["verdict"]["gap"] |= {"closed": 0.1, "on": "the frames themselves"}
    gap = found(rows, "gap that a learned shape closes")
    assert gap.sets == 19 and gap.value == pytest.approx(0.9) and gap.verdict() == "short"
