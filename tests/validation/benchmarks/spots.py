"""Spots of known truth, their frames by plain numpy, and the bounds of their parameters.

Nothing here comes from the library's estimator or law of a reading, so that both can be judged by it. Parameters are,
in this order: amplitude, x and y of the centre [px], σ along and across [px], orientation [rad] from +x towards +y,
offset.
"""

from collections.abc import Callable, Iterator

import numpy as np
from scipy.special import erf, ndtr
from scipy.stats import norm, poisson

from spotcheck.sensor import SensorModel

SIDE = 240
NAMES = ("amplitude", "x", "y", "σ major", "σ minor", "orientation", "offset")
MAJOR, MINOR, ORIENTATION = 3, 4, 5
X, Y = np.arange(SIDE, dtype=float)[None, :], np.arange(SIDE, dtype=float)[:, None]
# From this mean [e-] on a reading's information is that of a normal law to 0.2 %.
BRIGHT_E = 300.0


def set_a(rng: np.random.Generator) -> np.ndarray:
    """Truth of a random spot of the paper's kind: peak 9091 e-, widths of about 17 and 14 px, faint offset [e-]."""
    x, y = (SIDE - 1) / 2 + rng.uniform(-2, 2, 2)
    return np.array([9091.0, x, y, rng.uniform(16, 18), rng.uniform(13, 15), rng.uniform(0.2, 1.2), rng.uniform(5, 15)])


def mean_image(truth) -> np.ndarray:
    """Point-sampled elliptical Gaussian plus offset [SIDE, SIDE], in the unit of its amplitude."""
    u, v = _distances(truth)
    return truth[0] * np.exp(-(u * u + v * v) / 2) + truth[6]


def _distances(truth) -> tuple[np.ndarray, np.ndarray]:
    """Distances from the centre along the axes of the ellipse, over its widths."""
    _, x0, y0, major, minor, orientation, _ = truth
    cos, sin = np.cos(orientation), np.sin(orientation)
    return ((X - x0) * cos + (Y - y0) * sin) / major, ((Y - y0) * cos - (X - x0) * sin) / minor


def slopes(truth) -> np.ndarray:
    """Derivatives [7, SIDE, SIDE] of `mean_image`."""
    amplitude, _, _, major, minor, orientation, _ = truth
    cos, sin = np.cos(orientation), np.sin(orientation)
    u, v = _distances(truth)
    out = np.ones((7, SIDE, SIDE))
    out[0] = np.exp(-(u * u + v * v) / 2)
    light = amplitude * out[0]
    out[1] = light * (u * (cos / major) - v * (sin / minor))
    out[2] = light * (u * (sin / major) + v * (cos / minor))
    out[3] = light * u * u / major
    out[4] = light * v * v / minor
    out[5] = light * u * v * (major / minor - minor / major)
    return out


