"""Black clipping: the converter's zero lies above true black, or a dead zone reads 0."""

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def lowest(*, threshold, form):
    """The threshold [DN]: `subtracted` from every signal before the converter's own clip at 0, or the end of a `dead
    zone` that reads 0."""
    return threshold


def lowered(sensor, *, threshold, form):
    """The black level that is left, as far as it stays above 0; no key describes a dead zone."""
    left = sensor.black_level_dn - threshold
    return {"sensor.black_level_dn": left} if form == "subtracted" and left >= 0 else {}


EFFECT = Effect(
    number=3,
    name="black_clipping",
    sentence="the converter's zero lies above true black: the faint border of the spot is lost",
    noun="signal lost at black",
    place=Place.DIGITAL,
    parameters=(Parameter("threshold", "DN", 0.0, lambda c: 0.5 * c.peak_dn + 40.0),),
    starts=lambda c: [(1.0,), (4.0,), (0.6,), (0.03 * c.peak_dn,)],
    function=lowest,
    forms=("subtracted", "dead zone"),
    negligible=0.1,
    always=True,
    # Clipped noise is skewed and has tails of its own.
    marks=("skewness", "outliers"),
    flats="",
    adopts=lowered,
)
