"""Row noise: whole rows scatter together, anew in every frame."""

from spotcheck.old_engine.model.effect import Effect, Parameter, Place, Scatter


def offsets(rows, rng, *, rms):
    """Offset [DN] of each row of one frame."""
    return rms * rng.standard_normal(rows)


EFFECT = Effect(
    number=23,
    name="row_noise",
    sentence="whole rows scatter together, anew in every frame",
    noun="scatter of rows",
    place=Place.SCATTER,
    parameters=(Parameter("rms", "DN", 0.0, lambda c: 0.2 * c.full_scale_dn),),
    starts=lambda c: [(0.2,)],
    function=offsets,
    negligible=0.05,
    scatter=Scatter("row", "frame", "row"),
    # The scatter of lines tells it; the means see it only where black cuts it.
    idle={"": ("rms",)},
    # Pixels of a row share what it got, which adds up as stripes would.
    marks=("hot", "skewness", "outliers", "stripes"),
    flats="levels hold no rows",
)
