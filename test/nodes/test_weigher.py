"""What `kinematics` makes of a weighed payload: as old as its rest, and refused as any other."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from kinematics_inside import kinematics_inside

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.circumstances import allowed_range
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.online import StaleContext
from longarm_comp.core.compensation.weighing import SD, Wrist
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.payload import Weigher
from longarm_interfaces.msg import Motion

AGE_S = 1000.0


class Scale:
    """A weigher whose wrist sensor feels a payload, and an arm that goes from rest to rest."""

    def __init__(self, state: ArmState, arm: Arm) -> None:
        self.state, self.arm, self.weigher = state, arm, Weigher(state)
        self.model, self.rng, self.q = declared_model(arm), np.random.default_rng(2), arm.mid

    def feel(self, kg: float) -> None:
        at = self.model.posture(tuple(self.q), Context(columns={"payload_kg": kg}))
        row = len(self.arm.joints)
        force = np.array(at.force(at.frame(row)), float)
        self.weigher._wrist = Wrist(row, force, 0.05), time.monotonic()

    def weigh(self) -> float:
        """Tell the joints until the rest is weighed; the time before."""
        before, felt_s = time.monotonic(), self.weigher._felt_s
        self.until(lambda: self.weigher._felt_s > felt_s)
        self.weigher._last_s = -np.inf  # it would wait for the next second
        self.weigher.on_joints(self.q, 0.0)
        return before

    def until(self, done: Callable[[], bool]) -> None:
        while not done():
            self.weigher.on_joints(self.q, 0.0)
            time.sleep(0.01)

    def go_and_weigh(self, kg: float) -> float:
        self.weigher.on_command(self.q, History.unknown(self.arm.n))
        self.q = self.arm.lower + self.rng.uniform(0.2, 0.8, self.arm.n) * (
            self.arm.upper - self.arm.lower
        )
        self.feel(kg)
        self.weigher.on_motion(Motion(event=Motion.REACHED))
        return self.weigh()

    def context(self, later_s: float = 0.0) -> Context:
        now = time.monotonic() + later_s
        return self.state.readings.context(self.model, now, AGE_S)

    @property
    def rests(self) -> int:
        return len(self.weigher._weighing.rests)


@pytest.fixture
def scale(ros_domain: int, demo_arm_path: Path, arm: Arm) -> Iterator[Scale]:
    with kinematics_inside(**{
        "arm": demo_arm_path, "compiled": "false", "acknowledged": "false",
        "payload.by_load": "true", "monitor.settle_s": 0.0, "context_max_age_s": AGE_S,
    }) as node:  # fmt: skip
        yield Scale(node._arm, arm)


def test_a_weighed_payload_grows_old_from_the_last_rest_that_supports_it(scale: Scale) -> None:
    for _ in range(4):
        before = scale.go_and_weigh(0.9)
    after = time.monotonic()
    assert scale.context().columns["payload_kg"] == pytest.approx(0.9, abs=0.05)
    felt_s = scale.state.readings.readings["load"].at_s
    assert before <= felt_s == scale.weigher._felt_s <= after and scale.rests == 4
    scale.weigher._last_s = -np.inf  # it is told again, and no younger by that
    scale.weigher.on_joints(scale.q, 0.0)
    assert scale.state.readings.readings["load"].at_s == felt_s
    assert scale.context(felt_s + 0.99 * AGE_S - time.monotonic()).columns[SD] < 0.1
    with pytest.raises(StaleContext, match=r"payload_kg is 1\d\d\d"):
        scale.context(1.01 * AGE_S)

    # The rest lasts: weighed again, it is younger, and still one rest
    assert before + 0.5 * AGE_S <= scale.weigher._due <= time.monotonic() + 0.5 * AGE_S
    scale.feel(0.8)
    scale.weigher._due = 0.0
    again = scale.weigh()
    assert scale.state.readings.readings["load"].at_s >= again and scale.rests == 4
    assert scale.context().columns["payload_kg"] < 0.9

    # Not by what was felt before
    scale.weigher._due, felt_s, done = 0.0, scale.weigher._felt_s, threading.Event()
    scale.weigher.on_joints(scale.q, 0.0)
    scale.state.worker.submit(done.set)
    done.wait()
    assert scale.weigher._felt_s == felt_s and scale.rests == 4

    # Even after it has become too old, and where it comes to rest after a break
    scale.state.take_in("load", {"payload_kg": 0.8}, -2.0 * AGE_S)
    scale.weigher.on_motion(Motion(event=Motion.BROKEN_OFF))
    assert scale.weigher._due > time.monotonic()
    scale.feel(0.8)
    scale.weigher._due = 0.0
    scale.weigh()
    assert scale.context().columns["payload_kg"] < 0.9


def test_nothing_is_weighed_while_the_driver_takes_no_orders(scale: Scale) -> None:
    scale.state.driver.acknowledged = True  # and nobody reports
    scale.weigher.on_motion(Motion(event=Motion.REACHED))
    scale.feel(0.9)
    scale.weigher.on_joints(scale.q, 0.0)
    assert scale.weigher._due <= time.monotonic()
    scale.state.driver.acknowledged = False
    scale.weigh()
    assert scale.rests == 1


@pytest.mark.parametrize("kg", [20.0, -5.0])
def test_a_weighed_payload_is_refused_where_a_published_one_is(
    scale: Scale, arm: Arm, kg: float
) -> None:
    for _ in range(4):
        scale.go_and_weigh(kg)
    with pytest.raises(StaleContext, match=r"load: payload_kg: .* of arm"):
        scale.context()
    scale.state.take_in("payload", {"payload_kg": 0.4})  # somebody says what it carries
    scale.weigher._last_s = -np.inf
    scale.weigher.on_joints(scale.q, 0.0)
    assert scale.context().columns == {"payload_kg": 0.4}
    scale.go_and_weigh(1.0)
    assert scale.weigher._weighing.payload.tells(0.4)
    assert scale.context().columns == {"payload_kg": 0.4}


def test_an_empty_tool_weighs_nothing_and_not_less(scale: Scale) -> None:
    for _ in range(4):
        scale.go_and_weigh(-0.002)
    assert scale.weigher._weighing.payload.kg < 0.0
    assert scale.context().columns["payload_kg"] == allowed_range(scale.arm, "payload_kg")[0] == 0.0
