"""Close the loop: residual, missing effect, effect added, proof; or an honest "I don't know"."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.data.holdout import Sealed, blocked_split
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import LIBRARY
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify import noise as noise_step
from longarm_comp.core.identify.aliasing import Finding, findings, on_few_levels, with_parts
from longarm_comp.core.identify.calibrate import declared_model, errors
from longarm_comp.core.identify.candidates import Candidate, library
from longarm_comp.core.identify.confirm import Confirmed, confirm
from longarm_comp.core.identify.evidence import key
from longarm_comp.core.identify.fit import Fit, align, fit, frames, geometry
from longarm_comp.core.identify.next_poses import NextPoses, next_poses
from longarm_comp.core.identify.proof import Proof, prove
from longarm_comp.core.identify.search import SearchResult, dropped, search
from longarm_comp.core.identify.structure import Structure, examine
from longarm_comp.core.model.model import Model

POSES_TO_SPLIT = 12
MOST_NAMES = 7
"""A set of more names than this names nothing."""
LEAST_SHARE = 0.5
"""Where structure is left, names that took less than this of the held-out error are withdrawn."""
MOST_OUTLIERS = 0.16
"""More rejected rows than this are not outliers but something that the model lacks."""


class Residual(Protocol):
    """A learned correction, as `core.learn` makes one."""

    def predict(self, q: np.ndarray, context: Context | None = None) -> Prediction: ...


class Prediction(Protocol):
    """What a learned correction predicts."""

    @property
    def error(self) -> np.ndarray: ...

    @property
    def in_domain(self) -> np.ndarray: ...


Train = Callable[[Model, Session], Residual]


@dataclass(frozen=True)
class Diagnosis:
    """Everything that was found, and how sure it is.

    Attributes:
        verdict: noise, named, set, partly or unknown.
        summary: one sentence.
        arm: as declared.
        traced: the search.
        findings: effects that were added, strongest first; empty after a rollback.
        confirmed: intervals and doubts.
        structure: what is left.
        proof: held-out errors.
        rolled_back: the effects were found but did not help held-out poses.
        models: nominal, frames_only, calibrated, with_effects; the last is what to use.
        network: the learned correction of what is left, where it helped.
        split_by: poses per set.
        not_testable: (effect, why).
        train: rows that were fitted.
        held_out: the rows of the proof.
        holdout_uses: what the hold-out was opened for.
        seed: of everything random.
    """

    verdict: str
    summary: str
    arm: Arm
    traced: SearchResult
    findings: tuple[Finding, ...]
    confirmed: Confirmed
    structure: Structure
    proof: Proof
    rolled_back: bool
    models: Mapping[str, Model]
    network: Residual | None
    split_by: tuple[NextPoses, ...]
    not_testable: tuple[tuple[str, str], ...]
    train: Session
    held_out: Session
    holdout_uses: tuple[str, ...]
    seed: int

    @property
    def model(self) -> Model:
        """The model to use from now on."""
        return self.models["with_effects"]

    @property
    def fit(self) -> Fit:
        """The final fit."""
        return self.traced.fit


def diagnose(
    arm: Arm,
    session: Session,
    *,
    test: Session | None = None,
    model: Model | None = None,
    kinds: Sequence[type[Effect] | type[Bias]] = LIBRARY,
    train_network: Train | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Trace the residual of a session to what the model lacks.

    Args:
        arm: as declared.
        session: admitted measurements.
        test: hold-out; whole blocks of the session are locked away when not given.
        model: what is known already (its effects are never added twice).
        kinds: the library to search.
        train_network: makes the learned correction of what is left; none is trained without.
        seed: of everything random; the same seed gives the same bytes.
        progress: told what is going on.

    Raises:
        InputError: too few rows.
        JobError: a fit did not stay finite.
    """
    say = progress or (lambda _: None)
    rng = np.random.default_rng(seed)
    train, rest = _split(session, test, seed)
    sealed = Sealed(rest)
    nominal = model or declared_model(arm)
    base = _with_geometry(nominal, arm, train)
    say("frames")
    placed = fit(align(nominal_frames(nominal, arm, train), train), train)
    candidates = library(arm, train.context(), kinds, base.terms)
    start = align(base, train)
    traced = search(
        start,
        train,
        candidates.testable,
        known_noise=noise_step.from_repeats(train),
        progress=say,
    )
    say("look-alikes")
    traced, found = _told_apart(traced, candidates.testable)
    say("structure")
    calibrated = fit(
        start,
        train,
        sigma=traced.noise.sigma,
        rho=traced.noise.rho,
        weights=traced.fit.weights,
    )
    structure = examine(traced.fit, calibrated, rng)
    confirmed = confirm(traced, list(found), candidates.testable, rng)
    models = {
        "nominal": nominal,
        "frames_only": placed.model,
        "calibrated": calibrated.model,
        "with_effects": traced.fit.model,
    }
    seen = train.take(train.seen).take(traced.fit.weights > 0)

    def learned() -> Residual | None:
        if not structure.flag or train_network is None:
            return None
        say("network")
        return train_network(models["with_effects"], seen)

    network = learned()
    sealed.release(f"{len(traced.chosen)} terms, seed {seed}")
    held_out = sealed.open("proof")
    held_out = held_out.take(held_out.seen)
    spread = {
        "calibrated": expected_spread(calibrated, held_out),
        "with_effects": expected_spread(traced.fit, held_out),
    }
    proof = _prove(models, network, held_out, spread, rng)
    network = network if _helps(proof) else None
    minor = (structure.flag or proof.off) and proof.share < LEAST_SHARE
    rolled_back = bool(found) and (minor or not proof.better)
    if rolled_back:
        models["with_effects"] = models["calibrated"]
        structure = examine(calibrated, calibrated, rng)
        network = learned()  # the other one was trained on what the effects left
        proof = _with_network(proof, models["calibrated"], network, held_out)
        network = network if _helps(proof, "calibrated") else None
    structure = _other_signs(structure, traced, proof)
    levels = _levels(np.concatenate([train.q, held_out.q]))
    kept = () if rolled_back else found
    kept = tuple(on_few_levels(traced, candidates.testable, f, levels) for f in kept)
    say("next poses")
    splits = tuple(
        next_poses(traced, f, f.alternatives[0], POSES_TO_SPLIT, seed)
        for f in kept
        if f.alternatives
    )
    verdict = _verdict(kept, structure, rolled_back)
    return Diagnosis(
        verdict,
        summary(verdict, kept, structure, confirmed, traced, proof, rolled_back),
        arm,
        traced,
        kept,
        confirmed,
        structure,
        proof,
        rolled_back,
        models,
        network,
        splits,
        candidates.not_testable,
        train,
        held_out,
        sealed.uses,
        seed,
    )


