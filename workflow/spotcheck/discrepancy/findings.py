"""Records of the findings from a dataset, from which verdict.json, the extended model and the pictures are made.

The analysis of spot frames and that of flats fill the same records. The declared model is that of the instrument; the
extended model is the declared one with the named effects. A named effect is one that the verdict reports as present.
The gap is the squared residual of the declared model on held-out data beyond noise. The unit [peak] is the peak of the
spot, or of the brightest level of flats.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from spotcheck.characterization.sensor_choice import SHEET, SPOTS
from spotcheck.discrepancy.criteria import CLEAR_ERRORS
from spotcheck.model.effect import AppliedEffect, Effect
from spotcheck.model.light_shape import LightShape


@dataclass(frozen=True)
class ParameterValue:
    """A reported value with its standard error."""

    value: float  # in the unit below
    stderr: float  # standard error in the same unit; NaN if unknown
    unit: str  # "1" if dimensionless


@dataclass(frozen=True)
class Consistency:
    """Cochran's Q test of an effect's strength over cells of the data."""

    q: float  # Cochran's Q
    cells: int  # number of cells
    limit: float  # largest Q of a consistent effect
    is_consistent: bool  # whether Q is below the limit


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the verdict reports as present."""

    applied: AppliedEffect  # effect, variant and values of all its parameters
    values: Mapping[str, ParameterValue]  # reported parameters by name
    gain: float  # drop of −2 ln L by the effect; NaN if unknown
    z: float  # strength in standard errors
    consistency: Consistency | None = None  # None for laws, static shapes and random effects
    # Effects that explain the data about as well in its place, by name: by how much −2 ln L is larger with them.
    rivals: Mapping[str, float] = field(default_factory=dict)
    gap_closed: float = float("nan")  # part of the gap that the effect closes; NaN if unknown

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.applied.effect.name


@dataclass(frozen=True)
class ResidualTest:
    """A test of the residuals of the declared model."""

    name: str  # quantity that is tested, such as "blocks"
    where: str  # the place that disagrees most, in words; "" if there is no place
    statistic: float  # the strongest residual, at this place, in standard errors
    p_value: float  # of this test alone
    z: float  # normal deviate of this p-value


@dataclass(frozen=True)
class Detection:
    """Result of all tests for disagreement with a model."""

    p_value: float  # smallest p-value of all tests, corrected for their number
    tests: tuple[ResidualTest, ...]  # all tests, the smallest p-value first


@dataclass(frozen=True)
class Place:
    """A place in the images that disagrees with the declared model."""

    words: str  # description of the place
    z: float  # mean residual in standard errors


@dataclass(frozen=True)
class LearnedLight:
    """A learned light shape compared with the declared one."""

    shape: LightShape  # difference from the declared shape
    power: float  # part of the light that lies elsewhere: half the absolute difference over all light, 0 to 1
    stderr: float  # standard error of the power
    orders: tuple[float, ...]  # part of that power by azimuthal order, from 0 on
    major: float  # second-moment width along the long axis, over the declared one
    minor: float  # the same along the short axis
    direction_deg: float  # direction of the long axis [deg]
    lowest: float  # least value of the whole shape [peak]
    words: str  # description of the shape for the verdict
    gain: float = float("nan")  # drop of −2 ln L by the learned shape; NaN if unknown
    gap_closed: float = float("nan")  # part of the gap that the learned shape closes; NaN if unknown


@dataclass(frozen=True)
class SensorPull:
    """A parameter of the sensor: value of the data sheet, or as measured, and value fitted with it as a prior.

    A value from the spots was measured in the same frames to which the model is fitted. The frames count once in the
    error of the fitted value, which neither contradicts nor confirms the first.
    """

    name: str  # key of the instrument's sensor, such as "gain_dn_per_e"
    unit: str  # of all four numbers
    stated: float  # value of the data sheet, or as measured
    stated_stderr: float  # standard error of the stated value
    fitted: float  # value from the stated one and the frames together
    stderr: float  # standard error of the fitted value
    source: str = SHEET  # source of the stated value: one of `sensor_choice.SOURCES`

    @property
    def is_independent(self) -> bool:
        """Whether the stated value comes from elsewhere than from the fitted frames."""
        return self.source != SPOTS

    @property
    def shift(self) -> float:
        """Difference of fitted and stated value in standard errors of the stated one."""
        return (self.fitted - self.stated) / self.stated_stderr

    @property
    def contradicts(self) -> bool:
        """Whether the frames contradict the stated value: by `CLEAR_ERRORS` of its errors, and of the fitted value's.

        Misfit, which increases the error of the fitted value, may pull it far away from a precise stated one.
        """
        errors = min(abs(self.shift), abs(self.fitted - self.stated) / self.stderr)
        return bool(self.is_independent and errors > CLEAR_ERRORS)

    @property
    def z(self) -> float:
        """Difference of fitted and stated value in its standard deviation, on the assumption of a correct data sheet.

        The fitted value contains the stated one, so that the variance of the difference is that of the stated value
        less that of the fitted one.
        """
        return (self.fitted - self.stated) / max(self.stated_stderr**2 - self.stderr**2, 1e-300) ** 0.5


