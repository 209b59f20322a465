"""Which effects explain what was seen: every one alone, then together, and all that the data cannot tell from them."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.asimov import APART, asimov
from spotcheck.discrepancy.explain import Account, account, is_component, relief
from spotcheck.discrepancy.look import Look
from spotcheck.discrepancy.refit import basis, promised, screened
from spotcheck.discrepancy.stripes import peak
from spotcheck.model.effect import Effect, Place, Present

# Rivals whose −2 ln L (with 2 a free number) is within this of the best cannot be told from it: four standard
# deviations, for what is five apart may seem four.
TIED = 16.0
# Where rivals are expected to be less than `APART` behind, noise shows them so far behind once in 30,000. Nearer ones,
# that take all but this part of what the best explains, cannot be told from it.
FAR, MOSTLY = APART**2 + 8 * APART, 0.1
# A start that promises, to first order, this part of what the best fit gains is followed to its end: from a weak start
# a fit creeps where an effect grows by its square.
HOPEFUL = 0.5
# An effect stays in a model only if without it −2 ln L rises by more than this.
EARNS = 10.0
# A constant of a form must earn this beside the 2 of any free number: three standard errors in all.
CONSTANT = 7.0
# An effect that promises less than this part of the best, to first order, is not fitted; but for those whose first
# order says nothing.
HOPELESS = 0.004
# At the first look rivals are compared to this part of the gap they close: blocks blur what is strong.
SLACK = 0.004
LARGEST_CONTEST = 6
# One effect more must close this part of what is left, or it only mimics.
WORTH = 0.2
# How many explanations are followed to the next size, how many effects of the mean and how many of noise are tried
# beside each (and all that promise what only a fit can tell), and starts of each. The two promise by different
# measures, and scatter feeds on a wrong mean.
BEAM, BESIDE, BESIDE_SCATTER, STARTS = 4, 3, 3, 3
MOST = 3


# Fits an account about the expectation of another, and says whether it leaves nothing that matters.
Closer = Callable[[Account, Account], tuple[Account, bool]]
# The closer look about the expectation of an account.
NearTo = Callable[[Account], Look]


class Naming(NamedTuple):
    """Accounts of sets of effects: the best of each size tried, the explanations that hold (best first), and every
    single effect's account by name."""

    best: Account | None
    holding: list[Account]
    singles: dict[str, Account]


def singles(look: Look, effects: Sequence[Effect]) -> dict[str, Account]:
    """Every effect alone."""
    empty = account(look, ())
    span = basis(look.problem, empty.refit, (), empty.latent)
    out: dict[str, Account] = {}
    for effect in _promising(look, empty, effects, span):
        target = min((own.refit.score for own in out.values()), default=np.inf)
        found = _added(look, empty, effect, span, target)
        if found is not None:
            out[effect.name] = found
    return out


def _promising(look: Look, before: Account, effects: Sequence[Effect], span: np.ndarray) -> list[Effect]:
    """Effects by what they promise to first order, best first."""
    promise = {}
    for effect in effects:
        own = 0.0
        if not is_component(effect) and not effect.spectral:
            own = promised(look.problem, before.refit, span, effect)
        promise[effect.name] = own
    least = HOPELESS * max(promise.values(), default=0.0)
    chosen = [e for e in effects if promise[e.name] >= least or is_component(e) or e.always]
    return sorted(chosen, key=lambda effect: -promise[effect.name])


def _added(
    look: Look,
    before: Account,
    effect: Effect,
    span: np.ndarray | None = None,
    target: float = np.inf,
    forms: Sequence[str] = (),
) -> Account | None:
    """The best account of an effect added to another account, over its forms (or those given) and starts."""
    kept = present_of(before)
    if _told_already(before, effect):
        return None
    if is_component(effect):
        blank = Present(effect, "", tuple(0.0 for _ in effect.parameters))
        return account(look, (*kept, blank), before.refit.model)
    if effect.spectral:
        return _fringes(look, before, effect)
    if any(set(effect.replaces) & set(own.effect.replaces) for own in kept):
        return None
    problem = look.problem
    if span is None:
        span = basis(problem, before.refit, before.refit_effects, before.latent)
    best = None
    first: tuple[float, ...] | None = None
    for form in forms or effect.forms:
        promising = screened(problem, before.refit, span, effect, form)
        starts = promising[:STARTS] if first is None else [(0.0, first), promising[0]]
        for fall, values in starts:
            followed = fall > HOPEFUL * (before.refit.score - target)
            start = (*kept, Present(effect, form, values))
            found = account(look, start, before.refit.model, np.inf if followed else target)
            target = min(target, found.refit.score)
            if best is None or plainly(found) < plainly(best):
                best = found
        assert best is not None
        first = next(p.values for p in best.refit.model.present if p.effect.name == effect.name)
    return best


