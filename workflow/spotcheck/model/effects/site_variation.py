"""Site variation: brightness and width of the spot vary from site to site."""

from dataclasses import replace

import numpy as np

from spotcheck.model.effect import Effect, Need, Only, Parameter, RandomStep, Scope, Stage, multiply, normal_draws


def scale_width(frame, width, factor):
    """Return `width`, a `WidthLaw`, with the factor on the width σ_g multiplied by the drawn `factor` [1]."""
    return replace(width, factor=width.factor * factor)


# The steps draw for each site a factor on the width and one on the brightness; their logarithms are normal with mean 0.
STEPS = (
    RandomStep(Stage.WIDTH, scale_width, Scope.SITE, *normal_draws("width", np.exp)),
    RandomStep(Stage.BRIGHTNESS, multiply, Scope.SITE, *normal_draws("brightness", np.exp)),
)

EFFECT = Effect(
    number=26,
    name="site_variation",
    sentence="brightness and width of the spot vary from site to site",
    noun="scatter of brightness between sites",
    is_share=True,
    parameters=(
        # Standard deviations of the logarithms of peak and width.
        Parameter("brightness", "1", 0.0, 1.0, negligible=0.003),
        Parameter("width", "1", 0.0, 0.5, negligible=0.001),
    ),
    variants={Only.ONLY: STEPS},
    starts=lambda scales: [(0.02, 0.01)],
    # Without scatter of the brightness, the width may still scatter.
    vanishes_at=np.nan,
    needs=(Need.SITES, Need.LAW),
)
