"""Follows a joint trajectory: computes bounded servo goals step by step from the read-back.

It uses neither ROS nor a port. The caller reads the bus, calls ``step`` with the states and sends
the goals that ``step`` returns (`ServoArm.cycle`). When a fault begins, ``step`` returns once the
goals that hold the servos. After that it returns no goals until ``reset``.
"""

from collections.abc import Callable, Mapping

import numpy as np

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.follower_report import Accepted, Event, EventKind, FollowerState, Step
from longarm_comp.devices.joint_path import (
    Array,
    InParts,
    JointTrajectory,
    TakenOver,
    Turn,
    check_trajectory,
    find_turn,
    plan_path,
)
from longarm_comp.devices.servo_bus.state import ServoState
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_watch import (
    STILL_TICKS_S,
    JointFault,
    ServoTrouble,
    ServoWatch,
    stands_in_its_droop,
)
from longarm_comp.devices.trim import Trim
from longarm_comp.math.cubic_path import CubicPath
from longarm_comp.math.shaper import Shaper, Way

KeepsOut = Callable[[Array], str]
"""Says why the arm must not pass through postures (N, n), rad and m; empty if it may."""
Shapes = Callable[[Way, float], Shaper | None]
"""Returns how to split a move (joints over time, and its duration, s); None: it is not split."""


