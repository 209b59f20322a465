"""What a model would bring in place of what was seen, free of noise (Asimov's data set: Cowan et al. 2011,
doi:10.1140/epjc/s10052-011-1554-0): −2 ln L of any other model's best fit to it is what noise scatters about.
"""

from spotcheck.discrepancy.cells import pooled
from spotcheck.discrepancy.explain import expected_of, latent_of
from spotcheck.discrepancy.look import Look, course_of
from spotcheck.discrepancy.noise import COMPONENTS, grained
from spotcheck.discrepancy.refit import Model, Problem

# Signal-to-noise from which on two effects can be told apart.
APART = 5.0


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
