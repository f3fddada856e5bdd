"""The model at work learns from sightings of ordinary moves.

Each sighting is an equation of the model's parameters and of all that may have changed
(`posterior.py`).  The mean over all explanations is served, and what is sure is said.  Where the
moves of the work do not tell two explanations apart, it asks for the pose that would.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import LEGS, Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.at_work.changes import Parameters
from longarm_comp.core.at_work.explanations import DOUBT, Branch, Explanations
from longarm_comp.core.at_work.posterior import RecursivePosterior, Row
from longarm_comp.core.compensation.unknown import unknown_history
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.posterior.found import CREDIBLE
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.uncertainty import ModelUncertainty, factor_of
from longarm_comp.core.yaml_file import Declared

POOL = 256
"""Poses that are looked at: a power of 2, as Sobol's points are even then; 25 ms."""


@dataclass(frozen=True, eq=False)
class Asked:
    q: np.ndarray  # (n,) commanded joints, rad and m
    side: np.ndarray  # (n,) of +-1, from which each joint arrives, by a run-up
    between: tuple[str, str]  # effects that it tells apart, the likelier first

    @property
    def text(self) -> str:
        """In one line: ``backlash or servo_droop? measure q = 0.1 -0.3, from + -``."""
        q = " ".join(f"{value:.3f}" for value in self.q)
        side = " ".join("+" if value > 0 else "-" for value in self.side)
        return f"{' or '.join(self.between)}? measure q = {q}, from {side}"


def _new(branch: Branch, other: Branch) -> str:
    """Name of an effect that has changed by one explanation and not by another, or ""."""
    theirs = {change.key for change in other.changes}
    return next((change.key[0] for change in branch.changes if change.key not in theirs), "")


