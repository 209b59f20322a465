"""What a granular field brings to numbers that are not its own, and by what it is known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, uniform_filter

from spotcheck.discrepancy.explain import account, by_site
from spotcheck.discrepancy.noise import BOX, FrameFits, crossed, hottest
from spotcheck.discrepancy.shots import Design
from tests.library.small_verdict import looked, present


def grains(rng, count, size, grain):
    """Fields of variance 1 that correlate as exp(−d²/2 grain²)."""
    fields = gaussian_filter(rng.standard_normal((count, size, size)), (0, *[grain / np.sqrt(2)] * 2), mode="wrap")
    return fields / fields.std()


@pytest.mark.parametrize("grain, excess", [(0.8, 0.3), (1.6, 3.0), (3.0, 40.0)])
def test_products_of_two_sites_scatter_as_drawn_fields_do(grain, excess):
    """780 pairs of 40 sites under a Gaussian spot, their finest structure alone: the standard deviation of their
    products over that of noise, within a tenth (of so many pairs it scatters by 4 %)."""
    rng = np.random.default_rng(51)
    count, size, sigma = 40, 128, 16.0
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    weight = np.exp(-(x**2 + y**2) / (2 * sigma**2))
    # Pulls r/v of noise have the variance 1/v, of a field that follows the light C/v: here in units of the weight.
    contrast = np.sqrt(excess * weight.sum() / (weight**2).sum())

    def spread(fields):
        pulls = np.sqrt(weight) * rng.standard_normal((count, size, size)) + fields
        fine = (pulls - uniform_filter(pulls, (0, BOX, BOX), mode="constant")).reshape(count, -1)
        return (fine @ fine.T)[np.triu_indices(count, 1)].std()

    ratio = spread(contrast * weight * grains(rng, count, size, grain)) / spread(0.0)
    assert crossed(grain, excess) == pytest.approx(ratio, rel=0.1)


def test_without_a_field_products_scatter_as_noise():
    assert crossed(2.0, 0.0) == 1.0


def test_what_grain_may_bring_to_faint_light_is_not_hot():
    """The more a field may scatter, the less of an odd pixel is left; a hot one in the dark stays."""
    look, _ = looked()
    hot = hottest(look.measured)
    assert 3 < hot < 6  # of 3,600 pixels
    assert hottest(look.measured, 0.01) < hot
    look.measured.sums.dark_pull[np.unravel_index(look.measured.sums.dark_weight.argmax(), (60, 60))] += 1e3
    assert hottest(look.measured, 0.01) > 50


def some_design(sites, exposures):
    condition, site = np.tile(np.arange(exposures), sites), np.repeat(np.arange(sites), exposures)
    blank = np.full(exposures, np.nan)
    return Design(condition, site, site, np.linspace(0, 1, len(site)), 0 * blank, blank, np.zeros(exposures, int))


@pytest.mark.parametrize("own, expected", [(0.0, True), (0.3, True), (1.0, False)])
def test_a_field_moves_all_exposures_of_a_site_alike(own, expected):
    """A quantity that scatters by 20 of its standard errors from site to site, a part of that variance anew in every
    frame: fields leave a tenth of it, and a lag of the sensor all of it."""
    rng = np.random.default_rng(52)
    design = some_design(24, 3)
    value = 20 * (np.sqrt(1 - own) * rng.standard_normal(24)[design.site] + np.sqrt(own) * rng.standard_normal(72))
    value += rng.standard_normal(72)
    fits = FrameFits(value[:, None], np.ones((72, 1)), np.ones(72, bool))
    assert by_site(fits, design) == expected


def test_where_nothing_scatters_or_sites_have_one_exposure_nothing_is_said():
    rng = np.random.default_rng(53)
    for design, size in ((some_design(24, 3), 1.0), (some_design(24, 1), 30.0)):
        count = len(design.site)
        fits = FrameFits(size * rng.standard_normal((count, 1)), np.ones((count, 1)), np.ones(count, bool))
        assert by_site(fits, design)


def test_an_error_beside_grain_is_that_of_grain():
    """What sites share on the sensor is compared with what two fields have alike by chance."""

    def error(own):
        return next(o.error for o in own.observables if o.label == "sensor")

    look, bare = looked(grainy(0.2))
    assert error(account(look, (present("speckle", 0.2, 2.0),))) > 3 * error(bare)


def grainy(contrast):
    """Light with a field of each site, told by the spot's place in its pixel."""

    def light(dx, dy, angle, exposure, sigma, spot):
        seed = int(1e6 * abs(dx[0, 0])) + int(1e6 * abs(dy[0, 0]))
        field = grains(np.random.default_rng(seed), 1, dx.shape[0], 2.0)[0]
        return spot * np.maximum(1 + contrast * field, 0)

    return light
