"""`trajectory_compensator` while the driver, played by the test, is stopped and goes on."""

import time
from collections.abc import Callable

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from action_msgs.msg import GoalStatus
from nodes_bench import Bench
from places import DEMO_ARM as ARM
from planning import THEIRS, Controller, Planner, ramp
from played_driver import Driver, is_away
from rclpy.duration import Duration

from longarm_comp.core.arm.arm import Arm
from longarm_comp.nodes import interfaces as graph
from longarm_interfaces.msg import DriverState

pytestmark = pytest.mark.skipif(not graph.HAS_FOLLOW, reason="control_msgs is not installed")


def test_a_plan_from_before_a_stop_or_an_absence_is_not_followed(stage: Bench, arm: Arm) -> None:
    controller, driver = Controller(stage, arm), Driver(stage, arm)
    controller.timer.cancel()  # the driver tells where the joints are
    driver.instances = ("the only one",)
    process = stage.start("trajectory_compensator", {
        "arm": ARM, "controller": THEIRS, "acknowledged": True, "method": "deflection",
        "max_velocity": [1.0], "max_acceleration": [5.0], "planned_period_s": 0.05,
        "diagnostics_period_s": 0.1, "order_max_age_s": 60.0,
    })  # fmt: skip
    planner, names = Planner(stage), list(arm.joint_names)
    plan = ramp(arm.mid, arm.mid + 0.1 * (arm.upper - arm.lower))

    def refused(stamp: object = None) -> str:
        goal = planner.send(names, plan, stamp=stamp)
        return str(planner.ends(goal, GoalStatus.STATUS_ABORTED).error_string)

    def stops_and_goes_on() -> None:
        for state in (DriverState.ESTOP, DriverState.READY):
            driver.says(state)

    def unheard() -> None:
        driver.stops += 2
        driver.beat()

    def another() -> None:
        driver.instances = ("another",)
        driver.beat()

    events: tuple[Callable[[], object], ...] = (stops_and_goes_on, unheard, another)
    for happens in events:
        before = stage.node.get_clock().now().to_msg()
        happens()
        by = time.monotonic() + 0.5  # a goal without a stamp would be from after it
        while time.monotonic() < by:
            stage.executor.spin_once(timeout_sec=0.02)
        for publisher in stage.node.publishers:
            assert publisher.wait_for_all_acked(Duration(seconds=60.0))
        assert "the arm was stopped after this was asked" in refused(before)
    asked = list[object]()
    is_away(stage, process, 1.5, lambda: asked.append(planner.ask(names, plan)))
    stage.spin(asked[0].done)
    result = planner.ends(asked[0].result(), GoalStatus.STATUS_ABORTED)
    assert "this node was away" in result.error_string
    assert not controller.got
