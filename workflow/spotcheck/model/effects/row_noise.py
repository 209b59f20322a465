"""Row noise: whole rows scatter together, anew in every frame."""

from spotcheck.model.effect import Effect, Only, Parameter, RandomStep, Scope, Stage, normal_draws


def add(frame, offset_dn, rows_dn):
    """Return what is there plus the offset [DN] of each row."""
    return offset_dn + rows_dn


# Offset [rows, 1] of each row [DN].
OFFSETS = normal_draws("rms", size=lambda shape: (shape[0], 1))

EFFECT = Effect(
    number=23,
    name="row_noise",
    sentence="whole rows scatter together, anew in every frame",
    noun="scatter of rows",
    parameters=(Parameter("rms", "DN", 0.0, lambda scales: 0.2 * scales.full_scale_dn, negligible=0.05),),
    variants={Only.ONLY: (RandomStep(Stage.ROW_NOISE_AND_HOT_PIXELS, add, Scope.FRAME, *OFFSETS),)},
    starts=lambda scales: [(0.2,)],
    acts_on_noise=True,
    hidden_in_flats="levels hold no rows",
)
