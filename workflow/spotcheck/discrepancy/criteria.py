"""Every number that decides in the search for what is missing: its value, its unit, which decision, and why."""

from typing import NamedTuple


class Criterion(NamedTuple):
    """A value, its unit, what it decides, and why it is this one."""

    value: float
    unit: str
    decides: str
    reason: str


GAIN = Criterion(
    25.0,
    "−2 ln L",
    "a search goes on with an effect that gains this much at least, and names none that gains less",
    "five standard errors: a hundred starts are tried, and of all chance finds the largest is near four",
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
STATED = Criterion(
    3.0,
    "standard errors",
    "the data sheet is contradicted where a number moves by so many of its stated errors; and by so many of its own the"
    " power of what is left must exceed the tolerance, or it is not said to",
    "within three errors a sheet is as good as it says",
)
