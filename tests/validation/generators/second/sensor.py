"""From light to the numbers in the file, in the contract's order."""

from __future__ import annotations

import numpy as np

from tests.validation.generators.second.case import FULL_SCALE, Case
from tests.validation.generators.second.optics import add_pedestals, light, true_exposure


def saturate(electrons: np.ndarray, level: float, order: float | None) -> np.ndarray:
    """Stop the signal at `level` electrons: hard without an order, else a soft knee of that order."""
    if order is None:
        return np.minimum(electrons, level)
    return electrons / (1 + (np.maximum(electrons, 0.0) / level) ** order) ** (1 / order)


def add_offsets(case: Case, i: int, signal: np.ndarray) -> np.ndarray:
    """The signal [DN] of frame i behind the black level: pedestals, rows, hot pixels, mechanisms."""
    signal = add_pedestals(case, signal + case.black, "electronics")
    if effect := case.get("row_noise"):
        signal = signal + effect["rms"] * effect.state["z"][i][:, None]
    if effect := case.get("fixed_pattern"):
        hot = int(effect["hot_pixels"])
        signal[effect.state["y"][:hot], effect.state["x"][:hot]] += effect.state["height"][:hot]
    return case.apply("digital", signal, i)


def read_out(case: Case, i: int, rng: np.random.Generator) -> np.ndarray:
    """Frame i in DN."""
    electrons = light(case, i) / case.gain + case.dark_current * true_exposure(case, case.frames[i])
    electrons = case.apply("electrons", rng.poisson(electrons).astype(float), i, rng)
    if effect := case.get("smear"):
        electrons = electrons + effect["fraction"] * electrons.mean(axis=0, keepdims=True)
    well = case.get("saturation")
    if well and well.form["knee"] != "hard_after_read_noise":
        electrons = saturate(electrons, well["level"] / case.gain, well.form.get("order"))
    electrons = np.minimum(electrons, case.full_well)
    excess = case.get("excess_read_noise")
    electrons += (excess["total"] if excess else case.read_noise) * rng.standard_normal(electrons.shape)
    if well and well.form["knee"] == "hard_after_read_noise":
        electrons = saturate(electrons, well["level"] / case.gain, None)
    signal = case.gain * electrons
    if effect := case.get("nonlinearity"):
        signal = signal - effect["q"] * signal**2 / FULL_SCALE
    signal = add_offsets(case, i, signal)
    if effect := case.get("black_clipping"):
        kept = signal - effect["threshold"] if effect.form["law"] == "subtraction" else signal
        signal = np.where(signal > effect["threshold"], kept, 0.0)
    codes = case.apply("codes", np.clip(np.rint(signal), 0, FULL_SCALE), i)
    return np.clip(codes, 0, FULL_SCALE)


def expose(case: Case, i: int) -> np.ndarray:
    """Frame i as recorded, in DN, with the noise that belongs to the case's seed."""
    return read_out(case, i, np.random.default_rng([case.seed, 2, i]))
