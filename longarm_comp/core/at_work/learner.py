"""The learner: the model at work learns from sightings of ordinary moves.

Each sighting is an equation of the model's parameters and of the effects that it lacks
(`posterior.py`).  The model in use is the mean over all explanations, with its uncertainty.
Certain changes are reported.  If ordinary moves do not tell two explanations apart, the learner
asks for a measurement at a pose that does.
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
from longarm_comp.core.at_work.explanations import Branch, Explanations, NamedChange, name_change
from longarm_comp.core.at_work.posterior import RecursivePosterior
from longarm_comp.core.at_work.row import Row
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.compensation.sighting import (
    COMMON,
    PAYLOAD,
    SHARED,
    error_of_sighting,
    is_other_payload,
)
from longarm_comp.core.data.plan import random_joints
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.posterior.found import CREDIBLE
from longarm_comp.core.model.domain import RowDomain, least_moved
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.uncertainty import ModelUncertainty, factor_of

KNOCK = 3.0
"""Shift of a sighting, in its standard deviations, above which a change counts as a knock."""
LATELY = 20
"""Number of the last sightings of which the report says how many disagree."""
POOL = 256
"""Number of poses among which a request is chosen. Sobol points are even for powers of 2; takes
25 ms."""


@dataclass(frozen=True, eq=False)
class PoseRequest:
    """A pose at which a measurement would tell two explanations apart."""

    q: np.ndarray  # (n,) commanded joints, rad and m
    side: np.ndarray  # (n,) of +-1: the side from which each joint arrives, by a run-up
    between: tuple[str, str]  # the two effects, the likelier first

    @property
    def text(self) -> str:
        """The request in one line: ``backlash or servo_droop? measure q = 0.1 -0.3, from + -``."""
        q = " ".join(f"{value:.3f}" for value in self.q)
        side = " ".join("+" if value > 0 else "-" for value in self.side)
        return f"{' or '.join(self.between)}? measure q = {q}, from {side}"


STEP_M = 2e-3
"""Largest step by which one sighting may move the predicted tip at its own pose, m."""
DRAWN = 32
"""Number of further poses, all over the joints' ranges, at which the step of the tip is limited."""
WORTH = 0.1
"""Step of the tip, in standard deviations of a sighting, below which the model in use stays."""


@dataclass(frozen=True, eq=False)
class Version:
    """A version of the model: the given one, or the estimate when a change became certain."""

    at_s: float
    model: Model  # with its uncertainty
    named: NamedChange | None  # the change; None for the given model


