"""Frames whose brightness and width follow no law: what is named all the same, and what is not."""

import json

import numpy as np
import pytest

from spotcheck.discrepancy.base import base_of, spots_of
from spotcheck.discrepancy.cells import Setting
from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.freed import Evidence, flanks_of, spread_sites
from spotcheck.discrepancy.freed_named import (
    freed_of,
    gap_of_freed,
    left_of,
    line_of,
    recalled_freed,
    rightly,
    saved_of_freed,
    spots_of_unseen,
)
from spotcheck.discrepancy.look import look_at
from spotcheck.discrepancy.shots import Shot, design_of
from spotcheck.model.baseline import Baseline
from spotcheck.model.effects.speckle import field
from spotcheck.model.sensor import SensorModel

# One worker makes what most of these look at.
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("freed")]

SIDE, SIGMA, LEVEL, RATIO = 90, 6.5, 700.0, 1.25
SENSOR = SensorModel(0.11, 13.0, 0.0, np.inf, 0.0, 1023.0)
ANGLES, EXPOSURES, REPEATS = (0.0, 60.0, 120.0), (1e-4, 4e-4, 9e-4), 3


def frames(contrast: float = 0.0, ratio: float = RATIO, level: float = LEVEL, coma: float = 0.0) -> list[Shot]:
    """Sites whose brightness scatters by a factor e^0.7; peaks up to some 20 times over the level."""
    rng = np.random.default_rng(8)
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    out = []
    for angle in ANGLES:
        for repeat in range(REPEATS):
            x0, y0 = (SIDE - 1) / 2 + rng.uniform(-2, 2, 2)
            bright, sigma = 1.4e6 * np.exp(0.7 * rng.standard_normal()), SIGMA * (1 + 0.03 * rng.standard_normal())
            grain = field((SIDE, SIDE), rng, contrast=contrast, grain=0.8)
            turn = np.deg2rad(angle + 20)
            dx, dy = x - x0, y - y0
            along, across = dx * np.cos(turn) + dy * np.sin(turn), dy * np.cos(turn) - dx * np.sin(turn)
            rho2 = (along**2 / ratio + across**2 * ratio) / sigma**2
            rho2 = rho2 / (1 + coma * dx / sigma * np.sqrt(rho2) / (1 + rho2)) ** 2
            for exposure in EXPOSURES:
                electrons = rng.poisson(bright * exposure / 0.11 * 10 * np.exp(-rho2 / 2) * grain)
                signal = np.minimum(electrons, level / 0.11) + rng.normal(0, 13.0, x.shape)
                image = np.clip(np.rint(0.11 * signal), 0, 1023.0)
                out.append(Shot(angle, exposure, repeat, len(out), (), 0, 0, lambda image=image: image))
    return out


def opened(shots: list[Shot]):
    """Design, base and setting of frames."""
    baseline = Baseline(0.0, "spot_area", False, EXPOSURES[-1])
    design = design_of(shots)
    base = base_of(spots_of(shots, SENSOR, False), np.zeros((len(shots), 2)), design, baseline, SIDE)
    assert base is not None
    return design, base, Setting(baseline, SENSOR, float(SIDE), ((SIDE - 1) / 2, (SIDE - 1) / 2))


@pytest.fixture(scope="module")
def clipped():
    """Clipped, elliptic and granular frames, and what was named of them."""
    shots = frames(contrast=0.5)
    design, base, setting = opened(shots)
    return shots, design, base, setting, freed_of(shots, design, base, setting)


def test_areas_tell_the_width_of_a_clipped_spot():
    """Within 6 %, however far light goes over the level, and whatever grain there is."""
    shots = [shot for shot in frames(contrast=0.5, ratio=1.0) if shot.exposure_s == EXPOSURES[-1]]
    _, sigma = flanks_of(shots, 0.0)
    assert np.allclose(sigma, SIGMA, rtol=0.1) and sigma.mean() == pytest.approx(SIGMA, rel=0.06)


