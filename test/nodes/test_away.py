"""`kinematics` that is stopped and continued, and drowned in targets: what still moves the arm."""

import signal
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from nodes_bench import PATIENT, Bench
from places import DEMO_ARM as ARM
from played_driver import Driver
from publishing import publishing
from rclpy.clock import ClockType, ROSClock
from rclpy.time import Time
from target_requests import pose, request
from trajectory_msgs.msg import JointTrajectory

from bench.slow_path import slow_path
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.graph_client import GraphClient
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import stamp_ns
from longarm_comp.nodes.orders import Stamps, order_id
from longarm_interfaces.action import Reach
from longarm_interfaces.msg import Motion
from longarm_interfaces.srv import Compensate

STATUS = Compensate.Response
MAX_AGE_S = 1.0
FLOOD = 3_000


class Stand:
    """A node of `kinematics` and a driver that takes what it sends."""

    def __init__(self, stage: Bench, arm: Arm, **parameters: object) -> None:
        self.stage, self.arm = stage, arm
        self.driver = Driver(stage, arm)
        self.driver.instances = ("a",)
        self.node = stage.start("kinematics", {
            "arm": ARM, "acknowledged": True, "method": "deflection", "run_up": False,
            "diagnostics_period_s": 0.1, "target_max_age_s": MAX_AGE_S, **parameters,
        })  # fmt: skip
        self.target = declared_model(arm).pose(arm.mid)
        self.client = graph.COMPENSATE.client(stage.node)
        self.stories = stage.collect(graph.COMPENSATION)
        self.health = stage.collect(graph.DIAGNOSTICS)

    def goes(self) -> None:
        """Wait until a target is sent and accepted; then forget it."""
        ask = request(self.target, self.arm, execute=True)
        self.stage.spin(lambda: self.stage.call(self.client, ask).success)
        self.stage.spin(lambda: self.stories and self.stories[-1].accepted)
        del self.driver.got[:], self.stories[:]

    def facts(self) -> dict[str, int]:
        """The counts of a report that is made from now on."""
        now_ns = time.time_ns()

        def told() -> list[dict[str, int]]:
            return [
                {v.key: int(v.value) for v in status.values if v.value.isdecimal()}
                for array in self.health
                if stamp_ns(array.header.stamp) > now_ns
                for status in array.status
                if status.name == "/kinematics: targets"
            ]

        return self.stage.spin(told)[-1]


def passes(stage: Bench, seconds: float) -> None:
    end = time.monotonic() + seconds
    stage.spin(lambda: time.monotonic() > end)


def test_what_its_clients_gave_up_meanwhile_moves_nothing(stage: Bench, arm: Arm) -> None:
    stand = Stand(stage, arm)
    targets = graph.TARGET_POSE.publisher(stage.node)
    reach = stage.action(Reach, graph.REACH.name)
    stage.connected(targets)
    stand.goes()
    stand.node.send_signal(signal.SIGSTOP)
    unstamped = pose(stand.target)
    asked = stand.client.call_async(request(stand.target, arm, execute=True))
    targets.publish(unstamped)
    goal = reach.send_goal_async(Reach.Goal(target=unstamped))
    passes(stage, 2.0 * MAX_AGE_S)
    stand.node.send_signal(signal.SIGCONT)
    stage.spin(lambda: asked.done() and goal.done())
    ended = goal.result().get_result_async()
    stage.spin(ended.done)
    reached = ended.result().result.status
    stage.spin(lambda: len(stand.stories) >= 2)  # of a goal without a driver there is none
    said = [(s.status, s.message) for s in stand.stories]
    assert asked.result().status == STATUS.STALE_TARGET
    assert reached in (STATUS.STALE_TARGET, STATUS.NO_DRIVER)  # the driver was not heard either
    assert all(status == STATUS.STALE_TARGET and "sent" in why for status, why in said)
    assert not stand.driver.got
    stand.goes()


