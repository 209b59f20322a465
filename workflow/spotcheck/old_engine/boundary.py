"""Conversions between `spotcheck.model` and the frozen copies of it that the old engine uses.

No other module of the old engine imports from `spotcheck.model`.
"""

from spotcheck.dataset import Dataset
from spotcheck.errors import InputError
from spotcheck.model import effects as current
from spotcheck.old_engine.model import effects as frozen
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.effect import Effect
from spotcheck.old_engine.model.extended import Extended, check_bounds, context_of
from spotcheck.old_engine.model.sensor import SensorModel as OldSensor
from spotcheck.sensor import SensorModel


def old_sensor(sensor: SensorModel) -> OldSensor:
    """Return the sensor as the old engine takes it."""
    return OldSensor(**{name: getattr(sensor, name) for name in OldSensor._fields})


def new_sensor(sensor: OldSensor) -> SensorModel:
    """Return a sensor of the old engine as `spotcheck.estimate` takes it."""
    return SensorModel(**sensor._asdict())


def choose_effects(choice: current.Choice) -> None:
    """Set the frozen vocabulary of this process to what a choice leaves of it.

    Names that it does not know are ignored, and effects from files are no part of it. A choice that leaves none of it
    sets it whole, for `effects_to_search` refuses to search then.
    """
    left = _names_left(choice)
    left_out = tuple(name for name in frozen.built_in() if name not in left)
    frozen.choose(frozen.Choice(without=left_out) if left else frozen.LIBRARY)


def effects_to_search() -> list[Effect]:
    """Return the effects that the old engine searches for. Raises `InputError` where the run's vocabulary has none."""
    if not _names_left(current.chosen()):
        raise InputError(
            "vocabulary: leaves no effect that can be searched for; effects from files are simulated but not searched"
            f" for in this version, so leave at least one of {', '.join(frozen.built_in())}"
        )
    return list(frozen.vocabulary().values())


def remark_on_files() -> str:
    """Return a sentence that names the run's effects from files, which are not searched for; "" where it has none."""
    names = [effect["name"] for effect in current.record().get("own", ())]
    said = "effects from files are simulated but not searched for in this version"
    return f"{said}: {', '.join(names)}" if names else ""


def check_model(dataset: Dataset, model: Extended, baseline: Baseline, sensor: OldSensor, name: str) -> None:
    """Raise `InputError` as `spotcheck.simulation.check_model` does, for a model that the frozen copies have read."""
    crop = dataset.instrument.crop_px
    if model.law is not None and baseline.photon_budget == "free":
        raise InputError(f"{name}: has a law, which the photon budget free of this dataset cannot take")
    if crop > min(model.rows, model.columns):
        raise InputError(f"{name}: the frame has {model.columns} × {model.rows} px, but crop_px is {crop}")
    check_bounds(model, context_of(model, baseline, sensor, crop, dataset.exposures), name)


def _names_left(choice: current.Choice) -> list[str]:
    """Names of the frozen vocabulary that a choice leaves."""
    return [
        name for name in frozen.built_in() if name not in choice.without and (not choice.only or name in choice.only)
    ]
