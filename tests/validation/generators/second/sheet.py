"""The data sheet of a case."""

from __future__ import annotations

from tests.validation.generators.second.case import BITS, CROP, LASER, OPTICS, PIXEL_PITCH, Case


def instrument(case: Case, name: str) -> dict[str, object]:
    """What the experimenter states: the true camera and the base model, no effect."""
    sensor = {
        "pixel_pitch_m": PIXEL_PITCH,
        "bit_depth": BITS,
        "gain_dn_per_e": case.gain,
        "read_noise_e": case.read_noise,
        "dark_current_e_per_s": case.dark_current,
        "quantum_efficiency": 0.38,
        "black_level_dn": case.black,
        "value_shift_bits": 0,
        "full_well_e": case.full_well,
    }
    return {
        "name": name,
        "order_known": True,
        "crop_px": CROP,
        "sensor": sensor,
        "optics": OPTICS,
        "laser": LASER,
        "material": {"reflectance": 0.02},
        "model": {"photon_budget": case.budget, "top_hat": False},
    }