def _integral(x, x0: float, sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """∫ exp(−t²/2σ²) over each pixel, and its derivatives by x0 and σ."""
    low, high = x - 0.5 - x0, x + 0.5 - x0
    at_low, at_high = np.exp(-((low / sigma) ** 2) / 2), np.exp(-((high / sigma) ** 2) / 2)
    whole = sigma * np.sqrt(np.pi / 2) * (erf(high / (sigma * np.sqrt(2))) - erf(low / (sigma * np.sqrt(2))))
    return whole, at_low - at_high, (whole - high * at_high + low * at_low) / sigma


def integrated_image(truth) -> tuple[np.ndarray, np.ndarray]:
    """Mean [SIDE, SIDE] and derivatives [6, SIDE, SIDE] (no orientation) of a spot along the axes, integrated over each
    pixel."""
    amplitude, x0, y0, major, minor, _, offset = truth
    (px, px_0, px_s), (py, py_0, py_s) = _integral(X, x0, major), _integral(Y, y0, minor)
    light = amplitude * px * py
    rest = [px * py, amplitude * px_0 * py, amplitude * px * py_0, amplitude * px_s * py, amplitude * px * py_s]
    return light + offset, np.array([*rest, np.ones_like(light)])


def frame(mean_e: np.ndarray, sensor: SensorModel, rng: np.random.Generator) -> np.ndarray:
    """Random readings [DN, uint16] of a mean [e-]: the whole chain, written out in numpy."""
    electrons = np.minimum(rng.poisson(mean_e), sensor.full_well_e)
    signal = electrons + rng.normal(0.0, sensor.read_noise_e, mean_e.shape)
    reading = np.rint(sensor.gain_dn_per_e * signal + sensor.black_level_dn)
    return np.clip(reading, 0, min(sensor.full_scale_dn, 65535)).astype(np.uint16)


def bounds(derivatives: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Cramér–Rao bounds, as standard deviations, from derivatives [parameter, …] and each pixel's information."""
    flat = derivatives.reshape(len(derivatives), -1)
    matrix = (flat * information.ravel()) @ flat.T
    scale = 1 / np.sqrt(np.diag(matrix))
    return np.sqrt(np.diag(np.linalg.inv(matrix * np.outer(scale, scale)))) * scale


def plain_information(mean_e: np.ndarray, sensor: SensorModel) -> np.ndarray:
    """Information [1/e-²] of a reading that is as good as normal: 1/(ν + σ_r² + 1/(12 K²))."""
    return 1 / (mean_e + sensor.read_noise_e**2 + 1 / (12 * sensor.gain_dn_per_e**2))


def exact_information(sensor: SensorModel) -> Callable[[np.ndarray], np.ndarray]:
    """Information [1/e-²] as a function of the mean [e-] for a sensor that clips nothing: Σ_y (∂P(y)/∂ν)² / P(y).

    Between nodes the ratio to `plain_information` is interpolated; it is smooth and close to 1.
    """
    nodes = np.geomspace(0.5, BRIGHT_E, 24)
    ratio = [_summed_information(node, sensor) / plain_information(node, sensor) for node in nodes]
    return lambda mean_e: np.interp(np.log(mean_e), np.log(nodes), ratio) * plain_information(mean_e, sensor)


def _summed_information(mean_e: float, sensor: SensorModel) -> float:
    gain, noise, black = sensor.gain_dn_per_e, sensor.read_noise_e, sensor.black_level_dn
    reach = 8 * np.sqrt(mean_e) + 10
    counts = np.arange(max(0, int(mean_e - reach)), int(mean_e + reach) + 1)
    lowest, highest = gain * (counts[0] - 8 * noise) + black, gain * (counts[-1] + 8 * noise) + black
    edges = np.arange(np.floor(lowest) - 1, np.ceil(highest) + 2)
    below = ndtr((edges[None, :] - 0.5 - gain * counts[:, None] - black) / (gain * noise))
    given_count = np.diff(below, axis=1)
    probability = poisson.pmf(counts, mean_e) @ given_count
    # ∂ Pois(n; ν)/∂ν = Pois(n − 1; ν) − Pois(n; ν)
    slope = (poisson.pmf(counts - 1, mean_e) - poisson.pmf(counts, mean_e)) @ given_count
    likely = probability > 1e-200
    return float(np.sum(slope[likely] ** 2 / probability[likely]))


def clipped_share(mean_e: np.ndarray, sensor: SensorModel) -> np.ndarray:
    """What clipping at full scale leaves of a normal reading's information: Φ(a) − φ(a) (a − φ(a)/(1 − Φ(a))), for the
    standardised distance a to the clip, with a spread that does not depend on the mean."""
    sd = 1 / np.sqrt(plain_information(mean_e, sensor))
    clip_e = (sensor.full_scale_dn - 0.5 - sensor.black_level_dn) / sensor.gain_dn_per_e
    a = np.clip((clip_e - mean_e) / sd, -30, 30)
    # The hazard from logarithms: φ and 1 − Φ both vanish far away.
    hazard = np.exp(norm.logpdf(a) - norm.logsf(a))
    return np.maximum(ndtr(a) - norm.pdf(a) * (a - hazard), 0.0)


def turned(difference: np.ndarray) -> np.ndarray:
    """Differences [n, 7] of parameters with the orientation [rad] taken to ±π/2."""
    out = np.array(difference)
    out[:, ORIENTATION] = (out[:, ORIENTATION] + np.pi / 2) % np.pi - np.pi / 2
    return out


def start_of(image: np.ndarray) -> np.ndarray:
    """A sensible start: offset from the border, centre and form from the pixels above half maximum, widths from their
    number, 2π σ² ln 2."""
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    offset = float(np.mean(border))
    amplitude = float(np.mean(np.partition(image.ravel(), -20)[-20:])) - offset
    y, x = np.nonzero(image > offset + amplitude / 2)
    (vxx, vxy), (_, vyy) = np.cov(x, y)
    spread = np.hypot((vxx - vyy) / 2, vxy)
    ratio = np.sqrt(((vxx + vyy) / 2 + spread) / ((vxx + vyy) / 2 - spread))
    variance = len(x) / (2 * np.pi * np.log(2))
    widths, orientation = np.sqrt([variance * ratio, variance / ratio]), np.arctan2(2 * vxy, vxx - vyy) / 2
    return np.array([amplitude, x.mean(), y.mean(), *widths, orientation, offset])


def chunks(count: int, size: int) -> Iterator[int]:
    """`count` in parts of at most `size`."""
    for start in range(0, count, size):
        yield min(size, count - start)
