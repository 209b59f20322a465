"""Quality metrics against hand counts and closed forms."""

import math

import numpy as np
import pytest
import xarray as xr

from spotcheck.errors import InputError
from spotcheck.metrics import crop_metrics as metrics
from spotcheck.metrics.metrics_table import compute_metrics
from tests.samples.small_datasets import gaussian


def test_contrast_of_known_fields():
    """Eq. 2: 0 for a uniform field, 1 for an exponential one, √(n/p − 1) for p of n pixels lit alike."""
    assert metrics.speckle_contrast(np.full((9, 9), 5.0)) == 0
    field = np.random.default_rng(1).exponential(3.0, (600, 600))
    # Standard error of the contrast of an exponential law: 1/√n; five of them: false alarm 6e-7.
    assert metrics.speckle_contrast(field) == pytest.approx(1, abs=5 / 600)
    lit = np.zeros(100)
    lit[:20] = 7
    assert metrics.speckle_contrast(lit) == pytest.approx(2.0, rel=1e-12)


def test_contrast_leaves_out_what_is_not_there():
    """Eq. 2 over finite pixels alone; an image without light has no contrast."""
    image = np.random.default_rng(2).uniform(1, 9, (20, 20))
    masked = np.pad(image, 5, constant_values=np.nan)
    assert metrics.speckle_contrast(masked) == pytest.approx(image.std() / image.mean(), rel=1e-12)
    assert np.isnan(metrics.speckle_contrast(np.zeros((4, 4))))


def test_contrast_in_single_precision():
    """Eq. 2 sums in double: a bright crop in float32 gives what float64 gives."""
    image = np.random.default_rng(3).integers(60000, 60010, (240, 240))
    # Sums of whole numbers are exact in double; float32 sums would be off by 1e-2.
    assert metrics.speckle_contrast(image.astype("f4")) == pytest.approx(image.std() / image.mean(), rel=1e-9)


def test_averages_over_frames():
    """Eqs. 17–19: mean of all pixels, mean of maxima and mean of sums, against plain loops."""
    frames = np.random.default_rng(4).integers(0, 1024, (3, 5, 7)).astype(float)
    pixels = [frames[k, i, j] for k in range(3) for i in range(5) for j in range(7)]
    assert metrics.mean_of_frames(frames) == pytest.approx(sum(pixels) / len(pixels), rel=1e-12)
    maxima = [max(v for row in f for v in row) for f in frames]
    assert metrics.mean_maximum(np.array(maxima)) == pytest.approx(sum(maxima) / 3, rel=1e-12)
    sums = [sum(v for row in f for v in row) for f in frames]
    assert metrics.mean_sum(np.array(sums)) == pytest.approx(sum(sums) / 3, rel=1e-12)
    # Of equal frames the mean is the frame's own: the printed 1/(KMN + 1) would not give that.
    assert metrics.mean_of_frames(np.full((2, 3, 3), 8.0)) == 8.0
    # A frame that is missing does not count.
    assert metrics.mean_maximum(np.array([800.0, np.nan, 810.0])) == 805.0
    assert metrics.mean_sum(np.array([1.0, np.nan])) == 1.0


def test_peak_ratio_by_hand():
    """Two pixels within 2 % of 100, five above 50; exactly 98 counts as peak, exactly 50 not as plateau."""
    image = np.array([[100, 98, 97, 51, 50.1], [50, 49, 10, 0, np.nan]])
    assert metrics.peak_ratio(image) == pytest.approx(2 / 5, rel=1e-12)
    assert np.isnan(metrics.peak_ratio(np.zeros((3, 3))))


def test_peak_ratio_of_a_gaussian():
    """Areas within 2 % and above half of a Gaussian: ln(1/0.98)/ln 2 = 2.9 %, as the paper's 1–5 %."""
    # A circle's pixel count is off by less than its perimeter's share: 1/σ of the smaller circle's radius 0.2 σ.
    got = metrics.peak_ratio(gaussian(1201, 1.0, 600, 600, 150.0))
    assert got == pytest.approx(math.log(1 / 0.98) / math.log(2), rel=0.02)


