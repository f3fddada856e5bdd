"""Weighs the payload at rest, from the loads of the servos or the force at a wrist sensor."""

import math
import time
from functools import partial

import numpy as np
from geometry_msgs.msg import WrenchStamped

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.circumstances import allowed_range
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.online import StaleContext
from longarm_comp.core.compensation.weighing import SD, Drives, Weighing, Wrist, feel_rest
from longarm_comp.core.errors import InputError
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.health import OK, WARN, Report
from longarm_comp.nodes.messages import wrench_of
from longarm_comp.nodes.params import Param
from longarm_interfaces.msg import Motion

PARAMS = (
    Param("servos", "", "servo_driver.yaml, for the loads that servos report; empty: none"),
    Param("payload.by_load", False, "if nobody publishes a payload, estimate it from the loads"),
    Param(
        "payload.wrench_sigma_n", 1.0, "uncertainty of the wrist force and of its zero", 1e-4, 1e4
    ),
)


class Weigher:
    """Weighs the payload at the end of a move, and again while this rest lasts."""

    def __init__(self, state: ArmState) -> None:
        self._arm, self._state, p = state.arm, state, state.p
        self._drives = drives(p["servos"], state.arm)
        self._tells, self._settle_s = p["payload.by_load"], p["monitor.settle_s"]
        self._max_age_s, self._sigma = p["context_max_age_s"], p["payload.wrench_sigma_n"]
        self._weighing = self._before = Weighing(p["monitor.run_length"])  # before this rest
        self._due = math.inf
        self._wrist: tuple[Wrist, float] | None = None  # and when it was heard
        self._told: float | None = None
        self._last_s = self._felt_s = -math.inf
        self._entered: tuple[dict[str, float], float] = {}, self._felt_s
        graph.WRENCH.subscription(state.node, self._on_wrench)

    def on_command(self, q: np.ndarray, history: History) -> None:
        self._due, self._before = math.inf, self._weighing

    def on_motion(self, motion: Motion) -> None:
        if motion.event == Motion.REACHED:
            self._due = time.monotonic() + self._settle_s
        elif motion.event == Motion.BROKEN_OFF:  # it comes to rest somewhere
            self._due = time.monotonic() + self._again_s

    def on_joints(self, q: np.ndarray, at_s: float) -> None:
        """Queue the weighing if it is due; once a second, enter the result in the circumstances."""
        now = time.monotonic()
        context = None
        if now >= self._due and not self._state.driver.refusal:
            context = self._circumstances(now)
        if context is not None:
            self._due = now + self._again_s
            effort = self._state.effort
            self._state.worker.submit(partial(self._weigh_rest, q, context, effort, now))
        if self._tells and now - self._last_s >= 1.0:  # as often as a payload is published
            self._last_s = now
            self._tell_payload(now)

    def _on_wrench(self, message: WrenchStamped) -> None:
        try:
            row, force = wrench_of(message, self._arm)
        except InputError as error:
            self._state.node.tally.count_dropped("wrench", str(error))
            return
        self._wrist = Wrist(row, force, self._sigma), time.monotonic()

    @property
    def _again_s(self) -> float:
        """Time, s, after which a rest that lasts is weighed again."""
        return 0.5 * self._max_age_s

    def _circumstances(self, now: float) -> Context | None:
        """Return the circumstances, whatever the payload is; None while one is unknown or old."""
        readings = self._state.readings
        for source in ("payload", "load"):
            readings = readings.with_reading(source, {}, now)
        model, history = self._state.files.loaded.model, self._state.driver.history
        try:
            return readings.context(model, now, self._max_age_s, history)
        except StaleContext:
            return None

    def _weigh_rest(self, q: np.ndarray, context: Context, effort: np.ndarray, at_s: float) -> None:
        told = self._state.readings.fresh("payload", at_s, self._max_age_s)
        kg = told.get("payload_kg")
        if kg != self._told:
            self._before, self._told = self._weighing.change_payload(), kg
        model, wrist = self._state.files.loaded.model, None
        if self._wrist is not None and self._wrist[1] > self._felt_s:  # felt since
            wrist, _ = self._wrist
        rest = feel_rest(model, q, context, effort, self._drives, wrist)
        if not rest.finite:
            self._state.node.tally.count_dropped("rest", "what was felt at a rest is not finite")
            return
        if rest.measured:
            self._weighing, self._felt_s = self._before.with_rest(rest), at_s

    def _tell_payload(self, now: float) -> None:
        """Enter the payload of the last rest in the circumstances, unless one is published.

        An estimate outside the allowed range counts as its nearest allowed value, if it may be by
        chance. Otherwise it is refused, as a published one is.
        """
        found = self._weighing.payload
        if found is None or not found.tells(self._assumed_kg):
            return
        columns: dict[str, float] = {}
        if not self._state.readings.fresh("payload", now, self._max_age_s):
            low, high = allowed_range(self._arm, "payload_kg")
            nearest = min(max(found.kg, low), high)
            kg = found.kg if self._weighing.contradicts(nearest) else nearest
            columns = {"payload_kg": kg, SD: found.sigma_kg}
        if self._entered != (columns, self._felt_s):
            self._entered = columns, self._felt_s
            self._state.take_in("load", *self._entered)

    @property
    def _assumed_kg(self) -> float:
        declared = self._arm.payload
        return max(self._told or 0.0, 0.0 if declared is None else declared.mass_kg)

    def report(self) -> Report:
        found = self._weighing.payload
        if self._arm.payload is None:
            return Report(OK, "arm.yaml declares no payload")
        if found is None or not math.isfinite(found.sigma_kg):
            why = "no drive or wrist sensor reports a load"
            return Report(OK, f"the payload is not estimated: {why}")
        facts = {"kg": round(found.kg, 4), "sigma [kg]": round(found.sigma_kg, 4)}
        facts["rests"] = found.rests
        said = self._told if self._told is not None else self._arm.payload.mass_kg
        who = "told" if self._told is not None else "declared"
        if self._weighing.contradicts(said):
            wrong = f"{found} is felt, but {said:g} kg is {who}: weigh the payload and publish it"
            return Report(WARN, wrong, facts)
        if not found.tells(self._assumed_kg):
            return Report(OK, f"friction hides the payload: {found}", facts)
        return Report(OK, f"{found} is felt, {said:g} kg is {who}", facts)


def drives(servos: str, arm: Arm) -> Drives:
    """Return how the servos of a file measure loads; NaN for joints without data, or no file."""
    config = ServoConfig.load(servos).joints if servos else {}
    friction, step = np.full((2, arm.n), np.nan)
    for k, name in enumerate(arm.joint_names):
        joint = config.get(name)
        if joint is not None and joint.full_effort is not None and joint.servo.friction is not None:
            friction[k] = joint.full_effort * joint.servo.friction
            step[k] = joint.full_effort / joint.servo.full_load
    return Drives(friction, step)
