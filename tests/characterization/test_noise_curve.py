"""Gain and read noise of frames without a data sheet, from differences of neighbouring pixels."""

from dataclasses import replace

import numpy as np
import pytest

from spotcheck.characterization import sensor_choice as sensor_stage
from spotcheck.characterization.noise_curve import fit_gain, measure_noise_curve
from spotcheck.characterization.spot_estimates import estimate_from_spots
from spotcheck.crops.full_scale import FullScale
from tests.samples.small_datasets import SENSOR, gaussian, loaded, noisy

SIDE = 240
END = FullScale(1023, "bits of the converter")


def light_of(kind: str, seed: int) -> np.ndarray:
    """A smooth spot; the same with fine texture of 3 %; an even gradient."""
    if kind == "ramp":
        return np.broadcast_to(np.linspace(5, 900, SIDE), (SIDE, SIDE)).copy()
    spot = gaussian(SIDE, 900.0, 120, 118, 40.0)
    if kind == "spot":
        return spot
    return spot * (1 + 0.03 * np.random.default_rng(seed).normal(size=spot.shape)).clip(0)


@pytest.mark.parametrize("kind", ["spot", "textured spot", "ramp"])
def test_gain_of_simulated_frames(kind):
    """K and the floor over 20 frames: the mean within 4 standard errors of it, the stated error within 40 %."""
    found = [fit_gain(measure_noise_curve(noisy(light_of(kind, s), s).astype(float), 1023.0), 40.0) for s in range(20)]
    assert all(found)
    gains, errors = np.array([(g.gain, g.gain_stderr) for g in found]).T
    scatter = gains.std(ddof=1)
    # 4 standard errors (false alarm 6e-5) and 3 % for the spot's curvature and for bins that are not points.
    assert abs(gains.mean() - 0.11) < 4 * scatter / np.sqrt(20) + 0.03 * 0.11
    # The scatter of 20 is known to 16 %, and the error to some 20 %.
    assert errors.mean() == pytest.approx(scatter, rel=0.6)
    floors = np.array([g.floor for g in found])
    want = 0.11**2 * 169 + 1 / 12
    assert abs(floors.mean() - want) < 4 * floors.std(ddof=1) / np.sqrt(20) + 0.1 * want


def test_gain_of_small_spots_in_the_dark():
    """Most pixels have no light, and their noise tells no level: of 12 sets of 20 spots the mean of the gains, in their
    stated errors, is 0 within 4 standard errors of unit pulls (false alarm 6e-5), the floor's too."""
    own = replace(SENSOR, gain_dn_per_e=0.4, read_noise_e=10.0)
    pulls = []
    for k in range(12):
        crops = [noisy(gaussian(120, 900.0, 60.3, 59.8, 10.0), 20 * k + s, own).astype(float) for s in range(20)]
        found = estimate_from_spots(crops, {}, own.black_level_dn, 1023.0).gain
        floor = (own.gain_dn_per_e * own.read_noise_e) ** 2 + 1 / 12
        pulls.append([(found.gain - own.gain_dn_per_e) / found.gain_stderr, (found.floor - floor) / found.floor_stderr])
    assert (np.abs(np.mean(pulls, axis=0)) < 4 / np.sqrt(12)).all()


@pytest.mark.parametrize("angle_deg", [0.0, 8.0, 27.0, 45.0, 118.0])
@pytest.mark.parametrize("width_px", [0.9, 1.3, 1.6, 2.4])
def test_a_narrow_line_gives_its_gain_or_none(width_px, angle_deg):
    """The light of a line falls within a pixel or two: its slope must not count as noise, in any direction."""
    y, x = np.mgrid[:SIDE, :SIDE] - 119.7
    along, across = (x * np.cos(turn) + y * np.sin(turn) for turn in np.radians([angle_deg, angle_deg + 90]))
    light = 800 * np.exp(-((along / 50) ** 2 + (across / width_px) ** 2) / 2)
    gain = estimate_from_spots((noisy(light, seed).astype(float) for seed in range(3)), {}, None, 1023.0).gain
    # The interval of 95 %, and 10 % for the light.
    assert gain is None or (gain.low < 0.11 * 1.1 and gain.gain - 2 * gain.gain_stderr < 0.11 * 1.1)


def test_gain_at_black_level_0():
    """The default black level: the converter's zero lies in the middle of the border's noise."""
    own = replace(SENSOR, black_level_dn=0.0)
    found = [
        fit_gain(measure_noise_curve(noisy(light_of("spot", s), s, own).astype(float), 1023.0), 0.0) for s in range(20)
    ]
    floors = np.array([g.floor for g in found if g])
    want = 0.11**2 * 169 + 1 / 12
    assert abs(floors.mean() - want) < 4 * floors.std(ddof=1) / np.sqrt(len(floors)) + 0.1 * want


def test_curve_of_uniform_light():
    """Variance of second differences over 6 is a pixel's own: K L plus floor, within five standard errors."""
    light = np.repeat(np.linspace(50, 800, 24), 10)[:, None] * np.ones(SIDE)
    curve = measure_noise_curve(noisy(light, 1).astype(float), 1023.0)
    want = 0.11 * (curve.level - 40) + 0.11**2 * (169 + 70e-4) + 1 / 12
    # A bin mixes two levels at most (150/4 DN apart): its variance lies between theirs, 4 % of the widest.
    assert (np.abs(curve.variance - want) < 5 * curve.stderr + 0.04 * want).all()


NOTHING = {
    "dark": np.zeros((SIDE, SIDE)),
    "flat": np.full((SIDE, SIDE), 400.0),
}


@pytest.mark.parametrize("kind", NOTHING)
def test_no_gain_where_the_light_does_not_vary(kind):
    """One level shows no slope: None in at least 19 of 20 frames (3 standard errors of a slope: 0.3 % false alarms)."""
    found = [fit_gain(measure_noise_curve(noisy(NOTHING[kind], s).astype(float), 1023.0), 40.0) for s in range(20)]
    assert sum(g is None for g in found) >= 19


@pytest.mark.parametrize("image", [np.full((SIDE, SIDE), 1023.0), np.full((SIDE, SIDE), np.nan), np.ones((9, 9))])
def test_no_curve_of_nothing(image):
    """Overexposed, masked, or too small."""
    assert measure_noise_curve(image, 1023.0).level.size == 0
    assert fit_gain(measure_noise_curve(image, 1023.0), 0.0) is None


def test_the_data_sheet_speaks_first(tmp_path):
    """What instrument.yaml gives is used; full scale is the converter's; nothing is estimated."""
    text = "sensor: {bit_depth: 10, gain_dn_per_e: 0.2, read_noise_e: 5, black_level_dn: 3}\ncrop_px: 8"
    ds = loaded(tmp_path, [np.zeros((9, 9), np.uint16)], text)
    out = sensor_stage.choose_sensor_values(ds, END, [])
    model = sensor_stage.read_sensor_model(out)
    assert (model.gain_dn_per_e, model.read_noise_e, model.black_level_dn) == (0.2, 5, 3)
    assert model.full_scale_dn == 1023 and np.isinf(model.full_well_e)
    assert out["gain_dn_per_e"].attrs["source"] == "instrument.yaml" and np.isnan(out["gain_dn_per_e_stderr"])
