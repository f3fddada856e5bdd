"""Close the loop: residual, missing effect, effect added, proof; or an honest "I don't know"."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.holdout import Sealed, blocked_split, spread
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify.aliasing import MOST_NAMES, EffectFinding, findings, on_few_levels
from longarm_comp.core.identify.calibrate import Errors, declared_model, stages
from longarm_comp.core.identify.candidates import Candidate, library
from longarm_comp.core.identify.confirm import Confirmed, confirm
from longarm_comp.core.identify.discover.discovery import Discovery, discover
from longarm_comp.core.identify.fit import ModelFit, fit
from longarm_comp.core.identify.in_words import improvement, left_in_words, sentence
from longarm_comp.core.identify.minor import Minor, settled
from longarm_comp.core.identify.next_poses import NextPoses, next_poses
from longarm_comp.core.identify.noise import from_repeats
from longarm_comp.core.identify.plausible import check_fits, check_noise, check_sizes, check_worth
from longarm_comp.core.identify.practical import Gain
from longarm_comp.core.identify.proof import NETWORK, LearnedCorrection, Proof, prove
from longarm_comp.core.identify.remainder import without_remainders
from longarm_comp.core.identify.search import SearchResult, search
from longarm_comp.core.identify.standing import standing
from longarm_comp.core.identify.structure import Structure, examine
from longarm_comp.core.identify.wind_up import WindUp, as_fitted, refined, wind_up, with_run_ups
from longarm_comp.core.model.model import Model

POSES_TO_SPLIT = 12
LEAST_SHARE = 0.5
"""Where structure is left, names that took less than this of the held-out error are withdrawn."""
MOST_UNEVEN = 20.0
"""No sensor of positions is so much noisier along one axis than along another."""
MOST_OUTLIERS = 0.16
"""More rejected rows than this are not outliers but something that the model lacks."""

T = TypeVar("T")
Train = Callable[[Model, Session], LearnedCorrection]
Progress = Callable[[str], None]
Left = Mapping[str, np.ndarray]
DISCOVERED = "with_discovered"
"""Name of the stage with causes that have no name."""


@dataclass(frozen=True)
class Diagnosis:
    """Everything that was found, and how sure it is.

    Attributes:
        arm: as declared.
        search: what the search ended with, whether it was rolled back or not.
        findings: effects that were added, strongest first; empty after a rollback.
        confirmed: intervals and doubts.
        structure: what is left.
        proof: held-out errors.
        rolled_back: the effects were found but did not help held-out poses.
        models: nominal, frames_only, calibrated, with_effects; the last is what to use.
        network: the learned correction of what is left, where it helped.
        split_by: poses per set.
        not_testable: (effect, why).
        minor: what the fitted rows ask for but does not matter; not in the model.
        discovery: causes without a name, where structure was left; None where none was found.
        train: rows that were fitted.
        held_out: the rows of the proof.
        holdout_uses: what the hold-out was opened for.
        seed: of everything random.
    """

    arm: Arm
    search: SearchResult
    findings: tuple[EffectFinding, ...]
    confirmed: Confirmed
    structure: Structure
    proof: Proof
    rolled_back: bool
    models: Mapping[str, Model]
    network: LearnedCorrection | None
    split_by: tuple[NextPoses, ...]
    not_testable: tuple[tuple[str, str], ...]
    minor: tuple[Minor, ...]
    train: Session
    held_out: Session
    holdout_uses: tuple[str, ...]
    seed: int
    discovery: Discovery | None = None

    @property
    def model(self) -> Model:
        """The model to use from now on."""
        return self.models["with_effects"] if self.added is None else self.added.fit.model

    @property
    def added(self) -> Discovery | None:
        """Causes without a name that are in the model: those that the hold-out bears out."""
        return self.discovery if self.discovery is not None and self.discovery.kept else None

    @property
    def fit(self) -> ModelFit:
        """The search's final fit."""
        return self.search.fit

    @property
    def verdict(self) -> str:
        """``noise``, ``named``, ``set``, ``partly`` or ``unknown``."""
        if not self.findings:
            return "unknown" if self.structure.flag or self.rolled_back else "noise"
        if self.structure.flag or any(len(f.names) > MOST_NAMES for f in self.findings):
            return "partly"
        return "set" if any(f.alternatives for f in self.findings) else "named"

    @property
    def errors(self) -> dict[str, np.ndarray]:
        """Held-out errors (M, 3) as seen, m, by stage; the last model of them is `model`."""
        return self._in_use(self.proof.errors)

    @property
    def commanded(self) -> dict[str, np.ndarray]:
        """The same as a command would have them (`core/data/commanded.py`)."""
        return self._in_use(self.proof.commanded)

    def _in_use(self, left: Mapping[str, T]) -> dict[str, T]:
        """Without a network that was not kept; effects that were taken back leave no errors."""
        made = {k: v for k, v in left.items() if k != NETWORK or self.network is not None}
        return {**made, "with_effects": left["calibrated"]} if self.rolled_back else made

    @property
    def rows(self) -> dict[str, Errors]:
        """Figures of `errors` by stage."""
        return self._in_use(self.proof.rows)

    @property
    def stage(self) -> str:
        """The stage whose errors are those of `model`."""
        return "with_effects" if self.added is None else DISCOVERED

    @property
    def compared(self) -> tuple[str, str]:
        """The stages before and after what was added; the calibration where nothing was."""
        if self.network is not None:
            return "calibrated", NETWORK
        added = self.findings or self.added is not None
        return ("calibrated", self.stage) if added else ("nominal", "calibrated")

    @property
    def seen_gain(self) -> Gain:
        """Of the stages compared, as seen."""
        return Gain.of(*(self.errors[stage] for stage in self.compared))

    @property
    def commanded_gain(self) -> Gain:
        """Of the stages compared, as a command would have it."""
        return Gain.of(*(self.commanded[stage] for stage in self.compared))

    @property
    def summary(self) -> str:
        """The verdict in one sentence, and what was left out."""
        gone = "; ".join(f"{m.name} at {', '.join(m.where)}: {m.why}" for m in self.minor)
        return _summary(self) + (f" Not named: {gone}." if gone else "")


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
    identified = _identify(
        calibrated, train, lambda run_up: rows(run_up)[0], candidates.testable, rng, say
    )
    memory = identified.memory
    train, rest = (train, rest) if memory is None else rows(memory.run_up)
    sealed = Sealed(rest)
    learn = _Learner(train_network, identified.search.fit, say)
    network = learn.on(identified.search.fit.model, identified.structure)
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
    outcome = _judge(identified, calibrated, proof, network, learn, held_out, rng)
    structure = _all_signs(outcome.structure, identified.search, outcome.proof)
    discovery = None
    if structure.flag or not outcome.findings:
        discovery = _discover(identified, outcome, sealed, rng, say, seed)
    if discovery is not None and discovery.kept:
        outcome = _with_discovery(outcome, discovery, learn, held_out)
        structure = _at_least(structure, discovery)
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
        not_testable=candidates.not_testable,
        minor=identified.minor,
        train=train,
        held_out=held_out,
        holdout_uses=sealed.uses,
        seed=seed,
        discovery=discovery,
    )
    _check(diagnosis)
    return diagnosis


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


