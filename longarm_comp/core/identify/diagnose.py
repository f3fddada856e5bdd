"""The diagnosis of a session: finds the effects that the model lacks, and proves them."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import ORDER
from longarm_comp.core.calibration.calibrate import declared_model, fit_stages
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.calibration.kind_of_arm import KindOfArm
from longarm_comp.core.calibration.noise import noise_from_repeats
from longarm_comp.core.calibration.plausible import (
    check_noise,
    mark_believed_rows,
    refuse_implausible,
)
from longarm_comp.core.data.holdout import spread_rows
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import through_others
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.discover.causes import list_causes, propose_poses
from longarm_comp.core.identify.findings import make_findings
from longarm_comp.core.identify.intervals import compute_intervals
from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.identify.posterior.offers import tolerance_columns
from longarm_comp.core.identify.proof import CALIBRATED, WITH_FUNCTIONS
from longarm_comp.core.identify.proved_models import Train, prove_written
from longarm_comp.core.identify.run_ups import (
    find_run_up,
    set_run_up,
    with_fitted_run_ups,
    with_run_ups,
)
from longarm_comp.core.identify.structure import find_structure
from longarm_comp.core.identify.structure_tests import with_held_out, with_left_out, with_scatter
from longarm_comp.core.model.model import Model
from longarm_comp.core.planning.splitting_poses import choose_splitting_poses

POSES = 12
"""Number of poses proposed for each question: about an hour's work."""
MOST_ROWS = 2000
"""Largest number of rows that are fitted. A hundred parameters are then known to a few percent of
the noise; further rows prove the fit instead."""


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
    """Find the causes of a session's residual, and return the diagnosis.

    Args:
        arm: the declared arm.
        session: admitted measurements.
        test: rows to hold out; without them those of the session that are too many to fit, or, if
            there are none, every row once, in folds.
        model: the model so far, to which effects are added; None: the declared arm.
        kind: knowledge from other arms of the kind: their geometry, and effects that all have.
        kinds: the effect classes to try; None: all of the catalogue.
        train_network: trains a predictor of the residual; None: no predictor.
        seed: seed of everything random; the same seed gives the same bytes.
        progress: called with the name of each step.

    Raises:
        InputError: too few rows.
        JobError: a fit did not stay finite or may not be believed (`refuse_implausible`), or the
            residual is more than an instrument's noise.
    """
    say = progress or (lambda _: None)
    nominal = model or declared_model(arm)
    train, test = _prepare_rows(session, test, nominal)
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
    explained = explain_session(
        start,
        train,
        candidates,
        known_noise=noise_from_repeats(start, train),
        stepped=offered.stepped,
        seed=seed,
        progress=say,
    )
    say("held-out rows")
    proved = prove_written(nominal, staged, explained, test, seed)
    say("structure")
    tolerated = tolerance_columns(
        explained.fit, explained.candidates, explained.found, explained.tolerance
    )
    structure = find_structure(explained.fit, proved.fits[CALIBRATED], tolerated)
    structure = with_scatter(with_left_out(structure, explained.fit), explained.fit)
    structure = with_held_out(structure, proved.fullest)
    final = proved.fits[proved.written]
    in_model = {t.key for t in final.model.terms}
    added = [t for t in explained.chosen_terms if t.key in in_model]
    intervals = compute_intervals(final, added, candidates)
    findings = make_findings(explained.found, arm, explained.fit, final, intervals, proved.fullest)
    network, proof = None, proved.proof
    if structure.flag and train_network is not None and final.session.has_position.any():
        say("network")
        network, proof = proved.train_network(train_network)
    believed = mark_believed_rows(final, proved.held_out.take(proof.rows_at))
    errors = {name: error[believed] for name, error in proof.errors.items()}
    before = "the declared arm" if model is None else "the model before"
    plainer = {"calibration": errors[CALIBRATED], before: errors["nominal"]}
    set_aside = refuse_implausible(final, None, errors[proved.written], plainer)
    kept = proved.written == WITH_FUNCTIONS
    causes = list_causes(explained.fit, explained.found, proof.rows, kept)
    unnamed = [t for cause in causes for t in cause.effects]
    say("next poses")
    split_by = tuple(
        choose_splitting_poses(explained.fit, f.candidate, f.alternatives[0].candidate, POSES, seed)
        for f in findings
        if f.alternatives
    )
    diagnosis = Diagnosis(
        **vars(dataclasses.replace(proved, proof=proof)),
        arm=arm,
        model_given=model is not None,
        findings=findings,
        causes=causes,
        intervals=intervals,
        structure=structure,
        set_aside=set_aside,
        network=network,
        split_by=split_by,
        next_q=propose_poses(explained.fit, unnamed, POSES, seed),
        not_testable=offered.not_testable,
        train=train,
        seed=seed,
    )
    if diagnosis.verdict == "noise":
        check_noise(explained.noise.sigma, train)
    return diagnosis


def _prepare_rows(
    session: Session, test: Session | None, nominal: Model
) -> tuple[Session, Session | None]:
    """Return the rows to fit, about `MOST_ROWS` at most, and the rows to hold out (None: folds).

    The latter are those of `test`, or the rows with the label ``role`` "test", or else all rows
    that are too many to fit. Run-ups are as long as those of `nominal`, and rows without a time
    get numbers.

    Raises:
        InputError: there are rows of `test` and rows with the label.
    """
    session = with_fitted_run_ups(session, nominal)
    test = None if test is None else with_fitted_run_ups(test.on_clock_of(session), nominal)
    if not any(ORDER in e.inputs for e in nominal.terms):  # its events lie before this session
        test = None if test is None else _number_rows(test, len(session))
        session = _number_rows(session)
    roles = session.labels.get("role", np.array([]))
    if (roles == "test").any() and (roles != "test").any():
        if test is not None:
            raise session.error("role", "test", "no such row where other rows are held out")
        session, test = session.take(roles != "test"), session.take(roles == "test")
    fitted = spread_rows(session, MOST_ROWS)
    if test is None and not fitted.all():
        test = session.take(~fitted)
    return session.take(fitted), test


def _number_rows(session: Session, first: int = 0) -> Session:
    """Return a session with its row numbers, from `first` on, in a column `ORDER`.

    A session with this column or times is unchanged. Without one of them an event (a blow to a
    camera, another tool, a belt that jumps) is in no column.
    """
    if not {"t_s", ORDER}.isdisjoint(session.columns):
        return session
    order = first + np.arange(len(session), dtype=float)
    return dataclasses.replace(session, columns={**session.columns, ORDER: order})
