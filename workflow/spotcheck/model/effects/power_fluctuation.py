"""Power fluctuation: the brightness scatters from frame to frame at random."""

import numpy as np

from spotcheck.model.effect import Effect, Need, Only, Parameter, RandomStep, Scope, Stage, multiply, normal_draws

# Functions that draw the factor on the peak of one frame, and average over it: normal with mean 1 and deviation `rms`,
# never below 0.
FACTORS = normal_draws("rms", lambda deviation: np.maximum(1 + deviation, 0.0))

EFFECT = Effect(
    number=19,
    name="power_fluctuation",
    sentence="the brightness scatters from frame to frame without order",
    noun="scatter of brightness",
    is_share=True,
    parameters=(Parameter("rms", "1", 0.0, 2.0, negligible=0.003),),
    variants={Only.ONLY: (RandomStep(Stage.BRIGHTNESS, multiply, Scope.FRAME, *FACTORS),)},
    starts=lambda scales: [(0.02,)],
    needs=(Need.FRAMES, Need.LAW),
    # Independent brightnesses of frames can follow any law of the brightness.
    special_cases=("brightness",),
    hidden_in_flats="the drift between frames of a level is part of the errors",
)
