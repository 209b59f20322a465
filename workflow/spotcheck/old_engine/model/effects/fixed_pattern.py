"""Fixed pattern: pixel gains or hot pixels, the same in every frame."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place, Scatter


def gains(shape, rng, *, prnu, hot_pixels):
    """Factor [rows, columns] on each pixel's light; hot pixels are listed by the report, not drawn."""
    return np.maximum(1 + prnu * rng.standard_normal(shape), 0.0)


EFFECT = Effect(
    number=22,
    name="fixed_pattern",
    sentence="pixels differ in gain, or are hot, alike in every frame",
    noun="scatter of pixels' gains",
    part=True,
    place=Place.SCATTER,
    parameters=(
        Parameter("prnu", "1", 0.0, 1.0),
        Parameter("hot_pixels", "1", 0.0, 1e6),
    ),
    starts=lambda c: [(0.01, 0.0)],
    function=gains,
    negligible=0.002,
    scatter=Scatter("field", "sensor", "pixel"),
    # Hot pixels are outliers, and what all sites share adds up as stripes would.
    marks=("hot", "skewness", "outliers", "stripes"),
    flats="levels hold no pattern: DSNU and PRNU are in transfer.nc",
)
