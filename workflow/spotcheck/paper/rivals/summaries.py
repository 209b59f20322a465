"""Summaries of the measured frames, as the paper prints them, of readings drawn by a world.

The evaluation chain is the paper's: unweighted Gaussian fit, maximum, speckle contrast and sum of each crop; mean and
standard deviation over the eight frames of an angle and an exposure; smallest and largest of the twelve.
"""

from dataclasses import dataclass

import numpy as np

from spotcheck.fitting.spotfit import fit_spots
from spotcheck.fitting.width_law import regress_widths
from spotcheck.metrics import crop_metrics
from spotcheck.paper.bright_pixel import PRINTED_P1_PX, PRINTED_P2_PX
from spotcheck.paper.rivals.worlds import EXPOSURES_S, LASER_PX

ANGLES = 4
# Exposure [s] in the middle of the measured ones. p1 and p2 have errors that nearly cancel in the width there, so that
# p1 and this width are fitted instead of p1 and p2.
MIDDLE_S = 5e-4


@dataclass(frozen=True)
class Summary:
    """A number that the paper prints about its measured frames."""

    name: str  # name; `_smallest` and `_largest` are over the twelve pairs of angle and exposure
    printed: float  # printed value [unit]
    unit: str  # unit; "1" if dimensionless
    is_fitted: bool  # whether worlds are fitted to it; the others are held out
    is_mean: bool = False  # whether it is of the law p1 ln t + p2, or a mean of readings or amplitudes
    is_limit: bool = False  # whether the print gives an upper limit, which has a p-value and no score


# Means, and one standard deviation each for the brightness, the width and the contrast of sites, are fitted; other
# standard deviations, and the share of peak pixels, are held out.
SUMMARIES = (
    Summary("p1", PRINTED_P1_PX, "px", True, is_mean=True),
    Summary("broadening_500us", PRINTED_P1_PX * np.log(MIDDLE_S) + PRINTED_P2_PX, "px", True, is_mean=True),
    Summary("maximum_smallest", 800.0, "DN", True, is_mean=True),
    Summary("contrast_smallest", 4.4, "1", True),
    Summary("contrast_largest", 9.5, "1", True),
    Summary("contrast_sd_largest", 1.8, "1", True),
    Summary("amplitude_short_smallest", 839.0, "DN", True, is_mean=True),
    Summary("amplitude_short_largest", 924.0, "DN", True, is_mean=True),
    Summary("amplitude_long_smallest", 992.0, "DN", True, is_mean=True),
    Summary("amplitude_long_largest", 1062.0, "DN", True, is_mean=True),
    Summary("amplitude_sd_short", 227.0, "DN", True),
    Summary("width_sd_largest", 4.0, "px", True),
    Summary("p1_sd", 0.32, "px", False),
    Summary("p2_sd", 1.20, "px", False),
    Summary("contrast_sd_smallest", 0.35, "1", False),
    Summary("contrast_sd_ratio", 2.0, "1", False),
    Summary("amplitude_sd_long", 51.0, "DN", False),
    Summary("width_sd_smallest", 1.0, "px", False),
    Summary("sum_sd_largest", 1.1e6, "DN", False),
    Summary("peak_ratio_smallest", 0.01, "1", False),
    Summary("peak_ratio_largest", 0.05, "1", False),
    Summary("maximum_spread", 6.0, "DN", False),
    Summary("maximum_sd", 10.0, "DN", False, is_limit=True),
)
# Printed values by name, with that of p2, which is no summary itself.
PRINTED_BY_NAME = {"p2": PRINTED_P2_PX} | {summary.name: summary.printed for summary in SUMMARIES}
PRINTED = np.array([summary.printed for summary in SUMMARIES])
IS_FITTED = np.array([summary.is_fitted for summary in SUMMARIES])
IS_SCORED = np.array([not summary.is_fitted and not summary.is_limit for summary in SUMMARIES])


def summarise_readings(readings: np.ndarray) -> np.ndarray:
    """Return the summaries, in the order of `SUMMARIES`, of readings [site, exposure, y, x] in DN."""
    grid = readings.shape[:2]
    images = readings.reshape(-1, *readings.shape[2:])
    fits = fit_spots(images, weighting="equal")
    amplitude, width = (np.reshape(values, grid) for values in (fits.amplitude, fits.sigma_mean))
    maximum, contrast, total, peak_ratio = (
        np.reshape([metric(image) for image in images], grid)
        for metric in (
            crop_metrics.largest_reading,
            crop_metrics.speckle_contrast,
            crop_metrics.pixel_sum,
            crop_metrics.peak_ratio,
        )
    )
    p1, p2 = regress_widths(width, np.array(EXPOSURES_S), LASER_PX)
    by_angle = {
        name: values.reshape(ANGLES, -1, grid[1])
        for name, values in (
            ("amplitude", amplitude), ("width", width), ("maximum", maximum), ("contrast", contrast),
            ("total", total), ("peak_ratio", peak_ratio),
        )
    }  # fmt: skip
    mean = {name: values.mean(axis=1) for name, values in by_angle.items()}
    sd = {name: values.std(axis=1, ddof=1) for name, values in by_angle.items()}
    value_by_name = {
        "p1": p1.mean(),
        "broadening_500us": np.mean(p1 * np.log(MIDDLE_S) + p2),
        "p1_sd": p1.std(ddof=1),
        "p2_sd": p2.std(ddof=1),
        "maximum_smallest": mean["maximum"].min(),
        "maximum_spread": np.ptp(mean["maximum"]),
        "maximum_sd": sd["maximum"].max(),
        "contrast_smallest": mean["contrast"].min(),
        "contrast_largest": mean["contrast"].max(),
        "contrast_sd_smallest": sd["contrast"].min(),
        "contrast_sd_largest": sd["contrast"].max(),
        "contrast_sd_ratio": sd["contrast"][:, 0].mean() / sd["contrast"][:, 1:].mean(),
        "amplitude_short_smallest": mean["amplitude"][:, 0].min(),
        "amplitude_short_largest": mean["amplitude"][:, 0].max(),
        "amplitude_long_smallest": mean["amplitude"][:, 1:].min(),
        "amplitude_long_largest": mean["amplitude"][:, 1:].max(),
        "amplitude_sd_short": sd["amplitude"][:, 0].max(),
        "amplitude_sd_long": sd["amplitude"][:, 1:].max(),
        "width_sd_smallest": sd["width"].min(),
        "width_sd_largest": sd["width"].max(),
        "sum_sd_largest": sd["total"].max(),
        "peak_ratio_smallest": mean["peak_ratio"].min(),
        "peak_ratio_largest": mean["peak_ratio"].max(),
    }
    return np.array([value_by_name[summary.name] for summary in SUMMARIES], dtype=float)