def _told_already(own: Account, effect: Effect) -> bool:
    """Whether an account has the variance component, or the white noise, that an effect is."""
    noisy = effect.place is Place.NOISE and any(other.place is Place.NOISE for other, _ in own.effects)
    return noisy or effect.component in own.component


def plainly(own: Account) -> float:
    """The score by which forms of the same effects are compared: what only shapes a form must earn its place clearly,
    or the strength takes the shape's freedom for its own."""
    return own.score + CONSTANT * sum(len(e.parameters) - len(e.idle.get(form, ())) for e, form in own.effects)


def scatters(effect: Effect) -> bool:
    """Whether an effect promises nothing to the means: a component of variance, or white noise."""
    return is_component(effect) or effect.place is Place.NOISE


def is_striped(own: Account) -> bool:
    """Whether an effect of an account is found as a peak of the spectrum."""
    return any(effect.spectral for effect, _ in own.effects)


def present_of(own: Account) -> tuple[Present, ...]:
    """The effects of an account with their values, in its order."""
    values = {p.effect.name: p for p in own.refit.model.present}
    blank = lambda effect: Present(effect, "", tuple(0.0 for _ in effect.parameters))  # noqa: E731
    return tuple(values.get(effect.name) or blank(effect) for effect, _ in own.effects)


def _fringes(look: Look, before: Account, effect: Effect) -> Account | None:
    """Fringes from the highest peak of the sites' common spectrum, refined on the condition means."""
    found = peak(look.measured)
    values = (found.depth, found.period, found.direction, 0.0)
    return account(look, (*present_of(before), Present(effect, "site", values)), before.refit.model)


def search(look: Look, effects: Sequence[Effect], closer: Closer, near_to: NearTo) -> Naming:
    """From single effects upwards until a set holds; then all sets that cannot be told from the best.

    Sets are ranked at the first look. Those in contest are then fitted again about the best one's own expectation of
    every pixel, where what is compared is the small difference between them.
    """
    empty = account(look, ())
    alone = singles(look, effects)
    ranked = sorted(alone.values(), key=lambda own: own.score)
    ranked = [own for own in ranked if own.score < empty.score]
    best = None
    for size in range(1, MOST + 1):
        if not ranked:
            break
        best = _contest(ranked, empty, closer)
        stripes = next((own for own in alone.values() if is_striped(own)), None)
        if not best[0][1] and size == 1 and stripes is not None:
            # Blocks see nothing of stripes as short as they are: only a closer look does.
            found = closer(stripes, stripes)
            best = [found] if found[1] else best
        if best[0][1]:
            break
        if size == MOST:
            break
        by_means = sorted(ranked, key=lambda own: own.refit.score)[:2]
        parents = list({own.names: own for own in (*ranked[: BEAM - 1], *by_means)}.values())
        grown = _grown(look, parents, effects)
        left = max(ranked[0].refit.chi2 - look.problem.used.sum(), 0.0)
        if not grown or grown[0].score > ranked[0].score - max(EARNS, WORTH * left):
            break
        ranked = grown
    if best is None:
        return Naming(None, [], alone)
    best = _thinned(look, best, closer)
    beside = _beside_scatter(look, best, effects, empty, closer)
    # Free gains alone hold wherever a law does: it was added for what it earns.
    best = _thinned(look, beside, closer, EARNS) if beside is not best else best
    holding = _simplest([own for own, good in best if good])
    if len(holding) == 1 and len(holding[0].names) == 1 and holding[0].names[0] in alone:
        holding += _inseparable(holding[0], alone, empty, closer, near_to)
    if holding and len(holding[0].effects) > 1:
        # Once the means are off, scatter does not mislead; but what a look takes off frame by frame is not seen there.
        whole, near = holding, look
        if _taken_off(holding[0]):
            whole = [account(look, present_of(own)) for own in holding]
        else:
            near = near_to(holding[0])
        ranked = sorted([*whole, *_rivals(near, holding[0], effects)], key=lambda own: own.score)
        holding = [own for own, good in _contest(ranked, empty, closer) if good] or holding
    return Naming(best[0][0], _simplest(holding), alone)


