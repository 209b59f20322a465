"""Power fluctuation: brightness scatters from frame to frame without order."""

import numpy as np

from spotcheck.model.effect import Effect, Need, Only, Parameter, RandomStep, Scope, Stage, multiply, normal_draws

# Factor on the light of one frame: normal around 1, never below 0.
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
    # A brightness of each frame's own fits any law of the brightness.
    special_cases=("brightness",),
    hidden_in_flats="the drift between frames of a level is part of the errors",
)
