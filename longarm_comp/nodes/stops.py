"""The driver's services `~/estop`, `~/hold` and `~/reset`, which work in every lifecycle state."""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from typing import Protocol

from rclpy.node import Node

from longarm_comp.core.errors import InputError, JobError, LongarmError
from longarm_comp.devices.follower_report import EventKind, FollowerState
from longarm_comp.devices.kept_turns import KeptTurns
from longarm_comp.devices.servo_arm import ServoArm
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_watch import JointFault, ServoTrouble
from longarm_comp.devices.state_folder import state_folder
from longarm_comp.devices.stop_latch import Stop, StopLatch
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import sleepless_s, steady_timer
from longarm_comp.nodes.messages import driver_words
from longarm_comp.nodes.orders import Freshness
from longarm_comp.nodes.params import Param, where
from longarm_comp.nodes.worker import Asked, Together
from longarm_interfaces.msg import DriverState

PARAMS = (Param("state", "", "folder that keeps stops until they are reset; empty: the user's"),)

_MOMENT_S = 0.005
"""Longest time, s, by which the disk may delay what the servos are sent. It mostly takes 1 ms."""
_LOOK_S = 0.02
"""Time, s, between two looks whether the disk has kept a stop that is not answered yet."""
_STANDS_S = 1.0
"""Shortest time, s, for which a stop stands. What was sent before it arrives meanwhile, and is
refused, also if the sender's clock is ahead."""
_SWITCHED_OFF = {ServoTrouble.SILENT, ServoTrouble.SUPPLY}
"""Troubles that come of switching the servos' power off: their faults end with the process. All
others are kept for the next one, because to start a driver again must end no fault."""

_ENDS: dict[graph.Service, tuple[frozenset[Stop], frozenset[FollowerState]]] = {
    graph.ESTOP: (frozenset({Stop.ESTOP}), frozenset({FollowerState.ESTOP})),
    graph.HOLD: (frozenset({Stop.HOLD}), frozenset()),
    graph.RESET: (frozenset(Stop), frozenset({FollowerState.ESTOP, FollowerState.FAULT})),
}
"""By service: the stops that a request to go on ends, and the states of the arm that it ends."""


class Stoppable(Protocol):
    """The part of `servo_driver` that `Stops` uses."""

    @property
    def arm(self) -> ServoArm | None: ...
    @property
    def active(self) -> bool: ...
    @property
    def state(self) -> tuple[int, str]: ...
    def tell_state(self) -> None: ...