@pytest.mark.parametrize("data_range", [255.0, 1023.0, 65535.0])
def test_psnr_is_its_definition(data_range):
    """20 log10(range/rmse)."""
    rng = np.random.default_rng(5)
    a, b = rng.uniform(0, 1000, (2, 30, 30))
    got = metrics.psnr(a, b, data_range)
    assert got == pytest.approx(20 * math.log10(data_range / math.sqrt(np.mean((a - b) ** 2))), rel=1e-12)


def test_what_the_container_adds_to_psnr():
    """36.13 dB between a range of 65535 and one of 1023; 53–58 dB are an error of 83–147 DN."""
    a, b = np.zeros((2, 8, 8))
    a[:] = 100.0
    both = [metrics.psnr(a, b, r) for r in (metrics.CONTAINER_RANGE, 1023)]
    assert both[0] - both[1] == pytest.approx(36.13, abs=0.005)
    for error, printed in ((147, 53), (83, 58)):
        assert metrics.psnr(np.full((2, 2), float(error)), np.zeros((2, 2)), 65535) == pytest.approx(printed, abs=0.1)


def test_psnr_of_masked_and_equal_images():
    """Pixels that both have; infinite for equal images; NaN where they share none."""
    a = np.arange(16.0).reshape(4, 4)
    b = a + 2
    a[0], b[:, 0] = np.nan, np.nan
    assert metrics.psnr(a, b, 100.0) == pytest.approx(20 * math.log10(50), rel=1e-12)
    assert metrics.psnr(a, a, 100.0) == np.inf
    assert np.isnan(metrics.psnr(a, np.full((4, 4), np.nan), 100.0))


@pytest.mark.parametrize("move", [(0.0, 0.0), (0.5, 0.0), (0.3, -0.7), (-2.25, 3.6)])
def test_shift_against_an_analytic_gaussian(move):
    """Cubic splines of a Gaussian of σ = 5 px are off by less than 1e-4 of its peak, away from the border."""
    image = gaussian(80, 1000.0, 40, 38, 5.0)
    moved = metrics.shift_image(image, *move)
    want = gaussian(80, 1000.0, 40 + move[1], 38 + move[0], 5.0)
    # Error of a cubic spline: some 0.003 h⁴ f⁗, f⁗ up to 3/σ⁴ of the peak an axis: 3e-5 of it; rounding at 0.
    inner = slice(5, -5)
    np.testing.assert_allclose(moved[inner, inner], want[inner, inner], atol=0.1)


def test_shift_marks_what_came_from_outside():
    """Moved by three rows: the first three are NaN and nothing else."""
    moved = metrics.shift_image(np.ones((9, 9)), 3.0, 0.0)
    assert np.isnan(moved[:3]).all() and np.isfinite(moved[3:]).all()


def test_shift_keeps_a_uniform_image_uniform_beside_a_gap():
    """A masked crop of constant background stays constant wherever it is finite."""
    image = np.full((40, 40), 100.0)
    image[:, :8] = np.nan
    moved = metrics.shift_image(image, 0.3, 0.4)
    # Splines reproduce constants; 1e-9 for rounding.
    np.testing.assert_allclose(moved[np.isfinite(moved)], 100.0, rtol=1e-9)


def test_a_condition_does_not_take_the_place_of_a_metric():
    """Both would be one variable of the file."""
    crops = xr.Dataset({"status": (("angle", "peak_ratio", "centring"), np.zeros((1, 2, 2), int))})
    with pytest.raises(InputError, match=r"instrument\.yaml: key conditions names peak_ratio, .*; rename it"):
        compute_metrics({"measured": crops, "simulated": crops}, {}, 1023.0)
