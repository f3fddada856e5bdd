"""`servo_driver` (lifecycle): sends joint trajectories to a servo bus, publishes joint states.

When configured, the port is open and the servos are read. When active, their torque is on. Torque
is switched off on deactivate, cleanup, shutdown, emergency stop and at the end of the process, but
it stays on if the process ends because its terminal or supervisor is gone. An emergency stop, a
hold, or a fault other than lost power outlasts the process (`StopLatch`): while it is in force, the
driver switches no torque on and accepts no trajectory, in any state.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any

from lifecycle_msgs.srv import ChangeState
from pydantic import BaseModel
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.arm_folder.servos import find_contradictions
from longarm_comp.core.errors import InputError, JobError, LongarmError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import keeper
from longarm_comp.core.vibration.shaper import shaping
from longarm_comp.devices.follower_report import Accepted, Event, EventKind, FollowerState
from longarm_comp.devices.servo_arm import Cycle, ServoArm, ServoReading
from longarm_comp.devices.servo_bus.state import BusUnplugged, IncompleteReply
from longarm_comp.devices.servo_config import BusConfig, FollowerConfig, ServoConfig
from longarm_comp.devices.servo_follower import KeepsOut, Shapes, TrajectoryFollower
from longarm_comp.devices.servo_joint import JointConfig
from longarm_comp.devices.setup_journal import SetupJournal
from longarm_comp.devices.stop_latch import Stop
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes import orders, stops
from longarm_comp.nodes.clock import sleepless_s, steady_timer
from longarm_comp.nodes.health import ERROR, OK, PERIOD, THIS_INSTANCE, WARN, Report
from longarm_comp.nodes.messages import points_message, readings_message, trajectory_of
from longarm_comp.nodes.model_files import ModelFiles
from longarm_comp.nodes.node import ArmNode, program
from longarm_comp.nodes.orders import FollowServer, Freshness, Intake
from longarm_comp.nodes.params import Param, declare_sections, where
from longarm_comp.nodes.stops import Stops
from longarm_interfaces.msg import DriverState, Motion

PARAMS = (
    Param("rate_hz", 50.0, "cycles a second; each reads and commands all servos", 1.0, 500.0),
    Param("arm", "", "arm.yaml that the servos must fit, with keep-out boxes; empty: no checks"),
    Param("shaping", False, "split moves from rest so that `arm` rings little"),
    Param("model", "", "model.yaml that predicts the ring; empty: the arm as declared"),
    Param("autostart", True, "configure and activate without being asked, also after a failure"),
    Param("retry_s", 1.0, "pause between two attempts to configure and activate", 0.1, 60.0),
    Param("patience_s", 5.0, "time at the start before missing servos are an error", 0.0, 600.0),
    Param("trim", False, "after a move, correct the goals until readings and command agree"),
    *stops.PARAMS,
    *orders.PARAMS,
    PERIOD,
)
SECTIONS: dict[str, type[BaseModel]] = {
    "bus": BusConfig,
    "joints": JointConfig,
    "follower": FollowerConfig,
}
"""Parameters below these names are the servo configuration (`devices/servo_config.py`)."""

Transition = Callable[[Any, LifecycleState], TransitionCallbackReturn]


def reporting_faults(transition: Transition) -> Transition:
    """Wrap a lifecycle transition so that an exception in it is reported.

    rclpy drops the exception: the driver would stay in its state without any visible reason.
    """

    @wraps(transition)
    def tell(driver: _ServoDriver, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(driver, state)
        except Exception as error:
            driver.health.fault(error)
            driver.fault = f"{transition.__name__}: {driver.health.last_fault}"
            raise

    return tell


class _ServoDriver(ArmNode, LifecycleNode):
    def __init__(self, executor: SingleThreadedExecutor) -> None:
        super().__init__(executor, "servo_driver", PARAMS, tuple(SECTIONS))
        changes = self._service_change_state
        self._make_change, changes.callback = changes.callback, self._serve_change
        p, given = self.p, declare_sections(self, SECTIONS)
        self._config = ServoConfig.parse(given, "parameters of servo_driver")
        self._config.check_rate(p["rate_hz"], "parameters of servo_driver")
        self.names = list(self._config.joints)
        self._rules = self._make_rules()
        self._autostart, self._period_s = p["autostart"], 1.0 / p["rate_hz"]
        self.arm: ServoArm | None = None
        self.active = self._ended = False
        self._last: Cycle | None = None
        self.tally.counts |= {"trajectories": 0, "refused": 0, "incomplete cycles": 0}
        self.fault = self._trouble = self._waiting = self._motion = ""
        self._said: tuple[int, str] | None = None
        self._patient_until = time.monotonic() + p["patience_s"]
        self._joint_states = graph.JOINT_STATES.publisher(self)
        self._motions = graph.MOTION.publisher(self)
        self._states = graph.DRIVER_STATE.publisher(self)
        self._max_age_s, self._cycled = p["order_max_age_s"], sleepless_s()
        fresh = Freshness(self, self._max_age_s)
        self._intake = Intake(self, self, fresh, unstamped=p["unstamped"])
        self._follow = FollowServer(self, self) if graph.HAS_FOLLOW else None
        self._stops = Stops(self, self, p["state"], p["arm"], self._config, fresh)
        self._timer = steady_timer(self, self._period_s, self._run_cycle)
        # Pause between two messages of the state, s. It is also published when it changes
        steady_timer(self, 0.5, self.tell_state)
        self.health.parts |= {"servo bus": self._bus_report, "arm": self._arm_report}
        self._start_up()
        steady_timer(self, p["retry_s"], self._start_up)
        self._tell_change()

    def close(self) -> bool:
        if self.abandoned and (arm := self.arm) is not None and not arm.owing_off:
            # The torque stays as it is: a heavy arm must not fall without a command
            arm.follower.break_off(EventKind.HELD, "its supervisor is gone: it stays where it is")
            end = time.monotonic() + 2.0 * self._config.follower.blend_s + 1.0
            while self.following and time.monotonic() < end:
                self._drive_arm(arm)
                time.sleep(self._period_s)
            arm.leave()
            self.arm = None
        self._release_arm()
        self._ended = True
        self.tell_state()
        if self._stops.owed:
            self.exit_code = JobError.exit_code
        return super().close()

    def _make_rules(self) -> tuple[KeepsOut | None, Shapes | None, bool]:
        """Check the servos against arm.yaml; return what a `TrajectoryFollower` gets besides.

        That is: what refuses moves into keep-out boxes, what splits moves against ringing (None if
        the parameters do not ask for it), and whether moves are trimmed.
        """
        file, shaped, trim = self.p["arm"], self.p["shaping"], self.p["trim"]
        if not file:
            if shaped:
                raise InputError(where(self), "shaping", True, "false, or arm: the arm's file")
            return None, None, trim
        files = ModelFiles(file, self.p["model"])
        for contradiction in find_contradictions(self._config, files.arm, where(self), file):
            raise contradiction
        keeps_out = keeper(declared_model(files.arm), self.names, file)
        shapes = shaping(files.loaded.model, self.names, file) if shaped else None
        return keeps_out, shapes, trim

    def _serve_change(self, request: ChangeState.Request, response: ChangeState.Response) -> Any:
        """Make a transition; refuse one that is not possible in the present state.

        rclpy raises an exception there and sends no response, so the client would wait for ever.
        """
        try:
            return self._make_change(request, response)
        except RuntimeError:  # its RCLError
            response.success = False
            return response

    def _start_up(self) -> None:
        if self._autostart and self.arm is None:
            self.trigger_configure()
        if self._autostart and self.arm is not None and not self.active:
            self.trigger_activate()

    @reporting_faults
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            config, stops = self._config, self._stops
            follower = TrajectoryFollower(config, *self._rules)
            stopped = stops.estop or bool(stops.owed)
            journal = SetupJournal(self.p["state"], self.p["arm"], config.bus)
            self.arm = ServoArm(config, follower, stopped=stopped, journal=journal, away=stops.away)
        except LongarmError as error:
            return self._note_failure(error)
        for said in self.arm.said:
            self.get_logger().info(said)
        self.fault = ""
        self._stops.guard(self.arm)
        return super().on_configure(state)

    @reporting_faults
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Switch torque on unless a stop is in force; the arm holds its present position."""
        assert self.arm is not None
        try:
            if not self._stops.standing:
                self.arm.power(True)
        except LongarmError as error:
            return self._note_failure(error)
        self.fault, self.active, self._autostart = "", True, False
        self._stops.begin_anew()
        return super().on_activate(state)

    @reporting_faults
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = self._autostart = False
        self._tell_motion(Motion.BROKEN_OFF, self._motion, "torque off")
        assert self.arm is not None
        try:
            self.arm.power(False)
        except LongarmError as error:
            self._note_failure(error)  # torque off is sent as soon as the bus is back
        return super().on_deactivate(state)

    @reporting_faults
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Switch torque off and go back to unconfigured."""
        self._release_arm()
        return super().on_cleanup(state)

    on_error = on_cleanup

    @reporting_faults
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._autostart = False
        self._release_arm()
        return super().on_shutdown(state)

    def _note_failure(self, error: LongarmError) -> TransitionCallbackReturn:
        starting = self._autostart and time.monotonic() < self._patient_until
        if starting and isinstance(error, (BusUnplugged, IncompleteReply)):
            if not self._waiting:
                self.get_logger().info(f"waiting for the servos on {self._config.bus.port}")
            self._waiting = str(error)
            return TransitionCallbackReturn.FAILURE
        if str(error) != self.fault:
            self.get_logger().error(str(error))
        self.fault = str(error)
        return TransitionCallbackReturn.FAILURE

    def _release_arm(self) -> None:
        if self.following:
            self._tell_motion(Motion.BROKEN_OFF, self._motion, "torque off")
        self.active = False
        arm, self.arm, self._last = self.arm, None, None
        if arm is not None:
            self._stops.owe_off(bool(arm.close()))
        self._stops.let_go()
        if owed := self._stops.owed:
            self.get_logger().error(f"{owed}; cut the power of the servos")

    def _run_cycle(self) -> None:
        if self.arm is not None:
            self._drive_arm(self.arm)
        self._tell_change()

    def _drive_arm(self, arm: ServoArm) -> None:
        now, awake = time.monotonic(), sleepless_s()
        away, self._cycled = awake - self._cycled, awake
        if self.following and away > self._max_age_s:
            arm.follower.break_off(EventKind.SHORT, f"the driver was away for {away:.1f} s")
        cycle = self._last = arm.cycle(now)
        if cycle.joints:
            stamp = self.get_clock().now().to_msg()
            self._joint_states.publish(readings_message(self.readings, stamp))
        else:
            self.tally.count("incomplete cycles", "")
        for event in cycle.step.events:
            self._on_event(event)
        self._stops.keep_turns(arm)

    def _on_event(self, event: Event) -> None:
        why = f"{event.kind.value}: {event.message}"
        if event.kind is EventKind.FAULT:
            assert event.finding is not None
            self._trouble = event.message
            self._stops.keep_fault(event.finding)
        elif event.kind is EventKind.ARRIVED:
            self._tell_motion(Motion.REACHED, self._motion)
        if event.kind in (EventKind.FAULT, EventKind.ESTOP):
            self.get_logger().error(why)
        if event.kind in (EventKind.FAULT, EventKind.ESTOP, EventKind.SHORT, EventKind.HELD):
            self._tell_motion(Motion.BROKEN_OFF, self._motion, why)
        else:
            self.get_logger().debug(why)

    @property
    def readings(self) -> Mapping[str, ServoReading]:
        """The last read-back by joint; empty if a servo was silent, or before the first."""
        return self._last.joints if self._last is not None else {}

    @property
    def set_points(self) -> Mapping[str, float]:
        """The position where each joint should be now, rad or m; empty while none is driven."""
        return self.arm.follower.set_points if self.arm is not None else {}

    @property
    def following(self) -> str:
        """Id of the trajectory that is being followed; empty if none is."""
        moving = self.arm is not None and self.arm.follower.state is FollowerState.TRACKING
        return self._motion if moving else ""

    def take(self, message: JointTrajectory, name: str) -> None:
        """Check a trajectory and follow it; its events are published under its id ``name``."""
        why = self._stops.standing or ("" if self.active else "the driver is not active")
        if why := why or self._intake.doubt(message):
            self.refuse(name, why)
            return
        arm = self.arm
        assert arm is not None
        if not arm.follower.is_fresh(time.monotonic()):  # just begun, or a reply was lost
            self._drive_arm(arm)
        try:
            accepted = arm.accept(trajectory_of(message), time.monotonic())
        except LongarmError as error:
            self.refuse(name, str(error))
            return
        self.tally.count("trajectories", "")
        if accepted.replaces:
            self._tell_motion(Motion.REPLACED, self._motion, "another trajectory was accepted")
        self._motion = name
        self._tell_motion(Motion.ACCEPTED, name, taken=accepted)
        self._tell_change()

    def refuse(self, name: str, why: str) -> None:
        self.tally.count("refused", why)
        self._tell_motion(Motion.REFUSED, name, why)

    def _tell_motion(
        self, event: int, name: str, why: str = "", taken: Accepted | None = None
    ) -> None:
        joints = readings_message(self.readings, self.get_clock().now().to_msg())
        message = Motion(header=joints.header, id=name, event=event, message=why, joints=joints)
        if taken is not None:
            message.start = JointState(name=self.names, position=taken.start.tolist())
            message.points = points_message(taken.points, taken.times)
        self._motions.publish(message)
        if self._follow is not None:
            self._follow.on_event(event, name, why)

    def _tell_change(self) -> None:
        if self._said != self.state:
            self.tell_state()

    def tell_state(self) -> None:
        state, why = self._said = self.state
        told = DriverState(state=state, message=why, instance=THIS_INSTANCE, stops=self._stops.made)
        told.header.stamp = self.get_clock().now().to_msg()
        self._states.publish(told)

    @property
    def state(self) -> tuple[int, str]:
        """The state, a constant of `DriverState`, and the reason."""
        unready = "" if self.arm else self.fault or self._waiting or "not configured"
        follower = self.arm.follower.state if self.arm else None
        held, owed, (stopped, why) = self._stops.standing, self._stops.owed, self._stops.state
        if self._ended:
            return DriverState.UNCONFIGURED, "; ".join(filter(None, ("the driver has ended", owed)))
        if self.active and follower is FollowerState.FAULT and stopped != DriverState.FAULT:
            cure = f"{self._trouble}; {Stop.FAULT.cure}"
            return DriverState.FAULT, f"{cure}; {held}" if held else cure
        if held:
            return stopped, f"{why}; {unready}" if unready else why
        if unready:
            return DriverState.UNCONFIGURED, "; ".join(filter(None, (unready, owed)))
        if not self.active:
            return DriverState.INACTIVE, self.fault or "not active: torque is off"
        return DriverState.MOVING if follower is FollowerState.TRACKING else DriverState.READY, ""

    def _bus_report(self) -> Report:
        facts: dict[str, object] = {"port": self._config.bus.port}
        if self.arm is None:
            why = self.fault or self._waiting or "not configured"
            return Report(ERROR if self.fault else WARN, why, facts)
        if (bus := self.arm.bus) is not None:
            facts |= {name: getattr(bus.counters, name) for name in bus.counters.__slots__}
        for name, servo_id in self._config.ids.items():
            state = self._last.states.get(servo_id) if self._last else None
            if state is not None:
                facts[f"{name} temperature [C]"] = state.temperature_c
                facts[f"{name} load [share]"] = round(state.load, 3)
                facts[f"{name} voltage [V]"] = round(state.voltage_v, 1)
        trouble = "" if self._last is None else self._last.trouble
        return Report(ERROR if trouble else OK, trouble or "every servo answers", facts)

    def _arm_report(self) -> Report:
        facts, (state, why) = self.tally.facts, self.state
        if self.arm is not None:
            facts["state"] = self.arm.follower.state.value
        if state in (DriverState.UNCONFIGURED, DriverState.INACTIVE):
            return Report(WARN, self.fault or "not active: torque is off", facts)
        stopped = state in (DriverState.FAULT, DriverState.ESTOP) or self._stops.unkept
        return Report(ERROR if stopped else OK, why or str(facts["state"]), facts)


main = program(_ServoDriver)

if __name__ == "__main__":
    main()