class Stops:
    """Stops the arm and lets it go on. A stop also remains in force for the driver's next process.

    While a stop is in force, the driver switches no torque on and accepts no trajectory.

    Args:
        folder: folder that keeps stops, an absolute path; empty: the user's.
        arm: path of arm.yaml; empty if not known.
        fresh: the limit on the age of requests that end a stop.
    """

    def __init__(
        self,
        node: Node,
        site: Stoppable,
        folder: str,
        arm: str,
        servos: ServoConfig,
        fresh: Freshness,
    ) -> None:
        kept = state_folder(folder)
        if not kept.is_absolute():  # from another working folder a stop would not be found
            raise InputError(where(node), "state", folder, "an absolute path")
        self._site, self._servos = site, servos
        self.made = 0  # stops, and ends of them
        self._was_on = False  # the torque, when the emergency stop was asked for
        self._turns = KeptTurns(kept, arm, servos.bus.port, servos.ids)
        self._latch = StopLatch(kept, node.get_namespace(), arm, servos.bus.port)
        if self.standing:
            node.get_logger().warning(self._latch.words)
        self._owed = self.estop  # torque must still go off, while there is no `ServoArm` to do it
        steady_timer(node, 0.5, self._try_again)
        self._fresh, self._stopped = fresh, -math.inf  # when a stop was last answered
        self._unanswered: list[Asked] = []  # requests to stop, until the disk has kept the stop
        steady_timer(node, _LOOK_S, self._answer_stopped)
        Together(node, (graph.ESTOP, graph.HOLD, graph.RESET), self.serve)

    def serve(self, waiting: Sequence[Asked]) -> None:
        """Serve all waiting requests, those to stop first: `_end` refuses what was sent before."""
        with ExitStack() as served:  # runs all, last in first out, even if one raises
            served.callback(self._answer_stopped)
            for asked in sorted(waiting, key=_is_end, reverse=True):
                served.callback(self._try_to_end if _is_end(asked) else self._stop, asked)

    def _try_to_end(self, asked: Asked) -> None:
        _answer(asked, self._end)

    def _stop(self, asked: Asked) -> None:
        """Stop the arm and save the stop; `_answer_stopped` answers."""
        arm = self._site.arm
        self._unanswered.append(asked)
        try:
            if asked.service is graph.ESTOP:
                if not self.estop:
                    self._was_on = arm is not None and arm.powered
                self._latch.ask(Stop.ESTOP)
                try:  # first, so that a process that is killed now has not forgotten it
                    self._latch.mark(_MOMENT_S)
                finally:
                    self.let_go()
            else:
                self._hold()
            self._latch.keep(_MOMENT_S)
        finally:
            self.begin_anew()

    def _hold(self, why: str = "") -> None:
        arm = self._site.arm
        if arm is not None and Stop.HOLD not in self._latch.standing:
            arm.follower.break_off(EventKind.HELD, "held: it stays where it is")
        self._latch.ask(Stop.HOLD, why)

    def _answer_stopped(self) -> None:
        """Answer the requests to stop, once the disk has kept the stop or hangs."""
        if self._unanswered and not self._latch.writing:
            asked, self._unanswered = self._unanswered, []
            self._stopped = sleepless_s()
            with ExitStack() as answers:
                for one in asked:
                    answers.callback(_answer, one, self._describe_stopped)

    def _describe_stopped(self, asked: Asked) -> str:
        """Return what was done to stop the arm, or the state if a part was not."""
        stop, done = Stop.HOLD, "held: torque on, trajectories refused"
        if asked.service is graph.ESTOP:
            stop, done = Stop.ESTOP, "torque off, commands refused"
        torque = self._torque_yet(stop)
        said = self.state[1] if torque or self.unkept else done
        if torque and stop is Stop.ESTOP:
            raise JobError(said)
        return said

    def begin_anew(self) -> None:
        """Tell at once that the arm was stopped, or goes on; orders from before are refused."""
        self._fresh.begin_anew()
        self.made += 1
        self._site.tell_state()

    def _end(self, asked: Asked) -> str:
        """End the stops that the request names; return the driver's state.

        Refused if it may have been sent before a stop (its sender did not know of the stop), or was
        sent too long ago.
        """
        waited_s = self._fresh.waited_s(asked.sent_ns)
        if self._unanswered or sleepless_s() - waited_s <= self._stopped + _STANDS_S:
            when = f"after this was asked, or less than {_STANDS_S:g} s before"
            raise JobError(f"a stop came {when}: ask again")
        if waited_s > self._fresh.max_age_s:
            allowed = f"allowed {self._fresh.max_age_s:g} s"
            raise JobError(f"this was asked {waited_s:.1f} s ago, {allowed}: ask again")
        self._end_stops(*_ENDS[asked.service])
        state, why = self._site.state
        return why or driver_words(state)

    @property
    def standing(self) -> str:
        """The reason why the arm is stopped or held; empty if it is not."""
        return self._latch.words

    @property
    def estop(self) -> bool:
        """True while an emergency stop is in force."""
        return Stop.ESTOP in self._latch.standing

    @property
    def unkept(self) -> bool:
        """True if a stop could not be saved, so that it ends with this process."""
        return bool(self._latch.trouble)

    @property
    def state(self) -> tuple[int, str]:
        """The driver's state while a stop is in force, and why: ESTOP, else FAULT, else HOLDING."""
        torque = self.owed or ("torque is off" if self.estop else self._torque_yet(Stop.HOLD))
        why = "; ".join(filter(None, (self.standing, torque)))
        if self.estop:
            return DriverState.ESTOP, why
        faulty = Stop.FAULT in self._latch.standing
        return (DriverState.FAULT if faulty else DriverState.HOLDING), why

    def keep_fault(self, finding: JointFault) -> None:
        """Keep a fault for the driver's next process, until a reset."""
        if finding.trouble not in _SWITCHED_OFF and Stop.FAULT not in self._latch.standing:
            what = f"{finding.joint} {finding.trouble.value}: {finding.message}"
            self._latch.ask(Stop.FAULT, what)
            self._latch.keep(_MOMENT_S)

    def keep_doubt(self, doubt: str) -> None:
        """Keep as a fault why the arm may not stand where it reads; empty: no reason."""
        if doubt not in self._latch.standing.get(Stop.FAULT, ""):
            self._latch.ask(Stop.FAULT, doubt)
            self._latch.keep(_MOMENT_S)

    @property
    def away(self) -> frozenset[str]:
        """The joints whose servos a loss of power would bring back to another turn."""
        return self._turns.away

    def guard(self, arm: ServoArm) -> None:
        """Note that from now on an arm just configured switches the torque off."""
        self.keep_doubt(arm.returned)
        self.owe_off(False)
        self.let_go()

    def keep_turns(self, arm: ServoArm) -> None:
        """Keep a doubt about the servos' turns, and then which joints are `away`.

        An arm of which this cannot be kept is held: a count that it loses would go unnoticed.
        """
        self.keep_doubt(arm.doubt)
        if not (self._latch.writing or self._latch.trouble):
            self._turns.keep(arm.away)
        if self._turns.trouble and Stop.HOLD not in self._latch.standing:
            self._hold(f"because servo turns cannot be kept: {self._turns.trouble}")
            self._latch.keep(_MOMENT_S)
            self.begin_anew()

    def let_go(self) -> None:
        """Switch torque off under an emergency stop, also if the driver is not configured."""
        if not self.estop:
            return
        if self._site.arm is None:
            self.owe_off(True)
            return
        with suppress(LongarmError):
            self._site.arm.estop()  # sent again until every servo confirms it

    @property
    def owed(self) -> str:
        """The message that some servo has not confirmed torque off yet; empty if none is due."""
        arm = self._site.arm
        owed = self._owed if arm is None else arm.owing_off
        return "torque off: not every servo confirms it" if owed else ""

    def owe_off(self, owed: bool) -> None:
        """Set whether torque must be switched off while no arm is configured.

        If so, torque off is sent now, and repeatedly until every servo has confirmed it.
        """
        self._owed = owed
        self._pay()

    def _try_again(self) -> None:
        self._latch.keep(_MOMENT_S)  # writes only what could not be written before
        self._pay()

    def _pay(self) -> None:
        if self._owed:
            with suppress(LongarmError):
                self._servos.free_servos()
                self._owed = False

    def _torque_yet(self, stop: Stop) -> str:
        """Say how the torque differs from what a stop requires (a hold: on); empty if it is so."""
        if stop is Stop.ESTOP:
            return self.owed
        arm = self._site.arm
        return "" if arm is not None and arm.powered else "the driver has switched no torque on"

    def _end_stops(self, ends: frozenset[Stop], states: frozenset[FollowerState]) -> None:
        """End the given stops, and the state of the arm if it is one of ``states``.

        Torque then goes on if the driver is active and no other stop is in force. Under a hold that
        remains, it goes on only if it was on before the emergency stop; under a fault, not at all.
        """
        arm, active = self._site.arm, self._site.active
        stopped = arm is not None and arm.follower.state in states
        if not (stopped or self._latch.standing.keys() & ends):
            return
        asks = arm is not None and active and not arm.powered  # `ServoArm.power` then refuses it
        if arm is not None and arm.doubt and Stop.FAULT in ends and not asks:
            raise JobError(f"{arm.doubt}; then configure the driver again and reset it")
        with self._latch.lift_stops(*ends):
            left = set(self._latch.standing)
            if arm is not None and stopped:
                on = active and (not left or (self._was_on and left == {Stop.HOLD}))
                arm.release(time.monotonic(), on=on)
            elif arm is not None and active and not (self.standing or arm.powered):
                arm.power(True)
        self.begin_anew()


def _answer(asked: Asked, carry_out: Callable[[Asked], str]) -> None:
    response = asked.service.type.Response()
    try:
        response.message = carry_out(asked)
        response.success = True
    except LongarmError as error:
        response.message = str(error)
    asked.reply(response)


def _is_end(asked: Asked) -> bool:
    """Tell whether a request ends a stop; otherwise it asks for one."""
    return asked.service is graph.RESET or not asked.request.data
