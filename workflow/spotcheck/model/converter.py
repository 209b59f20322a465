"""The converter's last step, compiled: normal signals rounded once and cut at 0 and at the highest reading."""

import math

from numba import njit

# Standardised distance to a clip beyond which it never acts.
FAR = 6.0
# And one beyond which not even the last digit of a sum knows of it.
NEVER = 9.0
# Below this noise [DN] what rounding does depends on the mean; above, it counts as 1/12 DN².
FINE = 0.7
# Noise [DN] down to which few waves of the rounding error outlast it: a sixth would be exp(-2π²·36·0.25²) = 5e-20.
RIPPLED, WAVES = 0.25, 5
ROUNDING = 1 / 12
ROOT_HALF, PDF = 0.7071067811865476, 0.3989422804014327

compiled = njit(cache=True, error_model="numpy")


@compiled
def convert(mean, variance, highest, dead):
    """Replace mean [DN] and variance [DN²] of each signal by those of its reading, which is `highest` [DN] at most, of
    each its own; signals below `dead` [DN] read 0."""
    for k in range(mean.size):
        m, v, full_scale = mean[k], max(variance[k], 1e-8), highest[k]
        sd = math.sqrt(v)
        if dead > 0.0 and m < dead + FAR * sd:
            mean[k], variance[k] = _beyond(m, sd, full_scale, dead)
        elif RIPPLED < sd < FINE and FAR * sd < m < full_scale - FAR * sd:
            mean[k], variance[k] = _rippled(m, sd)
        elif sd < FINE:
            mean[k], variance[k] = _whole(m, sd, full_scale)
        elif m < FAR * sd or m > full_scale - FAR * sd:
            mean[k], variance[k] = _cut(m, sd, full_scale)
        else:
            variance[k] = v + ROUNDING


@compiled
def _whole(m, sd, full_scale):
    """Sum over the readings that may occur."""
    # A level between two readings shows as the nearer one.
    full_scale = math.floor(full_scale + 0.5)
    low, high = max(math.floor(m - FAR * sd), 0.0), min(math.ceil(m + FAR * sd), full_scale)
    if high <= low:
        return (0.0 if m < 0 else full_scale), 1e-8
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
def _beyond(m, sd, full_scale, dead):
    """Signals that get out of the dead zone. `_beyond_summed` by Euler-Maclaurin, to its third derivative."""
    if sd < FINE or m > full_scale - FAR * sd:
        return _beyond_summed(m, sd, full_scale, dead)
    lowest = math.floor(dead + 0.5)
    edge = lowest + 0.5
    z = (edge - m) / sd
    above, density = 0.5 * math.erfc(z * ROOT_HALF), PDF * math.exp(-z * z / 2) / sd
    at_lowest = 0.5 * math.erfc((dead - m) / sd * ROOT_HALF) - above
    third = (z * z - 1) / (720 * sd * sd)
    first = lowest * at_lowest + m * above + (sd * sd + ROUNDING - third) * density
    second = lowest * lowest * at_lowest + (m * m + sd * sd + ROUNDING) * above
    second += (sd * sd * (m + edge) + 2 * (ROUNDING - third) * edge + z / (120 * sd)) * density
    return first, max(second - first * first, 1e-8)


@compiled
def _beyond_summed(m, sd, full_scale, dead):
    """As `_beyond`, by a sum over the readings."""
    lowest = max(math.floor(dead + 0.5), 0.0)
    above = 0.5 * math.erfc((dead - m) / sd * ROOT_HALF)
    first, second = lowest * above, lowest * lowest * above
    reading, highest = lowest + 1, min(math.ceil(m + FAR * sd), math.floor(full_scale + 0.5))
    while reading <= highest:
        above = 0.5 * math.erfc((max(reading - 0.5, dead) - m) / sd * ROOT_HALF)
        first += above
        second += (2 * reading - 1) * above
        reading += 1
    return first, max(second - first * first, 1e-8)


@compiled
def _cut(m, sd, full_scale):
    """As `sensor.clipped_normal`, for one signal."""
    a, b = max(-m / sd, -40.0), min((full_scale - m) / sd, 40.0)
    below = above = pdf_a = pdf_b = 0.0
    # Nearly always one of the two is out of reach, and its functions cost as much as the other's.
    if a > -NEVER:
        below, pdf_a = 0.5 * math.erfc(-a * ROOT_HALF), PDF * math.exp(-a * a / 2)
    if b < NEVER:
        above, pdf_b = 0.5 * math.erfc(b * ROOT_HALF), PDF * math.exp(-b * b / 2)
    inside = 1 - below - above
    first = a * below + b * above + pdf_a - pdf_b
    second = a * a * below + b * b * above + inside + a * pdf_a - b * pdf_b
    at_low, at_high = ROUNDING * pdf_a / (2 * sd), ROUNDING * pdf_b / (2 * sd)
    spread = sd * sd * max(second - first * first, 0.0) + ROUNDING * inside
    spread += 2 * sd * ((first - a) * at_low + (b - first) * at_high)
    return m + sd * first - at_low + at_high, max(spread, 1e-8)
