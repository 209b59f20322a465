"""The converter's last step, compiled: signals rounded once and cut at 0 and at the highest reading."""

import math

from numba import njit

# Standardised distance to a clip beyond which it never acts.
FAR = 6.0
# Below this noise [DN] what rounding does depends on the mean; above, it counts as 1/12 DN².
FINE = 0.7
# Noise [DN] down to which few waves of the rounding error outlast it: a sixth would be exp(-2π²·36·0.25²) = 5e-20.
RIPPLED, WAVES = 0.25, 5
ROUNDING = 1 / 12
# Edgeworth's first term is good for no more skewness than this: light of a few electrons over hardly any read noise.
MOST_SKEWED = 0.5
ROOT_HALF, PDF = 0.7071067811865476, 0.3989422804014327

compiled = njit(cache=True, error_model="numpy")


@compiled
def convert(mean, variance, third, highest, dead):
    """Replace mean [DN] and variance [DN²] of each signal by those of its reading, which is `highest` [DN] at most, of
    each its own; signals below `dead` [DN] read 0. `third` [DN³] is the signals' third central moment: shot noise is
    skewed, which tells where black cuts it; at the highest reading it is not asked for."""
    for k in range(mean.size):
        m, v, full_scale = mean[k], max(variance[k], 1e-8), highest[k]
        sd = math.sqrt(v)
        if m < dead + FAR * sd:
            skew = min(third[k] / (v * sd), MOST_SKEWED)
            if sd < FINE:
                mean[k], variance[k] = _beyond_summed(m, sd, skew, full_scale, dead)
            else:
                mean[k], variance[k] = _beyond(m, sd, skew, full_scale, dead)
        elif RIPPLED < sd < FINE and m < full_scale - FAR * sd:
            mean[k], variance[k] = _rippled(m, sd)
        elif sd < FINE:
            mean[k], variance[k] = _whole(m, sd, full_scale)
        elif m > full_scale - FAR * sd:
            mean[k], variance[k] = _stopped(m, sd, full_scale)
        else:
            variance[k] = v + ROUNDING


@compiled
def _above(z, skew):
    """Part of a nearly normal law above `z`, by Edgeworth's first term."""
    part = 0.5 * math.erfc(z * ROOT_HALF)
    if skew == 0.0:
        return part
    return min(max(part + skew / 6 * (z * z - 1) * PDF * math.exp(-z * z / 2), 0.0), 1.0)


@compiled
def _whole(m, sd, full_scale):
    """Sum over the readings that may occur."""
    # A level between two readings shows as the nearer one.
    full_scale = math.floor(full_scale + 0.5)
    low, high = math.floor(m - FAR * sd), min(math.ceil(m + FAR * sd), full_scale)
    if high <= low:
        return full_scale, 1e-8
    first = second = 0.0
    # Σ P(y > k) and Σ (2k + 1) P(y > k), counted from the lowest reading.
    for j in range(int(high - low)):
        above = 0.5 * math.erfc((low + j + 0.5 - m) / sd * ROOT_HALF)
        first += above
        second += (2 * j + 1) * above
    return low + first, max(second - first * first, 1e-8)


@compiled
def _rippled(m, sd):
    """Rounding far from both ends: the error is a sawtooth of the signal, whose waves the noise damps."""
    damping = math.exp(-2 * (math.pi * sd) ** 2)
    cosine, sine = math.cos(2 * math.pi * m), math.sin(2 * math.pi * m)
    shift = slope = square = 0.0
    turned_cos, turned_sin = 1.0, 0.0
    for k in range(1, WAVES + 1):
        # By (-1)^k, since readings change half-way between whole numbers.
        turned_cos, turned_sin = turned_sin * sine - turned_cos * cosine, -turned_sin * cosine - turned_cos * sine
        left = damping ** (k * k)
        shift += left * turned_sin / (math.pi * k)
        slope += left * 2 * turned_cos
        square += left * turned_cos / (math.pi * k) ** 2
    return m + shift, sd * sd * (1 + 2 * slope) + ROUNDING + square - shift * shift


@compiled
def _beyond(m, sd, skew, full_scale, dead):
    """Signals that get out of the dead zone, or above black. `_beyond_summed` by Euler-Maclaurin, to its fifth
    derivative, and to the first in what skewness adds and at the highest reading."""
    lowest = math.floor(dead + 0.5)
    edge = lowest + 0.5
    z = (edge - m) / sd
    two, three, four = z * z - 1, z * (z * z - 3), z * z * (z * z - 6) + 3
    above, density = 0.5 * math.erfc(z * ROOT_HALF), PDF * math.exp(-z * z / 2) / sd
    beyond = ROUNDING - two / (720 * sd * sd) + four / (30240 * sd**4)
    first = m * above + (sd * sd + beyond) * density
    second = (m * m + sd * sd + ROUNDING) * above
    second += (sd * sd * (m + edge) + 2 * beyond * edge + z / (120 * sd) - three / (3024 * sd**3)) * density
    skewed = skew / 6 * sd * density
    first += skewed * (sd * z + two / 2 + three / (12 * sd))
    second += skewed * (2 * sd * (edge * z + sd) + edge * two - (two - edge * three / sd) / 6)
    if lowest:
        at_lowest = _above((dead - m) / sd, skew) - above
        first += lowest * at_lowest
        second += lowest * lowest * at_lowest
    if m > full_scale - FAR * sd:
        b = (full_scale - m) / sd
        over, pdf = 0.5 * math.erfc(b * ROOT_HALF), PDF * math.exp(-b * b / 2)
        at_end = ROUNDING * pdf / (2 * sd)
        first += sd * (b * over - pdf) + at_end
        second += (full_scale**2 - m * m - sd * sd - ROUNDING) * over - sd * (m + full_scale) * pdf
        second += 2 * full_scale * at_end
    return first, max(second - first * first, 1e-8)


@compiled
def _beyond_summed(m, sd, skew, full_scale, dead):
    """As `_beyond`, by a sum over the readings."""
    lowest = max(math.floor(dead + 0.5), 0.0)
    above = _above((dead - m) / sd, skew) if lowest else 0.0
    first, second = lowest * above, lowest * lowest * above
    reading, highest = lowest + 1, min(math.ceil(m + FAR * sd), math.floor(full_scale + 0.5))
    while reading <= highest:
        above = _above((max(reading - 0.5, dead) - m) / sd, skew)
        first += above
        second += (2 * reading - 1) * above
        reading += 1
    return first, max(second - first * first, 1e-8)


@compiled
def _stopped(m, sd, full_scale):
    """As `sensor.clipped_normal` at its upper end, for one signal."""
    b = min((full_scale - m) / sd, 40.0)
    above, pdf = 0.5 * math.erfc(b * ROOT_HALF), PDF * math.exp(-b * b / 2)
    first = b * above - pdf
    second = b * b * above + 1 - above - b * pdf
    at_end = ROUNDING * pdf / (2 * sd)
    spread = sd * sd * max(second - first * first, 0.0) + ROUNDING * (1 - above) + 2 * sd * (b - first) * at_end
    return m + sd * first + at_end, max(spread, 1e-8)
