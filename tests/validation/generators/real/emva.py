"""The package `emva1288`, the standard's reference implementation, on a dataset folder."""

import logging

import numpy as np
import pytest

from tests.validation.protocol import manifest_of


def reference(folder, spatial_photons):
    """Results of the package on the frames of a folder; non-uniformity at the light nearest to one given."""
    with pytest.MonkeyPatch.context() as patch:
        # It calls a function that numpy 2 has dropped.
        patch.setattr(np, "asfarray", lambda values, dtype=float: np.asarray(values, dtype), raising=False)
        from emva1288.process.data import Data1288
        from emva1288.process.loader import LoadImageData
        from emva1288.process.results import Results1288

        frames: dict = {}
        for row in manifest_of(folder):
            photons = float(row["photons_per_px"] or 0) if row["kind"] == "flat" else 0.0
            frames.setdefault(float(row["exposure_s"]) * 1e9, {}).setdefault(photons, []).append(row["file"])
        half = min(frames, key=lambda t: abs(max(frames[t]) - spatial_photons))
        images = {"temporal": frames, "spatial": {half: frames[half]}}
        data = Data1288(LoadImageData(images, path=str(folder), loglevel=logging.WARNING).data).data
        own = Results1288(data, loglevel=logging.WARNING)
        names = ("K", "R", "QE", "sigma_y_dark", "sigma_d", "u_e_min", "u_p_sat", "u_e_sat", "SNR_max", "DR", "LE_min",
                 "LE_max", "u_I_mean", "u_I_var", "PRNU1288", "DSNU1288")  # fmt: skip
        return {name: float(getattr(own, name)) for name in names}