# ------------------------------------------------------------------ the training rows


@dataclass(frozen=True)
class _Identified:
    """What the training rows say.

    Attributes:
        calibrated: the fit of the geometry alone, with the search's noise and outliers.
        search: the effects that were found.
        findings: the same with their look-alikes.
        structure: what the fit with effects leaves.
        confirmed: intervals and doubts.
        candidates: the library, with the radii that the joints' memory was found to have.
        minor: what does not matter.
        memory: these radii and the length of unrecorded run-ups, where joints remember.
    """

    calibrated: ModelFit
    search: SearchResult
    findings: tuple[EffectFinding, ...]
    structure: Structure
    confirmed: Confirmed
    candidates: tuple[Candidate, ...]
    minor: tuple[Minor, ...]
    memory: WindUp | None


def _identify(
    start: Model,
    train: Session,
    rows: Callable[[float], Session],
    candidates: tuple[Candidate, ...],
    rng: np.random.Generator,
    say: Progress,
) -> _Identified:
    """Memory of the joints, search, look-alikes, structure left, confirmation.

    Args:
        rows: the training rows with unrecorded run-ups taken to be so long (rad).
    """
    say("memory of the joints")
    memory = wind_up(start, rows, candidates)
    if memory is not None:
        candidates, train = memory.candidates(candidates), rows(memory.run_up)
    searched = search(
        start, train, candidates, known_noise=from_repeats(start, train), progress=say
    )
    if memory is not None:
        searched, memory = refined(searched, memory, rows)
        candidates, train = memory.candidates(candidates), rows(memory.run_up)
    searched, minor = settled(searched, say)
    searched, remainders = without_remainders(searched, say)
    minor += remainders
    say("look-alikes")
    result, found = findings(searched, candidates)
    say("structure")
    noise = result.noise
    weights = result.fit.weights
    calibrated = fit(start, train, sigma=noise.sigma, rho=noise.rho, weights=weights)
    structure = examine(result.fit, calibrated, rng)
    parts = [driver.part for driver in structure.drivers]
    result = dataclasses.replace(result, noise=noise.without(result.fit, parts))
    confirmed = confirm(result, list(found), candidates, rng)
    return _Identified(calibrated, result, found, structure, confirmed, candidates, minor, memory)


