"""Nonsense on the graph moves nothing, is said, and silences nothing else."""

import math
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from geometry_msgs.msg import PoseWithCovarianceStamped
from kinematics_inside import kinematics_inside
from nodes_bench import PATIENT, Bench, facts_of
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import Float64
from watched_kinematics import Watched

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.online import JointTrust
from longarm_comp.nodes import arm_state, worker
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.health import ERROR, OK, WARN, Report
from longarm_comp.nodes.kinematics import Kinematics
from longarm_comp.nodes.messages import efforts_of, joints_message
from longarm_interfaces.srv import Compensate

STATUS = Compensate.Response


@pytest.fixture
def inside(stage: Bench, demo_arm_path: Path) -> Iterator[Kinematics]:
    """The node in this process, so that a test can break parts of it."""
    with kinematics_inside(
        arm=demo_arm_path, compiled="false", acknowledged="false", method="deflection",
        diagnostics_period_s=0.1, **PATIENT,
    ) as node:  # fmt: skip
        yield node


class Moving(Watched):
    """An arm that tells its joints, and targets that are to be executed."""

    def __init__(self, stage: Bench, arm: Arm) -> None:
        super().__init__(stage, arm)
        self.sent = stage.collect(graph.JOINT_TRAJECTORY)
        self.tells(0.02, arm.mid)
        self.until("", STATUS.SUCCESS)

    def tells(self, period_s: float, q: np.ndarray, **more: Any) -> Any:
        """Publish joints as another publisher does; its timer."""
        joints, node = graph.JOINT_STATES.publisher(self.stage.node), self.stage.node

        def tell() -> None:
            now = node.get_clock().now().to_msg()
            joints.publish(joints_message(self.arm, q, more.get("stamp", now)))

        self.stage.connected(joints)
        return node.create_timer(period_s, tell)

    def until(self, words: str, status: int, do: Callable[[], object] = lambda: None) -> str:
        """Do something until an executed target is answered so; the answer's message."""

        def answered() -> str:
            do()
            answer = self.ask(execute=True)
            fits = answer.status == status and words in answer.message
            return answer.message or "sent" if fits else ""

        said: str = self.stage.spin(answered)
        return said


@pytest.fixture
def moving(stage: Bench, arm: Arm, demo_arm_path: Path) -> Moving:
    """Beside the node as a process."""
    stage.start("kinematics", {
        "arm": demo_arm_path, "method": "deflection", "diagnostics_period_s": 0.1,
    })  # fmt: skip
    return Moving(stage, arm)


@pytest.mark.parametrize("rate_hz", [2.0, pytest.param(5.0, marks=pytest.mark.long)])
def test_of_sixteen_targets_beside_rival_joints_none_moves_the_arm(
    stage: Bench, arm: Arm, moving: Moving, rate_hz: float
) -> None:
    """At zeros, as a forgotten joint_state_publisher tells them; at the arm's own joints too."""
    told = arm.mid.copy()
    rival = moving.tells(1.0 / rate_hz, told)
    for told[:] in (arm.mid, np.zeros(arm.n)):
        moving.until("two publishers tell joint_states", STATUS.NOT_READY)
        moving.sent.clear()
        for _ in range(16):
            pause = stage.node.get_clock().now().nanoseconds + int(0.13e9)
            stage.spin(lambda until=pause: stage.node.get_clock().now().nanoseconds > until)
            answer = moving.ask(execute=True)
            assert answer.status == STATUS.NOT_READY, answer.message
            assert "two publishers tell joint_states in turn: end one of them" in answer.message
        assert not moving.sent
    moving.says("targets", "two publishers tell joint_states", level=WARN)
    stage.node.destroy_timer(rival)
    moving.until("", STATUS.SUCCESS)
    stage.spin(lambda: moving.sent)


def test_payloads_that_no_arm_carries_move_nothing_and_silence_nothing(
    stage: Bench, moving: Moving
) -> None:
    payload, warmth = (t.publisher(stage.node) for t in (graph.PAYLOAD, graph.TEMPERATURE))
    tips = graph.TIP_MEASURED.publisher(stage.node)
    for publisher in (payload, warmth, tips):
        stage.connected(publisher)
    for kg in (-5.0, 10.0, 1e30, -1e-3):
        carries = partial(payload.publish, Float64(data=kg))
        said = moving.until("0 to 2.5", STATUS.STALE_CONTEXT, carries)
        assert f"payload_kg: {kg}" in said and "most_kg" in said
        moving.sent.clear()
        assert moving.ask(execute=True).status == STATUS.STALE_CONTEXT
        assert not moving.sent
        moving.says("messages", "not used: payload: payload_kg", level=WARN)
        moving.until("", STATUS.SUCCESS, partial(payload.publish, Float64(data=2.5)))
    for told in (math.nan, math.inf):  # dropped: the word before holds
        before = facts_of(moving.part("targets")).get("bad payload")

        def counted(told: float = told, before: Any = before) -> bool:
            payload.publish(Float64(data=told))
            return facts_of(moving.part("targets")).get("bad payload") != before

        stage.spin(counted)
        assert moving.ask(execute=True).status == STATUS.SUCCESS
    far = PoseWithCovarianceStamped()
    far.pose.pose.position.x = 1e300
    vague = PoseWithCovarianceStamped()
    vague.pose.covariance[7] = math.nan
    for publisher, message, words in (
        (warmth, Temperature(temperature=1e9), "not used: temperature: temperature_c: 1000000000"),
        (tips, far, "not used: tip_measured: position"),
        (tips, vague, "not used: tip_measured: covariance"),
    ):
        stage.spin(
            lambda p=publisher, m=message, w=words: (
                p.publish(m) or moving.part("messages").message.startswith(w)
            )
        )
        assert moving.ask(execute=True).status == STATUS.SUCCESS, "the model needs none of it"