@dataclass(frozen=True, eq=False)
class Learner:
    """The model at work. It never changes: `learn` returns the next one."""

    model: Model  # the model in use
    explanations: Explanations | None = None  # None before the first sighting
    versions: tuple[Version, ...] = ()  # of the model; the first is the given one
    frozen: bool = False  # whether sightings are ignored
    step_m: float = STEP_M  # largest step of the tip at the pose of one sighting, m
    sightings: int = 0  # number of sightings learned from
    doubtful: int = 0  # number of these that seem wrong and are left out
    lately: tuple[int, ...] = ()  # `doubtful` before and after each of the last `LATELY` sightings
    older: int = 1  # number of versions that are older than `explanations`
    knocked: bool = False  # whether base, tip or a measuring device has probably been knocked
    settled: Model | None = None  # the model in use before the present doubt; None without a doubt
    payload_kg: float = math.nan  # at the last sighting
    domain: RowDomain | None = None  # where the rows and the sightings were; None before the first

    @classmethod
    def of(cls, model: Model, step_m: float = STEP_M) -> Learner:
        """Make a learner that begins with a fitted model.

        Args:
            model: the model, with its uncertainty.
            step_m: largest step of the tip by one sighting, m.

        Raises:
            InputError: the model has no uncertainty.
        """
        if model.uncertainty is None:
            raise InputError("model", "uncertainty", "missing", "a model that a diagnosis wrote")
        return cls(model, versions=(Version(-math.inf, model, None),), step_m=step_m)

    @property
    def uncertainty(self) -> ModelUncertainty:
        """The uncertainty of the model in use."""
        assert self.model.uncertainty is not None
        return self.model.uncertainty

    @property
    def prior(self) -> ModelUncertainty:
        """The uncertainty of the model before any learning."""
        given = self.versions[0].model.uncertainty
        assert given is not None  # checked by `of`
        return given

    def learn(
        self,
        q: np.ndarray,
        context: Context,
        tip: np.ndarray,
        variance: np.ndarray,
        t_s: float,
        learned: np.ndarray | None = None,
    ) -> Learner:
        """Return the learner after a sighting of an arm at rest.

        Args:
            q, context, variance, learned: as in `error_of_sighting`.
            tip: (3,) m, the measured position, less the error that a predictor expects.
            t_s: time of the sighting, s, by any clock that the caller always uses.
        """
        if self.frozen:
            return self
        explanations = self.explanations or _begin_explanations(
            self.model, self.uncertainty, context
        )
        before = self.domain or self.uncertainty.domain
        promised = dataclasses.replace(self.prior, domain=before)
        domain = None if before is None else before.plus(q)
        error = error_of_sighting(self.model, promised, q, context, variance, learned)
        space, arm = explanations.space, self.model.arm
        point, columns = space.columns(self.model, q, context)
        at = space.values(self.model)
        # Error of the linear equation at the present estimate
        bent = space.at(explanations.within_bounds).measured(q, context) - point
        bent = bent - columns @ (explanations.within_bounds - at)
        row = Row(
            t_s,
            columns,
            value=tip - point + columns @ at,
            noise=error.noise + error.structure + np.outer(bent, bent),
            reach=float(np.linalg.norm(point)),
            pose=(q - arm.lower) / (arm.upper - arm.lower),
            structure=SHARED * error.structure,
            common=error.common,
            anew=(PAYLOAD,) if is_other_payload(self.payload_kg, context) else (),
        )
        taken = dataclasses.replace(self._take_in(explanations, row), domain=domain)
        served = taken._serve_mean(row, q, context)
        return dataclasses.replace(served, payload_kg=float(context.payload_kg(0.0)))

    def _take_in(self, before: Explanations, row: Row) -> Learner:
        """Return the learner after one more sighting, its model unchanged."""
        explanations = before.update(row)
        doubtful = self.doubtful + explanations.left_out - before.left_out
        older = self.older if self.explanations else len(self.versions)
        places = explanations.places
        versions = self.versions[:older]
        for v in self.versions[older:]:  # without changes that are no longer likely
            if v.named and places.get(v.named.where, 0.0) > 0.5:
                versions = (*versions, v)
        said = {v.named.where for v in versions if v.named}
        for where, chance in places.items():  # a new version where a change is now certain
            if where not in said and chance >= CREDIBLE:
                served = self._model_at(explanations, explanations.within_bounds)
                versions = (*versions, Version(row.t_s, served, name_change(explanations, where)))
        return dataclasses.replace(
            self,
            explanations=explanations,
            versions=versions,
            older=older,
            sightings=self.sightings + 1,
            doubtful=doubtful,
            lately=(*(self.lately or (self.doubtful,)), doubtful)[-LATELY - 1 :],
        )

    def _serve_mean(self, row: Row, q: np.ndarray, context: Context) -> Learner:
        """Return the learner with its model moved towards the mean over all explanations.

        The step is bounded. While the last sightings are in doubt, the model does not move.
        """
        explanations = self.explanations
        assert explanations is not None
        at = explanations.space.values(self.model)
        wanted = explanations.within_bounds - at
        step = float(np.linalg.norm(row.columns @ wanted))
        scatter = math.sqrt(float(np.trace(self.prior.noise + self.prior.structure)))
        knocked = explanations.chance_of_knock(row.columns, KNOCK * scatter) > 0.5
        in_doubt = explanations.is_disputed or explanations.chance_unexplained > 0.5 or knocked
        if step < WORTH * scatter and not (in_doubt or self.settled):
            return dataclasses.replace(self, knocked=knocked)
        share = 0.0
        if not in_doubt:
            share = self._share_of_step(
                explanations.space.at(explanations.within_bounds), q, context
            )
        return dataclasses.replace(
            self,
            model=self._model_at(explanations, at + share * wanted),
            knocked=knocked,
            settled=(self.settled or self.model) if in_doubt else None,
        )

    def _share_of_step(self, wanted: Model, q: np.ndarray, context: Context) -> float:
        """Return the share, 0 to 1, of the step to the model `wanted` that one sighting may make.

        The tip moves by at most `step_m` where it was seen, at joints q (n,).  Elsewhere it moves
        by at most `step_m` or the 90 % radius of error that the first version predicts there,
        whichever is more. (The radius of the model in use grows with every doubt.)
        """
        poses = np.concatenate([q[None], random_joints(self.model.arm, DRAWN)])
        there = _at_all(context, len(poses))
        now = self.model.tip(poses, there)
        moved = np.linalg.norm(wanted.tip(poses, there) - now, axis=1)
        bound = np.full(len(poses), self.step_m)
        far = 1 + np.flatnonzero(moved[1:] > self.step_m)
        if len(far):
            there, begun = _at_all(context, len(far)), self.versions[0].model
            miss = expected_miss(begun, poses[far], there, now[far])
            bound[far] = np.maximum(self.step_m, miss.sizes[1])
        return min(1.0, float((bound / np.maximum(moved, 1e-12)).min()))

    def _model_at(self, explanations: Explanations, values: np.ndarray) -> Model:
        """Build the model with parameter values (q,), and its uncertainty about these values."""
        model = explanations.space.at(values)
        given = self.prior
        active, covariance = explanations.covariance
        off = (explanations.within_bounds - values)[active]
        slots = [explanations.space.slots[k] for k in active]
        held = {term.key for term in model.terms}
        changed = {s.owner.key: s.owner for s in slots if isinstance(s.owner, Effect)}
        absent = {term.key: term for term in given.absent} | changed
        absent = {key: term for key, term in absent.items() if key not in held}
        kept = [k for k, s in enumerate(slots) if s.owner.key in held or s.owner.key in absent]
        left = covariance + np.outer(off, off)
        record = dataclasses.replace(
            self.uncertainty,
            slots=tuple(slots[k].identity for k in kept),
            factor=factor_of(left[np.ix_(kept, kept)]),
            structure=explanations.error_growth * (given.structure + given.noise) - given.noise,
            absent=tuple(absent.values()),
            domain=self.domain,
        )
        return dataclasses.replace(model, uncertainty=record)

    def request_pose(self, context: Context) -> PoseRequest | None:
        """Return the pose where the likeliest explanation and a rival disagree most, or None.

        Poses are drawn evenly over the ranges of the joints, in the given circumstances.  None is
        returned if there is no rival, if a single sighting would not decide between them, before
        the first sighting, and while the learner is frozen.
        """
        if self.explanations is None or self.frozen:
            return None
        first, *others = self.explanations.branches
        rivals = [b for b in others if b.weight > 1.0 - CREDIBLE and _new_effect(b, first)]
        if not rivals:
            return None
        from scipy.stats import qmc  # takes a quarter of a second

        space, arm = self.explanations.space, self.model.arm
        unit, turn = np.split(qmc.Sobol(2 * arm.n, seed=0).random(POOL), 2, axis=1)
        q, side = arm.lower + (arm.upper - arm.lower) * unit, np.where(turn < 0.5, -1.0, 1.0)
        legs = np.zeros((*q.shape, LEGS))
        legs[..., 0] = side * run_up_lengths(arm)
        came = History(side, legs, legs[..., 0]).fields()
        there = dataclasses.replace(_at_all(context, len(q)), **came)
        each = (b.posterior for b in (first, *rivals))
        likely = (
            space.most_probable(posterior.expected_values, *posterior.spread) for posterior in each
        )
        tips = [space.at(values).tip(q, there) for values in likely]
        off = np.array(tips[1:]) - tips[0]
        left = self.prior.structure_at(q, least_moved(arm))  # as `learn` takes it
        precision = np.linalg.inv(self.prior.noise + left)
        odds = 0.5 * np.einsum("rij,ijk,rik->ri", off, precision, off)
        which, best = np.unravel_index(int(odds.argmax()), odds.shape)
        if odds[which, best] < np.log(CREDIBLE / (1.0 - CREDIBLE)):
            return None
        rival = rivals[which]
        between = _new_effect(first, rival) or "no change", _new_effect(rival, first)
        return PoseRequest(q[best], side[best], between)

    @property
    def named(self) -> tuple[NamedChange, ...]:
        """The changes, in the order in which they became certain."""
        return tuple(v.named for v in self.versions if v.named is not None)

    @property
    def now(self) -> tuple[NamedChange, ...]:
        """The changes of `named`, with names and sizes as estimated now."""
        explanations = self.explanations
        if explanations is None:
            return self.named
        return tuple(
            name_change(explanations, n.where) if n.where in explanations.places else n
            for n in self.named
        )

    @property
    def disagreeing(self) -> int:
        """Number of the last `LATELY` sightings that are left out because they seem wrong."""
        return self.lately[-1] - self.lately[0] if self.lately else 0

    @property
    def unexplained(self) -> bool:
        """True if no known effect explains a change (probability 95 %): a diagnosis is needed."""
        return self.explanations is not None and self.explanations.chance_unexplained >= CREDIBLE

    def freeze(self) -> Learner:
        """Return the learner that keeps its model and ignores sightings until `thaw`."""
        return dataclasses.replace(self, frozen=True)

    def thaw(self) -> Learner:
        """Return the learner that learns again, from its model or that from before a doubt."""
        return dataclasses.replace(self._settle(self.settled or self.model), frozen=False)

    def undo(self) -> Learner:
        """Return the learner that uses the version before the last, or the given model.

        It ignores sightings until `thaw`.
        """
        kept = self.versions[:-1] or self.versions
        return dataclasses.replace(self._settle(kept[-1].model), versions=kept, frozen=True)

    def _settle(self, model: Model) -> Learner:
        """Return the learner that uses a model, without what it knows from sightings."""
        return dataclasses.replace(
            self, model=model, explanations=None, knocked=False, settled=None
        )


def _at_all(context: Context, count: int) -> Context:
    """Return the circumstances of one sighting, repeated for a number of poses."""
    columns = {name: np.full(count, value) for name, value in context.columns.items()}
    return dataclasses.replace(context, columns=columns)


def _new_effect(branch: Branch, other: Branch) -> str:
    """Return the first effect that has changed in `branch` but not in `other`, or ""."""
    theirs = {change.key for change in other.changes}
    return next((change.key[0] for change in branch.changes if change.key not in theirs), "")


def _begin_explanations(model: Model, record: ModelUncertainty, context: Context) -> Explanations:
    """Make the single explanation before any sighting: a fitted model with its uncertainty."""
    space = Parameters.of(model, context)
    fitted = [name for name in space.position if name in record.row]
    factor = record.factor[[record.row[name] for name in fitted]]
    active = np.array([space.position[name] for name in fitted], dtype=int)
    values = space.values(model)
    posterior = RecursivePosterior.begin(space, values, active, factor @ factor.T, COMMON)
    return Explanations((Branch(1.0, posterior),))
