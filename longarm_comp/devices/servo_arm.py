"""All servos of an arm: opens the bus, drives them cycle by cycle, and releases them at the end.

Not thread-safe. Times are monotonic seconds and are passed in.
"""

import contextlib
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from longarm_comp.core.errors import JobError
from longarm_comp.devices.follower_report import Accepted, FollowerState, Step
from longarm_comp.devices.joint_path import JointTrajectory
from longarm_comp.devices.servo_bus.bus import Change, SerialServoBus
from longarm_comp.devices.servo_bus.state import (
    BusUnplugged,
    IncompleteReply,
    ServoBusError,
    ServoFault,
    ServoState,
)
from longarm_comp.devices.servo_check import check_memory, check_placed, check_reach
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_follower import TrajectoryFollower
from longarm_comp.devices.servo_watch import stands_in_its_droop
from longarm_comp.devices.setup_journal import SetupJournal
from longarm_comp.devices.turn_counts import TurnCounts

_LOOK_S = 0.5
"""Time between two checks whether the torque is still on, s."""


@dataclass(frozen=True)
class ServoReading:
    """Position (rad or m), velocity and effort of one joint, as its servo reports them.

    The effort (N m, N) is NaN if the configuration has no `full_effort`.
    """

    position: float
    velocity: float
    effort: float


@dataclass(frozen=True)
class Cycle:
    step: Step  # step of the follower
    joints: dict[str, ServoReading]
    """All joints by name; empty unless every servo answered in this cycle."""
    states: Mapping[int, ServoState]  # read-back by servo id, of the servos that answered
    trouble: str  # message of a bus error; empty without one


def _say_doubt(names: list[str]) -> str:
    said = "may have lost count of servo turns: see where it stands"
    return f"{', '.join(names)} {said}" if names else ""


