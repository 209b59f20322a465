"""Every number that decides in the search for what is missing: its value, its unit, which decision, and why."""

from typing import NamedTuple


class Criterion(NamedTuple):
    """A value, its unit, what it decides, and why it is this one."""

    value: float
    unit: str
    decides: str
    reason: str


SURE = Criterion(
    5.0,
    "standard errors",
    "what is found: effects, patterns, noise that collapses, texture, and a shape beyond what noise would gain",
    "a hundred starts are tried, and of all chance finds the largest is near four",
)
GAIN = Criterion(
    SURE.value**2,
    "−2 ln L",
    "a search goes on with an effect that gains this much at least, and names none that gains less",
    "it is what `SURE` gains",
)
FIRST_ORDER = Criterion(
    0.5,
    "1",
    "a first-order size is taken for worth a fit, and a change for in proportion, where it is wrong by less than this",
    "first-order sizes of what is there are off by half at most",
)
PRICE = Criterion(
    2.0,
    "−2 ln L",
    "a form of a law is taken before another where it gains more by this for every parameter more",
    "Akaike's price: forms with more parameters always gain something",
)
WORST = Criterion(
    0.1,
    "1",
    "this part of the frames, the worst, has no say in whether brightness or place scatter",
    "a few bad frames are no scatter of all",
)
COMMON_WIDTH = Criterion(
    0.1,
    "1",
    "how well ln σ_g, what all frames have in common of it, is known to the laws",
    "a learned shape may be wider or narrower than the declared one by some tenth, whose width alone is the law's",
)
COHERENT = Criterion(
    0.7,
    "1",
    "stripes are fixed to the sensor or to the spot where the sites' phases add up to this part of what equal ones do",
    "equal phases that noise scatters by 0.8 rad add up to 0.73",
)
STANDS_OUT = Criterion(
    4.0,
    "1",
    "a peak is one of stripes, and readings gather at a code, where it is so many times what is beside",
    "light of many fine details has many peaks, and light that is flat by itself reads no code much more than others",
)
LONGEST = Criterion(
    2.0,
    "σ of the light",
    "no stripes of a longer period are looked for",
    "they are the shape's and the frames' numbers'",
)
FIELD_ALONE = Criterion(
    0.05,
    "1",
    "in one frame alone no field of a contrast below this is named",
    "gains of pixels, and what the shape's splines cannot resolve, are fields of it as well",
)
FRINGES_ALONE = Criterion(
    0.01,
    "1",
    "in one frame alone no fringes of a contrast below this are named",
    "light has fringes of its own, of dust and glass",
)
DRAWN = Criterion(
    0.4,
    "1",
    "cells of which a learned shape takes more than this part are not asked in the test of what is left",
    "a few draws tell what it takes to a third or so",
)
ROUNDED = Criterion(
    0.02,
    "1",
    "an effect holds everywhere if what it misses in cells exceeds chance by no more than this part of its own z²",
    "forms that are nearly right, a halo or a smear, miss up to 0.017 where they are true; false names miss 0.6",
)
CHANCE = Criterion(
    8.0,
    "standard deviations of χ²",
    "what an effect may miss in cells by chance",
    "rare even among the thousands of cells and effects that a day of verdicts looks at",
)
TIED = Criterion(
    0.002,
    "1",
    "an effect is tied with the light's shape where the shape leaves less than this part of its information",
    "what is left then hangs on what the shape's splines cannot resolve",
)
REFITTED = Criterion(
    3,
    "effects",
    "how many of the likeliest effects are fitted at each step of a search",
    "first-order scores rank the true effect among the first three in all sets that were looked at",
)
HOPELESS = Criterion(
    0.05,
    "1",
    "an effect is not fitted that promises less than this part of what another has gained",
    "first-order scores at starts that are off fall short of what a fit gains, by no more than ten times",
)
RIVAL = Criterion(
    10.0,
    "−2 ln L",
    "an effect that does as well but for this much in another's place is a rival: the name is ambiguous",
    "odds of 150 to 1 between two effects that are as likely before the frames are seen",
)
MOST = Criterion(6, "effects", "a search ends when it has found so many", "more have never been told apart")
ALPHA = Criterion(
    0.01,
    "1",
    "frames disagree with the declared model where the p-value of detection is less than this",
    "one false alarm in a hundred sets of frames is what a user puts up with",
)
LEFT = Criterion(
    0.002,
    "peaks, rms of block means",
    "what is left beside all that is named matters where it is more than this",
    "half a code where an 8-bit camera is used to its full scale",
)
WIDEST = Criterion(
    0.7,
    "sides of a crop",
    "no spot is fitted whose σ_g is more than this",
    "a wider one cannot be told from a background",
)
STATED = Criterion(
    3.0,
    "standard errors",
    "the data sheet is contradicted where a number moves by so many of its stated errors; and by so many of its own the"
    " power of what is left must exceed the tolerance, a law's parameter have moved, the light be no Gaussian, or it is"
    " not said to",
    "within three errors a sheet is as good as it says",
)