def test_an_answer_that_came_while_it_was_stopped_counts(stage: Bench, arm: Arm) -> None:
    stand = Stand(stage, arm, acknowledge_s=6.0)
    withdrawn = stage.collect(graph.WITHDRAWN)
    stand.goes()
    del withdrawn[:]  # of a first try that a busy machine answered late
    took = stand.driver.tell

    def stops(event: int, name: str, taken: JointTrajectory | None = None) -> None:
        stand.node.send_signal(signal.SIGSTOP)
        took(event, name, taken)

    stand.driver.tell = stops  # type: ignore[method-assign]
    asked = stand.client.call_async(request(stand.target, arm, execute=True))
    stage.spin(lambda: stand.driver.got)
    passes(stage, 7.0)  # longer than it waits for an answer
    stand.node.send_signal(signal.SIGCONT)
    stage.spin(asked.done)
    assert asked.result().success and not withdrawn
    assert asked.result().id == order_id(stand.driver.got[-1])
    stand.driver.tell, stand.driver.event = took, Motion.REFUSED  # type: ignore[method-assign]
    ask = request(stand.target, arm, execute=True)  # it has to hear of the driver first
    stage.spin(lambda: stage.call(stand.client, ask).status == STATUS.NOT_ACCEPTED)
    assert not withdrawn  # what is refused needs no withdrawal


def test_what_was_not_accepted_is_withdrawn(stage: Bench, arm: Arm) -> None:
    stand = Stand(stage, arm, acknowledge_s=0.3)
    withdrawn = stage.collect(graph.WITHDRAWN)
    stand.goes()
    del withdrawn[:]  # of a first try that a busy machine answered late
    stand.driver.answers = False
    answer = stage.call(stand.client, request(stand.target, arm, execute=True))
    assert answer.status == STATUS.NOT_ACCEPTED and "withdrawn" in answer.message
    stage.spin(lambda: withdrawn)
    assert [w.data for w in withdrawn] == [order_id(t) for t in stand.driver.got]
    sent = stand.driver.got[-1].header.stamp
    assert 1e9 * sent.sec + sent.nanosec == pytest.approx(time.time_ns(), abs=60e9)


def test_a_flood_of_targets_starves_neither_a_service_nor_the_last_of_them(
    stage: Bench, arm: Arm
) -> None:
    """Some 1,000 a second for three seconds, beside requests."""
    stand = Stand(stage, arm, **PATIENT)
    targets, sent = graph.TARGET_POSE.publisher(stage.node), 0
    stand.goes()
    stage.matched(targets, pose(stand.target), stand.stories)
    before, asked_before = stand.facts(), stage.asked[stand.client]
    poses = [pose(matrix) for matrix in slow_path(arm, 97)]

    def served() -> bool:
        """Whether the flood has let enough requests and targets through."""
        return stage.asked[stand.client] - asked_before > 10 and len(stand.driver.got) > 10

    def flood(client: GraphClient, step: int) -> None:
        nonlocal sent
        if sent < FLOOD:
            count = 20
        else:
            count = 0 if served() else 1
        for _ in range(count):
            targets.publish(poses[sent % len(poses)])
            sent += 1

    ask = request(stand.target, arm)
    with publishing(flood):
        while sent < FLOOD or not served():
            answer = stage.call(stand.client, ask)
            assert answer.success, answer.message
    asked = stage.asked[stand.client] - asked_before  # some of them twice, at load

    def accounted() -> bool:
        facts, counted = stand.facts(), 0
        for name, count in facts.items():
            if name.isupper() or name in (
                "superseded; its fate was not recorded",
                "lost on the way",
            ):
                counted += count - before.get(name, 0)
        return counted == sent + asked and not facts["superseded, not told yet"]

    stage.spin(accounted)
    last = slow_path(arm, 97)[(sent - 1) % 97]
    reached = np.array(stand.driver.got[-1].points[-1].positions)
    np.testing.assert_allclose(declared_model(arm).tip(reached), last[:3, 3], atol=1e-5)


def test_stamps_of_orders_differ_and_go_where_the_clock_goes() -> None:
    clock = ROSClock()
    clock._set_ros_time_is_active(True)
    stamps, made = Stamps(clock), []
    for now_ns in (5_000, 5_000, 5_001, 9_000, 2_000, 2_000, 4_000):  # it stands, and goes back
        clock.set_ros_time_override(Time(nanoseconds=now_ns, clock_type=ClockType.ROS_TIME))
        made.append(stamp_ns(stamps.next()))
    assert made == [5_000, 5_001, 5_002, 9_000, 2_000, 2_001, 4_000]
