"""What the hold-out leaves of the findings; what has no name, and a network, come after it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.data.holdout import Sealed
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.aliasing import EffectFinding
from longarm_comp.core.identify.diagnosis import DISCOVERED
from longarm_comp.core.identify.discover.discovery import Discovery, contest, discover
from longarm_comp.core.identify.discover.hold_out import together
from longarm_comp.core.identify.discover.set_aside import SharedDisplacement
from longarm_comp.core.identify.identified import Identified, Progress
from longarm_comp.core.identify.minor import noise_length, smallest
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.noise import from_repeats
from longarm_comp.core.identify.plausible import incredible
from longarm_comp.core.identify.proof import LearnedCorrection, Proof
from longarm_comp.core.identify.search import SearchResult
from longarm_comp.core.identify.structure import Structure, examine
from longarm_comp.core.model.model import Model

LEAST_SHARE = 0.5
"""Where structure is left, names that took less than this of the held-out error are withdrawn."""
MOST_UNEVEN = 20.0
"""No sensor of positions is so much noisier along one axis than along another."""
MOST_OUTLIERS = 0.16
"""More rejected rows than this are not outliers but something that the model lacks."""
Train = Callable[[Model, Session], LearnedCorrection]
Left = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Learner:
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


@dataclass(frozen=True)
class Judged:
    """What the hold-out leaves of the findings: the model to use and what goes with it."""

    model: Model
    findings: tuple[EffectFinding, ...]
    structure: Structure
    network: LearnedCorrection | None
    proof: Proof
    rolled_back: bool


def judge(
    identified: Identified, calibrated: Model, proof: Proof, rng: np.random.Generator
) -> Judged:
    """Effects that unseen poses do not bear out are taken back.

    So are those that took less than half of what is wrong, where structure is left, and all where
    one is of a size that no arm has: they stand in for something else.
    """
    model = identified.search.fit.model
    found, rho = identified.findings, identified.search.fit.rho
    more = identified.structure.flag or proof.off
    evidence = max((f.log_bayes_factor for f in found), default=0.0)
    helped = proof.better or (not more and together(proof, evidence, rho))
    small = more and proof.share < LEAST_SHARE
    if found and (not helped or small or incredible(model)):
        left = examine(identified.calibrated, identified.calibrated, rng)
        return Judged(calibrated, (), left, None, proof, True)
    return Judged(model, found, identified.structure, None, proof, False)


def look_further(
    identified: Identified,
    outcome: Judged,
    left: bool,
    sealed: Sealed,
    rng: np.random.Generator,
    say: Progress,
    seed: int,
) -> Discovery | None:
    """Functions without a name for what is left, beside the effects or in their place.

    Also where nothing was named and no structure shows: what a column drives on one axis may be
    taken for noise.  Where names leave nothing, one term in their place must be clearly better.

    Args:
        left: whether structure is left.
    """
    named, plain = identified.search.fit, identified.calibrated
    known = from_repeats(plain.model, plain.session)
    count = len(identified.candidates)

    def unseal() -> Session:
        opened = sealed.open("functions without a name")
        return opened.take(opened.seen)

    if outcome.rolled_back or not outcome.findings:
        return discover(plain, None, count, unseal, known, rng, say, seed)
    look = discover if left else contest
    return look(named, plain, count, unseal, known, rng, say, seed)


def with_rival(outcome: Judged, found: Discovery) -> Judged:
    """The outcome, its findings with the cause without a name that they are not told from."""
    mine = found.without if found.rival else ()
    findings = tuple(
        dataclasses.replace(f, unnamed=found.formulas) if f.name in mine else f
        for f in outcome.findings
    )
    return dataclasses.replace(outcome, findings=findings)


def at_least(structure: Structure, found: Discovery) -> Structure:
    """The structure with what was found of it, where no test showed any."""
    if structure.flag:
        return structure
    size = max(cause.tip_m[0] for cause in found.found)
    return dataclasses.replace(structure, flag=True, size_m=size, inputs=found.inputs)


def with_discovery(outcome: Judged, found: Discovery) -> Judged:
    """The outcome with what was found."""
    before = outcome.proof

    def joined(before: Left, after: Left) -> Left:
        return {**before, DISCOVERED: after["with_effects"]}

    proof = dataclasses.replace(
        before,
        errors=joined(before.errors, found.proof.errors),
        commanded=joined(before.commanded, found.proof.commanded),
        turned=joined(before.turned, found.proof.turned),
    )
    findings = tuple(f for f in outcome.findings if f.name not in found.without)
    return dataclasses.replace(outcome, findings=findings, proof=proof)


def with_network(
    outcome: Judged, found: Discovery | None, learn: Learner, held_out: Session
) -> Judged:
    """The outcome with a network of what all else leaves, where it helps.

    Args:
        found: what was added without a name.
        held_out: rows of the proof.
    """
    beside = "calibrated" if outcome.rolled_back else "with_effects"
    model, structure = outcome.model, outcome.structure
    if found is not None:
        model, structure, beside = found.fit.model, found.structure, DISCOVERED
    network = learn.on(model, structure)
    tested = outcome.proof.with_network(model, network, held_out)
    kept = network if tested.network_helps(beside) else None
    return dataclasses.replace(outcome, network=kept, proof=tested)


def all_signs(
    structure: Structure,
    result: SearchResult,
    proof: Proof,
    group: SharedDisplacement | None = None,
) -> Structure:
    """The structure, also where other signs than the test of the fitted rows show some.

    Many rows that are left out are one, where they hold more than the noise does: cameras err by
    more than a normal law has it, and that is no structure.  Few that share one displacement are
    another.

    Args:
        structure: as tested in the fitted rows.
        result: the search.
        proof: the hold-out.
        group: rows left out that share a displacement.
    """
    out = result.fit.weights == 0
    lengths = result.fit.residual * result.fit.metres
    rejected = float(np.sqrt((lengths[out] ** 2).sum() / len(out)))
    positions = result.fit.session.blocks[0].kind == "position"
    uneven = result.noise.unevenness if positions else 1.0
    for shows, size, where, sign in (
        (
            out.mean() > MOST_OUTLIERS and rejected > noise_length(result.fit),
            rejected,
            "outliers",
            "shows in the rows left out",
        ),
        (
            group is not None and rejected > smallest(result.fit),
            rejected,
            "outliers",
            "" if group is None else f"shows in rows left out: {group.sentence}",
        ),
        (
            uneven > MOST_UNEVEN,
            float(np.max(result.noise.sigma[:3])),
            "one axis",
            f"shows as noise of one axis, {uneven:.0f} times that of another",
        ),
        (
            proof.off and proof.excess_m > smallest(result.fit),
            proof.excess_m,
            "unseen poses",
            "shows in the held-out poses",
        ),
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