def _told_apart(
    traced: SearchResult, candidates: Sequence[Candidate]
) -> tuple[SearchResult, tuple[Finding, ...]]:
    """Findings with their look-alikes; what could be anything, one found already too, is dropped.

    Such a finding is the remainder of a stronger one whose form is not quite the library's: it
    stays in the residual, as structure, and gets no name.
    """
    found = findings(traced, candidates)
    for k, finding in enumerate(found):
        stronger = {f.name for f in found[:k]}
        if len(finding.names) > MOST_NAMES and stronger & set(finding.names):
            return _told_apart(dropped(traced, {key(t) for t in finding.terms}), candidates)
    return traced, with_parts(traced, candidates, found)


def _other_signs(structure: Structure, traced: SearchResult, proof: Proof) -> Structure:
    """What shows that something is left where the test of the fitted rows does not."""
    out = traced.fit.weights == 0
    rejected = float(np.sqrt((traced.fit.residual[out] ** 2).sum() / len(out)))
    for shows, size, where in (
        (out.mean() > MOST_OUTLIERS, rejected, "outliers"),
        (proof.off, proof.excess_m, "unseen poses"),
        (traced.exhausted, proof.excess_m, "more than the library holds"),
    ):
        if shows and not structure.flag:
            return dataclasses.replace(structure, flag=True, size_m=size, inputs=(where,))
    return structure


def nominal_frames(nominal: Model, arm: Arm, session: Session) -> Model:
    """The model with nothing but its frames free to move."""
    known = {(t.name, t.where) for t in nominal.terms}
    return nominal.plus(*(t for t in frames(arm, session) if (t.name, t.where) not in known))


def _with_geometry(nominal: Model, arm: Arm, session: Session) -> Model:
    known = {(t.name, t.where) for t in nominal.terms}
    return nominal.plus(*(t for t in geometry(arm, session) if (t.name, t.where) not in known))


def _levels(q: np.ndarray) -> np.ndarray:
    """(n,) distinct values of every joint, to a hundredth of its range."""
    span = np.maximum(np.ptp(q, axis=0), 1e-9)
    return np.array([len(np.unique(np.round(c, 2))) for c in (q / span).T])


