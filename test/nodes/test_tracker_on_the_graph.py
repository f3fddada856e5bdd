"""A tracker that stands anywhere, on a real graph: before its place is known, and after."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from cli_shell import Shell
from geometry_msgs.msg import PoseWithCovariance, PoseWithCovarianceStamped
from nodes_bench import Bench, bench
from own_graph import own_graph
from quick_arm import QuickArm, quick_arm
from small_arm import ARM as SMALL
from small_arm import AWAY
from target_requests import pose
from visualization_msgs.msg import MarkerArray

from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.drive_errors import GearEccentricity
from longarm_comp.core.effects.geometry_errors import DhError, JointZero
from longarm_comp.core.ik.engines import posture_at
from longarm_comp.core.model.model import Model, slots_of
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.core.model.uncertainty import ModelUncertainty
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import joints_of, pose_message, sighting_of
from longarm_interfaces.action import Reach

BENT = Model(SMALL, (DhError(row=2, alpha=0.01), GearEccentricity(2, cosine=0.01, sine=-0.01)))


def known_by_a_tracker() -> Model:
    """The bent arm, its tracker's place, and what rows of a tracker do not tell: a turn of the
    first joint's zero against one of the base."""
    zero = JointZero(1, 0.0)
    model, slots = BENT.plus(zero).plus(AWAY), slots_of(SMALL, (zero, AWAY))
    q = np.random.default_rng(0).uniform(SMALL.lower, SMALL.upper, (20, SMALL.n))
    columns = model.columns(posture_at(model, q, Context()), slots)[1].reshape(60, len(slots))
    base = np.linalg.lstsq(columns[:, 1:], -columns[:, 0])[0]
    together = 2e-3 * np.r_[1.0, base][:, None] * np.eye(len(slots))[:1]
    none = np.zeros((3, 3))
    record = ModelUncertainty(tuple(s.identity for s in slots), together, none, none, 1e-3, 200)
    return dataclasses.replace(model, uncertainty=record)


QUICK = ("--move", 0.1, "--sightings", 2, "--dwell", 0.2)
STANDS = AWAY.base(SMALL).matrix() @ np.linalg.inv(SMALL.base.frame().matrix())


class Scene:
    """The bent arm with its tracker, `kinematics` and `trajectory_compensator`, and a client."""

    def __init__(self, stage: Bench, folder: Path, arm: QuickArm) -> None:
        self.stage, self.true, self.file = stage, arm, folder / "arm.yaml"
        self.model = folder / "model.yaml"
        self.file.write_text(SMALL.model_dump_json(exclude_defaults=True))
        given = {"arm": self.file, "model": self.model, "method": "deflection"}
        stage.start("kinematics", given | {
            "acknowledged": True, "monitor.settle_s": 0.1, "monitor.sightings": 2,
            "diagnostics_period_s": 0.1, "readings.period_s": 0.2, "markers.period_s": 0.1,
        })  # fmt: skip
        stage.start("trajectory_compensator", given | {"planned_period_s": 0.05})
        self.said = stage.collect(graph.DIAGNOSTICS)
        self.seen, self.by_readings = (
            stage.collect(topic) for topic in (graph.TIP_SEEN, graph.TIP_BY_READINGS)
        )
        self.planned, self.stories = (
            stage.collect(topic) for topic in (graph.PLANNED_JOINTS, graph.COMPENSATION)
        )
        self.markers: list[MarkerArray] = []
        stage.node.create_subscription(MarkerArray, "markers", self.markers.append, 1)
        self.client = stage.action(Reach, graph.REACH.name)

    def reach(self, target: np.ndarray, frame: str) -> Any:
        """The result for a position (3,)."""
        goal = Reach.Goal(target=pose(target, frame), position_only=True)
        sent = self.client.send_goal_async(goal)
        self.stage.spin(sent.done)
        ended = sent.result().get_result_async()
        self.stage.spin(ended.done)
        return ended.result().result

    def part(self, name: str) -> Any:
        """What a node's part says now on /diagnostics."""
        del self.said[:]
        return self.stage.spin(lambda: next(
            (s for m in self.said for s in m.status if s.name.endswith(name)), None
        ))  # fmt: skip

    def calibrated(self) -> None:
        """Have both nodes read the model that knows the tracker's place."""
        save_model(self.model, store(known_by_a_tracker()))
        for node in ("kinematics", "trajectory_compensator"):
            self.stage.spin(lambda node=node: "loaded" in self.part(f"{node}: model").message)

    def latest(self, messages: list[Any]) -> Any:
        del messages[:]
        return self.stage.spin(lambda: messages and messages[-1])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    folder = tmp_path_factory.mktemp("tracker")
    bent = lambda q, side: BENT.tip(q)  # noqa: E731
    with (
        own_graph(folder), quick_arm(SMALL, lambda q: True, bent, frame="tracker", stands=STANDS)
        as arm, bench() as stage,
    ):  # fmt: skip
        yield Scene(stage, folder, arm)