@dataclass(frozen=True)
class UpperLimit:
    """Range that contains the strength of an effect that is not named, with 95 % confidence."""

    effect: str  # name of the effect
    parameter: str  # name of the parameter that is the strength
    unit: str  # unit of the strength
    reason: str  # why the effect is not named
    low: float = float("nan")  # lower end; NaN if the range is open below
    high: float = float("nan")  # upper end; NaN if the range is open above
    frames: int | None = None  # number of further frames, over all conditions, that halves the range; None if unknown
    remark: str = ""  # why further frames do not help; "" if they do

    @classmethod
    def of_effect(cls, effect: Effect, reason: str, **ends: Any) -> "UpperLimit":
        """Return the limit on the strength of an effect; `ends` are the fields from `low` on, by name."""
        return cls(effect.name, effect.parameters[0].name, effect.parameters[0].unit, reason, **ends)


@dataclass(frozen=True)
class Gap:
    """Residuals on held-out data: mean over blocks of the squared sum of residuals over its variance."""

    before: float  # under the declared model
    after: float  # under the extended model
    noise_floor: float  # expectation of `after` if the extended model is correct
    closed: float  # part of the gap that the extended model closes
    rms_dn_before: float  # rms of block means beyond noise, under the declared model [DN]
    rms_dn_after: float  # the same under the extended model [DN]
    gain: float  # drop of −2 ln p, with the predictive density p of all held-out data, from declared to extended model
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
    """Parameters (p1, p2) [px] of the width law σ = laser width + p1 ln t + p2; NaN if not fitted."""

    before: tuple[float, float] = (float("nan"), float("nan"))  # under the declared model
    after: tuple[float, float] = (float("nan"), float("nan"))  # under the extended model
    stderr: tuple[float, float] = (float("nan"), float("nan"))  # standard errors of `after`


@dataclass(frozen=True)
class Unexplained:
    """Difference of the mean image and the extended model that no named effect explains."""

    size: float  # rms difference beyond noise [peak]
    variance_error: float  # standard error of the mean squared difference [peak²]
    z: float  # mean squared difference in standard errors
    share: float  # part of the gap that remains; NaN if unknown
    p_value: float  # of the residual tests under the extended model; NaN if not tested


@dataclass(frozen=True)
class Advice:
    """A further measurement that would distinguish a named effect from a rival."""

    condition: Mapping[str, float | bool]  # `exposure_s`, and perhaps `angle_deg` or `blocked`
    separates: tuple[str, str]  # names of the effect and of the rival
    frames: int  # number of frames that are needed


@dataclass(frozen=True)
class LevelFindings:
    """Results from levels of flats other than effects. K is the gain of the sensor."""

    number: int  # number of levels
    gain: ParameterValue  # K from the fit with the named effects [DN/e-]
    straight_line: ParameterValue  # K from a straight line through the lower levels (EMVA 1288) [DN/e-]
    light_scatter: float  # scatter of the lamp from level to level, relative to its light


@dataclass(frozen=True)
class Findings:
    """Everything that a verdict reports of a dataset."""

    reason: str = ""  # why nothing could be assessed; "" if it was
    has_converged: bool = True  # whether the fits behind the effects have converged
    detection: Detection | None = None  # tests of the declared model; None if nothing was assessed
    rms_of_peak: float = float("nan")  # rms difference of mean image and declared model beyond noise [peak]
    places: tuple[Place, ...] = ()  # places that disagree most with the declared model, the strongest first
    effects: tuple[NamedEffect, ...] = ()  # named effects, the one that closes most of the gap first
    light: LearnedLight | None = None  # learned light shape; None if the declared one is kept
    sensor: tuple[SensorPull, ...] = ()  # parameters of the data sheet that were fitted
    limits: tuple[UpperLimit, ...] = ()  # limits on effects that were assessed but not named
    law: LawShift = LawShift()  # change of p1 and p2 by the effects
    unexplained: Unexplained | None = None  # residual of the extended model; None if nothing was assessed
    gap: Gap | None = None  # prediction of held-out data; None without these
    metrics: tuple[MetricChange, ...] = ()  # metrics of the paper; empty without held-out frames
    advice: tuple[Advice, ...] = ()  # further measurements that distinguish rivals
    not_assessed: tuple[tuple[str, str], ...] = ()  # (name, reason) of effects that the design cannot show
    levels: LevelFindings | None = None  # results from levels of flats; None for spot frames
    remarks: tuple[str, ...] = ()  # sentences on the data for the reader of the verdict
    deviating_frames: str = ""  # clause on held-out frames far from the model; "" if there are none