def _split(session: Session, test: Session | None, seed: int) -> tuple[Session, Session]:
    if test is not None:
        return session, test
    roles = session.labels.get("role")
    if roles is not None and (roles == "test").any() and (roles != "test").any():
        return session.take(roles != "test"), session.take(roles == "test")
    return blocked_split(session, rng=seed)


def expected_spread(fitted: Fit, rows: Session) -> np.ndarray:
    """(N, 3) standard deviation of unseen errors: noise and parameter uncertainty, m."""
    posture = fitted.model.posture([rows.q[:, j] for j in range(rows.n)], rows.context())
    columns = fitted.model.columns(posture)[1]
    own = np.einsum("nip,pq,niq->ni", columns, fitted.covariance, columns, optimize=True)
    return np.sqrt(fitted.sigma**2 + own)


def _prove(
    models: Mapping[str, Model],
    network: Residual | None,
    held_out: Session,
    spread: Mapping[str, np.ndarray],
    rng: np.random.Generator,
) -> Proof:
    proof = prove({name: errors(m, held_out) for name, m in models.items()}, spread, rng)
    return _with_network(proof, models["with_effects"], network, held_out)


def _with_network(proof: Proof, model: Model, network: Residual | None, held_out: Session) -> Proof:
    """The proof with the errors that a network on top of a model leaves."""
    if network is None:
        return proof
    predicted = network.predict(held_out.q, held_out.context())
    learned = np.where(predicted.in_domain[:, None], predicted.error, 0.0)
    return proof.plus("with_network", errors(model, held_out) - learned)


def _helps(proof: Proof, beside: str = "with_effects") -> bool:
    rows = proof.rows
    return "with_network" in rows and rows["with_network"].mean < rows[beside].mean


def _verdict(found: tuple[Finding, ...], structure: Structure, rolled_back: bool) -> str:
    if not found:
        return "unknown" if structure.flag or rolled_back else "noise"
    if structure.flag or any(len(f.names) > MOST_NAMES for f in found):
        return "partly"
    return "set" if any(f.alternatives for f in found) else "named"


def summary(
    verdict: str,
    found: tuple[Finding, ...],
    structure: Structure,
    confirmed: Confirmed,
    traced: SearchResult,
    proof: Proof,
    rolled_back: bool,
) -> str:
    """The verdict in one sentence."""
    left = (
        f"{1e3 * structure.size_m:.2f} mm of structure depends on {', '.join(structure.inputs)}"
        + (f", as if {structure.at} moved" if structure.at else "")
        if structure.flag
        else ""
    )
    if rolled_back:
        why = "is less than half of what is wrong" if proof.better else "is not beyond chance"
        text = f"Effects were found in the fitted poses but their gain on the held-out ones {why}"
        return f"{text}; the model was left as it was." + (
            f" {left} and has no name." if left else ""
        )
    if verdict == "noise":
        return "After calibration nothing but noise is left; no effect was added."
    if verdict == "unknown":
        return f"The model lacks something that no effect of the library explains: {left}."
    parts = [_sentence(f, confirmed, traced) for f in found]
    before, after = (proof.rows[k].mean for k in ("calibrated", "with_effects"))
    text = "; ".join(parts)
    for overlap in confirmed.overlaps:
        text += f"; {overlap.names[0]} and {overlap.names[1]} overlap"
        text += ", either alone explains most of what both do"
    text += f". Held-out mean error {1e3 * before:.2f} -> {1e3 * after:.2f} mm"
    return f"{text}; {left} and has no name." if left else f"{text}."


def _sentence(found: Finding, confirmed: Confirmed, traced: SearchResult) -> str:
    values = []
    places = {(t.name, t.where) for t in found.terms}
    for k, slot in enumerate(traced.fit.slots):
        if (slot.owner.name, slot.owner.where) in places:
            i = confirmed.intervals[k]
            p = slot.parameter
            values.append(
                f"{slot.owner.where} {p.name} {i.value:.3g} {p.unit} [{i.low:.3g}, {i.high:.3g}]"
            )
    name = " or ".join(found.names)
    other = ""
    if found.runner_up is not None and not found.alternatives:
        odds = found.log_bayes_factor - found.runner_up.log_bayes_factor
        other = f", runner-up {found.runner_up.candidate.name} (log odds {odds:.0f})"
    for part in found.parts[:1]:
        other += f"; {part.name} could stand for its {part.what}"
    return f"{name}: {', '.join(values[:4])}{', ...' if len(values) > 4 else ''}{other}"