def _beside_scatter(
    look: Look, best: list[tuple[Account, bool]], effects: Sequence[Effect], empty: Account, closer: Closer
) -> list[tuple[Account, bool]]:
    """The contest with a law of the brightness added, where that earns its place: free gains hold without it, for they
    scatter as any law does."""
    leader, good = best[0]
    free = next((effect for effect, _ in leader.effects if effect.component == "gain"), None)
    if not good or free is None:
        return best
    laws = [effect for effect in effects if free.has_as_special_case(effect) and effect.name not in leader.names]
    kept = account(look, present_of(leader))
    grown = [own for own in (_added(look, kept, law) for law in laws) if own and own.score < kept.score - EARNS]
    if not grown:
        return best
    found = _contest(sorted(grown, key=lambda own: own.score), empty, closer)
    return found if found[0][1] else best


def _thinned(
    look: Look, best: list[tuple[Account, bool]], closer: Closer, worse: float = np.inf
) -> list[tuple[Account, bool]]:
    """The contest, or alone an account that holds with fewer effects than its best one and at a first look is no more
    than `worse` in −2 ln L."""
    while best[0][1] and (fewer := _fewer(look, best[0][0], closer, worse)) is not None:
        best = [(fewer, True)]
    return best


def _fewer(look: Look, best: Account, closer: Closer, worse: float) -> Account | None:
    """An account of one effect less that holds by itself: a set may have been reached by way of one that mimicked."""
    whole = account(look, present_of(best)) if np.isfinite(worse) else best
    for leave in best.names if len(best.names) > 1 else ():
        kept = [p for p in present_of(best) if p.effect.name != leave]
        reduced = account(look, kept, best.refit.model)
        if reduced.score > whole.score + worse:
            continue
        own, good = closer(reduced, reduced)
        if good:
            return own
    return None


def _distinct(accounts: Sequence[Account]) -> list[Account]:
    """One account of each set of effects, whatever their order."""
    return list({frozenset(own.names): own for own in accounts}.values())


def _contest(ranked: Sequence[Account], empty: Account, closer: Closer) -> list[tuple[Account, bool]]:
    """Accounts that cannot be told from the best, best first, and whether each holds; the first alone where none does.

    Leaders are the best by everything and the best by the means alone: what is off in the mean also shows in the
    spectrum, and a closer look is what takes it off. Those in contest are compared about the leader's own expectation.
    """
    by_means = sorted(ranked, key=lambda own: own.refit.score)
    leaders = _distinct((ranked[0], by_means[0], *ranked[1:2]))
    for leader in leaders:
        first = closer(leader, leader)
        if not first[1]:
            continue
        slack = TIED + SLACK * abs(empty.refit.score - leader.refit.score)
        # A special case is as good as what holds it wherever the rest does not count, far off as a first look has it.
        near = [own for own in ranked if _special(own, leader)]
        near += [own for own in ranked if own.refit.score < leader.refit.score + slack]
        near += [own for own in ranked if own.score < leader.score + slack]
        contest = [own for own in _distinct(near) if set(own.names) != set(leader.names)][:LARGEST_CONTEST]
        exact = sorted([first, *(closer(leader, own) for own in contest)], key=lambda item: item[0].score)
        if set(exact[0][0].names) != set(leader.names) and exact[0][1]:
            leader = exact[0][0]
            again = [closer(leader, own) for own, _ in exact]
            exact = sorted(again, key=lambda item: item[0].score)
        exact = [item for item in exact if item[1]] or [first]
        return [item for item in exact if item[0].score < exact[0][0].score + TIED]
    return [(leaders[0], False)]


