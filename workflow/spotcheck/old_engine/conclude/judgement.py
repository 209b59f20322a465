"""All that is concluded of a set of frames, as pages, files and pictures take it."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine.conclude.detect import Detection
from spotcheck.old_engine.conclude.places import Where
from spotcheck.old_engine.conclude.unexplained import Unexplained
from spotcheck.old_engine.model.chain import Law
from spotcheck.old_engine.model.light_shape import LightShape
from spotcheck.old_engine.nuisance.sheet import Against
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Frame, Model, Numbers
from spotcheck.old_engine.observe.shots import Shot, pose_of
from spotcheck.old_engine.search.forward import Found

# Why an effect was not found that the light's shape mimics: what scores verdicts looks for these words.
TIED_WITH_SHAPE = "tied with the light's shape"
# Why an effect was not found that is certainly there, and weaker than what a user would call anything.
TOO_SMALL = "too small to matter"


class Light(NamedTuple):
    """What the learned shape has beside the declared one.

    - `power`: the part of the light that lies elsewhere than declared, half the absolute difference over all light,
      with its standard `error`, noise taken off.
    - `orders`: which part of that has each azimuthal order, from 0 on.
    - `axes`: second-moment widths along major and minor axis, over σ_g of the declared shape, and the direction of the
      major one [deg].
    - `lowest`: the least value of the whole shape, in peaks; below 0 by more than noise there is no such light.
    - `shape`: the surface itself.
    - `gain`: what −2 ln L gains by it; NaN: not reckoned.
    """

    power: float
    error: float
    orders: tuple[float, ...]
    axes: tuple[float, float, float]
    lowest: float
    shape: LightShape
    gain: float = np.nan


class Limit(NamedTuple):
    """What is not known of an effect that was not found: its strength with the unit, and why it was not found
    (`TIED_WITH_SHAPE` among others); the least and the greatest that it may still be (95 %; NaN: an end that is not
    told); and how many times as many frames would halve that, or else why no number of them would (`more`)."""

    effect: str
    parameter: str
    unit: str
    why: str
    low: float = np.nan
    high: float = np.nan
    times: float = np.nan
    more: str = ""


class Gap(NamedTuple):
    """How far the frames are from the model, on frames that had no part in choosing it: the root mean square of
    residuals over the declared model's noise `before` and `after` effects and shape were added, and of noise alone (1
    where the found model has no noise of its own); both in DN;
    the part of the excess that is `closed`, and of it what the light's shape closes (`by_light`) and each effect beyond
    (`by_effect`); what −2 ln L of these frames gains; and which frames they are."""

    before: float
    after: float
    noise_floor: float
    rms_dn_before: float
    rms_dn_after: float
    closed: float
    by_light: float
    by_effect: dict[str, float]
    gain: float
    on: str


class Shift(NamedTuple):
    """p1 and p2 [px] under the declared model and under the extended one with its standard error; None: no law."""

    before: tuple[float, float] | None
    after: tuple[float, float] | None
    errors: tuple[float, float] | None


NOTHING = Shift(None, None, None)


class Advice(NamedTuple):
    """A measurement that would tell two effects apart: its `condition` (`exposure_s`, `angle_deg`, `blocked`), the two
    by name, and how many frames of it."""

    condition: Mapping[str, float | bool]
    separates: tuple[str, str]
    frames: int


class Fits(NamedTuple):
    """The fits behind a judgement, of which pictures and the extended model are made.

    - `shots`: those that were searched, then those that were kept unseen.
    - `frames` and their `design`: of the shots that were searched.
    - `before` and `after`: the declared model, and that with all that was found in the gauge of its shape, each with
      the numbers of `frames`.
    - `unseen`: numbers of the frames that were kept unseen under `after`; empty where there are none.
    - `law`: p1, p2 [px] and the peak [DN] under `after`; None where the baseline has no law.
    """

    shots: tuple[Shot, ...]
    frames: tuple[Frame, ...]
    design: Design
    before: Model
    after: Model
    unseen: Numbers
    law: Law | None

    def poses(self) -> list[tuple[float, ...]]:
        """Fibre angle and declared conditions under which each of several lights was seen, NaN where not recorded."""
        lights = self.after.lights
        if lights is None or len(lights.coefficients) < 2:
            return []
        first = [self.shots[int(np.flatnonzero(lights.which == k)[0])] for k in range(len(lights.coefficients))]
        return [pose_of(shot) for shot in first]


class Levels(NamedTuple):
    """What levels of flats tell beside effects: how many there are, and of how many frames; K [DN/e-] with its error
    under all that was found, and that of a straight line through the lower levels (EMVA 1288); and the scatter of light
    from level to level, as a part of it, beyond what frames of one level say."""

    number: int
    frames: int
    gain: float
    gain_error: float
    line: float
    line_error: float
    scatter: float


class Judgement(NamedTuple):
    """The whole judgement; where nothing could be tested, `why_not` says why and all else is empty.

    - `found`: effects, the one that closes most first.
    - `beyond`: names of found effects of which frames that had no part in the search were not told better.
    - `light`: the one that is least as declared; None where the declared shape stands. `lights`: all that were learned,
      in the order of the fits.
    - `errors`: standard errors of all parameters of a found effect, by its name; NaN where one has none. Of effects
      that are missing here (scatter) the strength's alone is known, from `Found`.
    - `off`: how far the mean image is from the declared model, as rms in peaks, noise taken off; None: unknown.
    - `rest`: the test of what is left beside all that was added; None: not asked.
    - `advice`: where effects tie, what to measure next.
    - `not_assessed`: effects that this design cannot show, and why.
    - `levels`: of flats without spots; their peak is the highest signal.
    - `black_level_dn`: where readings begin, by which a strength that they show as a whole number is rounded [DN].
    - `fits`: the fits themselves.
    """

    why_not: str
    detection: Detection | None
    found: tuple[Found, ...]
    beyond: tuple[str, ...]
    light: Light | None
    sheet: tuple[Against, ...]
    unexplained: Unexplained | None
    gap: Gap | None
    shift: Shift
    limits: tuple[Limit, ...]
    where: tuple[Where, ...]
    errors: Mapping[str, tuple[float, ...]] = MappingProxyType({})
    off: float | None = None
    rest: Detection | None = None
    advice: tuple[Advice, ...] = ()
    lights: tuple[Light, ...] = ()
    not_assessed: tuple[tuple[str, str], ...] = ()
    levels: Levels | None = None
    black_level_dn: float = 0.0
    fits: Fits | None = None


def untested(why: str) -> Judgement:
    """The judgement of a dataset of which nothing could be tested."""
    return Judgement(why, None, (), (), None, (), None, None, NOTHING, (), ())
