"""Spotcheck: how a camera sees a laser spot on a composite, and what a simulation of it is missing.

Public names stand in `__all__` and in workflow/docs/api.md; a module is imported when a name of it is first used.

Inside, imports go down: judging > cli > figures, discrepancy > estimate, metrics > model > sensor > frames, optics >
dataset, store.
"""

from typing import TYPE_CHECKING

__all__ = [
    "Caustic",
    "Characterisation",
    "Dataset",
    "InputError",
    "Look",
    "PixelMaps",
    "SensorModel",
    "SpotBounds",
    "SpotFits",
    "__version__",
    "characterise_dataset",
    "characterise_sensor",
    "fit_caustic",
    "fit_spots",
    "judge_dataset",
    "look",
    "read_dataset",
    "read_image",
    "simulate_dataset",
    "spot_bounds",
]

if TYPE_CHECKING:
    from spotcheck.dataset import Dataset
    from spotcheck.dataset import load as read_dataset
    from spotcheck.design import simulate_dataset
    from spotcheck.errors import InputError
    from spotcheck.estimate.caustic import Caustic, fit_caustic
    from spotcheck.estimate.characterise import Characterisation, characterise_dataset, characterise_sensor
    from spotcheck.estimate.fitted import SpotFits
    from spotcheck.estimate.spot_bounds import SpotBounds, spot_bounds
    from spotcheck.estimate.spotfit import fit_spots
    from spotcheck.first_look.looking import Look, look
    from spotcheck.frames import read as read_image
    from spotcheck.judging import judge_dataset
    from spotcheck.sensor import SensorModel
    from spotcheck.sensor.pixel_maps import PixelMaps

    __version__: str
else:
    # Public name → where it lives.
    _HOME = {
        "Caustic": "estimate.caustic.Caustic",
        "Characterisation": "estimate.characterise.Characterisation",
        "Dataset": "dataset.Dataset",
        "InputError": "errors.InputError",
        "Look": "first_look.looking.Look",
        "PixelMaps": "sensor.pixel_maps.PixelMaps",
        "SensorModel": "sensor.model.SensorModel",
        "SpotBounds": "estimate.spot_bounds.SpotBounds",
        "SpotFits": "estimate.fitted.SpotFits",
        "characterise_dataset": "estimate.characterise.characterise_dataset",
        "characterise_sensor": "estimate.characterise.characterise_sensor",
        "fit_caustic": "estimate.caustic.fit_caustic",
        "fit_spots": "estimate.spotfit.fit_spots",
        "judge_dataset": "judging.judge_dataset",
        "look": "first_look.looking.look",
        "read_dataset": "dataset.load",
        "read_image": "frames.read",
        "simulate_dataset": "design.simulate_dataset",
        "spot_bounds": "estimate.spot_bounds.spot_bounds",
    }

    def __getattr__(name):
        """A public name, imported when it is first asked for (PEP 562)."""
        from importlib import import_module, metadata

        if name == "__version__":
            value = metadata.version(__name__)
        elif name in _HOME:
            module, own = _HOME[name].rsplit(".", 1)
            value = getattr(import_module(f"{__name__}.{module}"), own)
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value
        return value

    def __dir__():
        return sorted({*globals(), *__all__})