class ServoArm:
    """Connects a servo bus and a trajectory follower. Reopens the port after a disconnection.

    Raises:
        BusUnplugged, IncompleteReply: the port or a servo is not there.
        JobError: a servo is of another model than configured, or with its stored settings it would
            misunderstand commands.

    Args:
        stopped: whether an emergency stop is in force. Torque off is then sent as soon as the port
            is open, whichever servos answer.
        journal: journal of setups of this arm; its entries are removed once the servos are set as
            configured.
        away: the joints that were `away` when an earlier process last read them.

    Attributes:
        returned: why the count of turns may have been lost before; or "".
        said: messages for the user about changes of the servos' settings.
    """

    def __init__(
        self,
        config: ServoConfig,
        follower: TrajectoryFollower | None = None,
        *,
        stopped: bool = False,
        journal: SetupJournal | None = None,
        away: Collection[str] = (),
    ) -> None:
        self._journal, self.returned = journal, ""
        self.config, self.follower = config, follower or TrajectoryFollower(config)
        self._ids = list(config.ids.values())
        self._speeds: dict[int, float] = {}
        self._counts, self._now = TurnCounts(config, away), math.nan  # when a cycle last began
        self._moved: list[str] = []  # joints moved while the port was lost: may have lost count
        self.said: list[str] = []
        self.powered = False  # whether the torque was switched on
        self.owing_off = stopped  # whether torque off is due, and not every servo confirmed it
        self._unheld: set[int] = set()  # servos that have not confirmed their hold since a fault
        self._look_at = 0.0  # when to check next whether the torque is on
        self._missed: set[int] = set()  # servos that were silent since the last such check
        self._next_try = 0.0  # when to try next to reopen the port, or to switch the torque off
        self._closed = f"{config.bus.port} is unplugged"  # why there is no bus, if there is none
        self.bus: SerialServoBus | None = self._open_bus(again=False)

    def _open_bus(self, again: bool) -> SerialServoBus:
        """Open the port and check the servos.

        ``again``: whether it was open before. It may lead to another arm now, so servos set for one
        turn instead of many, or the reverse, are then refused and not changed.
        """
        bus = self.config.open_bus()
        try:
            if self.owing_off:  # first, because the checks below fail if one servo is silent
                with contextlib.suppress(IncompleteReply, ServoFault):
                    bus.torque(self._ids, on=False)
            self._check_servos(bus, turned=again)
            if self.powered:
                self._check_unmoved(bus)
            self._set_turns(bus)
            if not again:
                self.returned = _say_doubt(self._counts.begin(self._now, bus.read(self._ids)))
        except BaseException:
            bus.close()
            raise
        return bus

    def _check_servos(self, bus: SerialServoBus, turned: bool) -> None:
        """Refuse servos of other models, or with settings that give commands another meaning.

        ``turned``: whether servos set for one turn instead of many, or the reverse, are refused.
        """
        for name, joint in self.config.joints.items():
            number = bus.ping(joint.servo_id)
            if number != joint.servo.model_number:
                raise JobError(
                    f"{name} is not the configured servo: `longarm servo setup` writes the "
                    "model that it finds; or correct servo_id",
                    servo_id=joint.servo_id,
                    model=joint.model,
                    answers=bus.model_name(number) or f"unknown model {number}",
                )
        for _ in range(2):  # a late answer to an earlier request comes only once
            before = replace(bus.counters)
            kept = bus.memory(self._ids) | bus.memory(self._ids[::-1])
            count = bus.counters
            if count.timeouts > before.timeouts or count.stray_frames == before.stray_frames:
                break
        else:
            raise JobError("two servos have the same id: `longarm servo scan` shows which")
        for name, joint in self.config.joints.items():
            for check in (check_memory, check_placed, check_reach):
                check(name, joint, kept[joint.servo_id])
            if turned and kept[joint.servo_id].many_turns is (not joint.multi_turn):
                raise JobError(
                    f"servo {joint.servo_id} of {name} was set for other turns meanwhile: "
                    "configure the driver again"
                )
        for joint in self.config.joints.values():
            speed = 1.5 * joint.max_speed_ticks_s  # limit in the servo itself, so that none lags
            most = kept[joint.servo_id].speed_ticks_s
            self._speeds[joint.servo_id] = speed if most is None else min(speed, most)

    def _check_unmoved(self, bus: SerialServoBus) -> None:
        """Refuse an arm that does not stand where it was held when the port was lost."""
        why = "this port leads to another arm, or the arm was moved: configure the driver again"
        states, self._moved = bus.read(self._ids), []
        for name, joint in self.config.joints.items():
            at, stood = states[joint.servo_id].position_ticks, self._counts.stood[joint.servo_id]
            if abs(at - stood) > self.config.follower.lost_error_ticks:
                self._moved = [] if joint.absolute else [name]
                raise JobError(why, servo_id=joint.servo_id, reads=at, stood=stood)

    def _set_turns(self, bus: SerialServoBus) -> None:
        """Set the servos permanently for one turn or many as configured; never a driven one."""

        def refuse_driven(changes: dict[int, Change]) -> None:
            if driven := [i for i, on in bus.driven(list(changes)).items() if on]:
                raise JobError(
                    "servos hold the arm and have to be set for other turns, which lets go: "
                    "support the arm and cut their power once",
                    ids=driven,
                )

        many = {j.servo_id: j.multi_turn for j in self.config.joints.values()}
        self.said += bus.set_turns(many, refuse_driven)
        if self._journal is not None:
            self.said += self._journal.end(many) + self._journal.describe_others()

    def power(self, on: bool) -> None:
        """Switch the torque on or off.

        Off also drops the present motion. `cycle` repeats it until every servo has confirmed it.
        If not every servo can be switched on, all are switched off again, unless they were on.

        Raises:
            BusUnplugged, IncompleteReply, ServoFault: some servo was not switched on, or did not
                confirm that it is off.
            JobError: a servo was set for other turns meanwhile, or may have lost count of them
                (`TurnCounts`).
        """
        before = self.powered
        if before and not on:
            self._counts.lose(self._missed)
        self.powered = self.powered and on
        self.owing_off = self.owing_off or not on
        goals: dict[int, int] = {}
        if not on:
            self.follower.let_go()
        if self.bus is None:
            raise BusUnplugged(port=self.config.bus.port, why="the port is gone")
        try:
            if on:
                self._check_servos(self.bus, turned=True)
                goals = self._goals_to_hold(self.bus)
            self.bus.torque(self._ids, on, kept=goals)
        except ServoBusError:
            if on and not before:
                with contextlib.suppress(ServoBusError):
                    self.power(False)
            raise
        self.powered, self.owing_off = on, False
        if on:
            self._missed.clear()
            self.follower.hold_at({**self._counts.stood, **goals})

    def _goals_to_hold(self, bus: SerialServoBus) -> dict[int, int]:
        """Return the present goals, ticks by id, of driven servos that rest in their droop.

        They keep these goals: a loaded arm would sink if its present position became the goal.
        """
        states, goals, driven = bus.read(self._ids), bus.goals(self._ids), bus.driven(self._ids)
        self._note_lost(states, driven)
        self._counts.follow(self._now, states)
        self._counts.check()
        return {
            joint.servo_id: goals[joint.servo_id]
            for joint in self.config.joints.values()
            if driven[joint.servo_id]
            and stands_in_its_droop(
                states[joint.servo_id], goals[joint.servo_id], joint, self.config.follower
            )
        }

    def _note_lost(self, states: Mapping[int, ServoState], driven: Mapping[int, bool]) -> None:
        """Note servos whose torque went off without command or alarm: they had lost power."""
        if self.powered:
            off = {i for i, on in driven.items() if not on}
            self._counts.lose(i for i in off if not states[i].error_flags)

    @property
    def doubt(self) -> str:
        """Why the arm may not stand where it reads, by what was read since it was made; or ""."""
        return _say_doubt([*self._counts.doubtful, *self._moved])

    @property
    def away(self) -> frozenset[str]:
        """The joints whose servos a loss of power would bring back to another turn."""
        return self._counts.away

    def accept(self, trajectory: JointTrajectory, now: float) -> Accepted:
        """Accept a trajectory (`TrajectoryFollower.accept`); JobError also while torque is off."""
        if not self.powered:
            raise JobError("the torque is off")
        if trajectory.points and self.follower.is_fresh(now):
            self._counts.check()
        return self.follower.accept(trajectory, now)

    def estop(self) -> None:
        """Switch the torque off and refuse commands until `release`. Raises what `power` raises."""
        self.follower.estop()
        self.power(False)

    def release(self, now: float, on: bool = True) -> None:
        """End a fault or an emergency stop, and switch the torque on unless ``on`` is False.

        If the cause persists, an error is raised and the torque stays as it was: on after a fault,
        so that a heavy arm does not drop, and off after an emergency stop.
        """
        if not on:
            self.follower.reset(now)
            return
        before = self.powered
        self.power(True)
        try:
            self.follower.reset(now)
        except JobError:
            if not before:
                self.power(False)
            raise

    def cycle(self, now: float) -> Cycle:
        """Read all servos, step the follower, send goals. Bus errors are not raised."""
        self._now = now
        trouble, states, driven = "", {}, {}
        if (self.bus is None or self.owing_off) and now >= self._next_try:
            self._next_try = now + 0.5
            self._mend_bus()
        bus = self.bus
        if bus is None:
            trouble = self._closed
        else:
            try:
                states = bus.read(self._ids)
                if self.powered and (now >= self._look_at or self._missed):
                    driven = bus.driven(self._ids)
                    self._look_at = now + _LOOK_S
                    self._missed.clear()
            except IncompleteReply as error:
                trouble, states = str(error), error.states
            except ServoBusError as error:
                trouble = self._lose_port(error)
        self._missed |= set(self._ids) - states.keys()
        self._note_lost(states, driven)
        step = self.follower.step(now, states, driven)
        driving = step.state in (FollowerState.TRACKING, FollowerState.HOLDING)
        if not driving:
            self._counts.follow(now, states)
        elif self.follower.is_fresh(now):
            self._counts.trust(now, states)
        stopped = step.state is FollowerState.FAULT
        if not stopped:
            self._unheld.clear()
        elif step.goals is not None:  # the fault has just begun
            self._unheld = set(self._ids)
        if self.bus is not None and self.powered:
            try:
                if stopped:  # repeated until confirmed: a servo that misses its goal drives on
                    self._hold_unheld(self.bus)
                elif step.goals:
                    self.bus.write_goal(step.goals, self._speeds)
            except ServoBusError as error:
                trouble = self._lose_port(error)
        return Cycle(step, self._convert_states(states), states, trouble)

    def _hold_unheld(self, bus: SerialServoBus) -> None:
        """Hold each servo that has not confirmed its hold, if its reading is trusted in this cycle.

        A servo without torque gets no goal, because a goal would switch its torque on.
        """
        goals = self.follower.find_holding_goals()
        driven = bus.driven(sorted(self._unheld & goals.keys()))
        held = {i: goals[i] for i, on in driven.items() if on}
        missing = bus.hold(held)
        self._unheld -= held.keys() - missing
        if missing:
            raise IncompleteReply("servos have not confirmed where they hold", ids=sorted(missing))

    def close(self) -> str:
        """Switch the torque off if possible and release the port. Must not raise.

        Returns:
            The reason why some servo has not confirmed torque off; empty if all have.
        """
        why = ""
        for _ in range(3):
            try:
                self.power(False)
            except ServoBusError as error:
                why = str(error)
            else:
                why = ""
                break
        self.leave()
        return why

    def leave(self) -> None:
        """Release the port; the torque stays as it is."""
        if self.bus is not None:
            self.bus.close()
            self.bus = None

    def _convert_states(self, states: Mapping[int, ServoState]) -> dict[str, ServoReading]:
        if not states.keys() >= set(self._ids):
            return {}
        readings = {}
        for name, joint in self.config.joints.items():
            state = states[joint.servo_id]
            position, speed = joint.to_si(state.position_ticks), state.velocity_ticks_s
            effort = joint.effort_to_si(state.load)
            readings[name] = ServoReading(position, joint.speed_to_si(speed), effort)
        return readings

    def _lose_port(self, error: ServoBusError) -> str:
        if isinstance(error, BusUnplugged) and self.bus is not None:
            self.bus.close()
            self.bus, self._missed = None, set(self._ids)
        return str(error)

    def _mend_bus(self) -> None:
        """Reopen a lost port, and switch the torque off if this is due (`owing_off`)."""
        try:
            self.bus = self.bus or self._open_bus(again=True)
            if self.owing_off:
                self.power(False)
        except ServoBusError as error:
            self._lose_port(error)
            if self.bus is None:
                unplugged = isinstance(error, BusUnplugged)
                self._closed = f"{self.config.bus.port} is unplugged" if unplugged else str(error)
        except JobError as error:  # what answers there is refused
            self._closed = str(error)