def _inseparable(
    best: Account, alone: dict[str, Account], empty: Account, closer: Closer, near_to: NearTo
) -> list[Account]:
    """Single effects that hold as well and, by chance, were seen further behind than can be expected."""
    ahead = empty.score - alone[best.names[0]].score
    near = [own for own in alone.values() if own.names != best.names and not _special(own, best)]
    near = sorted((own for own in near if empty.score - own.score > (1 - MOSTLY) * ahead), key=lambda own: own.score)
    exact = (closer(best, own) for own in near[:LARGEST_CONTEST])
    seen = [own for own, good in exact if good and own.score < best.score + min(FAR, MOSTLY * ahead)]
    return [own for own in seen if _separation(near_to(best), best, own) < APART**2]


def _separation(near: Look, best: Account, rival: Account) -> float:
    """−2 ln L by which the best fit of a rival would fall behind, were the best account the truth."""
    ideal = asimov(near, best.refit.model, best.component, best.grain)
    truth = account(ideal, present_of(best), best.refit.model)
    return account(ideal, present_of(rival), rival.refit.model).score - truth.score


def _taken_off(own: Account) -> bool:
    """Whether a closer look about an account takes off brightness, place or stripes of frames by themselves."""
    return own.latent.gain or own.latent.centre or is_striped(own)


def _simplest(holding: list[Account]) -> list[Account]:
    """Without those that contain another of the list as a special case."""
    return [own for own in holding if not any(_special(other, own) for other in holding)]


def _special(own: Account, of: Account) -> bool:
    """Whether a set of effects is a special case of another: they differ in one, and the other's contains it."""
    gone = [effect for effect, _ in of.effects if effect.name not in own.names]
    came = [effect for effect, _ in own.effects if effect.name not in of.names]
    return len(gone) == len(came) == 1 and gone[0].has_as_special_case(came[0])


def _grown(look: Look, parents: Sequence[Account], effects: Sequence[Effect]) -> list[Account]:
    """Accounts of one effect more, best first: beside each parent the effects that promise most."""
    seen: dict[frozenset, Account] = {}
    for parent in parents:
        span = basis(look.problem, parent.refit, parent.refit_effects, parent.latent)
        promise = []
        for effect in effects:
            if effect.name in parent.names or _told_already(parent, effect):
                continue
            if scatters(effect):
                own = relief(look, parent, effect)
            elif effect.spectral:
                own = np.inf if "grain" not in parent.component else 0.0
            else:
                own = promised(look.problem, parent.refit, span, effect)
            promise.append((own, effect))
        promise.sort(key=lambda item: -item[0])
        target = _to_beat(seen.values())
        untold, means, scatter = _parted(promise)
        for own, effect in (*untold, *means[:BESIDE], *scatter[:BESIDE_SCATTER]):
            key = frozenset((*parent.names, effect.name))
            # A fit of the means may have been led astray by what another parent had wrong.
            if own < EARNS or (key in seen and (scatters(effect) or effect.spectral)):
                continue
            found = _added(look, parent, effect, span, target)
            if found is not None and (key not in seen or found.score < seen[key].score):
                seen[key] = found
                target = _to_beat(seen.values())
    return sorted(seen.values(), key=lambda own: own.score)


def _to_beat(accounts: Iterable[Account]) -> float:
    """The least −2 ln L of the means; free gains and centres, which pay for themselves elsewhere, beat every law."""
    return min((own.refit.score for own in accounts if not (own.latent.gain or own.latent.centre)), default=np.inf)


def _parted(promise: list[tuple[float, Effect]]) -> tuple[list, list, list]:
    """Promises that only a fit can tell (infinite), of the means, and of noise."""
    told = [item for item in promise if np.isfinite(item[0])]
    means, scatter = ([item for item in told if scatters(item[1]) == noisy] for noisy in (False, True))
    return [item for item in promise if np.isinf(item[0])], means, scatter


def _rivals(look: Look, best: Account, effects: Sequence[Effect]) -> list[Account]:
    """Every member swapped for every other effect; for one that it contains in its own form, which a closer look
    chose."""
    out = []
    for leave in present_of(best):
        kept = tuple(p for p in present_of(best) if p.effect.name != leave.effect.name)
        reduced = account(look, kept)
        for effect in effects:
            if effect.name in best.names:
                continue
            same = leave.effect.has_as_special_case(effect) and leave.form in effect.forms
            own = _added(look, reduced, effect, None, best.refit.score, (leave.form,) if same else ())
            if own is not None:
                out.append(own)
    return sorted(out, key=lambda own: own.score)
