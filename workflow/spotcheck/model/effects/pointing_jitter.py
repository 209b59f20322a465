"""Pointing jitter: the centre scatters between the exposures of a site."""

from spotcheck.model.effect import Effect, Need, Only, Parameter, RandomStep, Scope, Stage, normal_draws


def shift_x(frame, dx, dy, offset):
    """Return the displacements dx, dy [px] from a centre that is moved to the right by the drawn `offset` [px]."""
    return dx - offset, dy


def shift_y(frame, dx, dy, offset):
    """Return the displacements dx, dy [px] from a centre that is moved down by the drawn `offset` [px]."""
    return dx, dy - offset


# Each step draws the displacement [px] of the centre of each frame along one axis, normal with the deviation `rms`.
STEPS = tuple(RandomStep(Stage.COORDINATES, shift, Scope.FRAME, *normal_draws("rms")) for shift in (shift_x, shift_y))

EFFECT = Effect(
    number=21,
    name="pointing_jitter",
    sentence="the spot's centre scatters between the exposures of a site",
    noun="scatter of the centre",
    parameters=(Parameter("rms", "px", 0.0, lambda scales: scales.crop_px / 4, negligible=0.1),),
    variants={Only.ONLY: STEPS},
    starts=lambda scales: [(0.2,)],
    needs=(Need.EXPOSURES,),
)
