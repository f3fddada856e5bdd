"""Whole graphs on simulated arms: two side by side, killed nodes, a drifted arm, `longarm up`."""

import os
import shlex
import signal
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from places import DEMO_ARM as ARM

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from action_msgs.msg import GoalStatus
from nodes_bench import Bench, children, gone, last_status
from simulated_graph import forked_graph
from target_requests import pose
from visualization_msgs.msg import Marker

from longarm_comp.cli.run import root
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import SIMULATED, BringUp, Supervisor, running
from longarm_comp.nodes.health import WARN
from longarm_comp.nodes.messages import sighting_of, trajectory_message
from longarm_interfaces.action import Reach
from longarm_interfaces.srv import Compensate

SPEED = 8.0


class Station:
    """One arm's namespace as a client sees it."""

    def __init__(self, stage: Bench, namespace: str, arm: Arm) -> None:
        self.stage, self.arm, self.model = stage, arm, declared_model(arm)
        self.tips = stage.collect(graph.TIP_MEASURED, namespace)
        self.joints = stage.collect(graph.JOINT_STATES, namespace)
        self.diagnostics = stage.collect(graph.DIAGNOSTICS)
        self.namespace = namespace
        self.client = stage.node.create_client(Compensate, f"/{namespace}/compensate")

    def alive(self) -> bool:
        """Whether every part has said something since the lists were emptied."""
        return bool(self.tips and self.joints)

    def forget(self) -> None:
        for got in (self.tips, self.joints, self.diagnostics):
            got.clear()

    def reach(self, q: np.ndarray) -> np.ndarray:
        """Send the tip to where it hangs at q; the sighting that follows."""
        target = self.target = self.model.pose(q)
        request = Compensate.Request(target=pose(target), execute=True)

        def arrived() -> Any:
            answer = self.stage.call(self.client, request)
            if not answer.success:
                return None
            goal = np.array(answer.command.position)
            self.tips.clear()
            self.stage.spin(lambda: len(self.tips) > 4)
            at = dict(zip(self.joints[-1].name, self.joints[-1].position, strict=True))
            now = np.array([at[name] for name in self.arm.joint_names])
            return np.abs(now - goal).max() < 2e-3

        self.stage.spin(arrived)
        tip, _ = sighting_of(self.tips[-1])
        np.testing.assert_allclose(tip, target[:3, 3], atol=2e-3)
        return tip

    def told(self, part: str) -> tuple[bytes, str]:
        """Level and sentence of a part of /diagnostics, the last."""
        status = last_status(self.diagnostics, f"/{self.namespace}/{part}")
        return (b"", "") if status is None else (status.level, status.message)


def bring_up(namespace: str, **more: Any) -> BringUp:
    quick = {"diagnostics_period_s": 0.2, "compiled": False}
    parameters = {
        "simulated_arm": {"frame_rate_hz": 4.0} | more.pop("sim", {}),
        "kinematics": quick | more.pop("kinematics", {}),
    }
    return BringUp(arm=ARM, sim=True, speed=SPEED, namespace=namespace, set=parameters, **more)


@pytest.mark.long
def test_two_arms_side_by_side_survive_killed_nodes(stage: Bench, arm: Arm) -> None:
    said: list[str] = []
    compiled = bring_up("right_arm", kinematics={"compiled": True})
    with running(bring_up("left_arm"), say=said.append) as left, running(compiled) as right:
        one, two = Station(stage, "left_arm", arm), Station(stage, "right_arm", arm)
        stage.spin(lambda: one.alive() and two.alive())
        still = np.array(two.joints[-1].position)
        tip = one.reach(arm.mid)
        np.testing.assert_allclose(two.joints[-1].position, still, atol=1e-4)
        other = two.reach(0.3 * arm.lower + 0.7 * arm.upper)
        assert np.linalg.norm(other - tip) > 0.05
        shows_what_there_is(stage, one)
        the_action_says_where_it_came_to_rest(stage, one)
        for node in SIMULATED:
            survives(stage, one, left, node)
        end_tidily(stage, one, left, said)
        one.reach(0.6 * arm.lower + 0.4 * arm.upper)
        pids = [s.pid(node) for s in (left, right) for node in SIMULATED]
    assert all(gone(pid) for pid in pids)


