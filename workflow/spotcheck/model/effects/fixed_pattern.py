"""Fixed pattern: the gains of pixels differ, or pixels are hot, in the same way in every frame."""

import numpy as np

from spotcheck.model.effect import Effect, Only, Parameter, RandomStep, Scope, Stage, multiply, normal_draws

# Functions that draw the gain of each pixel [row, column] over the mean gain, and average over it: normal with mean 1
# and deviation `prnu`, never below 0. Hot pixels (`hot_pixels` is their number) are not simulated; the report lists
# those of the frames.
GAINS = normal_draws("prnu", lambda deviation: np.maximum(1 + deviation, 0.0), size=tuple)

EFFECT = Effect(
    number=22,
    name="fixed_pattern",
    sentence="pixels differ in gain, or are hot, alike in every frame",
    noun="scatter of pixels' gains",
    is_share=True,
    parameters=(Parameter("prnu", "1", 0.0, 1.0, negligible=0.002), Parameter("hot_pixels", "1", 0.0, 1e6)),
    variants={Only.ONLY: (RandomStep(Stage.PIXEL_GAIN, multiply, Scope.SENSOR, *GAINS),)},
    starts=lambda scales: [(0.01, 0.0)],
    reference="EMVA 1288 Release 4.0, Section 4 (PRNU)",
    acts_on_noise=True,
    hidden_in_flats="levels hold no pattern: DSNU and PRNU are in transfer.nc",
)