def targets(n: int) -> np.ndarray:
    span = SMALL.upper - SMALL.lower
    share = np.random.default_rng(5).uniform(0.25, 0.75, (n, SMALL.n))
    return BENT.tip(SMALL.lower + share * span)


def ready(scene: Scene) -> None:
    scene.stage.spin(lambda: scene.reach(targets(1)[0], "base").success)


def test_before_a_calibration_targets_are_in_the_base_and_no_sighting_is_believed(
    scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    ready(scene)
    for target in targets(2):
        found = scene.reach(target, "base")
        assert found.success and not found.seen, found.message
        assert "frame 'tracker' is unknown" in found.message
        assert 2e-3 < np.linalg.norm(scene.true.true - target) < 0.05  # not compensated
    said = scene.part("kinematics: monitor")
    assert "'tracker' is unknown" in said.message and said.level == b"\x00"
    assert scene.latest(scene.seen).header.frame_id == "tracker"
    away = scene.reach(targets(1)[0], "tracker")
    assert not away.success and "frame 'tracker' is unknown" in away.message
    shell = Shell(scene.file.parent, capsys)
    output = scene.file.parent / "verified"
    shell("verify", scene.file, "-n", 8, "--seed", 1, *QUICK, "-o", output)
    assert "'tracker'" in shell.err
    made = json.loads((output / "verify.json").read_text())
    assert made["placed_by_each_run"] == "tracker" and made["seen_in_both"] == 8
    assert max(row["max_mm"] for row in made["rows"]) < 20.0


def test_after_it_all_is_told_in_the_base_and_targets_may_be_in_either_frame(
    scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    scene.calibrated()
    ready(scene)
    for k, target in enumerate(targets(3)):
        frame = ("base", "tracker", "measured")[k % 3]
        place = target if frame == "base" else STANDS[:3, :3] @ target + STANDS[:3, 3]
        found = scene.reach(place, frame)
        assert found.success and found.seen, found.message
        np.testing.assert_allclose(found.reached.position, found.command.position, atol=1e-9)
        np.testing.assert_allclose(scene.true.true, target, atol=1e-5)
        np.testing.assert_allclose([found.tip.x, found.tip.y, found.tip.z], target, atol=1e-5)
        miss = [found.miss.x, found.miss.y, found.miss.z]
        np.testing.assert_allclose(miss, scene.true.true - target, atol=1e-6)
        story = scene.stories[-1]
        at = story.pseudo_target.pose.position
        np.testing.assert_allclose([at.x, at.y, at.z], target, atol=1e-9)
        assert story.target.header.frame_id == "base"
        assert (story.sigma > 2e-4) == (frame == "base")  # else what is not known cancels
    assert "as expected" in scene.part("kinematics: monitor").message
    told = scene.latest(scene.seen)
    assert told.header.frame_id == "base"
    np.testing.assert_allclose(sighting_of(told)[0], scene.true.true, atol=1e-9)
    by_readings = scene.latest(scene.by_readings)
    np.testing.assert_allclose(sighting_of(by_readings)[0], scene.true.true, atol=1e-6)
    drawn = {m.ns: m.points for m in scene.latest(scene.markers).markers}
    for name in ("hanging", "target", "tip_measured"):
        at = drawn[name][-1]
        np.testing.assert_allclose([at.x, at.y, at.z], scene.true.true, atol=1e-5)
    planned = joints_of(scene.latest(scene.planned), SMALL, "planned")
    np.testing.assert_allclose(Model(SMALL).tip(planned), scene.true.true, atol=1e-5)
    shell = Shell(scene.file.parent, capsys)
    for more in ((), ("--model", scene.model)):
        made = shell.json("verify", scene.file, "-n", 3, "--seed", 1, *QUICK, *more)
        without, with_it = (row["mean_mm"] for row in made["rows"])
        assert not made["placed_by_each_run"] and not made["refused"]
        assert without > 1.0 and with_it < 0.05


def test_a_sighting_in_any_frame_is_told(scene: Scene) -> None:
    tips = graph.TIP_MEASURED.publisher(scene.stage.node)
    for number, frame in enumerate(("measured", "tip", "base_link", "a frame/", "", "tracker")):
        message = PoseWithCovarianceStamped(pose=PoseWithCovariance(pose=pose_message(np.eye(4))))
        message.header.frame_id, message.header.stamp.sec = frame, number + 1

        def is_told(sent: PoseWithCovarianceStamped = message) -> bool:
            tips.publish(sent)  # again: who hears of a publisher is not known at once
            return sent.header.stamp.sec in {m.header.stamp.sec for m in scene.seen}

        scene.stage.spin(is_told)
    ready(scene)
