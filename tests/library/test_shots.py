"""The design that a list of frames spans, and which frames are kept unseen."""

import numpy as np
import pytest

from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.shots import Shot, design_of, held_out, never_chose, parted


def shot(angle=0.0, exposure=1e-4, repeat=0, order: int | None = 0, conditions=(), left=0, top=0) -> Shot:
    """A frame without pixels."""
    return Shot(angle, exposure, repeat, order, conditions, left, top, lambda: np.zeros((2, 2)))


def grid(angles=(0.0, 45.0, 90.0), exposures=(1e-4, 5e-4, 9e-4), repeats=2, **fixed) -> list[Shot]:
    """Every repeat of every angle at every exposure, in the order of acquisition."""
    cells = [(a, t, r) for r in range(repeats) for a in angles for t in exposures]
    return [shot(a, t, r, k, **fixed) for k, (a, t, r) in enumerate(cells)]


def counts(design: Design) -> tuple[int, int]:
    """How many conditions and sites there are, each numbered from 0 on without a gap."""
    for own in (design.condition, design.site):
        np.testing.assert_array_equal(np.unique(own), np.arange(own.max() + 1))
    return int(design.condition.max()) + 1, int(design.site.max()) + 1


def test_numbers_of_a_grid():
    """Conditions by angle, then exposure; a site is one angle's repeat at all exposures."""
    shots = grid()
    design = design_of(shots)
    assert counts(design) == (9, 6)
    np.testing.assert_array_equal(design.condition, np.tile(np.arange(9), 2))
    np.testing.assert_array_equal(design.site, [2 * (k // 3 % 3) + k // 9 for k in range(18)])
    np.testing.assert_allclose(design.order, np.arange(18) / 17, rtol=1e-15)
    np.testing.assert_array_equal(design.angle_deg, [own.angle_deg for own in shots])
    np.testing.assert_array_equal(design.exposure_s, [own.exposure_s for own in shots])


def test_numbers_do_not_hang_on_the_order_of_the_list():
    """Ascending in angle and exposure, whichever frame comes first; each frame keeps its own."""
    shots = grid()
    turn = np.random.default_rng(2).permutation(len(shots))
    plain, mixed = design_of(shots), design_of([shots[k] for k in turn])
    for name in Design._fields:
        np.testing.assert_array_equal(getattr(mixed, name), getattr(plain, name)[turn])


def test_whole_numbers_and_numpys_are_the_same_keys():
    """45 and 45.0 and np.float64(45) are one angle."""
    design = design_of([shot(45), shot(45.0, repeat=1), shot(np.float64(45), repeat=2)])
    assert counts(design) == (1, 3)


def test_minus_zero_is_zero():
    """An angle of −0 is no second angle."""
    assert counts(design_of([shot(0.0), shot(-0.0, repeat=1)])) == (1, 2)


def test_numbers_sort_as_numbers():
    """10 comes after 9, and negative angles before positive ones."""
    shots = [shot(a, t) for a in (10.0, 9.0, -45.0, 100.0) for t in (1e-3, 9e-4, 1e-10)]
    design = design_of(shots)
    turn = np.argsort(design.condition)
    np.testing.assert_array_equal(design.angle_deg[turn][::3], [-45.0, 9.0, 10.0, 100.0])
    np.testing.assert_array_equal(design.exposure_s[turn][:3], [1e-10, 9e-4, 1e-3])


def test_what_was_not_recorded():
    """Blank angles are one angle, blank exposures one exposure, both NaN; blank and stated do not mix."""
    design = design_of([shot(None, None, r, r) for r in range(4)])
    assert counts(design) == (1, 4)
    assert np.isnan(design.angle_deg).all() and np.isnan(design.exposure_s).all()
    no_angle = design_of([shot(None, t, r) for r in range(2) for t in (1e-4, 9e-4)])
    assert counts(no_angle) == (2, 2) and np.isnan(no_angle.angle_deg).all()
    mixed = design_of([shot(0.0), shot(None), shot(90.0)])
    np.testing.assert_array_equal(mixed.condition, [1, 0, 2])
    np.testing.assert_array_equal(mixed.angle_deg, [0.0, np.nan, 90.0])
    # NaN says the same as a blank.
    assert counts(design_of([shot(None), shot(float("nan"), repeat=1)])) == (1, 2)


def test_declared_conditions_are_axes():
    """A scan along z: each z its own condition and sites; a blank z is one of its own."""
    shots = [shot(0.0, t, r, 0, (z, 300.0)) for z in (0.2, 0.1, None) for r in range(2) for t in (1e-4, 9e-4)]
    design = design_of(shots)
    assert counts(design) == (6, 6)
    # In ascending order of z, the blank one first.
    np.testing.assert_array_equal(design.condition[:4], [4, 5, 4, 5])
    np.testing.assert_array_equal(design.condition[-4:], [0, 1, 0, 1])
    assert len(set(design.site[:4])) == 2 and set(design.site[:4]).isdisjoint(design.site[4:])


def test_an_incomplete_grid():
    """Cells that were not taken have no number; sites are counted where they are."""
    cells = grid(repeats=3)
    missing = [s for s in cells if s.angle_deg == 45.0 and s.exposure_s == 5e-4]
    missing += [s for s in cells if s.angle_deg != 0.0 and s.repeat == 2]
    assert counts(design_of([s for s in cells if s not in missing])) == (8, 7)


def test_one_frame():
    """The smallest design there is."""
    design = design_of([shot(30.0, 1e-3, 0, 5)])
    assert counts(design) == (1, 1) and np.isnan(design.order).all()


def test_order_runs_from_0_to_1():
    """By place in the order of acquisition, gaps included; unknown as soon as one frame's is."""
    np.testing.assert_allclose(design_of([shot(order=k) for k in (4, 6, 14)]).order, [0.0, 0.2, 1.0])
    np.testing.assert_allclose(design_of([shot(order=k) for k in (14, 4, 6)]).order, [1.0, 0.0, 0.2])
    assert np.isnan(design_of([shot(order=k) for k in (0, 1, None)]).order).all()
    assert np.isnan(design_of([shot(order=None) for _ in range(3)]).order).all()
    assert np.isnan(design_of([shot(order=7) for _ in range(3)]).order).all()


@pytest.mark.parametrize(
    ("repeats", "kept"),
    [
        (1, []),
        (2, []),
        (5, []),
        (6, [2, 5]),
        (7, [2, 5]),
        (8, [2, 5]),
        (9, [2, 5, 8]),
        (50, list(range(2, 50, 3))),
    ],
)
def test_every_third_repeat_is_kept_of_six_or_more(repeats, kept):
    """The contract: of six repeats or more every third (2, 5, 8, … counted from 0), of fewer none."""
    repeat = np.tile(np.arange(repeats), 4)
    got = held_out(repeat)
    assert got.dtype == bool and got.shape == repeat.shape
    assert sorted(set(repeat[got])) == kept
    # All frames of a repeat go together, or the same site would be on both sides.
    assert all(len(set(got[repeat == r])) == 1 for r in range(repeats))


def test_kept_repeats_are_counted_not_named():
    """Repeats that begin at 1, or have gaps, are counted from 0 all the same; their order in the list is nothing."""
    assert sorted(set(np.arange(1, 7)[held_out(np.arange(1, 7))])) == [3, 6]
    assert sorted(np.array([0, 2, 4, 10, 20, 30, 31])[held_out(np.array([0, 2, 4, 10, 20, 30, 31]))]) == [4, 30]
    mixed = np.array([5, 0, 3, 1, 4, 2])
    assert sorted(mixed[held_out(mixed)]) == [2, 5]


def test_frames_are_parted_by_whole_sites():
    """Every frame on one side, all of a site on the same; conditions of which none may choose the model are told."""
    shots = grid(repeats=6)
    own, out = parted(shots)
    np.testing.assert_array_equal(np.sort(np.concatenate([own, out])), np.arange(len(shots)))
    site = design_of(shots).site
    assert set(site[own]).isdisjoint(site[out]) and len(out) == 18
    assert never_chose(shots) == "" == never_chose(grid())
    few = [s for s in shots if s.angle_deg == 0 or s.repeat == 2]
    assert never_chose(few).startswith("6 frames belong to conditions of which every frame is kept unseen")
    one = [s for s in few if s.angle_deg == 0 or (s.angle_deg == 45 and s.exposure_s == 1e-4)]
    assert never_chose(one).startswith("1 frame belongs to conditions")


def test_taking_by_number():
    """Indices do as well as flags, in any order, and may repeat a frame."""
    design, at = design_of(grid()), np.array([17, 3, 3, 0])
    for own, all_of_it in zip(design.take(at), design, strict=True):
        np.testing.assert_array_equal(own, all_of_it[at])
    np.testing.assert_array_equal(design.take(design.site == 2).condition, [3, 4, 5])