class TrajectoryFollower:
    """Follows one trajectory at a time within the limits of ``config``.

    Call ``step`` at a steady rate, also while idle, so that the read-back stays up to date.
    ``now`` is monotonic seconds in every method.

    Args:
        keeps_out: called for every trajectory, and may refuse it; None: no such check.
        shapes: called for every trajectory that does not replace another one; None: no trajectory
            is shaped.
        trim: whether goals are corrected at the end of a move until the readings agree (`Trim`).
    """

    def __init__(
        self,
        config: ServoConfig,
        keeps_out: KeepsOut | None = None,
        shapes: Shapes | None = None,
        trim: bool = False,
    ) -> None:
        self._config, self._keeps_out, self._shapes = config, keeps_out, shapes
        self._joints = list(config.joints.values())
        self._names = tuple(config.joints)
        self._lower = np.array([j.lower for j in self._joints])
        self._upper = np.array([j.upper for j in self._joints])
        self._max_velocity = np.array([j.max_velocity for j in self._joints])
        self._watch = ServoWatch(config)
        self.state = FollowerState.IDLE
        self._events: list[Event] = []
        self._now: float | None = None
        self._fresh = False  # whether the last step had a trusted reading of every servo
        self._doubting = False  # whether the motion waits for such readings
        self._settled = True  # whether the end of the last trajectory has been reported
        self._still_s = 0.0  # how long all servos have stood still
        self._set: Array | None = None  # (n,) set-point, rad and m; None: no joint is driven
        self._velocity = np.zeros(len(self._joints))  # of the set-point
        self._goals: dict[int, int] | None = None  # last goals, ticks by servo id
        self._held: Mapping[int, int] = {}  # goals (ticks by id) that hold the arm while idle
        self._way: TakenOver | InParts | None = None
        self._way_time = 0.0  # time along `_way`, s
        self._turn: Turn | None = None
        self._trim, self._trim_wanted = Trim(config), trim
        self._trimming = False  # whether the arm is trimmed when it rests after this trajectory
        self._trim_failure = ""  # which joints trim could not bring to their goals

    @property
    def set_points(self) -> dict[str, float]:
        """The position where each joint should be now, rad or m; empty while none is driven."""
        return {} if self._set is None else dict(zip(self._names, self._set.tolist(), strict=True))

    @property
    def trim_by_joint(self) -> dict[str, float]:
        """Correction of each joint's goal by trim, ticks."""
        return dict(zip(self._names, self._trim.offset.tolist(), strict=True))

    def is_fresh(self, now: float) -> bool:
        """Tell whether the last step was recent, and had a trusted reading of every servo."""
        late = self._now is None or now - self._now > self._config.follower.silence_s
        return self._fresh and not late

    def accept(self, trajectory: JointTrajectory, now: float) -> Accepted:
        """Accept a trajectory. It starts with the next step, from the present set-point.

        Joints that it does not name stay where they are. A trajectory without points stops the arm
        smoothly from its set-point, even if the readings are missing or wrong. A trajectory that is
        too fast is slowed down (`plan_path`), with an event SLOWED. Every trajectory ends at rest,
        with an event ARRIVED, or SHORT if a joint came to rest elsewhere.

        Raises:
            InputError: the trajectory is invalid, or leaves the limits.
            JobError: it leads into a keep-out box, or the state of the arm does not allow motion.
        """
        if self.state in (FollowerState.FAULT, FollowerState.ESTOP):
            raise JobError("no trajectory is taken until the arm is reset", state=self.state.value)
        moves, replaces = bool(trajectory.points), self.state is FollowerState.TRACKING
        if moves or self._set is None:
            if not self.is_fresh(now):
                raise JobError("no fresh reading of every servo", servos=len(self._joints))
            self._check_health(now)
        start = self._start_path()
        if moves:
            times, positions, velocities = check_trajectory(trajectory, self._config, start)
            path = plan_path(start, times, positions, velocities, self._max_velocity)
            accepted = Accepted(start, positions, path.times[-len(times) :], replaces)
            low, high = path.extremes()
            for k, (name, joint) in enumerate(self._config.joints.items()):
                for value in (low[k], high[k]):
                    joint.check_inside(float(value), "joint trajectory", f"{name} on the way")
        else:
            path = self._plan_braking(start)
            accepted = Accepted(start, path.end[None], np.zeros(1), replaces)
        # A move has one point, or two: the end of its run-up, and its own. More points are a path
        is_path = len(trajectory.points) > 2
        taken = self._take_over(path, start)
        way: TakenOver | InParts = taken
        if moves and self._shapes is not None and not replaces:
            shaper = self._shapes(taken.at, taken.duration)
            way = taken if shaper is None else InParts(taken, shaper)
        if moves and self._keeps_out is not None:
            entry = self._keeps_out(way.postures())
            if entry:
                raise JobError(entry)
        self._set, self._way, self._way_time = start, way, 0.0
        self._turn = find_turn(accepted, self._config.follower) if way is taken else None
        self._trimming = self._trim_wanted and moves and not is_path
        self._trim_failure = ""
        self._trim.begin(path=is_path)
        self.state, self._settled, self._still_s = FollowerState.TRACKING, False, 0.0
        kind = EventKind.REPLACED if replaces else EventKind.STARTED
        self._note_event(kind, f"{len(trajectory.points)} points, {way.duration:.2f} s")
        if path.stretch > 1.001:
            slower = f"{path.stretch:.2f} times slower, for the velocity limits"
            self._note_event(EventKind.SLOWED, slower)
        return accepted

    def _take_over(self, path: CubicPath, start: Array) -> TakenOver:
        """Return a path that begins with a blend from braking the present motion."""
        blend_s = self._config.follower.blend_s
        return TakenOver(path, start, self._velocity.copy(), blend_s, self._lower, self._upper)

    def _plan_braking(self, start: Array) -> CubicPath:
        """Return the path that is only the position where braking from a set-point ends."""
        brake = start + 0.5 * self._config.follower.blend_s * self._velocity
        rest = np.clip(brake, self._lower, self._upper)[None]
        return CubicPath(np.zeros(1), rest, np.zeros_like(rest))

    def break_off(self, kind: EventKind, why: str) -> None:
        """Stop smoothly before the end of the trajectory, with an event ``kind`` and its reason."""
        if self.state is FollowerState.TRACKING and self._set is not None:
            self._way = self._take_over(self._plan_braking(self._set), self._set)
            self._way_time, self._turn = 0.0, None
        self._settled = True
        self._note_event(kind, why)

    def hold_at(self, goals: Mapping[int, int]) -> None:
        """Set the goals, ticks by servo id, that hold the arm. The next trajectory begins there."""
        self._held = dict(goals)

    def let_go(self) -> None:
        """Drop any motion, because the torque is off. A fault or emergency stop stays in force."""
        self._held = {}
        if self.state in (FollowerState.TRACKING, FollowerState.HOLDING):
            self.state = FollowerState.IDLE
        self._drop_motion()

    def estop(self) -> None:
        """Send no goals until ``reset``. The caller switches the torque off."""
        self._held = {}
        self.state = FollowerState.ESTOP
        self._drop_motion()
        self._note_event(EventKind.ESTOP, "emergency stop")

    def reset(self, now: float) -> None:
        """Go back to idle after a fault or an emergency stop."""
        self._check_health(now)
        self._watch.forget_errors()
        self._drop_motion()
        self.state = FollowerState.IDLE
        self._note_event(EventKind.RESET, "ready")

    def step(
        self, now: float, states: Mapping[int, ServoState], driven: Mapping[int, bool] | None = None
    ) -> Step:
        """Process one read-back, and return the goals to send.

        Args:
            states: read-back by servo id, of the servos that answered.
            driven: result of ``SerialServoBus.driven``, given only from time to time. It reveals a
                servo that lost power for a moment: it answers as before, but its torque is off.
        """
        limit = self._config.follower.max_step_s
        dt = 0.0 if self._now is None else min(max(now - self._now, 0.0), limit)
        self._now = now if self._now is None else max(now, self._now)
        self._fresh, findings = self._watch.update(self._now, states, self._goals)
        loose = [n for n, i in self._config.ids.items() if (driven or {}).get(i) is False]
        findings += [JointFault(ServoTrouble.LET_GO, n, "its torque is off") for n in loose]
        goals = None
        if self.state in (FollowerState.TRACKING, FollowerState.HOLDING):
            goals = self._enter_fault(findings) if findings else self._move_on(dt)
        elif self.state is FollowerState.IDLE and self._held:
            findings = [f for f in findings if f.trouble is not ServoTrouble.SILENT]
            goals = self._enter_fault(findings) if findings else None
        events, self._events = tuple(self._events), []
        return Step(self.state, goals, self.set_points, events)

    def _move_on(self, dt: float) -> dict[int, int] | None:
        """Take a bounded step of ``dt``, s, along the path; return goals, ticks by servo id.

        None, and no motion, while the read-back of a servo is missing or doubtful.
        """
        if not self._fresh:
            if not self._doubting:
                self._note_event(EventKind.DOUBTFUL, "waiting for a trusted reading of every servo")
            self._doubting = True
            self._velocity = np.zeros_like(self._velocity)
            return None
        self._doubting = False
        assert self._way is not None and self._set is not None
        path = self._way.path
        if self._turn is None:
            self._way_time += dt
        else:  # the end of a run-up is not skipped
            way, turn = self._way, self._turn
            self._way_time = turn.time_after(
                self._way_time, dt, lambda: not self._find_away(way.at(turn.time_s), turn.joints)
            )
        bound = self._max_velocity * dt
        step = np.clip(self._way.at(self._way_time) - self._set, -bound, bound)
        self._set = self._set + step
        self._velocity = step / dt if dt > 0.0 else self._velocity
        arrived = self._way_time >= self._way.duration + self._config.follower.blend_s
        if arrived and np.allclose(self._set, path.end, rtol=0.0, atol=1e-9):
            self.state = FollowerState.HOLDING
            self._settle_joints(dt)
        wanted = self._wanted_ticks()
        for name, by in zip(wanted, self._trim.correction_now(dt).tolist(), strict=True):
            wanted[name] = self._config.joints[name].nearest_within_limits(wanted[name] + by)
        self._goals = {self._config.ids[name]: goal for name, goal in wanted.items()}
        return self._goals

    def _wanted_ticks(self) -> dict[str, int]:
        """Return the goals without trim, ticks by joint."""
        joints = self._config.joints
        return {name: joints[name].to_ticks(value) for name, value in self.set_points.items()}

    def _settle_joints(self, dt: float) -> None:
        """Trim an arm at rest step by step; then report once that it has arrived, or not."""
        read = {name: self._watch.state(name) for name in self._names}
        states = {name: state for name, state in read.items() if state is not None}
        still = all(abs(s.velocity_ticks_s) < STILL_TICKS_S for s in states.values())
        still = still and len(states) == len(read)
        self._still_s = self._still_s + dt if still else 0.0
        if self._settled or not still:
            return
        if self._trimming:
            if self._still_s < self._config.follower.trim_pause_s:
                return
            wanted = self._wanted_ticks()
            if self._trim.take_step(wanted, states):
                self._still_s = 0.0
                return
            self._trimming = False
            self._trim_failure = self._trim.describe_failure(wanted, states)
        assert self._set is not None
        short = self._trim_failure or self._find_away(self._set, np.ones(len(self._set), bool))
        if not short:
            self._note_event(EventKind.ARRIVED, "at rest at the end of the trajectory")
        elif self._still_s > self._config.follower.stall_time_s:
            self._note_event(
                EventKind.SHORT, "at rest short of the end of the trajectory: " + short
            )
        else:
            return
        self._settled = True

    def _find_away(self, wanted: Array, among: Array) -> str:
        """Say which joints stand too far from where they should be; empty if none does.

        Args:
            wanted: (n,) where they should be, rad and m.
            among: (n,) bool: the joints to look at.
        """
        far = []
        for name, value in zip(np.array(self._names)[among], wanted[among].tolist(), strict=True):
            state, joint = self._watch.state(name), self._config.joints[name]
            assert state is not None
            off = joint.to_si(state.position_ticks) - value
            if abs(off) > self._config.follower.stall_error_ticks * joint.si_per_tick:
                far.append(f"{name} by {abs(off):.4g} {joint.unit}")
        return ", ".join(far)

    def _enter_fault(self, findings: list[JointFault]) -> dict[int, int]:
        """Enter the fault state; return goals that hold the present positions, ticks by servo id.

        A servo without a trusted reading in this step is left out. The caller holds it when its
        reading is trusted again.
        """
        self.state = FollowerState.FAULT
        for finding in findings:
            what = f"{finding.joint} {finding.trouble.value}: {finding.message}"
            self._note_event(EventKind.FAULT, what, finding)
        self._drop_motion()
        self._held = goals = self.find_holding_goals()
        return goals

    def find_holding_goals(self) -> dict[int, int]:
        """Return goals, ticks by servo id, that hold the joints trusted in the last step.

        A joint beyond its limits is held at the limit if this is within `stall_error_ticks`, else
        where it is.
        """
        goals, near = {}, self._config.follower.stall_error_ticks
        for name, joint in self._config.joints.items():
            state = self._watch.state(name)
            if state is not None and self._watch.was_heard(name):
                at = state.position_ticks
                inside = joint.nearest_within_limits(at)
                goals[joint.servo_id] = inside if abs(inside - at) <= near else at
        return goals

    def _drop_motion(self) -> None:
        self._trim.drop()
        self._way = self._set = self._goals = None
        self._velocity = np.zeros_like(self._velocity)

    def _start_path(self) -> Array:
        """Return the set-point (n,), rad and m, from which a trajectory starts.

        While idle, a joint starts from the goal that holds it if it rests in its droop below that
        goal (`stands_in_its_droop`), else from its present position.

        Raises:
            InputError: a joint stands too far beyond its limits.
        """
        if self._set is not None:
            return self._set
        values, limits = [], self._config.follower
        for name, joint in self._config.joints.items():
            state = self._watch.state(name)
            assert state is not None
            value = joint.to_si(state.position_ticks)
            slack = max(limits.stall_error_ticks, limits.trim_ticks) * joint.si_per_tick
            if not joint.lower - slack <= value <= joint.upper + slack:
                allowed = f"{joint.lower:g} to {joint.upper:g} {joint.unit}; move it by hand"
                raise InputError("read-back", name, value, allowed)
            goal = self._held.get(joint.servo_id)
            if goal is not None and stands_in_its_droop(state, goal, joint, limits):
                value = joint.to_si(goal)
            values.append(min(max(value, joint.lower), joint.upper))
        return np.array(values)

    def _check_health(self, now: float) -> None:
        standing = self._watch.find_standing_faults(now)
        if standing:
            first = standing[0]
            raise JobError(
                f"a servo is {first.trouble.value}", joint=first.joint, why=first.message
            )

    def _note_event(self, kind: EventKind, message: str, finding: JointFault | None = None) -> None:
        self._events.append(Event(kind, message, finding))
