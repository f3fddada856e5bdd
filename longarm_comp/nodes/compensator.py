"""Computes the answer to one target, and compiles in advance what the next target needs."""

from collections.abc import Hashable
from dataclasses import replace
from functools import partial

import numpy as np
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Header

from longarm_comp.core.arm.frame_tree import UnknownPlace, carry_place
from longarm_comp.core.compensation.arrive import compensate_move
from longarm_comp.core.compensation.compensate import physics_of
from longarm_comp.core.compensation.online import StaleContext, check_inside
from longarm_comp.core.compensation.result import CompensationOptions, Method, Status
from longarm_comp.core.compensation.target_frame import MEASURED
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.ik.codegen import Compiled
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import describe_entry, most_motion
from longarm_comp.nodes.answers import Answer, Refusal, TargetRequest, target_of
from longarm_comp.nodes.arm_state import MAX_CORRECTION, ArmState
from longarm_comp.nodes.clock import stamp_ns, steady_timer
from longarm_comp.nodes.frames import FrameListener, prefix_of
from longarm_comp.nodes.health import OK, WARN, Report, Twins
from longarm_comp.nodes.messages import joints_message, joints_of, pose_message
from longarm_comp.nodes.params import Param

PARAMS = (
    Param(
        "method", "both", "what is compensated", choices=tuple(m.value for m in Method), live=True
    ),
    Param("single_pass", False, "correct once, as in the paper", live=True),
    Param("tolerance_m", 1e-5, "the passes end at a smaller change of the error", 1e-9, 0.01),
    Param("max_passes", 10, "pseudo-target passes permitted", 1, 100),
    MAX_CORRECTION,
    Param("run_up", True, "joints make a run-up if the model needs their side", live=True),
    Param("realisable", True, "choose joints among the servo steps of arm.yaml", live=True),
)