def the_action_says_where_it_came_to_rest(stage: Bench, station: Station) -> None:
    """One goal is reached and measured, another one cancelled on its way."""
    arm, model = station.arm, station.model
    client = stage.action(Reach, f"/{station.namespace}/reach")
    heard: list[Reach.Feedback] = []

    def goal(q: np.ndarray) -> Any:
        wanted = Reach.Goal(target=pose(model.pose(q)))
        sent = client.send_goal_async(wanted, feedback_callback=lambda m: heard.append(m.feedback))
        stage.spin(sent.done)
        assert sent.result().accepted
        return sent.result()

    q = 0.4 * arm.lower + 0.6 * arm.upper
    first, second = goal(q), goal(arm.mid)  # in their order
    cancelled = second.cancel_goal_async()
    answer = first.get_result_async()
    stage.spin(answer.done)
    result = answer.result().result
    assert answer.result().status == GoalStatus.STATUS_SUCCEEDED
    assert result.success and result.seen and result.id, result.message
    np.testing.assert_allclose(
        model.tip(np.array(result.command.position)), model.tip(q), atol=1e-5
    )
    np.testing.assert_allclose(result.reached.position, result.command.position, atol=2e-3)
    tip = np.array([result.tip.x, result.tip.y, result.tip.z])
    miss = np.array([result.miss.x, result.miss.y, result.miss.z])
    np.testing.assert_allclose(tip - model.tip(q), miss, atol=1e-9)
    assert np.abs(miss).max() < 2e-3
    moving = [feedback for feedback in heard if feedback.phase == Reach.Feedback.MOVING]
    assert np.abs(moving[0].remaining).max() > np.abs(moving[-1].remaining).max()
    assert any(feedback.phase == Reach.Feedback.LOOKING for feedback in heard)
    stage.spin(cancelled.done)
    dropped = second.get_result_async()
    stage.spin(dropped.done)
    assert dropped.result().status == GoalStatus.STATUS_CANCELED
    assert not dropped.result().result.command.name  # it was not begun

    third = goal(arm.mid)
    heard.clear()
    stage.spin(lambda: any(feedback.phase == Reach.Feedback.MOVING for feedback in heard))
    cancelled = third.cancel_goal_async()
    stage.spin(cancelled.done)
    stopped = third.get_result_async()
    stage.spin(stopped.done)
    assert stopped.result().status == GoalStatus.STATUS_CANCELED
    assert "cancelled" in stopped.result().result.message
    assert np.abs(np.array(stopped.result().result.reached.position) - arm.mid).max() > 1e-3


def survives(stage: Bench, station: Station, supervisor: Supervisor, node: str) -> None:
    """Kill a node: another takes its place, and the arm is measured and read again."""
    before = supervisor.pid(node)
    os.kill(before, signal.SIGKILL)

    def again() -> bool:
        supervisor.look()
        return supervisor.pid(node) != before

    stage.spin(again)
    station.forget()
    stage.spin(station.alive)


def end_tidily(stage: Bench, station: Station, supervisor: Supervisor, said: list[str]) -> None:
    """SIGINT ends every node with exit code 0, and the arm works with those that follow."""
    before = {node: supervisor.pid(node) for node in SIMULATED}
    said.clear()
    for pid in before.values():
        os.kill(pid, signal.SIGINT)

    def others() -> bool:
        supervisor.look()
        return all(supervisor.pid(node) != pid for node, pid in before.items())

    stage.spin(others)
    for node in SIMULATED:
        assert any(line.startswith(f"{node} ended (exit code 0)") for line in said), said
    station.forget()
    stage.spin(station.alive)