def test_saturation_ellipse_and_grain_are_named(clipped):
    """Level within 1 %, ratio within 2 %, contrast within 15 %; p1 = 0 and p2 = the sites' mean width within three of
    their errors, where the law would have it that width grows by pixels."""
    freed = clipped[-1]
    assert freed is not None and set(freed.names) == {"saturation", "fibre_anisotropy", "speckle"}
    values = {own.effect.name: own.values for own in freed.present}
    assert values["saturation"][0] == pytest.approx(LEVEL, rel=0.01)
    assert values["fibre_anisotropy"][0] == pytest.approx(RATIO, rel=0.02)
    assert values["speckle"][0] == pytest.approx(0.5, rel=0.15)
    for (value, error), true in ((freed.p1, 0.0), (freed.p2, SIGMA)):
        assert abs(value - true) < 3 * error
    assert freed.p1[1] < 0.1 and freed.p2[1] < 0.8


def test_findings_come_back_from_their_file(clipped):
    freed = clipped[-1]
    text = json.dumps(saved_of_freed(freed), allow_nan=False)
    again = recalled_freed(json.loads(text))
    assert json.dumps(saved_of_freed(again)) == text and again.whole[-1].named() == freed.whole[-1].named()


def test_little_is_left_and_unseen_frames_are_foretold(clipped):
    shots, design, base, setting, freed = clipped
    look = look_at(shots, design, base, setting)
    first = account(look, ())
    left = left_of(freed, shots, look)
    assert left.refit.chi2 < 0.01 * first.refit.chi2
    unseen = [shot._replace(repeat=shot.repeat + REPEATS) for shot in shots[: len(EXPOSURES)]]
    gap = gap_of_freed(freed, first, look, unseen, design_of(unseen))
    assert gap is not None and gap.closed > 0.97 and gap.before > 20 * gap.after and len(gap.parts) == 3
    assert gap_of_freed(freed, first, look, [], None) is None


def test_spots_of_unseen_frames_are_those_that_chose_the_model(clipped):
    """The same frames, once as unseen ones: centres within a fifth of a pixel, widths within 2 %, as few sites are
    fitted at a time and the grain's weights differ."""
    shots, design, base, setting, freed = clipped
    look = look_at(shots, design, base, setting)
    some = slice(len(EXPOSURES), 3 * len(EXPOSURES))
    own = spots_of_unseen(freed, look, shots[some], design_of(shots[some]))
    for name in ("x0", "y0"):
        assert np.allclose(getattr(own, name), getattr(freed.base, name)[some], atol=0.2)
    assert np.allclose(own.sigma, freed.base.sigma[some], rtol=0.02)
    assert np.allclose(own.amplitude, freed.base.amplitude[some], rtol=0.1)


def test_another_shape_is_not_named():
    """A comet's tail outside the vocabulary: no effect takes its place."""
    shots = frames(ratio=1.0, level=np.inf, coma=0.3)
    shots = [shot._replace(pixels=lambda own=shot: own.pixels() / 1.0) for shot in shots if shot.exposure_s < 2e-4]
    design, base, setting = opened(shots)
    assert freed_of(shots, design, base, setting) is None


def test_an_effect_needs_large_part_no_rival_and_nothing_left():
    good = Evidence("saturation", 1000.0, "super_gaussian", 900.0, 60.0, 40)
    assert rightly(good)
    assert not rightly(good._replace(rival_rise=500.0))
    assert not rightly(good._replace(left=200.0))
    assert not rightly(good._replace(rise=5.0, rival_rise=5.0, left=0.0))
    # Beside a fit that leaves noise alone a rival need only fall far short.
    strong = good._replace(rise=9000.0, left=10.0)
    assert rightly(strong._replace(rival_rise=1200.0)) and not rightly(strong._replace(rival_rise=900.0))


def test_line_takes_sites_as_draws():
    """Widths 3 + 0.2 ln t of sites that scatter by 0.5 px: slope within sites, its error from how slopes differ."""
    shots = frames()
    design = design_of(shots)
    rng = np.random.default_rng(2)
    offset = rng.normal(0, 0.5, design.sites)
    sigma = 5.0 + 0.2 * np.log(design.exposure_s[design.condition]) + offset[design.site]
    baseline = Baseline(2.0, "linear", False, 1e-3)
    (p1, error), (p2, error2) = line_of(sigma, design, baseline)
    assert p1 == pytest.approx(0.2) and error < 1e-9
    assert p2 == pytest.approx(3 + offset.mean()) and error2 == pytest.approx(offset.std(ddof=1) / 3)


def test_sites_are_spread_over_the_angles():
    design = design_of(frames())
    chosen = spread_sites(design)
    place = [design.place[design.condition[design.site == site][0]] for site in chosen]
    assert len(chosen) == 8 and min(np.bincount(place)) >= 2
