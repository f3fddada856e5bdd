"""A diagnosis: what was found and how sure it is, or an honest "I don't know"."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.aliasing import MOST_NAMES, EffectFinding
from longarm_comp.core.identify.calibrate import Errors
from longarm_comp.core.identify.confirm import Confirmed
from longarm_comp.core.identify.discover.discovery import Discovery
from longarm_comp.core.identify.in_words import improvement, left_in_words, sentence
from longarm_comp.core.identify.minor import Minor
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.next_poses import NextPoses
from longarm_comp.core.identify.plausible import incredible
from longarm_comp.core.identify.practical import Gain
from longarm_comp.core.identify.proof import NETWORK, LearnedCorrection, Proof
from longarm_comp.core.identify.search import SearchResult
from longarm_comp.core.identify.structure import Structure
from longarm_comp.core.model.model import Model

T = TypeVar("T")
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
        return "set" if any(f.open for f in self.findings) else "named"

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
        size = incredible(found.search.fit.model)
        small = found.proof.better
        why = "is less than half of what is wrong" if small else "is not beyond chance"
        text = "Effects were found in the fitted poses but "
        text += size or f"their gain on the held-out ones {why}"
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
