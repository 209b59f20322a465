"""What rows share, and lines of pixels that hardly ever show a reading."""

import numpy as np

from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.look import look_again, look_at
from spotcheck.discrepancy.shots import design_of
from spotcheck.model.chain import Law
from tests.library import small_verdict
from tests.library.small_verdict import SENSOR, frames, present

# Noise of 1.65 DN that black cuts at 0.
CUT = SENSOR._replace(black_level_dn=0.0, read_noise_e=15.0)


def near(own, **options):
    """Account of an effect at a closer look, by observable, and that look's own observables."""
    shots, base, setting = frames(sensor=CUT, **options)
    look = look_at(shots, design_of(shots), base, setting)
    first = account(look, [own])
    look = look_again(shots, look, first.refit.model, first.latent)
    blocks = ("frame", "line", "spectrum")
    seen = {o.label: o for o in look.observables if o.block in blocks}
    return {o.label: o for o in account(look, [own]).observables if o.block in blocks}, seen


def test_what_rows_bring_to_a_frame_where_black_cuts_them(monkeypatch):
    """Rows of 2.2 DN raise the scatter of every frame's own spot fivefold and more, as much as reckoned: within four
    standard errors (5 numbers: by chance 3 in 10,000). The narrow spot leaves most of a frame dark."""
    monkeypatch.setattr(small_verdict, "LAW", Law(1.2, 15.0, 150.0))
    left, seen = near(present("row_noise", 2.2), rows_dn=2.2, repeats=12)
    for label in ("brightness", "centre", "width", "roundness", "pedestal"):
        assert seen[label].value > 5, label
        assert abs(left[label].value) < 4 * left[label].error, label
    # An offset of the rows that these few had by chance is no skew of the noise.
    assert "skewness" not in left


def test_lines_that_a_dead_zone_silences():
    """Where noise passes the end of a dead zone once in 100,000 times, the sums of lines are none of normal numbers."""

    def silenced(image, rng):
        return np.where(image > 7, image, 0.0)

    left, _ = near(present("black_clipping", 7.5, form="dead zone"), after=silenced, repeats=12)
    for label in ("rows of a frame", "columns of a frame"):
        assert abs(left[label].value) < 4 * left[label].error, label


def test_light_that_seldom_passes_a_dead_zone_makes_no_hot_pixels():
    """A zone that ends ten standard deviations above black, and spots that leave most pixels lit in a frame or two: a
    reading of 17 DN beside zeros is no outlier of 1.7 DN. Of 3600 pixels the furthest is off by 4 or so; 5.5 is passed
    once in 7000 sets."""

    def silenced(image, rng):
        return np.where(image > 16, image, 0.0)

    exposures = tuple(1e-4 * 1.25**k for k in range(8))
    _, seen = near(present("black_clipping", 16.5, form="dead zone"), after=silenced, repeats=1, exposures=exposures)
    assert seen["hot"].value < 5.5


def test_what_smears_along_a_column_may_carry_its_noise():
    left, _ = near(present("smear", 0.1))
    assert "columns of a frame" not in left and "rows of a frame" in left
