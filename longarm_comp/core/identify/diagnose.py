"""The diagnosis of a session: residual, missing effect, effect added, proof; or "I don't know"."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import ORDER
from longarm_comp.core.calibration.calibrate import declared_model, fit_stages
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.kind_of_arm import KindOfArm, fold_directions
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.noise import noise_from_repeats
from longarm_comp.core.calibration.plausible import (
    check_noise,
    mark_believed_rows,
    refuse_implausible,
)
from longarm_comp.core.calibration.standing import place_as_seen
from longarm_comp.core.data.holdout import take_spread_rows
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.set_aside import SetAside
from longarm_comp.core.effects.catalogue import through_others
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.discover.causes import describe_doubts, list_causes, propose_poses
from longarm_comp.core.identify.findings import complete_findings, make_findings
from longarm_comp.core.identify.intervals import compute_intervals
from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.identify.posterior.explained import ExplainedSession
from longarm_comp.core.identify.posterior.offers import tolerance_columns
from longarm_comp.core.identify.proof import (
    CALIBRATED,
    WITH_EFFECTS,
    WITH_FUNCTIONS,
    Fold,
    Proof,
    describe_worsening,
    fit_folds,
    prove_models,
)
from longarm_comp.core.identify.run_ups import (
    find_run_up,
    set_run_up,
    with_fitted_run_ups,
    with_run_ups,
)
from longarm_comp.core.identify.structure import (
    find_structure,
    with_held_out,
    with_left_out,
    with_scatter,
)
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.model.model import Model
from longarm_comp.core.planning.splitting_poses import choose_splitting_poses

POSES = 12
"""Poses proposed for each question: an hour's work."""
MOST_ROWS = 2000
"""Rows that are fitted at most. A hundred parameters are then known to a few percent of the noise;
further rows cost time and change nothing."""
Train = Callable[[Model, Session], Predictor]


