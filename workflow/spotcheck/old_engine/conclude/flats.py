"""The whole way of flats and darks without spots: from levels of light to all that is concluded."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

from spotcheck.estimate.photon_transfer import Transfer
from spotcheck.old_engine import criteria
from spotcheck.old_engine.conclude.detect import Detection
from spotcheck.old_engine.conclude.judgement import NOTHING, TOO_SMALL, Gap, Judgement, Levels, Limit, untested
from spotcheck.old_engine.conclude.limits import ALREADY, NOT_FOUND, UNTOLD
from spotcheck.old_engine.conclude.places import Where
from spotcheck.old_engine.conclude.reach import ONE_SIDED, THERE, TWO_SIDED
from spotcheck.old_engine.conclude.unexplained import Unexplained
from spotcheck.old_engine.evidence.parts import SMALLEST, Part, smallest_of
from spotcheck.old_engine.model.effect import Effect
from spotcheck.old_engine.observe.flats import FEWEST, Series, hidden, series_of
from spotcheck.old_engine.search import flats as search
from spotcheck.old_engine.search.flats import LevelFit, Standard
from spotcheck.old_engine.search.forward import Found

TOO_FEW = f"fewer than {FEWEST} levels of different light below saturation, in pairs of frames"
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
    plain, after, found = search.search_levels(series, usable)
    errors, wide, peak = search.errors_of(series, after), search.scatter_of(series, after), series.values[0].max()
    own = search.standard_of(series, after.slopes[0], wide)
    gap, gains = compared(series, plain, after, own)
    lamp = (wide.mean * series.errors[0] / peak)[~series.unseen] ** 2
    off, left = (float(np.mean((fit.rest[0] / peak)[~series.unseen] ** 2 - lamp)) for fit in (plain, after))
    error = float(np.sqrt(2 * (lamp**2).sum()) / len(lamp))
    sensor = after.model.sensor
    scatter = float(np.sqrt(wide.mean**2 - 1) * np.median(series.errors[0] / series.values[0]))
    return Judgement(
        why_not="",
        detection=detected(series, plain, own),
        found=tuple(sorted(found, key=lambda one: -gap.by_effect[one.own.effect.name])),
        beyond=tuple(name for name, gain in gains.items() if min(gain, gap.by_effect[name]) <= 0),
        light=None,
        sheet=(),
        unexplained=Unexplained(max(left, 0.0) ** 0.5, error, float(lamp.mean() ** 0.5), left / error, 0.0),
        gap=gap,
        shift=NOTHING,
        limits=tuple(limits(series, after, found, usable)),
        where=oddest(series, own(plain.rest)),
        errors={one.own.effect.name: strengths(after, errors, k) for k, one in enumerate(found)},
        off=max(off, 0.0) ** 0.5,
        rest=detected(series, after, own),
        not_assessed=tuple((e.name, hidden(e, series)) for e in effects if e not in usable),
        levels=Levels(
            len(series.light), series.frames, sensor.gain_dn_per_e, float(errors[1]), line.value, line.stderr, scatter
        ),
        black_level_dn=sensor.black_level_dn,
    )


def detected(series: Series, fit: LevelFit, own: Standard) -> Detection:
    """Whether what a fit leaves is smooth in light, of means and of variances; scatter from level to level is a lamp's.

    Each is a sum of squares over smooth directions that the fit does not have. Its errors are at best as well known as
    scatter beyond these tells, so it follows Fisher's F law.
    """
    seen = ~series.unseen
    z, taken, smooth = own(fit.rest), search.taken_by(series, fit, own), search.smooth_of(int(seen.sum()))
    parts = []
    for k, block in enumerate(BLOCKS):
        basis = np.kron(np.arange(len(BLOCKS))[:, None] == k, smooth)
        directions, sizes, _ = np.linalg.svd(basis - taken @ (taken.T @ basis), full_matrices=False)
        count = int((sizes > LEAST).sum())
        q = float(((directions[:, :count].T @ z[:, seen].ravel()) ** 2).sum())
        p = float(stats.f.sf(q / count, count, len(smooth) - smooth.shape[1])) if count else 1.0
        at = oddest(series, np.where(np.arange(len(z))[:, None] == k, z, 0.0))[0].words
        size = (q - count) / max(2 * count, 1) ** 0.5
        parts.append(Part(f"{block}: smooth in light", size, max(p, SMALLEST), at, size))
    parts.sort(key=lambda part: part.p_value)
    return Detection(smallest_of(parts[0].p_value, len(parts)), tuple(parts))


def oddest(series: Series, z: np.ndarray) -> tuple[Where, ...]:
    """The levels that are missed most."""
    places = [divmod(int(k), z.shape[1]) for k in np.argsort(-np.abs(z), axis=None)[:ODDEST]]
    return tuple(
        Where(f"the {BLOCKS[k]} of the level at {series.values[0, at]:.4g} DN", float(z[k, at])) for k, at in places
    )


def compared(series: Series, plain: LevelFit, after: LevelFit, own: Standard) -> tuple[Gap, dict[str, float]]:
    """The gap on levels that had no part in the search, and by how much each effect lowers −2 ln L of these."""
    fewer = [search.fit_levels(series, after.model.without(k).present, after) for k in range(len(after.model.present))]
    every, out = [plain, after, *fewer], series.unseen
    square = [float((own(fit.rest)[:, out] ** 2).mean()) for fit in every]
    rms_dn = [float(np.sqrt((fit.rest[0, out] ** 2).mean())) for fit in every]
    # No single level decides: at the edge of a clip light's unevenness counts.
    deviance = [search.deviance_of(series, fit, out, most=criteria.GAIN.value) for fit in every]
    excess, names = max(square[0] - 1, 1e-12), search.names_of(after)
    gap = Gap(square[0] ** 0.5, square[1] ** 0.5, 1.0, rms_dn[0], rms_dn[1], (square[0] - square[1]) / excess, 0.0,
              {name: (square[2 + k] - square[1]) / excess for k, name in enumerate(names)}, deviance[0] - deviance[1],
              "unseen levels")  # fmt: skip
    return gap, {name: deviance[2 + k] - deviance[1] for k, name in enumerate(names)}


def strengths(fit: LevelFit, errors: np.ndarray, k: int) -> tuple[float, ...]:
    """Standard errors of all parameters of an effect of a number; NaN where one is not fitted."""
    own = {free.parameter: float(error) for free, error in zip(fit.free, errors[1:], strict=True) if free.effect == k}
    return tuple(own.get(p, np.nan) for p in range(len(fit.model.present[k].values)))


def limits(series: Series, after: LevelFit, found: Sequence[Found], effects: Sequence[Effect]) -> list[Limit]:
    """How large every effect that was not found may be beside those that were, and why it was not found."""
    rivals, out = {name: one.own.effect.name for one in found for name in one.rivals}, []
    for effect in (e for e in effects if e.name not in search.names_of(after)):
        own, low, high, why = effect.parameters[0], np.nan, np.nan, NOT_FOUND
        times, more = np.nan, ""
        signs = effect.signs(series.context)
        if effect.name in rivals:
            why = f"does as well in the place of {rivals[effect.name]}"
        elif np.isfinite(effect.neutral):
            fit = search.in_place(series, after, effect)
            error = search.errors_of(series, fit)[search.strength_at(fit, len(fit.model.present) - 1)]
            value = fit.model.present[-1].values[0]
            low = value - TWO_SIDED * error if len(signs) > 1 else np.nan
            high = max(value, effect.neutral) + (TWO_SIDED if len(signs) > 1 else ONE_SIDED) * error
            # Errors fall with all frames; what is there is not made smaller by them.
            there = abs(value - effect.neutral) > THERE * error
            times, more = (np.nan, ALREADY) if there else (4.0, "")
            if after.deviance - fit.deviance >= criteria.GAIN.value:
                why = "levels do not agree about it" if search.matters(series, fit) else TOO_SMALL
        else:
            why = UNTOLD
        out.append(Limit(effect.name, own.name, own.unit, why, float(low), float(high), times, more))
    return out