def test_a_part_that_fails_silences_no_other_and_a_worker_that_fails_moves_nothing(
    inside: Kinematics, stage: Bench, arm: Arm, demo_arm_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    moving = Moving(stage, arm)

    def broken() -> Report:
        raise np.linalg.LinAlgError("Singular matrix")

    inside.health.parts = {"payload": broken, **inside.health.parts, "last": broken}
    inside.health.parts["payload"] = broken
    for part in ("payload", "last"):
        moving.says(part, "its state cannot be told: LinAlgError: Singular matrix", level=ERROR)
    for part in ("process", "graph", "monitor"):
        assert moving.part(part).level == OK
    assert moving.ask(execute=True).status == STATUS.SUCCESS

    fails = [True]

    def weigh() -> None:
        if fails:
            raise np.linalg.LinAlgError("Singular matrix")

    other = threading.Event()
    inside._arm.worker.submit(partial(partial(weigh)))
    inside._arm.worker.submit(other.set)
    assert other.wait(60.0), "the worker goes on"
    said = moving.until("not sent", STATUS.NOT_READY)
    assert "weigh failed: LinAlgError: Singular matrix" in said
    assert moving.ask().status == STATUS.SUCCESS, "computed only"
    moving.says("worker", "no motion: ", level=ERROR)
    fails.clear()
    other.clear()
    inside._arm.worker.submit(weigh)
    inside._arm.worker.submit(other.set)
    assert other.wait(60.0) and not inside._arm.worker.failing
    moving.until("", STATUS.SUCCESS)
    moving.says("worker", "every job was done")
    fails.append(True)
    inside._arm.worker.submit(weigh)
    moving.until("weigh failed", STATUS.NOT_READY)
    monkeypatch.setattr(worker, "_FAILING_S", 0.0)  # it is not held against it for ever
    moving.until("", STATUS.SUCCESS)
    stage.start("kinematics", {"arm": demo_arm_path, "diagnostics_period_s": 0.1})
    moving.until("two kinematics command this arm", STATUS.NO_DRIVER)


def test_old_joints_move_nothing(
    inside: Kinematics, arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = inside._arm
    heard = iter(range(1, 100))

    def tell() -> None:
        state._on_joints(joints_message(arm, arm.mid), {"publication_sequence_number": next(heard)})

    assert state.doubt == arm_state.NO_JOINTS
    tell()
    assert not state.doubt
    now = arm_state.time.monotonic()
    for age_s, old in ((59.0, False), (61.0, True), (1e5, True)):
        monkeypatch.setattr(arm_state.time, "monotonic", lambda age_s=age_s: now + age_s)
        assert bool(state.doubt) == old
        assert not old or "the last joint_states is" in state.doubt
    monkeypatch.undo()
    state._trust.distrust("for another reason")
    assert state.doubt == "for another reason"


# ------------------------------------------------------------------ without a graph


def test_who_publishes_joints_is_told_by_the_numbers_of_the_messages(arm: Arm) -> None:
    trust, now_s = JointTrust(arm, rate=1.0), 0.0

    def tell(number: int | None, q: np.ndarray = arm.mid) -> str:
        nonlocal now_s
        now_s += 0.02
        trust.heard(number, now_s)
        trust.read(q, now_s)
        return trust.doubt

    assert not any(tell(k) for k in (*range(100, 110), 150, 151)), "some are lost"
    assert tell(1) == "joint_states come from another publisher than before"
    doubts = [bool(tell(k)) for k in range(2, 80)]
    assert all(doubts[:49]) and not any(doubts[53:]), "a driver that was started again"
    now_s += 9.9
    assert not tell(80)
    tell(152)  # the same joints, of a publisher that is ahead: its return tells it
    assert tell(81) == "joint_states come from another publisher than before"
    for k in range(82, 85):
        assert tell(152)
        assert "two publishers tell joint_states in turn" in tell(k)
    now_s += 9.9
    assert "two publishers" in tell(85)
    assert "two publishers" in tell(86, np.zeros(arm.n)), "the cause is said, not the jump"
    now_s += 0.2
    assert [bool(tell(k)) for k in range(87, 92)] == [True] * 3 + [False] * 2
    now_s += 99.0
    assert tell(91) == "joint_states come from another publisher than before", "at the same number"


def test_where_no_message_has_a_number_a_jump_is_another_publisher(arm: Arm) -> None:
    trust, away = JointTrust(arm, rate=1.0), arm.mid + 0.4 * (arm.upper - arm.lower)
    for k, q in enumerate((arm.mid, away, *[arm.mid] * 499, *[arm.mid] * 10)):
        trust.heard(None, 0.02 * k)
        believed = trust.read(q, 0.02 * k)
        assert believed == (k == 0 or k >= 504), k


def test_efforts_that_no_drive_makes_are_none(arm: Arm) -> None:
    told = [1.0, -2.0, math.inf, 1e30, -1e30, math.nan, 0.0]
    message = JointState(name=list(arm.joint_names), effort=told)
    np.testing.assert_array_equal(efforts_of(message, arm), [1, -2, *[np.nan] * 4, 0])