@dataclass(frozen=True)
class _Learner:
    """Trains the learned correction of what a model leaves of the inliers of a fit."""

    train: Train | None
    fitted: ModelFit
    say: Progress

    def on(self, model: Model, structure: Structure) -> LearnedCorrection | None:
        """A correction on top of a model; None where nothing is left, or none is wanted."""
        if not structure.flag or self.train is None or not self.fitted.session.located.any():
            return None
        self.say("network")
        return self.train(model, self.fitted.session.take(self.fitted.weights > 0))


# ------------------------------------------------------------------ the hold-out


@dataclass(frozen=True)
class _Outcome:
    """What the hold-out leaves of the findings: the model to use and what goes with it."""

    model: Model
    findings: tuple[EffectFinding, ...]
    structure: Structure
    network: LearnedCorrection | None
    proof: Proof
    rolled_back: bool


def _judge(
    identified: _Identified,
    calibrated: Model,
    proof: Proof,
    network: LearnedCorrection | None,
    learn: _Learner,
    held_out: Session,
    rng: np.random.Generator,
) -> _Outcome:
    """Effects that do not help unseen poses are taken back, whatever the fitted rows say.

    So are those that took less than half of what is wrong, where structure is left.
    """
    model, structure = identified.search.fit.model, identified.structure
    minor = (structure.flag or proof.off) and proof.share < LEAST_SHARE
    tested = proof.with_network(model, network, held_out)
    if identified.findings and (minor or not proof.better):
        return _roll_back(identified, calibrated, tested, learn, held_out, rng)
    kept = network if tested.network_helps("with_effects") else None
    return _Outcome(model, identified.findings, structure, kept, tested, False)


def _roll_back(
    identified: _Identified,
    model: Model,
    proof: Proof,
    learn: _Learner,
    held_out: Session,
    rng: np.random.Generator,
) -> _Outcome:
    """The calibrated model, with a network trained on what that one leaves."""
    structure = examine(identified.calibrated, identified.calibrated, rng)
    network = learn.on(model, structure)
    tested = proof.with_network(model, network, held_out)
    kept = network if tested.network_helps("calibrated") else None
    return _Outcome(model, (), structure, kept, tested, True)


def _discover(
    identified: _Identified,
    outcome: _Outcome,
    sealed: Sealed,
    rng: np.random.Generator,
    say: Progress,
    seed: int,
) -> Discovery | None:
    """Functions without a name for what is left, beside the effects or in their place.

    Also where nothing was named and no structure shows: what a column drives on one axis may be
    taken for noise.
    """
    named, plain = identified.search.fit, identified.calibrated
    known = from_repeats(plain.model, plain.session)
    bare = outcome.rolled_back or not outcome.findings
    count = len(identified.candidates)

    def unseal() -> Session:
        opened = sealed.open("functions without a name")
        return opened.take(opened.seen)

    base, without = (plain, None) if bare else (named, plain)
    return discover(base, without, count, unseal, known, rng, say, seed)


