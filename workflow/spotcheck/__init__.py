"""Spotcheck: how a camera sees a laser spot on a composite, and what a simulation of it is missing.

Public names stand in `__all__` and in workflow/docs/api.md; a module is imported when a name of it is first used.

Packages, from the top; each imports only from those below it: cli, quicklook, report, paper and export, discrepancy,
metrics, fitting, characterization, model, sensor, crops, dataset, io.
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
    from spotcheck.characterization.characterise import Characterisation, characterise_dataset, characterise_sensor
    from spotcheck.cli.pipeline import judge_dataset
    from spotcheck.dataset.folder import Dataset
    from spotcheck.dataset.folder import load as read_dataset
    from spotcheck.dataset.frames import read_image
    from spotcheck.errors import InputError
    from spotcheck.fitting.caustic import Caustic, fit_caustic
    from spotcheck.fitting.fit_results import SpotFits
    from spotcheck.fitting.spot_bounds import SpotBounds, spot_bounds
    from spotcheck.fitting.spotfit import fit_spots
    from spotcheck.model.design import simulate_dataset
    from spotcheck.quicklook.first_look import Look, look
    from spotcheck.sensor import SensorModel
    from spotcheck.sensor.pixel_maps import PixelMaps

    __version__: str
else:
    # Public name → where it lives.
    _HOME = {
        "Caustic": "fitting.caustic.Caustic",
        "Characterisation": "characterization.characterise.Characterisation",
        "Dataset": "dataset.folder.Dataset",
        "InputError": "errors.InputError",
        "Look": "quicklook.first_look.Look",
        "PixelMaps": "sensor.pixel_maps.PixelMaps",
        "SensorModel": "sensor.model.SensorModel",
        "SpotBounds": "fitting.spot_bounds.SpotBounds",
        "SpotFits": "fitting.fit_results.SpotFits",
        "characterise_dataset": "characterization.characterise.characterise_dataset",
        "characterise_sensor": "characterization.characterise.characterise_sensor",
        "fit_caustic": "fitting.caustic.fit_caustic",
        "fit_spots": "fitting.spotfit.fit_spots",
        "judge_dataset": "cli.pipeline.judge_dataset",
        "look": "quicklook.first_look.look",
        "read_dataset": "dataset.folder.load",
        "read_image": "dataset.frames.read_image",
        "simulate_dataset": "model.design.simulate_dataset",
        "spot_bounds": "fitting.spot_bounds.spot_bounds",
    }

    def __getattr__(name):
        """A public name, imported when it is first asked for (PEP 562)."""
        from importlib import import_module, metadata

        if name == "__version__":
            value = metadata.version("laser-spotcheck")
        elif name in _HOME:
            module, attribute = _HOME[name].rsplit(".", 1)
            value = getattr(import_module(f"{__name__}.{module}"), attribute)
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value
        return value

    def __dir__():
        return sorted({*globals(), *__all__})
