"""Row noise: all pixels of a row share a random offset, which is drawn for every frame."""

from spotcheck.model.effect import Effect, Only, Parameter, RandomStep, Scope, Stage, normal_draws


def add_row_offsets(frame, offset_dn, rows_dn):
    """Return the offsets so far [DN] plus the drawn offset of each row, `rows_dn` [row, 1] in DN."""
    return offset_dn + rows_dn


# Functions that draw the offset of each row [row, 1] in DN, and average over it: normal with mean 0 and deviation
# `rms`.
OFFSETS = normal_draws("rms", size=lambda shape: (shape[0], 1))

EFFECT = Effect(
    number=23,
    name="row_noise",
    sentence="whole rows scatter together, anew in every frame",
    noun="scatter of rows",
    parameters=(Parameter("rms", "DN", 0.0, lambda scales: 0.2 * scales.full_scale_dn, negligible=0.05),),
    variants={Only.ONLY: (RandomStep(Stage.ROW_NOISE_AND_HOT_PIXELS, add_row_offsets, Scope.FRAME, *OFFSETS),)},
    starts=lambda scales: [(0.2,)],
    acts_on_noise=True,
    hidden_in_flats="levels hold no rows",
)