def _at_least(structure: Structure, found: Discovery) -> Structure:
    """The structure with what was found of it, where no test showed any."""
    if structure.flag:
        return structure
    size = max(cause.tip_m[0] for cause in found.found)
    return dataclasses.replace(structure, flag=True, size_m=size, inputs=found.inputs)


def _with_discovery(
    outcome: _Outcome, found: Discovery, learn: _Learner, held_out: Session
) -> _Outcome:
    """The outcome with what was found: a network comes after it, of what that leaves."""
    before = outcome.proof

    def joined(before: Left, after: Left) -> Left:
        kept = {stage: left for stage, left in before.items() if stage != NETWORK}
        return {**kept, DISCOVERED: after["with_effects"]}

    proof = dataclasses.replace(
        before,
        errors=joined(before.errors, found.proof.errors),
        commanded=joined(before.commanded, found.proof.commanded),
        turned=joined(before.turned, found.proof.turned),
    )
    network = learn.on(found.fit.model, found.structure)
    tested = proof.with_network(found.fit.model, network, held_out)
    kept = network if tested.network_helps(DISCOVERED) else None
    findings = tuple(f for f in outcome.findings if f.name not in found.without)
    return dataclasses.replace(outcome, findings=findings, network=kept, proof=tested)


def _all_signs(structure: Structure, result: SearchResult, proof: Proof) -> Structure:
    """The structure, also where other signs than the test of the fitted rows show some."""
    out = result.fit.weights == 0
    lengths = result.fit.residual * result.fit.metres
    rejected = float(np.sqrt((lengths[out] ** 2).sum() / len(out)))
    positions = result.fit.session.blocks[0].kind == "position"
    uneven = result.noise.unevenness if positions else 1.0
    for shows, size, where, sign in (
        (out.mean() > MOST_OUTLIERS, rejected, "outliers", "shows in the rows left out"),
        (
            uneven > MOST_UNEVEN,
            float(np.max(result.noise.sigma[:3])),
            "one axis",
            f"shows as noise of one axis, {uneven:.0f} times that of another",
        ),
        (proof.off, proof.excess_m, "unseen poses", "shows in the held-out poses"),
        (
            result.exhausted,
            proof.excess_m,
            "more than the library holds",
            "would need more effects than may be added",
        ),
    ):
        if shows and not structure.flag:
            return dataclasses.replace(
                structure, flag=True, size_m=size, inputs=(where,), sign=sign
            )
    return structure


MOST_ROWS = 2000
"""Rows that are fitted at most. A hundred parameters are then known to a few percent of the noise;
further rows cost time and change nothing."""


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


# ------------------------------------------------------------------ in words


def _summary(found: Diagnosis) -> str:
    text = _named(found)
    return text if found.discovery is None else f"{text} {found.discovery.sentence}."


def _change(found: Diagnosis) -> str:
    """Before and after, also where only orientations were measured."""
    before, after = (found.rows[stage] for stage in found.compared)
    if not before.n:
        return f"{before.said} -> {after.said}"
    return improvement(found.seen_gain, found.commanded_gain)


def _named(found: Diagnosis) -> str:
    left = left_in_words(found.structure)
    unnamed = f" {left} and has no name." if left else ""
    gain = f"Held-out mean error {_change(found)}"
    if found.proof.set_aside:
        gain += f", {found.proof.set_aside} of {len(found.held_out)} rows set aside, "
        gain += "which no model explains"
    added = found.compared[1] != "calibrated"
    besides = f" {gain}." if added else ""
    if found.rolled_back:
        small = found.proof.better
        why = "is less than half of what is wrong" if small else "is not beyond chance"
        text = f"Effects were found in the fitted poses but their gain on the held-out ones {why}"
        return f"{text}; the model was left as it was.{unnamed}{besides}"
    if found.verdict == "noise":
        text = "After calibration nothing but noise is left; no effect was added."
        return f"{text} {gain} by the calibration."
    if found.verdict == "unknown":
        text = f"The model lacks something that no effect of the library explains: {left}."
        return text + besides
    text = "; ".join(sentence(f, found.fit, found.confirmed) for f in found.findings)
    for overlap in found.confirmed.overlaps:
        text += f"; {overlap.names[0]} and {overlap.names[1]} overlap"
        text += ", either alone explains most of what both do"
    return f"{text}. {gain}.{unnamed}"
