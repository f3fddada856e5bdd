"""A model: the declared arm and a list of effects.  It predicts the tip and explains errors.

To predict, the effects' twists are composed inside the chain, in passes, so that every effect
uses the loads of the sagged arm (Eq. 1-4).  To explain, Eq. (5) is applied to the change of twist
per unit of a parameter.  This module names no effect.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import PLACEMENT, Chain, Posture, Twists
from longarm_comp.core.arm.spatial import Frame, Scalar, Vec
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.slots import Slot as Slot  # importers find both here
from longarm_comp.core.model.slots import slots_of as slots_of
from longarm_comp.core.model.tip_motion import Reseen, TipMotion, TwistChange, move_tip, stack
from longarm_comp.core.model.uncertainty import ModelUncertainty


@dataclass(frozen=True)
class Model:
    """An arm with its effects and the biases of what measures it.

    Attributes:
        arm: as declared.
        effects: arm side, in any order.
        biases: measuring side, applied in order. They never change a joint command.
        passes: load passes (1 leaves 0.14 mm at 18 mm of sag, 2 leave 0.001; docs/physics.md).
        elements_per_beam: number of elements of each beam.
        arrivals: per commanded joint, number of fitted rows that arrived from above (-1) and
            from below (+1); empty if not recorded.
        row_legs: per commanded joint, the distance (rad, m) since its last reversal that 75 % of
            the fitted rows reach; 0 if not recorded; empty if recorded for no joint.
        tolerances: share of the drawing's tolerances by which the geometry may be wrong; below 1
            if other arms of the kind are known.
        beyond: (identity of a parameter, factor) for each prior that a fit made wider or narrower,
            such as geometry beyond its tolerance. Each fit finds them anew; they are not saved.
        uncertainty: how far its tip may be from the true tip; None if that is not known.
        ended_s: time (s) on its session's clock when the session ended; None if not known.
        frame_shift: mean shift (m) of the fitted rows by the biases: the frame of the measurements
            is off the arm's own frame by this much.
        chain: the arm's stations; made from `arm` and `elements_per_beam`, never given.
    """

    arm: Arm
    effects: tuple[Effect, ...] = ()
    biases: tuple[Bias, ...] = ()
    passes: int = 3
    elements_per_beam: int = 2
    arrivals: tuple[tuple[int, int], ...] = ()
    row_legs: tuple[float, ...] = ()
    tolerances: float = 1.0
    beyond: tuple[tuple[tuple[object, ...], float], ...] = field(default=(), compare=False)
    uncertainty: ModelUncertainty | None = field(default=None, compare=False)
    ended_s: float | None = field(default=None, compare=False)
    frame_shift: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), compare=False)
    chain: Chain = field(default=None, compare=False)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        known = self.chain  # of the model that this one is a changed copy of
        if known is None or known.arm is not self.arm or known.cuts != self.elements_per_beam:
            object.__setattr__(self, "chain", Chain(self.arm, self.elements_per_beam))

    def __repr__(self) -> str:
        counts = Counter(term.name for term in self.terms)
        held = (f"{count} {name}" if count > 1 else name for name, count in counts.items())
        beams = len(self.arm.links)
        left_out = beams and not any(term.bends_beams for term in self.effects)
        rest = f"; {beams} declared beams left out, see la.declared_model" if left_out else ""
        return f"Model({self.arm.name}: {', '.join(held) or 'rigid'}{rest})"

    def __getstate__(self) -> dict[str, object]:
        """State for copies and other processes, without compiled programs."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}

    @property
    def terms(self) -> tuple[Effect | Bias, ...]:
        """Effects, then biases."""
        return self.effects + self.biases

    @cached_property
    def slots(self) -> tuple[Slot, ...]:
        """All free parameters, in the order of `values` and of the columns."""
        beyond, made = dict(self.beyond), []
        for slot in slots_of(self.arm, self.terms):
            p, owner = slot.parameter, slot.owner
            share = beyond.get(slot.identity, 1.0) if beyond else 1.0
            if owner.geometry and not owner.passing and not p.unknown:
                share *= self.tolerances
            if share != 1.0:
                p = dataclasses.replace(p, prior=p.prior * share)
                slot = dataclasses.replace(slot, parameter=p)
            made.append(slot)
        return tuple(made)

    def uncertain_slots(self, known: ModelUncertainty) -> tuple[Slot, ...]:
        """Return the arm's parameters that an uncertainty covers, absent effects included."""
        held = {term.key for term in self.effects}
        slots = (*self.slots, *slots_of(self.arm, [t for t in known.absent if t.key not in held]))
        return tuple(s for s in slots if isinstance(s.owner, Effect) and s.identity in known.row)

    @cached_property
    def values(self) -> np.ndarray:
        """Parameter values, (p,)."""
        return np.array([s.value for s in self.slots], dtype=float)

    @cached_property
    def rigid(self) -> Model:
        """The model without deflection: its calibrated geometry alone."""
        return self._keep(lambda term: isinstance(term, Bias) or term.geometry)

    @cached_property
    def commandable(self) -> Model:
        """The model without effects that no command can correct, such as a servo's rounding."""
        return self._keep(lambda term: isinstance(term, Bias) or term.continuous)

    @cached_property
    def memo(self) -> dict[str, Any]:
        """A cache, by name, for results that other modules derive from this model."""
        return {}

    def with_values(self, values: np.ndarray) -> Model:
        """Return a copy with other parameter values, (p,)."""
        changes: list[dict[str, float]] = [{} for _ in self.terms]
        for slot, value in zip(self.slots, values, strict=True):
            changes[slot.term][slot.parameter.name] = float(value)
        return self.with_terms(
            [t.with_values(c) if c else t for t, c in zip(self.terms, changes, strict=True)]
        )

    def with_missing(self, terms: Iterable[Effect | Bias]) -> Model:
        """Return a copy with those of the terms whose name and place it lacks, each once."""
        held = {(t.name, t.where): t for t in self.terms}
        known = len(held)
        for term in terms:
            held.setdefault((term.name, term.where), term)
        return self.plus(*list(held.values())[known:])

    def lasting(self) -> Model:
        """Return a copy without facts of one session, such as the place of a touched point."""
        return self._keep(lambda term: not term.passing)

    def without(self, places: Container[tuple[str, str]]) -> Model:
        """Return a copy without its terms at some places (`Effect.key`)."""
        return self.with_terms([t for t in self.terms if t.key not in places])

    def with_terms(self, terms: Sequence[Effect | Bias]) -> Model:
        """Return a copy with these terms and no others."""
        return dataclasses.replace(
            self,
            effects=tuple(t for t in terms if isinstance(t, Effect)),
            biases=tuple(t for t in terms if isinstance(t, Bias)),
        )

    def plus(self, *terms: Effect | Bias) -> Model:
        """Return a copy with further terms."""
        return self.with_terms([*self.terms, *terms])

    def told_by(self, context: Context) -> Model:
        """Return the model without the terms that need a circumstance that the context lacks."""
        return self._keep(lambda term: not term.missing(context))

    def _keep(self, wanted: Callable[[Effect | Bias], bool]) -> Model:
        """Return the model with the wanted terms only: itself if it holds no other."""
        kept = [term for term in self.terms if wanted(term)]
        return self if len(kept) == len(self.terms) else self.with_terms(kept)

    def posture(self, q: Sequence[Scalar], context: Context | None = None) -> Posture:
        """Return the loaded, deflected arm at q (n scalars, each a float or (N,)).

        Raises InputError for another number of joints.
        """
        if len(q) != self.arm.n:
            allowed = f"{self.arm.n}: {', '.join(self.arm.joint_names)}"
            raise InputError(f"model of {self.arm.name}", "q", f"{len(q)} joint values", allowed)
        context = context or Context()
        return self._pass_loads(self.posture_without_sag(q, context), self.load_passes)

    def posture_near(self, known: Posture, close: bool = False) -> Posture:
        """Return the posture at the joints and circumstances of a similar model's posture.

        To start from its loads saves one load pass.

        Args:
            close: the models differ so little that one load pass is enough.
        """
        if any(e.changes_loads for e in self.effects):
            known = self._weigh_masses(known)
        return self._pass_loads(known, 1 if close else max(self.load_passes - 1, 1))

    def _weigh_masses(self, posture: Posture) -> Posture:
        """Return a posture with the same frames, under this model's gravity and masses."""
        gravity: Vec = self.arm.gravity_mps2  # in the frame of the measurements
        for effect in self.effects:
            gravity = effect.gravity(gravity)
        home = self.arm.base.frame()
        for twists in self._list_placements(posture.context):
            turn = spatial.exp_large(twists[PLACEMENT])
            gravity = home.rotate(turn.rotate(home.unrotate(gravity)))
        bare = dataclasses.replace(posture, gravity=gravity, extra=())
        extra = tuple(mass for effect in self.effects for mass in effect.masses(bare))
        return dataclasses.replace(bare, extra=extra) if extra else bare

    def _list_placements(self, context: Context) -> list[Twists]:
        """Return the twists of the effects that place the base."""
        bare = self.posture_without_frames((), context)
        return [effect.twists(bare) for effect in self.effects if effect.seen_only]

    def _pass_loads(self, posture: Posture, passes: int) -> Posture:
        for _ in range(passes):
            known = posture.of_lengths if posture.chain is self.chain else None
            twists = self.twists(posture)
            posture = self.posture_with_twists(posture.q, posture.context, twists, known)
        return posture

    @property
    def load_passes(self) -> int:
        """The number of load passes: 1 if no effect depends on loads, 0 if there is no effect."""
        return self.passes if any(e.loaded for e in self.effects) else min(1, len(self.effects))

    def posture_without_sag(self, q: Sequence[Scalar], context: Context) -> Posture:
        """Return the arm at q with its base placed, but no other effect; load passes begin here."""
        placed = spatial.sum_twists(self._list_placements(context))
        return self.posture_with_twists(q, context, placed)

    def posture_without_frames(self, q: Sequence[Scalar], context: Context) -> Posture:
        """Return the joints at q without frames and loads, for effects that depend on neither."""
        return Posture(self.chain, tuple(q), context, [], [], self.arm.gravity_mps2)

    def posture_with_twists(
        self,
        q: Sequence[Scalar],
        context: Context,
        twists: Twists,
        of_lengths: dict[str, Any] | None = None,
    ) -> Posture:
        """Return the arm at q with given twists (by station), and its loads."""
        placed, gravity = self.chain.place(q, twists), self.arm.gravity_mps2
        known = {} if of_lengths is None else of_lengths
        bare = Posture(self.chain, tuple(q), context, *placed, gravity, twists, of_lengths=known)
        return self._weigh_masses(bare)

    def twists(self, posture: Posture) -> Twists:
        """Return the sum of all effects' twists, by station."""
        return spatial.sum_twists(effect.twists(posture) for effect in self.effects)

    def tip_frame(self, posture: Posture) -> Frame:
        """Return the pose of the tip in the base frame.

        If the context names a marker, the position is that of the marker.
        """
        tip = self.arm.tip
        frame = posture.frames[posture.spot()] @ tip.pose()
        if not self.arm.markers or "marker" not in posture.context.labels:
            return frame
        p: Vec = spatial.ZERO
        for name, marker in self.arm.markers.items():
            mine = posture.context.is_label("marker", name)
            at = posture.frames[posture.spot(name)].transform(marker.position_m)
            p = spatial.add(p, spatial.scale(mine, at))
        return frame._replace(p=p)

    def seen(self, point: Vec, context: Context, kind: str = "position") -> Vec:
        """Return a point as a sensor of that kind of measurement reports it, with its biases."""
        for bias in self.biases:
            if kind in bias.sees:
                point = bias.seen(point, context, self.arm)
        return point

    def seen_axes(self, tip: Frame, context: Context) -> Frame:
        """Return the tip with its axes as a sensor of poses reports them, of any length."""
        for bias in self.biases:
            if "orientation" in bias.sees:
                tip = bias.seen_pose(tip, context, self.arm)
        return tip

    def read(self, value: Scalar, row: int) -> Scalar:
        """Return what the encoder of a DH row reads when the joint is at a value (rad or m)."""
        for bias in self.biases:
            value = bias.read(value, row)
        return value

    def tip(self, q: np.ndarray, context: Context | None = None) -> np.ndarray:
        """Return the predicted true tip position (..., 3), m, base frame, at q (..., n)."""
        return stack(self.tip_frame(self.posture(unstack(q), context)).p)

    def pose(self, q: np.ndarray, context: Context | None = None) -> np.ndarray:
        """Return the predicted true tip pose (..., 4, 4), base frame, at q (..., n)."""
        return self.tip_frame(self.posture(unstack(q), context)).matrix()

    def measured(self, q: np.ndarray, context: Context | None = None) -> np.ndarray:
        """Return the predicted position measurement (..., 3), m, biases included, at q (..., n)."""
        return self.measured_at(self.posture(unstack(q), context))

    def measured_at(self, posture: Posture) -> np.ndarray:
        return stack(self.seen(self.tip_frame(posture).p, posture.context))

    def columns(
        self, posture: Posture, slots: Sequence[Slot] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the predicted position measurement and its derivative by every parameter.

        Args:
            posture: the arm at N poses.
            slots: the parameters; all of them by default.

        Returns:
            Points (N, 3) in m and columns (N, 3, p), by Eq. (5) with fixed frames: exact at zero
            effect, within a few percent at large ones.
        """
        return self.motion(posture, slots).point()

    def motion(
        self, posture: Posture, slots: Sequence[Slot] | None = None, turns: bool = False
    ) -> TipMotion:
        """Return the tip at N postures and its motion per unit of every parameter, as `columns`.

        Args:
            turns: compute the rotation of the tip's axes too.
        """
        ends = self.list_changes(posture, self.slots if slots is None else slots)
        return self._move_tip(posture, ends, turns)

    def list_changes(self, posture: Posture, slots: Sequence[Slot]) -> list[TwistChange | Reseen]:
        """Return the change at a posture per unit of each parameter, by central differences."""
        ends: list[TwistChange | Reseen] = []
        for slot in slots:
            term, per = slot.owner, 0.5 / slot.step
            if isinstance(term, Bias):
                raised, lowered = (self._with_changed(term, end) for end in slot.ends)
                ends.append(Reseen(raised, lowered, per, term.sees))
            elif term.changes_loads:
                ends.append(self._change_of_loads(slot, posture))
            else:
                up, down = ([(term, end.twists(posture))] for end in slot.ends)
                ends.append(TwistChange(up, down, per))
        return ends

    def motion_with(
        self, posture: Posture, terms: Sequence[Effect | Bias], turns: bool = False
    ) -> TipMotion:
        """Return the tip and its motion by each of some terms outside the model.

        To first order, by Eq. (5). It is meant for terms without free parameters.
        """
        ends = [
            Reseen(self.plus(term), self, 1.0, term.sees)
            if isinstance(term, Bias)
            else TwistChange([(term, term.twists(posture))], [], 1.0)
            for term in terms
        ]
        return self._move_tip(posture, ends, turns)

    def _move_tip(
        self, posture: Posture, ends: Sequence[TwistChange | Reseen], turns: bool
    ) -> TipMotion:
        tip = self.tip_frame(posture)
        arm_side = [e for e in ends if isinstance(e, TwistChange)]
        shifts = iter(move_tip(posture, tip.p, arm_side, turns))
        changes = [next(shifts) if isinstance(e, TwistChange) else e for e in ends]
        return TipMotion(self, posture, tip, changes, arm_side)

    def _change_of_loads(self, slot: Slot, posture: Posture) -> TwistChange:
        """Return the change of load-dependent twists by a parameter that changes the loads."""
        if not any(term is slot.owner for term in self.terms):  # the change from no such load
            none = {p.name: 0.0 for p in slot.owner.parameters(self.arm)}
            slot = dataclasses.replace(slot, owner=slot.owner.with_values(none))
        model = self._with_changed(slot.owner, slot.ends[0])
        raised, here = (
            [(e, e.twists(at)) for e in of.effects if e.loaded or e.changes_loads]
            for of, at in ((model, model._weigh_masses(posture)), (self, posture))
        )
        return TwistChange(raised, here, 1.0 / slot.step)

    def _with_changed(self, term: Effect | Bias, to: Effect | Bias) -> Model:
        """Return a copy with a term changed, which is added if the model does not hold it."""
        if all(t is not term for t in self.terms):
            return self.plus(to)
        return self.with_terms([to if t is term else t for t in self.terms])


def unstack(q: np.ndarray) -> tuple[Scalar, ...]:
    """Split (n,) into n floats, (N, n) into n arrays of (N,)."""
    joints = np.moveaxis(np.atleast_1d(np.asarray(q, dtype=float)), -1, 0)
    return tuple(np.ascontiguousarray(v) if v.ndim else float(v) for v in joints)