def diagnose(
    arm: Arm,
    session: Session,
    *,
    test: Session | None = None,
    model: Model | None = None,
    kind: KindOfArm | None = None,
    kinds: Sequence[type[Effect] | type[Bias]] | None = None,
    train_network: Train | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Trace the residual of a session to what the model lacks.

    Args:
        arm: the declared arm.
        session: admitted measurements.
        test: rows to hold out; without them every row of the session is held out once, in folds.
        model: what is known already (its effects are never added twice).
        kind: what other arms of the kind tell about its geometry and about effects that all have.
        kinds: the effects to try; all of the catalogue where None.
        train_network: trains a predictor of the residual; without it none is trained.
        seed: seed of everything random; the same seed gives the same bytes.
        progress: called with the name of each step.

    Raises:
        InputError: too few rows.
        JobError: a fit did not stay finite or may not be believed (`refuse_implausible`), or the
            residual is more than an instrument's noise.
    """
    say = progress or (lambda _: None)

    nominal = model or declared_model(arm)
    session = with_fitted_run_ups(session, nominal)
    test = None if test is None else with_fitted_run_ups(test.on_clock_of(session), nominal)
    if not any(ORDER in e.inputs for e in nominal.effects):  # what the model holds has happened
        test = None if test is None else _number_rows(test, len(session))
        session = _number_rows(session)
    train, test = _split_test_rows(session, test)
    staged = dict(fit_stages(nominal, train, say, kind))
    calibrated = staged["geometry"].model
    start = calibrated.with_missing(through_others(arm))
    offered = list_candidates(arm, train.context(), kinds, start.terms)
    candidates = offered.testable
    say("memory of the joints")
    length = find_run_up(start, lambda length: with_run_ups(train, arm, length), candidates)
    if length:
        candidates, train = set_run_up(candidates, length), with_run_ups(train, arm, length)
        test = None if test is None else with_run_ups(test, arm, length)
    found = explain_session(
        start,
        train,
        candidates,
        known_noise=noise_from_repeats(start, train),
        stepped=offered.stepped,
        seed=seed,
        progress=say,
    )
    say("structure")
    fits = _fit_written_models(calibrated, found)
    models = {
        "nominal": place_as_seen(nominal, train)[0],
        "frames_only": staged["frames_only"].model,
        **{name: fold_directions(fitted).model for name, fitted in fits.items()},
    }
    say("every row held out once")
    if test is None:
        held_out, made = fit_folds(nominal, staged["frames_only"].model, fits, found, seed)
    else:
        held_out = test.take(test.seen)
        made = (Fold(models, fits, held_out, np.arange(len(held_out))),)
    proof = prove_models(made)
    lengths = proof.expected_errors(found.found, list(fits))
    seen = {name: np.linalg.norm(each, axis=1) for name, each in proof.errors.items()}
    written, failed = _choose_written(lengths, seen)
    beside = tolerance_columns(found.fit, found.candidates, found.found, found.tolerance)
    structure = find_structure(found.fit, fits[CALIBRATED], beside)
    structure = with_left_out(structure, found.fit)
    fullest = [(list(f.fits.values())[-1], f.rows) for f in made]
    structure = with_held_out(with_scatter(structure, found.fit), fullest)
    final = fold_directions(fits[written])
    added = [t for f in found.found for t in f.terms if t.key in {s.key for s in final.model.terms}]
    ends = compute_intervals(final, added, candidates)
    named = complete_findings(make_findings(found.found), arm, found.fit, final, ends, fullest)
    network = None
    if structure.flag and train_network is not None and final.session.located.any():
        say("network")
        learned = train_network(final.model, final.session.take(final.weights > 0))
        network = learned if learned.gain.helps else None
    if network is not None and train_network is not None:
        train_one = train_network

        def train_on_fold(fold: Fold) -> tuple[Model, Predictor]:
            if test is not None:
                return final.model, network
            kept = fold.fits[written]
            return kept.model, train_one(kept.model, kept.session.take(kept.weights > 0))

        proof = prove_models(made, train_on_fold)
    aside = _refuse_as_calibrate(final, proof, held_out.take(proof.rows_at), written)
    without_name = list_causes(found.fit, found.found)
    unnamed = [t for cause in without_name for t in cause.terms]
    say("next poses")
    split_by = tuple(
        choose_splitting_poses(found.fit, f.candidate, f.alternatives[0].candidate, POSES, seed)
        for f in named
        if f.alternatives
    )
    diagnosis = Diagnosis(
        arm=arm,
        search=found,
        findings=named,
        causes=without_name,
        fits={name: fold_directions(fitted) for name, fitted in fits.items()},
        expected={name: float(each.mean()) for name, each in lengths.items()},
        written=written,
        failed=failed,
        intervals=ends,
        structure=structure,
        set_aside=aside,
        models=models,
        folds=made,
        proof=proof,
        network=network,
        split_by=split_by,
        doubts=describe_doubts(found.fit, unnamed),
        next_q=propose_poses(found.fit, unnamed, POSES, seed),
        not_testable=offered.not_testable,
        train=train,
        held_out=held_out,
        seed=seed,
    )
    if diagnosis.verdict == "noise":
        check_noise(found.noise.sigma, train)
    return diagnosis


def _refuse_as_calibrate(final: ModelFit, proof: Proof, rows: Session, written: str) -> SetAside:
    """Refuse a fit that `calibrate` would refuse; return the rows that it set aside."""
    at = {name: error[mark_believed_rows(final, rows)] for name, error in proof.errors.items()}
    plainer = {"calibration": at[CALIBRATED], "the declared arm": at["nominal"]}
    return refuse_implausible(final, None, at[written], plainer)


def _choose_written(
    expected: Mapping[str, np.ndarray], seen: Mapping[str, np.ndarray]
) -> tuple[str, str]:
    """Choose the model to write, and say how the proof of a fuller model failed.

    A model is out if a command is expected to err more with it, beyond chance, than with a plainer
    one. Its proof fails if its errors as seen are larger, beyond chance, than a plainer one's; no
    doubt about the measuring side explains that. Of the others the one of least mean error is
    chosen, of equals the plainer.

    Args:
        expected: by model, plainer ones first: errors (M,), m, that a command may expect.
        seen: by model: errors (M,), m, as seen.
    """
    written, failed = dict(expected), dict[str, str]()
    for name, plainer in combinations(list(expected)[::-1], 2):
        if describe_worsening(expected[plainer], expected[name]):
            written.pop(name, None)
        if rise := describe_worsening(seen[plainer], seen[name]):
            failed[name] = f"{plainer} -> {name}: {rise}"
    left = {name: each.mean() for name, each in written.items() if name not in failed}
    return min(left, key=left.__getitem__), "; ".join(failed.values())


def _fit_written_models(start: Model, found: ExplainedSession) -> dict[str, ModelFit]:
    """Fit the calibration alone, the model with named effects, and that with functions, to the same
    rows."""
    whole = found.fit
    bare = fit_model(start, whole.session, **whole.noise_arguments)
    more = found.found or found.tolerance.compliance
    made = {CALIBRATED: bare, WITH_EFFECTS: whole if more else bare}
    functions = {t.key for f in found.found if f.unnamed for t in f.terms}
    if functions:
        less = fit_model(whole.model.without(functions), whole.session, **whole.noise_arguments)
        made = {CALIBRATED: bare, WITH_EFFECTS: less, WITH_FUNCTIONS: whole}
    return made


def _number_rows(session: Session, first: int = 0) -> Session:
    """Return a session whose rows are numbered in a column `ORDER`, if it does not tell their time.

    Without it an event (a blow to a camera, another tool, a belt that jumps) shows in no column.
    """
    if not {"t_s", ORDER}.isdisjoint(session.columns):
        return session
    order = first + np.arange(len(session), dtype=float)
    return dataclasses.replace(session, columns={**session.columns, ORDER: order})


def _split_test_rows(session: Session, test: Session | None) -> tuple[Session, Session | None]:
    """Split a session into rows to fit and rows to hold out, if such are given or labelled."""
    roles = session.labels.get("role", np.array([]))
    if test is None and (roles == "test").any() and (roles != "test").any():
        session, test = session.take(roles != "test"), session.take(roles == "test")
    return take_spread_rows(session, MOST_ROWS), test
