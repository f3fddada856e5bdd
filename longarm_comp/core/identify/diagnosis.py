"""The result of a diagnosis: what was found and how sure it is, or "I don't know"."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import CLOCK
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.plausible import mark_believed_rows
from longarm_comp.core.compensation.unshown import describe_unshown
from longarm_comp.core.data.commanded import in_frame_of_start
from longarm_comp.core.data.measurement import compute_posture
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.set_aside import SetAside
from longarm_comp.core.effects.effect import Bias
from longarm_comp.core.effects.units import in_names
from longarm_comp.core.identify.candidate_states import (
    SmallestSize,
    TriedCandidate,
    find_smallest_sizes,
    judge_candidates,
)
from longarm_comp.core.identify.discover.causes import Cause
from longarm_comp.core.identify.findings import (
    Finding,
    describe_finding,
    describe_improvement,
    describe_structure,
)
from longarm_comp.core.identify.gains import Gain
from longarm_comp.core.identify.intervals import Interval
from longarm_comp.core.identify.posterior.found import CREDIBLE, NONE
from longarm_comp.core.identify.proof import CALIBRATED, NETWORK, WITH_FUNCTIONS
from longarm_comp.core.identify.proved_models import ProvedModels
from longarm_comp.core.identify.structure import Structure
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.model.model import Model
from longarm_comp.core.planning.splitting_poses import SplittingPoses

SPLITS = NONE
"""Smallest expected log odds between two names for which poses are worth measuring: those from
which an effect counts as found."""


@dataclass(frozen=True)
class Diagnosis(ProvedModels):
    """The result of a diagnosis: the proved models, what was found, and how sure it is.

    Attributes:
        arm: the declared arm.
        model_given: whether the model before was given; else it was that of the declared arm.
        findings: effects with a name, strongest first.
        causes: functions without a name, largest first.
        intervals: intervals of the parameters of the model to use, by position in its slots.
        structure: the structure that is left in the residual.
        set_aside: rows that the fit of the model to use set aside as outliers.
        network: the predictor of the residual; None if it does not help at held-out poses.
        split_by: for each finding with other names, the poses that would tell them apart.
        next_q: (M, n) poses that would settle the doubts about the causes, rad and m.
        not_testable: (effect, reason) of the candidates that could not be tested.
        train: rows that were fitted.
        seed: seed of everything random.
    """

    arm: Arm
    model_given: bool
    findings: tuple[Finding, ...]
    causes: tuple[Cause, ...]
    intervals: Mapping[int, Interval]
    structure: Structure
    set_aside: SetAside
    network: Predictor | None
    split_by: tuple[SplittingPoses, ...]
    next_q: np.ndarray
    not_testable: tuple[tuple[str, str], ...]
    train: Session
    seed: int

    @cached_property
    def fit(self) -> ModelFit:
        """The fit of the model to use.

        If the frame of the measurements certainly drifts, targets are in this frame as it was at
        the start of the session.
        """
        fitted = self.fits[self.written]
        seen = [f for f in self.explained.found if isinstance(f.terms[0], Bias)]
        drifts = (f for f in seen if any(CLOCK in t.inputs for t in f.terms))
        if not all(f.presence * f.chance_bias >= CREDIBLE for f in drifts):
            return fitted
        model = in_frame_of_start(fitted.model, fitted.session)
        if model is fitted.model:
            return fitted
        return replace(fitted, model=model, posture=compute_posture(model, fitted.session))

    @property
    def errors_anew(self) -> np.ndarray | None:
        """(N, 3) errors, m, at the fitted rows by the model to use, chosen and fitted without them.

        NaN where there is none; None if the rows to hold out were given.
        """
        if len(self.folds) == 1:
            return None
        made = np.full((len(self.fit.session), 3), np.nan)
        held = np.sort(np.concatenate([fold.numbers for fold in self.folds]))
        made[held[self.proof.rows_at]] = self.proof.errors[self.written]
        return made

    @property
    def model(self) -> Model:
        """The model to use from now on."""
        return self.fit.model

    @property
    def left_out(self) -> bool:
        """True if the model to use does not contain all that was found."""
        return self.written != list(self.fits)[-1]

    @cached_property
    def none_of_these(self) -> float:
        """Probability that a cause is needed that has no name in the library."""
        found = (*self.explained.found, *self.explained.doubtful)
        none = (1.0 - f.presence * f.chance_unnamed for f in found)
        return 1.0 - math.prod(none) * (1.0 - self.structure.chance)

    @cached_property
    def smallest(self) -> tuple[SmallestSize, ...]:
        """Evidence and smallest visible size of every candidate that is not in the model."""
        held = {t.key for t in self.explained.chosen_terms}
        library = self.explained.candidates
        outside = [c for c in library if held.isdisjoint(t.key for t in c.terms)]
        return find_smallest_sizes(self.explained.fit, outside, self.explained.needed_evidence)

    @cached_property
    def candidates(self) -> list[TriedCandidate]:
        """Every candidate with its state, the best first, those that cannot be tested last."""
        written = {t.key for t in self.model.terms}
        return judge_candidates(
            self.explained, self.findings, written, self.smallest, self.not_testable
        )

    @property
    def splits(self) -> list[SplittingPoses]:
        """Poses that are worth measuring because they would tell two names apart."""
        return [by for by in self.split_by if by.log_bayes_factor >= SPLITS]

    @property
    def verdict(self) -> str:
        """The verdict: ``noise``, ``named``, ``set``, ``partly`` or ``unknown``."""
        found = bool(self.findings or (self.causes and self.written == WITH_FUNCTIONS))
        if self.causes or self.structure.flag or (self.failed and found):
            contradicted = self.failed and self.written == CALIBRATED
            return "partly" if found and not contradicted else "unknown"
        if not self.findings:
            return "noise"
        return "set" if any(f.open for f in self.findings) else "named"

    @property
    def compared_stages(self) -> tuple[str, str]:
        """The names of the two models to compare: before and after the additions.

        If nothing was added to the calibrated model, they are nominal and calibrated.
        """
        if self.network is not None:
            return CALIBRATED, NETWORK
        return ("nominal", CALIBRATED) if self.written == CALIBRATED else (CALIBRATED, self.written)

    @cached_property
    def believed(self) -> np.ndarray:
        """(M,) True at the rows of the proof that were not set aside; at all, if all were."""
        kept = mark_believed_rows(self.fit, self.held_out.take(self.proof.rows_at))
        return kept if kept.any() else ~kept

    @property
    def seen_gain(self) -> Gain:
        """The gain between the two `compared_stages`, in errors as seen."""
        return self._gain(self.proof.errors, slice(None))

    @property
    def commanded_gain(self) -> Gain:
        """The gain between the two `compared_stages`, in errors as a command would have them."""
        return self._gain(self.proof.commanded, slice(None))

    @property
    def believed_gains(self) -> tuple[Gain, Gain]:
        """The gains as seen and as commanded at the `believed` rows."""
        errors = self.proof.errors, self.proof.commanded
        return self._gain(errors[0], self.believed), self._gain(errors[1], self.believed)

    def _gain(self, errors: Mapping[str, np.ndarray], rows: np.ndarray | slice) -> Gain:
        before, after = (errors[stage][rows] for stage in self.compared_stages)
        return Gain.of(before, after, self.proof.fold[rows])

    @property
    def summary(self) -> str:
        """The verdict in one sentence, the doubtful effects, and what the rows cannot show."""
        doubtful = "; ".join(
            f"{f.name} at {', '.join(dict.fromkeys(t.where for t in f.terms))}"
            f" ({100 * f.presence:.0f} % probable)"
            for f in self.explained.doubtful
        )
        doubt = f"In doubt, and not added: {doubtful}." if doubtful else ""
        said = (_describe_findings(self), doubt, describe_unshown(self.arm, self.fit.session))
        return in_names(" ".join(filter(None, said)), self.arm.names_for_people)


def _describe_findings(found: Diagnosis) -> str:
    left = describe_structure(found.structure)
    unnamed = f" {left} and has no name." if left else ""
    before, after = (found.proof.rows[stage] for stage in found.compared_stages)
    change = f"{before.mean_text} -> {after.mean_text}"
    if before.n:  # else only orientations were measured
        change = describe_improvement(*found.believed_gains)
    which = "" if found.believed.all() else " (without the rows set aside)"
    gain = f"Held-out mean error{which} {change}"
    if found.verdict == "noise":
        rows, aside = len(found.fit.session), len(found.set_aside.rows)
        noise = "only noise is left" + (f" in {rows - aside} of {rows} rows" if aside else "")
        if found.explained.tolerance.compliance and found.written != CALIBRATED:
            text = "Every part of the arm is a little off; the model now holds this. "
            return f"{text}Beyond it {noise}. {gain}."
        return f"After calibration {noise}; no effect was added. {gain} by the calibration."
    if found.verdict == "unknown" and not found.failed and not found.causes:
        return f"The model lacks something that no effect of the library explains: {left}."
    said = [describe_finding(f) for f in found.findings]
    said += [f"without a name: {cause.sentence}" for cause in found.causes]
    text = "; ".join(said)
    if found.failed:
        text = f"The proof failed ({found.failed}): {found.written} was written. Found: {text}"
    elif found.left_out:
        text += f". A command is expected to err least with the model {found.written}, "
        text += "which was written"
    doubts = dict.fromkeys(each for cause in found.causes for each in cause.doubts)
    doubt = f" In doubt: {'; '.join(doubts)}." if doubts else ""
    return f"{text}. {gain}.{unnamed}{doubt}"
