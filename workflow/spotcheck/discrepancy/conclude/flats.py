"""The whole way of flats and darks without spots: from levels of light to all that is concluded."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

from spotcheck.discrepancy import criteria
from spotcheck.discrepancy.conclude.detect import Detection
from spotcheck.discrepancy.conclude.judge import NOTHING, untested
from spotcheck.discrepancy.conclude.judgement import Gap, Judgement, Levels, Limit, Where
from spotcheck.discrepancy.conclude.limits import ONE_SIDED
from spotcheck.discrepancy.conclude.unexplained import Unexplained
from spotcheck.discrepancy.evidence.parts import SMALLEST, Part, cauchy, sidak
from spotcheck.discrepancy.observe.flats import Series, hidden, series_of
from spotcheck.discrepancy.search.flats import (
    LevelFit,
    Standard,
    deviance_of,
    errors_of,
    fit_levels,
    in_place,
    matters,
    scatter_of,
    search_levels,
    smooth_of,
    standard_of,
    strength_at,
    taken_by,
)
from spotcheck.discrepancy.search.forward import Found
from spotcheck.estimate.photon_transfer import Transfer
from spotcheck.model.effect import Effect

TOO_FEW = "fewer than six levels of different light below saturation, in pairs of frames"
BLOCKS = ("mean", "variance")
# A smooth direction of which a fit leaves less than this part [1] tells nothing.
LEAST = 0.1
# So many of the oddest levels are told.
ODDEST = 3


def judge_flats(transfer: Transfer, full_scale_dn: float, effects: Sequence[Effect]) -> Judgement:
    """Everything that is concluded of levels; those that are kept unseen are opened last."""
    series, line = series_of(transfer, full_scale_dn), transfer.quantities["gain"]
    if series is None:
        return untested(f"the manifest names no frame of kind spot; {line.why or TOO_FEW}")
    usable = [e for e in effects if not hidden(e, series)]
    plain, after, found = search_levels(series, usable)
    seen, errors, peak = ~series.unseen, errors_of(series, after), float(series.values[0].max())
    wide = scatter_of(series, after)
    own = standard_of(series, after.slopes[0], wide)
    gap, gains = compared(series, plain, after, own)
    lamp = (wide.mean * series.errors[0, seen] / peak) ** 2
    off, left = (float(np.mean((fit.rest[0, seen] / peak) ** 2 - lamp)) for fit in (plain, after))
    error = float(np.sqrt(2 * (lamp**2).sum()) / len(lamp))
    sensor = after.model.sensor
    return Judgement(
        why_not="",
        detection=detected(series, plain, own),
        found=tuple(sorted(found, key=lambda one: -gap.by_effect[one.own.effect.name])),
        beyond=tuple(name for name, gain in gains.items() if min(gain, gap.by_effect[name]) <= 0),
        light=None,
        sheet=(),
        unexplained=Unexplained(max(left, 0.0) ** 0.5, error, float(lamp.mean() ** 0.5), left / error, np.zeros(0),
                                np.zeros(0), 0.0, (0, 0, 0, 0.0)),
        gap=gap,
        shift=NOTHING,
        limits=tuple(limits(series, after, found, usable)),
        where=oddest(series, plain, own),
        errors={p.effect.name: strengths(after, errors, k) for k, p in enumerate(after.model.present)},
        off=max(off, 0.0) ** 0.5,
        rest=detected(series, after, own),
        not_assessed=tuple((e.name, hidden(e, series)) for e in effects if e not in usable),
        levels=Levels(len(series.light), sensor.gain_dn_per_e, float(errors[1]), line.value, line.stderr,
                      float(np.sqrt(wide.mean**2 - 1) * np.median(series.errors[0] / series.values[0]))),
        black_level_dn=sensor.black_level_dn,
    )  # fmt: skip


def detected(series: Series, fit: LevelFit, own: Standard) -> Detection:
    """Whether what a fit leaves is smooth in light, of means and of variances; scatter from level to level is a lamp's.

    Each is a sum of squares over smooth directions that the fit does not have. Its errors are at best as well known as
    scatter beyond these tells, so it follows Fisher's F law.
    """
    seen = ~series.unseen
    z, taken, smooth = own(fit.rest)[:, seen].ravel(), taken_by(series, fit, own), smooth_of(int(seen.sum()))
    parts = []
    for k, block in enumerate(BLOCKS):
        basis = np.zeros((2, *smooth.shape))
        basis[k] = smooth
        basis = basis.reshape(len(z), -1)
        directions, sizes, _ = np.linalg.svd(basis - taken @ (taken.T @ basis), full_matrices=False)
        count = int((sizes > LEAST).sum())
        q = float(((directions[:, :count].T @ z) ** 2).sum())
        if count:
            p = float(max(stats.f.sf(q / count, count, len(smooth) - smooth.shape[1]), SMALLEST))
            parts.append(
                Part(f"{block}: smooth in light", (q - count) / (2 * count) ** 0.5, p, _where(series, fit, own, k))
            )
    parts.sort(key=lambda part: part.p_value)
    values = [part.p_value for part in parts]
    return Detection(sidak(values[0], len(values)), cauchy(values), tuple(parts))


def oddest(series: Series, fit: LevelFit, own: Standard) -> tuple[Where, ...]:
    """The levels that a fit misses most."""
    z = own(fit.rest)
    order = np.argsort(-np.abs(z), axis=None)[:ODDEST]
    return tuple(Where(_words(series, *divmod(int(k), z.shape[1])), float(z.ravel()[k])) for k in order)


def _where(series: Series, fit: LevelFit, own: Standard, block: int) -> str:
    return _words(series, block, int(np.argmax(np.abs(own(fit.rest)[block]))))


def _words(series: Series, block: int, level: int) -> str:
    return f"the {BLOCKS[block]} of the level at {series.values[0, level]:.4g} DN"


def compared(series: Series, plain: LevelFit, after: LevelFit, own: Standard) -> tuple[Gap, dict[str, float]]:
    """The gap on levels that had no part in the search, and by how much each effect lowers −2 ln L of these."""
    out = series.unseen

    def square(fit: LevelFit) -> float:
        return float((own(fit.rest)[:, out] ** 2).mean())

    def rms_dn(fit: LevelFit) -> float:
        return float(np.sqrt((fit.rest[0, out] ** 2).mean()))

    before, end = square(plain), square(after)
    excess = max(before - 1, 1e-12)
    fewer = {p.effect.name: fit_levels(series, after.model.without(k).present, after)
             for k, p in enumerate(after.model.present)}  # fmt: skip
    gap = Gap(
        before=before**0.5,
        after=end**0.5,
        noise_floor=1.0,
        rms_dn_before=rms_dn(plain),
        rms_dn_after=rms_dn(after),
        closed=(before - end) / excess,
        by_light=0.0,
        by_effect={name: (square(fit) - end) / excess for name, fit in fewer.items()},
        gain=deviance_of(series, plain, out) - deviance_of(series, after, out),
        on="unseen levels",
    )
    last = deviance_of(series, after, out)
    return gap, {name: deviance_of(series, fit, out) - last for name, fit in fewer.items()}


def strengths(fit: LevelFit, errors: np.ndarray, k: int) -> tuple[float, ...]:
    """Standard errors of all parameters of an effect of a number; NaN where one is not fitted."""
    own = {free.parameter: float(error) for free, error in zip(fit.free, errors[1:], strict=True) if free.effect == k}
    return tuple(own.get(p, np.nan) for p in range(len(fit.model.present[k].values)))


def limits(series: Series, after: LevelFit, found: Sequence[Found], effects: Sequence[Effect]) -> list[Limit]:
    """How large every effect that was not found may be beside those that were, and why it was not found."""
    rivals = {name: one.own.effect.name for one in found for name in one.rivals}
    named = {one.own.effect.name for one in found}
    out = []
    for effect in (e for e in effects if e.name not in named):
        own, value, why = effect.parameters[0], None, "not found"
        if effect.name in rivals:
            why = f"does as well in the place of {rivals[effect.name]}"
        elif np.isfinite(effect.neutral):
            fit = in_place(series, after, effect)
            error = errors_of(series, fit)[strength_at(fit, len(fit.model.present) - 1)]
            value = float(effect.neutral + abs(fit.model.present[-1].values[0] - effect.neutral) + ONE_SIDED * error)
            if after.deviance - fit.deviance >= criteria.GAIN.value:
                why = "levels do not agree about it" if matters(series, fit) else "too small to matter"
        out.append(Limit(effect.name, own.name, value, own.unit, why))
    return out
