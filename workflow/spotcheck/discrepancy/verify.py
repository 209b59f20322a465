"""Whether the gap shrank on data that no earlier step has seen."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.discrepancy.base import base_of, spots_of
from spotcheck.discrepancy.cells import cells_of
from spotcheck.discrepancy.explain import Account
from spotcheck.discrepancy.look import Look, held_blocks, look_again, look_at
from spotcheck.discrepancy.measure import Measured
from spotcheck.discrepancy.refit import Model, Problem, Refit, refit
from spotcheck.discrepancy.shots import Design, Shot


class Gap(NamedTuple):
    """Mean squared standardised residual of the condition means before and after, what it would be under the extended
    model, the part of the gap that closed (NaN: there was none), rms of the residual [DN] free of noise, and on what.
    `parts` are the closed parts after each effect was added, in order."""

    before: float
    after: float
    noise_floor: float
    closed: float
    rms_dn_before: float
    rms_dn_after: float
    on: str
    parts: tuple[float, ...]
    maps: dict[str, np.ndarray]


def verify(
    look: Look,
    first: Account,
    stages: Sequence[Account],
    unseen: Sequence[Shot],
    unseen_design: Design | None,
    exact: Account | None = None,
) -> Gap:
    """Predict unseen data with the base model (`first`) and with the models of `stages`, each with one effect more;
    `exact` is the last of these as a closer look fitted it, for unseen repeats to be looked at as closely.

    Laws and effects keep the values that the other data gave them.
    """
    accounts = [first, *stages]
    if unseen and unseen_design is not None:
        seen = _look_of(unseen, unseen_design, look)
        problem = seen.problem
        tests = [(problem, [_frozen(problem, own, own.refit.model) for own in accounts])]
        if exact is not None:
            tests[0][1][-1] = _closely(unseen, seen, exact)
        on = "unseen repeats"
    elif len(np.unique(look.measured.design.repeat)) > 1:
        tests, on = [], "left-out repeats"
        for repeat in np.unique(look.measured.design.repeat):
            out = look.measured.design.repeat == repeat
            rest = Problem(cells_of(part_of(look.measured, ~out), look.setting), look.setting)
            test = Problem(cells_of(part_of(look.measured, out), look.setting), look.setting)
            fits = [refit(rest, own.refit_effects, own.refit.model, own.latent) for own in accounts]
            tests.append((test, [_frozen(test, own, fit.model) for own, fit in zip(accounts, fits, strict=True)]))
    else:
        held = held_blocks(look.measured.design, look.cells.residual.shape)
        problem = Problem(look.cells, look.setting, mask=held)
        tests, on = [(problem, [_at(problem, own, own.refit.model) for own in accounts])], "unseen blocks"
    used = [problem.used for problem, _ in tests]
    count = sum(int(u.sum()) for u in used)
    chi2 = np.array([sum(fits[k].chi2 for _, fits in tests) for k in range(len(accounts))]) / count
    centres = 0 if on == "unseen blocks" else sum(2 * (int(p.cells.place.max()) + 1) for p, _ in tests)
    floor = 1 - centres / count
    gap = chi2[0] - floor
    closed = (chi2[0] - chi2) / gap if gap > 0 else np.full(len(chi2), np.nan)
    rms = [rms_of([(p, fits[k]) for p, fits in tests]) for k in (0, -1)]
    maps = {
        "before": np.where(tests[0][0].used, tests[0][1][0].residual, np.nan),
        "after": np.where(tests[0][0].used, tests[0][1][-1].residual, np.nan),
    }
    before, after = rms
    return Gap(float(chi2[0]), float(chi2[-1]), float(floor), float(closed[-1]), before, after, on,
               tuple(np.diff(closed).tolist()), maps)  # fmt: skip


def part_of(measured: Measured, frames: np.ndarray) -> Measured:
    """Block sums of some frames only; the fields are those of all."""
    sums = measured.sums._replace(**{name: getattr(measured.sums, name)[frames] for name in measured.sums._fields[:14]})
    base = measured.base._replace(
        **{name: getattr(measured.base, name)[frames] for name in ("amplitude", "sigma", "x0", "y0")}
    )
    design = measured.design.take(np.flatnonzero(frames))
    return measured._replace(design=design, base=base, sums=sums, left=measured.left[frames], top=measured.top[frames])


def _look_of(unseen: Sequence[Shot], design: Design, look: Look) -> Look:
    setting = look.setting
    spots = spots_of(unseen, setting.sensor, setting.baseline.top_hat)
    corners = np.array([(s.left, s.top) for s in unseen], float)
    base = base_of(spots, corners, design, setting.baseline, unseen[0].pixels().shape[0])
    assert base is not None  # the discovery frames of the same set had a base
    return look_at(unseen, design, base, setting)


def _frozen(problem: Problem, own: Account, model: Model) -> Refit:
    return refit(problem, own.refit_effects, model, own.latent, fixed=True)


def _closely(unseen: Sequence[Shot], seen: Look, exact: Account) -> Refit:
    """An account's prediction of every pixel, edges and all, which blocks alone would blur."""
    blurred = _frozen(seen.problem, exact, exact.refit.model)
    near = look_again(unseen, seen, blurred.model, exact.latent)
    sharp = _frozen(near.problem, exact, near.problem.start)
    # Where a model says that readings repeat one number a closer look does not hear them.
    heard = near.problem.used
    residual, variance = (
        np.where(heard, one, other)
        for one, other in ((sharp.residual, blurred.residual), (sharp.variance, blurred.variance))
    )
    chi2 = float(np.sum((residual**2 / variance)[seen.problem.used]))
    return blurred._replace(residual=residual, variance=variance, chi2=chi2)


