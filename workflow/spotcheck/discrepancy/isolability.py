"""Which effects a design can tell apart, before any data are read: every rival refitted to what an effect would bring.

The data are the expectation of the model with the effect, without noise; by how much −2 ln L of a rival then lies above
the truth's is SNR²(1 − ρ²), with ρ the correlation of the two signatures after everything else was refitted.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.asimov import asimov
from spotcheck.discrepancy.explain import Account, account
from spotcheck.discrepancy.look import Look
from spotcheck.discrepancy.name import is_striped, present_of, singles
from spotcheck.discrepancy.refit import plain
from spotcheck.model.effect import Effect, Present

# Steps towards a strength.
STEPS = 14


class Isolation(NamedTuple):
    """Signal-to-noise of an effect after the base was refitted; its nearest rival ("": none) and the signal-to-noise of
    what tells them apart."""

    effect: str
    snr: float
    rival: str
    apart: float


def isolation(look: Look, own: Account, effects: Sequence[Effect]) -> dict[str, float]:
    """−2 ln L of every rival's best fit over that of an account, if the account is the truth."""
    ideal = asimov(look, own.refit.model, own.component, own.grain)
    truth = account(ideal, present_of(own), own.refit.model)
    found = singles(ideal, [effect for effect in effects if effect.name not in own.names])
    found = {name: _as_deep(ideal, rival) if is_striped(rival) else rival for name, rival in found.items()}
    empty = account(ideal, ())
    return {"": empty.score - truth.score} | {name: rival.score - truth.score for name, rival in found.items()}


def _as_deep(ideal: Look, stripes: Account) -> Account:
    """Stripes with the depth of the waves that the means gave each site: blocks take stripes as long as they are wide
    for a brightness, and only the spectrum speaks against that."""
    wave, own = stripes.refit.model.wave, present_of(stripes)[0]
    depth = float(np.sqrt((wave**2).sum(axis=1).mean())) if wave.size else own.values[0]
    return account(ideal, [own._replace(values=(depth, *own.values[1:]))], stripes.refit.model)


def isolability(look: Look, effect: Effect, effects: Sequence[Effect], snr: float = 100.0) -> Isolation:
    """One effect at the strength that has a signal-to-noise, or the largest within its bounds."""
    own = _at_strength(look, effect, snr)
    distances = isolation(look, own, effects)
    seen = float(np.sqrt(max(distances.pop(""), 0.0)))
    # What contains the effect as a special case explains it as well, and still is not its name.
    for other in effects:
        if other.has_as_special_case(effect):
            distances.pop(other.name, None)
    if not distances:
        return Isolation(effect.name, seen, "", seen)
    rival = min(distances, key=lambda name: distances[name])
    return Isolation(effect.name, seen, rival, float(np.sqrt(max(distances[rival], 0.0))))


def _at_strength(look: Look, effect: Effect, snr: float) -> Account:
    """An account of what the effect would be at a strength, by bisection: −2 ln L of a scatter follows no power."""
    context = look.problem.context
    base = plain(look.cells)
    values = list(effect.starts(context)[0]) if effect.starts(context) else [0.02, context.sigma_px, 30.0, 0.0]
    name = effect.component
    neutral = effect.neutral if np.isfinite(effect.neutral) else 0.0
    strength = 1e-4 if name else values[0] - neutral
    low, high = effect.bounds(context)[0]

    def at(strength: float) -> tuple[Account, float]:
        if name:
            present: tuple[Present, ...] = ()
            component = {name: strength}
        else:
            own = float(np.clip(neutral + strength, low, high))
            form = "spot" if effect.spectral else effect.forms[0]
            present, component = (Present(effect, form, (own, *values[1:])),), {}
        ideal = asimov(look, base._replace(present=present), component, values[-1] if name == "grain" else 1.0)
        truth = present or (Present(effect, "", tuple(0.0 for _ in effect.parameters)),)
        fitted = account(ideal, truth, base)
        return fitted, float(np.sqrt(max(account(ideal, ()).score - fitted.score, 1e-12)))

    found, reached = at(strength)
    weak, large = (strength, np.inf) if reached < snr else (0.0, strength)
    for _ in range(STEPS):
        if abs(reached / snr - 1) < 0.1:
            break
        step = float(np.clip(snr / reached, 0.05, 20.0)) ** (2 if name else 1)
        inside = np.sqrt(weak * large) if weak > 0 and np.isfinite(large) else strength * step
        strength = float(inside)
        found, reached = at(strength)
        weak, large = (strength, large) if reached < snr else (weak, strength)
    return found