def _pool(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints (N, n), even over their ranges, and sides (N, n) to arrive from."""
    from scipy.stats import qmc  # takes a quarter of a second

    unit = qmc.Sobol(2 * len(lower), seed=0).random(POOL)
    q, side = np.split(unit, 2, axis=1)
    return lower + (upper - lower) * q, np.where(side < 0.5, -1.0, 1.0)


STEP_M = 2e-3
"""Largest step of the tip by one sighting's learning, m."""
WORTH = 0.1
"""Step, in standard deviations of a sighting, from which on another model is served: less is
lost in what scatters."""


class Named(Declared):
    """What changed: a place, and the effect there that is the most probable.

    Attributes:
        since_s: time of the first sighting that shows it.
        by: (parameter, unit, how much), of those that moved.
        probability: of the effect, given that something changed there.
        rivals: other effects there that may have, with theirs.
        sightings: that it took.
    """

    effect: str
    where: str
    since_s: float
    by: tuple[tuple[str, str, float], ...]
    probability: float
    rivals: tuple[tuple[str, float], ...]
    sightings: int

    @property
    def text(self) -> str:
        """In one line: ``backlash (61 %) or servo_droop (39 %), joint 2: width +0.0031 rad``."""
        each = ((self.effect, self.probability), *self.rivals)
        names = " or ".join(f"{name} ({100 * p:.0f} %)" for name, p in each)
        by = ", ".join(f"{name} {value:+.2g} {unit}" for name, unit, value in self.by)
        return f"{names}, {self.where}: {by}"


@dataclass(frozen=True, eq=False)
class Version:
    """The model as it was served once a change was sure."""

    at_s: float
    model: Model  # with the record of how good it is
    named: Named | None  # what had changed


@dataclass(frozen=True, eq=False)
class Learner:
    """The model at work. Frozen: `seen` returns the next one."""

    model: Model  # that is served
    known: Explanations | None = None  # what is known; None before the first sighting
    versions: tuple[Version, ...] = ()  # of the model, the first as it was given
    frozen: bool = False  # whether sightings change nothing
    step_m: float = STEP_M  # largest correction of the tip by one sighting
    sightings: int = 0  # taken in
    doubtful: int = 0  # left out
    pending: tuple[Explanations, Row, float] | None = None

    @classmethod
    def of(cls, model: Model, step_m: float = STEP_M) -> Learner:
        """From a fitted model, which says how well it is known."""
        if model.uncertainty is None:
            raise InputError("model", "uncertainty", "missing", "a model that a diagnosis wrote")
        return cls(model, versions=(Version(-math.inf, model, None),), step_m=step_m)

    @property
    def record(self) -> ModelUncertainty:
        assert self.model.uncertainty is not None
        return self.model.uncertainty

    def seen(
        self, q: np.ndarray, context: Context, tip: np.ndarray, variance: np.ndarray, t_s: float
    ) -> Learner:
        """Take a sighting of an arm at rest.

        Args:
            q: (n,) commanded joints.
            context: circumstances, with the history of the joints.
            tip: (3,) m, and its variance (3,) m^2.
            t_s: when, on a clock of the caller's.
        """
        if self.frozen:
            return self
        known = self.known or _begun(self.model, self.record, context)
        point, columns = known.space.columns(self.model, q, context)
        at = known.space.values(self.model)
        (spread,), _ = unknown_history(self.model, q[None], context)
        noise = np.maximum(self.record.noise, np.diag(variance)) + np.diag(spread**2)
        noise = noise + self.record.structure
        value = tip - point + columns @ at
        row = Row(t_s, columns, value, noise, float(np.linalg.norm(point)))
        known, pending, doubtful = _judged(known, row, self.pending)
        after = dataclasses.replace(
            self, known=known, pending=pending, sightings=self.sightings + 1,
            doubtful=self.doubtful + doubtful,
        )  # fmt: skip
        if known is self.known:
            return after
        return after._named(known, t_s)._served(known, columns, at)

    def _named(self, known: Explanations, t_s: float) -> Learner:
        """With a version for every place at which something has surely changed."""
        made, said = self, {n.where for n in self.named}
        for where, chance in known.places.items():
            if where not in said and chance >= CREDIBLE:
                version = Version(t_s, self._of(known, known.expected), _name(known, where))
                made = dataclasses.replace(made, versions=(*made.versions, version))
        return made

    def _served(self, known: Explanations, columns: np.ndarray, at: np.ndarray) -> Learner:
        """Serve the mean over all explanations, in a bounded step."""
        wanted = np.clip(known.expected, *known.space.bounds) - at
        step = float(np.linalg.norm(columns @ wanted))
        if step < WORTH * math.sqrt(float(np.trace(self.record.noise + self.record.structure))):
            return self
        share = min(1.0, self.step_m / step)
        return dataclasses.replace(self, model=self._of(known, at + share * wanted))

    def _of(self, known: Explanations, values: np.ndarray) -> Model:
        model = known.space.at(values)
        active, covariance = known.covariance()
        slots = tuple(known.space.slots[k].identity for k in active)
        record = dataclasses.replace(self.record, slots=slots, factor=factor_of(covariance))
        return dataclasses.replace(model, uncertainty=record)

    def asked(self, context: Context) -> Asked | None:
        """The pose where the likeliest explanation and a rival disagree most, in circumstances.

        None where there is no rival, or none that a single sighting would decide against.
        """
        if self.known is None or self.frozen:
            return None
        first, *others = self.known.branches
        rivals = [b for b in others if b.weight > 1.0 - CREDIBLE and _new(b, first)]
        if not rivals:
            return None
        space, arm = self.known.space, self.model.arm
        q, side = _pool(arm.lower, arm.upper)
        legs = np.zeros((*q.shape, LEGS))
        legs[..., 0] = side * run_up_lengths(arm)
        there = dataclasses.replace(
            context,
            **History(side, legs).fields(),
            columns={name: np.full(len(q), value) for name, value in context.columns.items()},
        )
        tips = [space.at(b.known.expected).tip(q, there) for b in (first, *rivals)]
        off = np.array(tips[1:]) - tips[0]
        precision = np.linalg.inv(self.record.noise + self.record.structure)
        odds = 0.5 * np.einsum("rij,jk,rik->ri", off, precision, off)
        which, best = np.unravel_index(int(odds.argmax()), odds.shape)
        if odds[which, best] < np.log(CREDIBLE / (1.0 - CREDIBLE)):
            return None
        between = _new(first, rivals[which]) or "no change", _new(rivals[which], first)
        return Asked(q[best], side[best], between)

    @property
    def named(self) -> tuple[Named, ...]:
        """What changed, in the order in which it was sure."""
        return tuple(v.named for v in self.versions if v.named is not None)

    @property
    def now(self) -> tuple[Named, ...]:
        """The same, by what is known now."""
        known = self.known
        if known is None:
            return self.named
        return tuple(_name(known, n.where) if n.where in known.places else n for n in self.named)

    @property
    def unexplained(self) -> bool:
        """Whether something changed that no known effect explains: a matter of a diagnosis."""
        return self.known is not None and self.known.unexplained >= CREDIBLE

    def freeze(self) -> Learner:
        """Serve what is served now, whatever is seen."""
        return dataclasses.replace(self, frozen=True)

    def thaw(self) -> Learner:
        """Learn on, from what is served."""
        return dataclasses.replace(self, frozen=False, known=None, pending=None)

    def undo(self) -> Learner:
        """Serve the version before the last, and learn no more until told."""
        kept = self.versions[:-1] or self.versions
        return dataclasses.replace(
            self, model=kept[-1].model, versions=kept, known=None, pending=None, frozen=True
        )


def _name(known: Explanations, where: str) -> Named:
    here = [(b, c) for b in known.branches for c in b.changes if c.where == where]
    whole = sum(b.weight for b, _ in here)
    chances: dict[str, float] = {}
    for branch, change in here:
        name = change.key[0]
        chances[name] = chances.get(name, 0.0) + branch.weight / whole
    first, *others = sorted(chances, key=lambda name: -chances[name])
    branch, change = next((b, c) for b, c in here if c.key[0] == first)
    space = branch.known.space
    places = space.own(space.keys.index(change.key))
    moved = branch.known.expected[places] - np.array(change.before)
    parameters = (space.slots[k].parameter for k in places)
    by = ((p.name, p.unit, float(v)) for p, v in zip(parameters, moved, strict=True) if v)
    return Named(
        effect=first, where=where, since_s=change.since_s, by=tuple(by),
        probability=chances[first], rivals=tuple((name, chances[name]) for name in others),
        sightings=change.sightings,
    )  # fmt: skip


def _begun(model: Model, record: ModelUncertainty, context: Context) -> Explanations:
    """What a fitted model's record says."""
    space = Parameters.of(model, context)
    held = [name for name in space.position if name in record.row]
    factor = record.factor[[record.row[name] for name in held]]
    active = np.array([space.position[name] for name in held], dtype=int)
    known = RecursivePosterior.begun(space, space.values(model), active, factor @ factor.T)
    return Explanations((Branch(1.0, known),))


def _judged(
    known: Explanations, row: Row, pending: tuple[Explanations, Row, float] | None
) -> tuple[Explanations, tuple[Explanations, Row, float] | None, bool]:
    """Take a row in, unless it is doubtful; the one before, if that was doubtful, with it."""
    after = known.seen(row)
    doubt = _doubtful(known, row)
    if pending is not None:
        before, held, held_doubt = pending
        both = before.seen(held)
        together = both.seen(row)
        if both.log_likelihood + together.log_likelihood > held_doubt + max(
            after.log_likelihood, doubt
        ):
            return together, None, False
    if doubt > after.log_likelihood:
        return known, (known, row, doubt), pending is not None
    return after, None, pending is not None


def _doubtful(known: Explanations, row: Row) -> float:
    """Log likelihood of a sighting of anything around, with its prior odds."""
    off = row.value - row.columns @ known.expected
    square = float(off @ off) / row.reach**2
    return math.log(DOUBT) - 0.5 * square - 1.5 * math.log(2.0 * math.pi * row.reach**2)
