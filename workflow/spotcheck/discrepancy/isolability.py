"""Which effects a design can tell apart, before any data are read: every rival refitted to what an effect would bring.

The data are the expectation of the model with the effect, without noise (Asimov's data set: Cowan et al. 2011,
doi:10.1140/epjc/s10052-011-1554-0); by how much −2 ln L of a rival then lies above the truth's is SNR²(1 − ρ²), with ρ
the correlation of the two signatures after everything else was refitted.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.cells import pooled
from spotcheck.discrepancy.explain import COMPONENT, Account, account, expected_of, latent_of
from spotcheck.discrepancy.look import Look, course_of
from spotcheck.discrepancy.name import CONTAINS, present_of, singles
from spotcheck.discrepancy.noise import COMPONENTS, grained
from spotcheck.discrepancy.refit import Model, Problem, plain
from spotcheck.model.effect import Effect, Present

# Signal-to-noise from which on two effects can be told apart.
APART = 5.0
# Steps towards a strength.
STEPS = 14


class Isolation(NamedTuple):
    """Signal-to-noise of an effect after the base was refitted; its nearest rival and the signal-to-noise of what tells
    them apart."""

    effect: str
    snr: float
    rival: str
    apart: float


def asimov(look: Look, model: Model, component: dict[str, float], grain: float) -> Look:
    """A look at what a model would bring, in place of what was seen; noise has its size and no value."""
    problem = look.problem
    at = problem.evaluate(model)
    cells = look.cells._replace(residual=pooled(at.mean) - problem.mean_start)
    value = grained(look.observables, grain, look.measured.side) @ [component.get(name, 0.0) for name in COMPONENTS]
    course = course_of(look, model.present)[:, None]
    quiet = look._replace(brightness=look.brightness._replace(value=0 * look.brightness.value + course))
    value = value + expected_of(quiet, at, model.present)
    seen = [o._replace(value=float(v)) for o, v in zip(look.observables, value, strict=True)]
    scatter = problem.variance(at, latent_of(look, component, grain, ()))
    again = Problem(cells, look.setting, problem.start, problem.used, scatter)
    return quiet._replace(cells=cells, problem=again, observables=seen)


def isolation(look: Look, own: Account, effects: Sequence[Effect]) -> dict[str, float]:
    """−2 ln L of every rival's best fit over that of an account, if the account is the truth."""
    ideal = asimov(look, own.refit.model, own.component, own.grain)
    truth = account(ideal, present_of(own), own.refit.model)
    found = singles(ideal, [effect for effect in effects if effect.name not in own.names])
    empty = account(ideal, ())
    return {"": empty.score - truth.score} | {name: rival.score - truth.score for name, rival in found.items()}


def isolability(look: Look, effect: Effect, effects: Sequence[Effect], snr: float = 100.0) -> Isolation:
    """One effect at the strength that has a signal-to-noise, or the largest within its bounds."""
    own = _at_strength(look, effect, snr)
    distances = isolation(look, own, effects)
    seen = float(np.sqrt(max(distances.pop(""), 0.0)))
    # What contains the effect as a special case explains it as well, and still is not its name.
    for name in CONTAINS.get(effect.name, ()):
        distances.pop(name, None)
    rival = min(distances, key=lambda name: distances[name])
    return Isolation(effect.name, seen, rival, float(np.sqrt(max(distances[rival], 0.0))))


def _at_strength(look: Look, effect: Effect, snr: float) -> Account:
    """An account of what the effect would be at a strength, by bisection: −2 ln L of a scatter follows no power."""
    context = look.problem.context
    base = plain(look.cells)
    values = list(effect.starts(context)[0]) if effect.starts(context) else [0.02, context.sigma_px, 30.0, 0.0]
    name = COMPONENT.get(effect.name)
    neutral = effect.neutral if np.isfinite(effect.neutral) else 0.0
    strength = 1e-4 if name else values[0] - neutral
    low, high = effect.bounds(context)[0]

    def at(strength: float) -> tuple[Account, float]:
        if name:
            present: tuple[Present, ...] = ()
            component = {name: strength}
        else:
            own = float(np.clip(neutral + strength, low, high))
            form = "spot" if effect.name == "interference_fringes" else effect.forms[0]
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