def shows_what_there_is(stage: Bench, station: Station) -> None:
    """The picture for RViz is that of this arm, this target and this sighting."""
    pictures = stage.collect(graph.MARKERS, station.namespace)

    def drawn() -> dict[str, Any]:
        made = {marker.ns: marker for marker in pictures[-1].markers} if pictures else {}
        return made if all(len(made[name].points) for name in made) else {}

    made = stage.spin(drawn)
    at = {name: np.array([[p.x, p.y, p.z] for p in made[name].points]) for name in made}
    shapes = {name: marker.type for name, marker in made.items()}
    assert shapes == {
        "declared": Marker.LINE_STRIP, "hanging": Marker.LINE_STRIP, "target": Marker.SPHERE_LIST,
        "pseudo_target": Marker.SPHERE_LIST, "tip_measured": Marker.SPHERE_LIST,
        "error": Marker.ARROW,
    }  # fmt: skip
    assert {marker.header.frame_id for marker in made.values()} == {f"{station.namespace}/base"}
    joints = dict(zip(station.joints[-1].name, station.joints[-1].position, strict=True))
    q = np.array([joints[name] for name in station.arm.joint_names])
    np.testing.assert_allclose(at["declared"][-1], Model(station.arm).tip(q), atol=1e-3)
    np.testing.assert_allclose(at["hanging"][-1], station.model.tip(q), atol=1e-3)
    assert at["hanging"][-1][2] < at["declared"][-1][2] - 1e-3  # it sags
    target, tip = at["target"][0], at["tip_measured"][0]
    np.testing.assert_allclose(target, station.target[:3, 3], atol=1e-9)
    np.testing.assert_allclose(at["pseudo_target"][0], target, atol=1e-9)  # no predictor here
    np.testing.assert_allclose(tip, target, atol=2e-3)
    np.testing.assert_allclose(at["error"], [target, target + 50.0 * (tip - target)], atol=1e-9)


def runs_as_written(line: str, folder: Path) -> None:
    """Every command of the advice is one that `longarm` takes, with files that are there."""
    (folder / "poses.csv").touch()
    (folder / "session").mkdir()
    here = ("poses.csv", "session", "diagnosis")
    commands = [shlex.split(command) for command in line.split(" && ")]
    assert [words[1] for words in commands] == ["plan", "collect", "diagnose"]
    for longarm, name, *words in commands:
        assert longarm == "longarm" and str(ARM) in words
        command = root().get_command(click.Context(root()), name)
        assert command is not None
        command.make_context(name, [str(folder / w) if w in here else w for w in words])
    assert "--namespace arm" in line


def test_a_drifted_arm_is_noticed_and_the_command_named(
    stage: Bench, arm: Arm, tmp_path: Path
) -> None:
    settings = {"monitor.sigma_m": 3e-4, "monitor.settle_s": 0.2, "monitor.sightings": 1}
    drifted = bring_up("arm", sim={"hidden": "base_pose=4.0"}, kinematics=settings)
    with forked_graph(drifted):
        station = Station(stage, "arm", arm)
        stage.spin(station.alive)
        rng = np.random.default_rng(2)
        sender = stage.node.create_publisher(
            graph.JOINT_TRAJECTORY.type, "/arm/joint_trajectory", 10
        )
        stage.connected(sender)

        def warned() -> bool:
            q = arm.mid + 0.1 * (rng.random(arm.n) - 0.5) * (arm.upper - arm.lower)
            now = stage.node.get_clock().now().to_msg()
            sender.publish(trajectory_message(arm, q[None], 0.1, now))
            station.tips.clear()
            stage.spin(lambda: len(station.tips) > 5)
            return station.told("kinematics: monitor")[0] == WARN

        stage.spin(warned)
        _, message = station.told("kinematics: monitor")
        runs_as_written(message.split("run: ")[1], tmp_path)


def test_nothing_outlives_longarm_up(stage: Bench, arm: Arm) -> None:
    """Killed. That it ends when it is told to is tried where it is installed, in test_package."""
    command = ["-m", "longarm_comp", "up", str(ARM), "--sim", "--namespace", "arm"]
    program = stage.python([*command, "--speed", str(SPEED)])
    station = Station(stage, "arm", arm)
    stage.spin(station.alive)
    pids = children(program)
    assert len(pids) == len(SIMULATED)
    program.kill()
    program.wait(timeout=300)
    stage.spin(lambda: all(map(gone, pids)))


def test_a_wrong_bring_up_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="elbow"):
        BringUp(arm=ARM, set={"elbow": {}})
    with pytest.raises(InputError, match="speed"):
        BringUp(arm=ARM, speed=0.0)
