"""Explains a session: finds the effects that the model lacks, and how sure they are.

The search (`search.py`) finds an explanation.  Each of its effects is then compared with its rivals
and with its absence.  Finally the probabilities are averaged over samples of the rows.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.linear import BETTER
from longarm_comp.core.calibration.noise import NoiseEstimate
from longarm_comp.core.data.holdout import split_in_half
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.identify.model_tolerance import fit_with_background
from longarm_comp.core.identify.posterior.explained import ExplainedSession, widen_prior
from longarm_comp.core.identify.posterior.found import CREDIBLE, FoundEffect, replace_effect
from longarm_comp.core.identify.posterior.offer import ROUNDS
from longarm_comp.core.identify.posterior.resampled import SAMPLES, Resampling
from longarm_comp.core.identify.posterior.search import ExplanationSearch
from longarm_comp.core.model.model import Model


def explain_session(
    base: Model,
    session: Session,
    candidates: Sequence[Candidate],
    *,
    known_noise: NoiseEstimate | None = None,
    stepped: Sequence[type[Effect]] = (),
    functions: bool = True,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> ExplainedSession:
    """Find the effects that the model lacks, and return the model fitted with them.

    Args:
        base: the declared model with its geometry terms.
        session: training rows.
        candidates: the library.
        known_noise: the noise from repeats, as an upper limit; None: only from the residual.
        stepped: effect classes whose steps are scanned (`step_scan.py`).
        functions: whether functions without a name are offered.
        seed: seed of the samples of the rows over which the probabilities are averaged.
        progress: called with the name of each step and of each effect found.

    Raises:
        InputError, JobError: as `fit_model`.
    """
    say = progress or (lambda _: None)
    search = ExplanationSearch(base, session, list(candidates), known_noise, stepped, say)
    say("geometry")
    state = search.fit_geometry()
    weighed = not any(t.through_others for t in base.terms)
    state = search.repeat_until_best(state) if weighed else _start_soft(search, state)
    of_halves: tuple[tuple[FoundEffect, ...], ...] = ()
    if functions:  # only beside the best named effects
        state, _, changed = _compare_rivals(search, state)
        state = search.repeat_until_best(state) if changed else state
        search = replace(search, nameless=True)
        state = search.repeat_until_best(search.repeat_until_best(state), functions=True)
        state, of_halves = _explain_halves(search, state, seed)
    for _ in range(ROUNDS):
        state, doubtful = _replace_by_rivals(search, state)
        better, absence = _compare_absence(search, state)
        if better is None:
            break
        state = better
    say("resampled rows")
    state, unstable = _average_samples(search, state, absence, of_halves, seed)
    doubtful = tuple(f for f in (*doubtful, *unstable) if f.in_doubt)
    return replace(_converge_fit(search, state), doubtful=doubtful)


def _average_samples(
    search: ExplanationSearch,
    state: ExplainedSession,
    absence: Mapping[str, tuple[FoundEffect, float]],
    of_halves: tuple[tuple[FoundEffect, ...], ...],
    seed: int,
) -> tuple[ExplainedSession, tuple[FoundEffect, ...]]:
    """Average the probabilities over samples of the rows.

    Returns the new state, and the effects that are dropped from it because few samples show them.
    """
    tolerance = search.weigh_tolerances(state.fit, state.found)[1]
    resampling = Resampling(
        state.fit, search.candidates, search.functions, state.found, tolerance, of_halves
    )
    found = tuple(
        f.add_rival(*absence[f.name]) if f.name in absence else f
        for f in resampling.average_samples(seed)
    )
    least = 0.5 * SAMPLES / (SAMPLES + len(of_halves))  # a half may have too few rows
    stable = tuple(f for f in found if f.presence > least)
    fewer = search.fit_with(state, stable) if len(stable) < len(found) else None
    if fewer is None:
        return replace(state, found=found, tolerance=tolerance, resampling=resampling), ()
    tolerance = search.weigh_tolerances(fewer.fit, fewer.found)[1]
    resampling = replace(resampling, fit=fewer.fit, found=fewer.found, tolerance=tolerance)
    unstable = tuple(f for f in found if f.presence <= least)
    return replace(fewer, tolerance=tolerance, resampling=resampling), unstable


def _converge_fit(search: ExplanationSearch, state: ExplainedSession) -> ExplainedSession:
    """Return the state with its fit converged, and with the background compliance.

    If an elastic effect was found, other parts may be as soft without a penalty of the prior.
    Effects that act only through others, as a mass through a part that yields under load, are left
    out if none of these is there.
    """
    soft, noise = any(t.elastic for t in state.chosen_terms), state.fit.noise_arguments
    offered = search.offer_by_tolerance(state.fit, state.found, others=False)
    best = max(offered, key=lambda o: o.evidence_pruned - o.tolerance.log_prior * soft)
    fitted = fit_model(state.fit.model, search.session, begun=state.fit, **noise)
    if best.tolerance.compliance:
        fitted = fit_with_background(fitted, search.candidates, best.tolerance.compliance)
    idle = {e.key for e in fitted.model.effects if e.through_others}
    if idle and not any(e.loaded for e in fitted.model.effects if e.key not in idle):
        fitted = fit_model(fitted.model.without(idle), search.session, near=fitted, **noise)
    known = {t.variant: t for t in fitted.model.terms}
    held = (f.with_terms(known[t.variant] for t in f.terms) for f in state.found)
    return replace(state, fit=fitted, found=tuple(held), candidates=tuple(search.candidates))


def _start_soft(search: ExplanationSearch, state: ExplainedSession) -> ExplainedSession:
    """Search also from each elastic effect at all of its places, if that has a higher evidence.

    The weights of an arm that declares none are estimated only by a fit: without an elastic effect
    they have no columns, and after a fit with the wrong effect the columns favour the wrong part.
    """
    best = search.repeat_until_best(state)
    for c in search.candidates:
        if len(c.terms) > 1 and c.terms[0].elastic:
            every = (FoundEffect.of(c.terms, 1.0, 0.0),)
            here, there = (
                search.evidence_refitted(best, found, best_places=True)
                for found in (best.found, every)
            )
            if there > here + BETTER and (begun := search.fit_with(best, every)) is not None:
                taken = search.repeat_until_best(begun)
                best = taken if search.compare_odds(best, taken) > BETTER else best
    return best


def _explain_halves(
    search: ExplanationSearch, state: ExplainedSession, seed: int
) -> tuple[ExplainedSession, tuple[tuple[FoundEffect, ...], ...]]:
    """Explain each half of the rows alone, and try these explanations on all rows.

    This is done only if the state contains functions without a name. If there are many causes,
    none may raise the evidence enough while the others count as noise, so the ascent stops early.
    On other rows it stops elsewhere.

    Returns the better state, and the effects found on each half: a sample of what another session
    would show.
    """
    of_halves: tuple[tuple[FoundEffect, ...], ...] = ()
    if not any(f.unnamed for f in state.found):
        return state, of_halves
    for rows in split_in_half(search.session, seed):
        half = replace(search, session=search.session.take(rows))
        begun = half.fit_with(state, ())
        if begun is None:
            continue
        found = half.repeat_until_best(begun, functions=True).found
        of_halves = (*of_halves, found)
        taken = search.fit_with(state, tuple(map(widen_prior, found)))
        if taken is not None and search.compare_odds(state, taken) > BETTER:
            state = search.repeat_until_best(taken, functions=True)
    return state, of_halves


def _replace_by_rivals(
    search: ExplanationSearch, state: ExplainedSession
) -> tuple[ExplainedSession, tuple[FoundEffect, ...]]:
    """Compare every effect with its rivals, and explain again, until no rival is better.

    Returns the state, and the doubtful effects.
    """
    doubtful: tuple[FoundEffect, ...] = ()
    for _ in range(ROUNDS):
        state, new, changed = _compare_rivals(search, state)
        taken = {t.key for f in (*state.found, *new) for t in f.terms}
        doubtful = (*new, *(f for f in doubtful if taken.isdisjoint(t.key for t in f.terms)))
        if not changed:
            break
        state = search.repeat_until_best(state)
    return state, doubtful


def _compare_rivals(
    search: ExplanationSearch, state: ExplainedSession
) -> tuple[ExplainedSession, tuple[FoundEffect, ...], bool]:
    """Converge the fit, and compare every effect with its rivals, each fitted in its place.

    Returns the state, the doubtful effects, and whether an effect was dropped or replaced, so that
    everything must be explained again.
    """
    was = state.fit
    state = replace(
        state, fit=fit_model(was.model, search.session, begun=was, **was.noise_arguments)
    )
    offered = search.offer_by_tolerance(state.fit, state.found)
    best = max(offered, key=lambda o: o.evidence_of_known)
    found, doubtful = best.judge_found(state.found, offered)
    sure = tuple(f for f in found if f.presence >= CREDIBLE)
    if len(sure) < len(found) and (fewer := search.fit_with(state, sure)) is not None:
        return fewer, (*doubtful, *(f for f in found if f.presence < CREDIBLE)), True
    state = replace(state, found=sure)
    here = search.evidence_of_all(state.fit, sure)
    for k, mine in enumerate(sure):
        worth = {
            rival.name: search.evidence_refitted(
                state, replace_effect(state.found, k, mine.put_first(rival, ()))
            )
            - here
            for rival in mine.fitted_rivals
        }
        judged, better = mine.compare_with(worth)
        if better:
            taken = search.fit_with(state, replace_effect(state.found, k, judged))
            if taken is not None:
                return taken, doubtful, True
        else:
            found = (*state.found[:k], judged, *state.found[k + 1 :])
            state = replace(state, found=found)
    return state, doubtful, False


def _compare_absence(
    search: ExplanationSearch, state: ExplainedSession
) -> tuple[ExplainedSession | None, dict[str, tuple[FoundEffect, float]]]:
    """Compare the explanation with the best one that lacks a named effect, for each such effect.

    Several functions may explain as much as one named effect, and an exchange of one effect for
    another never finds them. Elastic effects are not compared. Nothing is compared if all effects
    of the explanation have names.

    Returns:
        The first better explanation, or None; and for each name the function that would replace
        it, with the log odds of the explanation with this function.
    """
    absence: dict[str, tuple[FoundEffect, float]] = {}
    if not any(f.unnamed for f in state.found):
        return None, absence
    names = {f.name for f in state.found if not f.unnamed and not f.terms[0].elastic}
    for name in sorted(names):
        others = replace(search, candidates=[c for c in search.candidates if c.name != name])
        rest = tuple(f for f in state.found if not f.unnamed and f.name != name)
        left = others.fit_with(state, rest)
        left = None if left is None else others.repeat_until_best(left, functions=True)
        new = [] if left is None else [f for f in left.found if f.unnamed]
        if left is None or not new:
            continue
        odds = search.compare_odds(state, left)
        if odds > 0:
            return left, {}
        absence[name] = new[0], odds
    return None, absence
