"""Records of all that is concluded of a dataset, from which verdict.json, the extended model and the pictures are made.

The analysis of spot frames and that of flats fill the same records.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from spotcheck.model.effect import AppliedEffect
from spotcheck.model.light_shape import LightShape


@dataclass(frozen=True)
class ParameterValue:
    """A reported value."""

    value: float
    stderr: float  # standard error; NaN if unknown
    unit: str  # "1" for none


@dataclass(frozen=True)
class Consistency:
    """Cochran's Q test of an effect's strength over cells of the data."""

    q: float  # Cochran's Q
    cells: int  # number of cells
    limit: float  # largest Q of a consistent effect
    is_consistent: bool  # whether Q is below the limit


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the frames show."""

    applied: AppliedEffect  # effect, variant and values of all its parameters
    values: Mapping[str, ParameterValue]  # reported parameters by name
    gain: float  # drop of −2 ln L by it; NaN if unknown
    z: float  # its strength in standard errors
    consistency: Consistency | None = None  # None for effects that scatter
    rivals: Mapping[str, float] = field(default_factory=dict)  # effects that do as well: how much larger −2 ln L is
    gap_closed: float = float("nan")  # part of the gap on held-out frames that it closes; NaN if unknown

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.applied.effect.name


@dataclass(frozen=True)
class ResidualTest:
    """A test of the residuals of the declared model."""

    name: str  # what is tested, such as "blocks"
    where: str  # the place that disagrees most, in words; "" if there is no place
    statistic: float  # its strongest residual in standard errors
    p_value: float  # of this test alone
    z: float  # normal equivalent of the p-value


@dataclass(frozen=True)
class Detection:
    """Whether anything disagrees with a model."""

    p_value: float  # of the strongest test, corrected for their number
    tests: tuple[ResidualTest, ...]  # all tests


@dataclass(frozen=True)
class Place:
    """A place in the images that disagrees with the declared model."""

    words: str  # where it is
    z: float  # its mean residual in standard errors


@dataclass(frozen=True)
class LearnedLight:
    """A learned light shape compared with the declared one."""

    shape: LightShape  # difference from the declared shape
    power: float  # part of the light that lies elsewhere: half the absolute difference over all light
    stderr: float  # standard error of the power
    orders: tuple[float, ...]  # part of that power by azimuthal order, from 0 on
    major: float  # second-moment width along the long axis, over the declared one
    minor: float  # the same along the short axis
    direction_deg: float  # direction of the long axis
    lowest: float  # least value of the whole shape [peak]
    words: str  # the same for a person
    gain: float = float("nan")  # drop of −2 ln L by it; NaN if unknown
    gap_closed: float = float("nan")  # part of the gap on held-out frames that it closes; NaN if unknown


@dataclass(frozen=True)
class SensorPull:
    """A number of the data sheet and what the frames say of it."""

    name: str  # key of the instrument's sensor, such as "gain_dn_per_e"
    unit: str  # of all four numbers
    stated: float  # value of the data sheet
    stated_stderr: float  # its standard error
    fitted: float  # by data sheet and frames together
    stderr: float  # standard error of the fitted value

    @property
    def shift(self) -> float:
        """Shift from the stated value in stated errors."""
        return (self.fitted - self.stated) / self.stated_stderr

    @property
    def z(self) -> float:
        """Shift in the standard deviation that it would have if the data sheet were right."""
        return (self.fitted - self.stated) / max(self.stated_stderr**2 - self.stderr**2, 1e-300) ** 0.5


@dataclass(frozen=True)
class UpperLimit:
    """Range in which the strength of an effect that is not named lies (95 %)."""

    effect: str
    parameter: str
    unit: str
    reason: str  # why it is not named
    low: float = float("nan")  # NaN: no lower end
    high: float = float("nan")  # NaN: no upper end
    frames: int | None = None  # more frames of all conditions that would halve it; None if no number is known to
    remark: str = ""  # why more frames would not help


@dataclass(frozen=True)
class Gap:
    """Residuals on held-out data: mean over blocks of the squared sum of residuals over its variance."""

    before: float  # declared model
    after: float  # extended model
    noise_floor: float  # expectation of `after` if the extended model is right
    closed: float  # part of the gap that is closed
    rms_dn_before: float  # rms of block means beyond noise [DN]
    rms_dn_after: float
    gain: float  # drop of −2 ln p, the predictive log score, over all held-out frames
    on: str  # which data are held out, in words


@dataclass(frozen=True)
class MetricChange:
    """One of the paper's metrics on held-out frames, mean over conditions."""

    name: str  # in words
    unit: str  # of all values
    measured: float  # of the held-out frames
    declared: float  # simulated by the declared model
    extended: float  # simulated by the extended model


@dataclass(frozen=True)
class LawShift:
    """p1 and p2 [px] under the declared and under the extended model; NaN without a law."""

    before: tuple[float, float] = (float("nan"), float("nan"))
    after: tuple[float, float] = (float("nan"), float("nan"))
    stderr: tuple[float, float] = (float("nan"), float("nan"))  # of `after`


@dataclass(frozen=True)
class Unexplained:
    """What is left of the mean image beside all that is named."""

    size: float  # rms [peak], noise taken off
    variance_error: float  # standard error of its square [peak²]
    z: float  # its square in standard errors
    share: float  # part of the gap that is left; NaN if unknown
    p_value: float  # of the tests of detection beside the extended model; NaN if not tested


@dataclass(frozen=True)
class Advice:
    """A measurement that would separate two candidates."""

    condition: Mapping[str, float | bool]  # such as `exposure_s`, `angle_deg`, `blocked`
    separates: tuple[str, str]  # names of the candidates
    frames: int  # number of frames


@dataclass(frozen=True)
class LevelFindings:
    """What levels of flats say beside effects."""

    number: int  # of levels
    frames: int
    gain: ParameterValue  # K with all that is named [DN/e-]
    straight_line: ParameterValue  # K by a straight line through the lower levels (EMVA 1288) [DN/e-]
    light_scatter: float  # scatter of the lamp from level to level, as part of its light


@dataclass(frozen=True)
class Findings:
    """All that is concluded of a dataset."""

    reason: str = ""  # why nothing could be assessed; "" if it was
    has_converged: bool = True  # whether the fits behind the effects have converged
    detection: Detection | None = None  # tests of the declared model; None if nothing was assessed
    rms_of_peak: float = float("nan")  # rms of the mean image about the declared model [peak], noise taken off
    places: tuple[Place, ...] = ()  # where the declared model fails, the strongest first
    effects: tuple[NamedEffect, ...] = ()  # the one that closes most of the gap first
    light: LearnedLight | None = None  # None if the declared shape stands
    sensor: tuple[SensorPull, ...] = ()  # numbers of the data sheet that were fitted
    limits: tuple[UpperLimit, ...] = ()  # of effects that are not named
    law: LawShift = LawShift()  # change of p1 and p2 by the effects
    unexplained: Unexplained | None = None  # what the extended model leaves; None if nothing was assessed
    gap: Gap | None = None  # on held-out frames; None if there are none
    metrics: tuple[MetricChange, ...] = ()  # of the paper; empty without held-out frames
    advice: tuple[Advice, ...] = ()  # measurements that separate rivals
    not_assessed: tuple[tuple[str, str], ...] = ()  # effects that the design cannot show, and why
    levels: LevelFindings | None = None  # of flats alone
    remarks: tuple[str, ...] = ()  # what a reader should know of the data
