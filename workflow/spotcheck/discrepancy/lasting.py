"""Whether pixels that stick out of the sum of all frames do so in more than one of them."""

from collections.abc import Sequence

import numpy as np

from spotcheck.discrepancy.look import Look
from spotcheck.discrepancy.measure import base_scenes
from spotcheck.discrepancy.noise import BOX, hot_field
from spotcheck.discrepancy.shots import Shot

# A pixel that fewer frames saw says nothing.
LEAST_FRAMES = 3
# Of what a pixel has over its neighbours in all frames, the part that a single one brings: a hit's is all of it, a hot
# pixel's that is seen in three frames at seven standard deviations is 1/3 ± 0.1.
MOST_OF_ONE = 0.6


def lasting(shots: Sequence[Shot], look: Look, prnu: float) -> bool:
    """Whether most of the pixels that are hot beyond gains of rms `prnu` are so in more than one frame, as the sensor's
    own are; what hits once, as a cosmic ray, is no pattern. True where too few frames saw any of them to say."""
    measured, setting = look.measured, look.setting
    places = np.argwhere(hot_field(measured, prnu))
    if not len(places):
        return True
    scene = base_scenes(shots, measured.design, measured.base, setting.baseline, setting.sensor)
    off = np.zeros((len(shots), len(places)))
    seen = np.zeros(off.shape, bool)
    half = BOX // 2
    for k, shot in enumerate(shots):
        image, expected = shot.pixels(), scene(k)
        corner = int(measured.top[k]) - measured.corner[0], int(measured.left[k]) - measured.corner[1]
        for i, (row, column) in enumerate(places - corner):
            if not (half <= row < image.shape[0] - half and half <= column < image.shape[1] - half):
                continue
            box = np.s_[row - half : row + half + 1, column - half : column + half + 1]
            rest = image[box] - expected.mean[box]
            if np.isfinite(rest).all():
                off[k, i] = (rest[half, half] - np.median(rest)) / expected.variance[row, column]
                seen[k, i] = True
    total = off.sum(axis=0)
    told = (seen.sum(axis=0) >= LEAST_FRAMES) & (total != 0)
    if not told.any():
        return True
    most = (off * np.sign(total)).max(axis=0)[told] / np.abs(total[told])
    return bool(np.median(most) < MOST_OF_ONE)
