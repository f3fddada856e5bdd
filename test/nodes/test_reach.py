"""The action `reach`: what a cancelled goal still moves."""

import threading

import pytest
from places import DEMO_ARM as ARM

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from action_msgs.msg import GoalStatus
from kinematics_inside import kinematics_inside
from nodes_bench import PATIENT, Bench
from played_driver import Driver
from target_requests import pose, request

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.nodes import interfaces as graph
from longarm_interfaces.action import Reach


def test_a_goal_cancelled_before_its_joints_are_sent_moves_nothing(stage: Bench, arm: Arm) -> None:
    """The worker is busy with another job when the goal comes, and still when it is cancelled."""
    target = declared_model(arm).pose(arm.mid)
    begun, go_on = threading.Event(), threading.Event()

    def busy() -> None:
        begun.set()
        go_on.wait()

    with kinematics_inside(
        arm=ARM, compiled="false", acknowledged="true", method="deflection",
        **PATIENT,
    ) as node:  # fmt: skip
        worker = node._arm.worker
        try:
            driver = Driver(stage, arm)
            driver.instances = ("a",)
            client = graph.COMPENSATE.client(stage.node)
            reach = stage.action(Reach, graph.REACH.name)
            stage.spin(lambda: stage.call(client, request(target, arm, execute=True)).success)
            stage.spin(lambda: driver.got)
            worker.submit(busy)
            stage.spin(begun.is_set)
            driver.got.clear()
            sent = reach.send_goal_async(Reach.Goal(target=pose(target)))
            stage.spin(lambda: sent.done() and worker.waiting)
            goal = sent.result()
            stage.spin(goal.cancel_goal_async().done)
        finally:
            go_on.set()
        ended = goal.get_result_async()
        stage.spin(ended.done)
    assert ended.result().status == GoalStatus.STATUS_CANCELED
    assert ended.result().result.message == "cancelled before anything was sent"
    assert not driver.got
