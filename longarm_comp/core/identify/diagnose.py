"""Close the loop: residual, missing effect, effect added, proof; or an honest "I don't know"."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.holdout import Sealed, blocked_split, spread
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify.aliasing import EffectFinding, on_few_levels
from longarm_comp.core.identify.calibrate import declared_model, stages
from longarm_comp.core.identify.candidates import library
from longarm_comp.core.identify.diagnosis import DISCOVERED, Diagnosis
from longarm_comp.core.identify.discover.banks import sides
from longarm_comp.core.identify.discover.set_aside import shared
from longarm_comp.core.identify.evidence import key
from longarm_comp.core.identify.identified import Progress, identify
from longarm_comp.core.identify.next_poses import next_poses
from longarm_comp.core.identify.outcome import (
    Learner,
    Train,
    all_signs,
    at_least,
    judge,
    look_further,
    with_discovery,
    with_network,
    with_rival,
)
from longarm_comp.core.identify.plausible import check_fits, check_noise, check_sizes, check_worth
from longarm_comp.core.identify.proof import prove
from longarm_comp.core.identify.search import SearchResult
from longarm_comp.core.identify.standing import standing
from longarm_comp.core.identify.wind_up import as_fitted, with_run_ups
from longarm_comp.core.model.model import Model

POSES_TO_SPLIT = 12
MOST_ROWS = 2000
"""Rows that are fitted at most. A hundred parameters are then known to a few percent of the noise;
further rows cost time and change nothing."""


def diagnose(
    arm: Arm,
    session: Session,
    *,
    test: Session | None = None,
    model: Model | None = None,
    kinds: Sequence[type[Effect] | type[Bias]] | None = None,
    train_network: Train | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Diagnosis:
    """Trace the residual of a session to what the model lacks.

    Args:
        arm: as declared.
        session: admitted measurements.
        test: hold-out; whole blocks of the session are locked away when not given.
        model: what is known already (its effects are never added twice).
        kinds: the effects to try; all of the catalogue where None.
        train_network: makes the learned correction of what is left; none is trained without.
        seed: of everything random; the same seed gives the same bytes.
        progress: told what is going on.

    Raises:
        InputError: too few rows.
        JobError: a fit did not stay finite, or the outcome may not be believed.
    """
    say = progress or (lambda _: None)
    rng = np.random.default_rng(seed)

    @cache
    def rows(run_up: float) -> tuple[Session, Session]:
        """To fit and to hold out, with unrecorded run-ups taken to be so long (rad)."""
        held = None if test is None else with_run_ups(test, arm, run_up)
        return _split(with_run_ups(session, arm, run_up), held, seed)

    nominal = model or declared_model(arm)
    session = as_fitted(session, nominal)
    test = None if test is None else as_fitted(test, nominal)
    train, rest = _split(session, test, seed)
    staged = dict(stages(nominal, train, say))
    calibrated = staged["geometry"].model
    candidates = library(arm, train.context(), kinds, calibrated.terms)
    identified = identify(
        calibrated,
        train,
        lambda run_up: rows(run_up)[0],
        candidates.testable,
        rng,
        say,
        candidates.stepped,
    )
    memory = identified.memory
    train, rest = (train, rest) if memory is None else rows(memory.run_up)
    sealed = Sealed(rest)
    sealed.release(f"{len(identified.search.chosen)} terms, seed {seed}")
    opened = sealed.open("proof")
    held_out = opened.take(opened.seen)
    models = {
        "nominal": standing(nominal, train)[0],
        "frames_only": staged["frames_only"].model,
        "calibrated": calibrated,
        "with_effects": identified.search.fit.model,
    }
    proof = prove(models, identified.calibrated, identified.search.fit, held_out, rng)
    outcome = judge(identified, calibrated, proof, rng)
    group = shared(identified.search.fit, sides(identified.search.fit))
    structure = all_signs(outcome.structure, identified.search, outcome.proof, group)
    discovery = look_further(identified, outcome, structure.flag, sealed, rng, say, seed)
    added = discovery if discovery is not None and discovery.kept else None
    if discovery is not None:
        outcome = with_rival(outcome, discovery)
    if added is not None:
        outcome = with_discovery(outcome, added)
        structure = at_least(structure, added)
    learn = Learner(train_network, identified.search.fit, say)
    outcome = with_network(outcome, added, learn, held_out)
    looked_at = np.concatenate([train.q, held_out.q])
    found = tuple(
        on_few_levels(identified.search, identified.candidates, f, looked_at)
        for f in outcome.findings
    )
    say("next poses")
    diagnosis = Diagnosis(
        arm=arm,
        search=identified.search,
        findings=found,
        confirmed=identified.confirmed,
        structure=structure,
        proof=outcome.proof,
        rolled_back=outcome.rolled_back,
        models={**models, "with_effects": outcome.model},
        network=outcome.network,
        split_by=tuple(
            next_poses(identified.search, f, f.alternatives[0], POSES_TO_SPLIT, seed)
            for f in found
            if f.alternatives
        ),
        not_testable=(*candidates.not_testable, *_unknown_steps(identified.search, found)),
        minor=identified.minor,
        train=train,
        held_out=held_out,
        holdout_uses=sealed.uses,
        seed=seed,
        discovery=discovery,
    )
    _check(diagnosis)
    return diagnosis


def _unknown_steps(
    result: SearchResult, found: Sequence[EffectFinding]
) -> Iterator[tuple[str, str]]:
    """(effect, why) where steps show, but not their size, and nothing of the kind was named."""
    named = {key(term) for finding in found for term in finding.terms}
    return ((u.name, u.why) for u in result.unknown_steps if (u.name, u.where) not in named)


def _check(found: Diagnosis) -> None:
    """Refuse an outcome that may not be believed."""
    final = "calibrated" if found.rolled_back else "with_effects"
    final = DISCOVERED if found.added is not None else final
    left, source = found.proof.errors, found.train.source
    check_worth(left[final], left["frames_only"], source)
    check_fits(found.model, found.train)
    check_sizes(found.model, source)
    if found.verdict == "noise":
        check_noise(found.search.noise.sigma, found.train)


def _split(session: Session, test: Session | None, seed: int) -> tuple[Session, Session]:
    train, rest = _divided(session, test, seed)
    return spread(train, MOST_ROWS), rest


def _divided(session: Session, test: Session | None, seed: int) -> tuple[Session, Session]:
    if test is not None:
        return session, test
    roles = session.labels.get("role")
    if roles is not None and (roles == "test").any() and (roles != "test").any():
        return session.take(roles != "test"), session.take(roles == "test")
    return blocked_split(session, rng=seed)