def _at(problem: Problem, own: Account, model: Model) -> Refit:
    """Blocks of the very frames that were fitted: nothing is left to fit."""
    at = problem.evaluate(model)
    residual, variance = problem.residual(at), problem.variance(at, own.latent)
    chi2 = float(np.sum((residual**2 / variance)[problem.used]))
    return Refit(model, 0.0, chi2, np.zeros((0, 0)), residual, variance, at, 0)


def rms_of(fits: Sequence[tuple[Problem, Refit]]) -> float:
    """Rms residual [DN], free of noise."""
    squares = np.concatenate([(fit.residual**2 - fit.variance)[p.used] for p, fit in fits])
    return float(np.sqrt(max(squares.mean(), 0.0)))


NUMBERS = {
    "before": ("1", "mean squared standardised residual of the base model"),
    "after": ("1", "mean squared standardised residual of the extended model"),
    "noise_floor": ("1", "the same where only noise is left"),
    "closed": ("1", "part of the gap that closed"),
    "rms_dn_before": ("DN", "rms residual of the base model, free of noise"),
    "rms_dn_after": ("DN", "rms residual of the extended model, free of noise"),
}


def dataset_of_gap(gap: Gap | None, title: str, name: str) -> xr.Dataset:
    """A gap as a file; without one a file without variables that says so."""
    ds = xr.Dataset(attrs={"title": title, "dataset": name, "on": gap.on if gap else "nothing was added to the model"})
    if gap is None:
        return ds
    for key, (units, long_name) in NUMBERS.items():
        ds[key] = ((), getattr(gap, key), {"units": units, "long_name": long_name})
    ds["part"] = ("effect", np.array(gap.parts), {"units": "1", "long_name": "part that each effect closed"})
    for key, values in gap.maps.items():
        ds[f"map_{key}"] = (
            ("condition", "block_row", "block_column"),
            values.astype("f4"),
            {"units": "DN", "long_name": f"residual {key} the effects were added"},
        )
    return ds


def gap_from(ds: xr.Dataset) -> Gap | None:
    """The gap of a file."""
    if "before" not in ds:
        return None
    numbers = {key: float(ds[key]) for key in NUMBERS}
    maps = {key: ds[f"map_{key}"].values for key in ("before", "after")}
    return Gap(on=str(ds.attrs["on"]), parts=tuple(ds["part"].values.tolist()), maps=maps, **numbers)