class Compensator:
    """Computes the answers to requests, one at a time."""

    def __init__(self, state: ArmState, twins: Twins, frames: FrameListener) -> None:
        self._node, self._files, self._state = state.node, state.files, state
        self._twins = twins
        self._declared = declared_model(state.arm)
        self._frames = frames
        self._base_frame = state.base_frame
        self._measured = prefix_of(state.node) + MEASURED

    def kind(self) -> Hashable:
        """Return a key that changes whenever targets need newly compiled programs.

        Raises:
            StaleContext: a circumstance that the model needs is not known.
        """
        loaded, options = self._files.loaded, self._read_options()
        now = self._state.context(model=physics_of(loaded.model, options.method))
        known = tuple(sorted(now.columns))
        asked = (options.method, options.run_up, options.realisable)
        return loaded.file_hash, loaded.learned, *asked, known

    def rehearse(self) -> None:
        """Compute the target at the middle of the joint ranges, to compile what targets need."""
        if not self._state.driver.acknowledged:  # the times of its orders need it
            most_motion(self._files.loaded.model.commandable)
        mid = self._files.arm.mid
        seed = joints_message(self._files.arm, mid)
        frame = Header(frame_id=self._base_frame)
        target = PoseStamped(header=frame, pose=pose_message(self._files.rigid.pose(mid)))
        self.answer(TargetRequest("", target, False, 0.0, execute=False, seed=seed))

    def answer(self, target: TargetRequest) -> Answer:
        """Compute a target; return its answer, which may be a refusal."""
        try:
            return self._compensate_target(target)
        except Refusal as refusal:
            return self.refuse(target, refusal.status, str(refusal))
        except StaleContext as error:
            return self.refuse(target, Status.STALE_CONTEXT, str(error))
        except InputError as error:
            return self.refuse(target, Status.BAD_TARGET, str(error))
        except Exception as error:
            self._node.health.fault(error)
            text = f"{type(error).__name__}: {error}"
            return self.refuse(target, Status.INTERNAL_ERROR, text)

    def refuse(self, target: TargetRequest, status: Status, reason: str) -> Answer:
        """Make the answer to a target that is refused before any computation."""
        method = self._read_options(target.method).method.value
        return Answer(target, status, reason, method, self._files.loaded.file_hash)

    def _compensate_target(self, target: TargetRequest) -> Answer:
        given, place = self._in_base(target)
        options = self._read_options(target.method)
        start, seed = self._find_start(target)
        if target.execute and (why := self._twins.refusal or self._state.driver.refusal):
            raise Refusal(Status.NO_DRIVER, f"not sent: {why}")
        if target.execute and (why := self._state.worker.failing):
            raise Refusal(Status.NOT_READY, f"not sent: {why}")
        if why := self._files.refusal:
            raise Refusal(Status.NOT_READY, why)
        loaded = self._files.loaded
        stands, model = loaded.stands, loaded.model
        if not self._frames.hangs_on(target.pose.header.frame_id, self._measured):
            model = stands.promising(model)
        compensate = partial(
            compensate_move,
            model,
            target=stands.carry_to_model(place),
            start=start,
            seed=seed,
            history=self._state.driver.history,
            position_only=target.position_only,
            context_after=self._state.circumstances(physics_of(loaded.model, options.method)),
            options=options,
        )
        arrival, used, why = self._state.predictor.compensate_with(options.method, compensate)
        arrival = replace(arrival, outcome=stands.carry_back(arrival.outcome))
        outcome = arrival.outcome
        status, reason = outcome.status, outcome.reason
        if status is Status.NO_PREDICTOR:
            reason += f": {why}"
        if outcome.success:
            path = np.vstack([start, arrival.move.points])
            entry = describe_entry(self._declared, path)
            status, reason = (Status.KEPT_OUT, entry) if entry else (status, reason)
        in_base, method = replace(target, pose=given), options.method.value
        return Answer(in_base, status, reason, method, loaded.file_hash, used, arrival)

    def _in_base(self, target: TargetRequest) -> tuple[PoseStamped, np.ndarray]:
        """Return the target in the base frame, as a message and as (4, 4) or (3,), m."""
        place, header = target_of(target.pose, target.position_only), target.pose.header
        if header.frame_id in (self._base_frame, self._state.p["base_frame"]):
            return target.pose, place
        try:
            frame = self._frames.place(header.frame_id, self._base_frame, stamp_ns(header.stamp))
        except UnknownPlace as error:
            allowed = f"allowed: {self._base_frame!r}, and what tf connects with it"
            raise Refusal(Status.BAD_FRAME, f"{error}; {allowed}") from None
        place = carry_place(frame, place)
        moved = Header(stamp=header.stamp, frame_id=self._base_frame)
        return PoseStamped(header=moved, pose=pose_message(place)), place

    def _read_options(self, method: str = "") -> CompensationOptions:
        value, p = lambda name: self._node.get_parameter(name).value, self._state.p
        return CompensationOptions(
            Method(method or value("method")),
            run_up=bool(value("run_up")),
            realisable=bool(value("realisable")),
            single_pass=bool(value("single_pass")),
            tol_m=p["tolerance_m"],
            max_passes=p["max_passes"],
            max_correction_m=p["max_correction_m"] or None,
        )

    def _find_start(self, target: TargetRequest) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the joints (n,), rad and m, where the move starts, and the seed of the search.

        A move that is executed starts at the present joints. One that is only computed starts at
        the seed, if the target has one.
        """
        seed = None
        if target.seed.name:
            seed = joints_of(target.seed, self._files.arm, "seed")
            check_inside(seed, self._files.arm, "seed")
        if seed is not None and not target.execute:
            return seed, seed
        doubt, q = self._state.doubt, self._state.joints
        if doubt or q is None:
            raise Refusal(Status.NOT_READY, doubt)
        return q, seed


class Readiness:
    """Compiles, on the worker and between targets, the programs that the next target needs.

    A new model, another method, or a circumstance received for the first time needs new ones.
    """

    def __init__(self, state: ArmState, compute: Compensator) -> None:
        self._worker, self._compute, self._predictor = state.worker, compute, state.predictor
        self._compiled = state.p["compiled"]
        self._prepared: Hashable = None
        self._probed = False
        steady_timer(state.node, 0.25, self.look)
        self.look()

    def look(self) -> None:
        """Let the worker prepare whatever the next target needs that is not ready yet."""
        if self._programs_needed()[0] != self._prepared or not self._predictor.answers:
            self._worker.submit_once(self._prepare_programs)

    def _programs_needed(self) -> tuple[Hashable, str]:
        """Return the key of the programs that the next target needs.

        While a circumstance is unknown, it is the last key; the second value then says why.
        """
        try:
            return (self._compute.kind() if self._compiled else "not compiled"), ""
        except StaleContext as unknown:
            return self._prepared, str(unknown)

    def _prepare_programs(self) -> None:
        needed, _ = self._programs_needed()
        try:
            self._predictor.probe()
            self._probed = True
            if needed != self._prepared and self._compiled:
                with ik.compile_at_once():
                    self._compute.rehearse()
        finally:
            self._prepared = needed  # also after a fault, which every target would repeat

    def report(self) -> Report:
        """Report whether the next target will take its usual time."""
        facts = {"programs compiled": Compiled.programs}
        needed, unknown = self._programs_needed()
        if unknown:
            return Report(WARN, unknown, facts)
        if not self._probed or needed != self._prepared:
            return Report(WARN, "getting ready", facts)
        return Report(OK, "ready", facts)
