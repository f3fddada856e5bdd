"""Frames on a real graph: the arm's own, its URDF, and targets in frames that others tell."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import DEMO_ARM

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")
pytest.importorskip("tf2_msgs", reason="tf2_msgs is not installed: run make setup")

from nodes_bench import Bench, bench
from own_graph import own_graph
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from target_requests import pose

from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.frame_tree import FrameTree, UnknownPlace
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import Placed
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import stamp_ns
from longarm_comp.nodes.frames import FrameTeller
from longarm_comp.nodes.messages import joints_message
from longarm_comp.urdf_export import export_urdf
from longarm_interfaces.srv import Compensate

SIDE = "left_arm"
BASE = f"{SIDE}/base"


class Scene:
    """A `kinematics` in a namespace, and a program that tells it frames and asks for targets."""

    def __init__(self, stage: Bench, arm_path: Path, folder: Path) -> None:
        self.stage, self.arm = stage, Arm.load(arm_path)
        self.model = declared_model(self.arm).plus(*JointCompliance.for_arm(self.arm)[1:2])
        self.model = self.model.with_values(np.full(len(self.model.slots), 2e-3))
        save_model(folder / "model.yaml", store(self.model))
        stage.start("kinematics", {"arm": arm_path, "model": folder / "model.yaml"}, SIDE)
        self.heard = stage.collect(graph.TF), stage.collect(graph.TF_STATIC)
        self.urdf = stage.collect(graph.ROBOT_DESCRIPTION, SIDE)
        self.stories = stage.collect(graph.COMPENSATION, SIDE)
        self.joints = stage.node.create_publisher(
            graph.JOINT_STATES.type, f"/{SIDE}/joint_states", 10
        )
        self.client = stage.node.create_client(Compensate, f"/{SIDE}/compensate")
        self.teller = FrameTeller(stage.node)
        stage.spin(lambda: self.teller.listeners > 1 and self.client.service_is_ready())

    def stands(self) -> FrameTree:
        """What tf tells of the arm while it stands in the middle of its ranges."""
        known = FrameTree()

        def told() -> bool:
            message = joints_message(self.arm, self.arm.mid)
            message.header.stamp = self.stage.node.get_clock().now().to_msg()
            self.joints.publish(message)
            for static, messages in enumerate(self.heard):
                for sent in (t for m in messages for t in m.transforms):
                    p, o = sent.transform.translation, sent.transform.rotation
                    known.hear(
                        sent.header.frame_id, sent.child_frame_id,
                        np.array([p.x, p.y, p.z]), np.array([o.x, o.y, o.z, o.w]),
                        stamp_ns(sent.header.stamp), static=bool(static),
                    )  # fmt: skip
            return all(
                self._is_connected(known, f"{SIDE}/{name}") for name in ("tip", "tip_predicted")
            )

        self.stage.spin(told)
        return known

    @staticmethod
    def _is_connected(known: FrameTree, frame: str) -> bool:
        """Whether tf has told the whole chain from the base to a frame."""
        try:
            known.place(frame, BASE, 0)
        except UnknownPlace:
            return False
        return True

    def ask(self, frame: str, target: np.ndarray, stamp: Time | None = None) -> Any:
        """The answer for a target (4, 4) of a frame, with its story."""
        self.stories.clear()
        given = pose(target, frame)
        if stamp is not None:
            given.header.stamp = stamp.to_msg()
        seed = joints_message(self.arm, self.arm.mid)
        answer = self.stage.call(self.client, Compensate.Request(target=given, seed=seed))
        self.stage.spin(lambda: self.stories)
        return answer

    def reached(self, answer: Any) -> np.ndarray:
        return self.model.pose(np.array(answer.command.position))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    folder = tmp_path_factory.mktemp("frames")
    with own_graph(folder), bench() as stage:
        yield Scene(stage, DEMO_ARM, folder)


def test_tf_tells_links_and_tips_as_the_urdf_names_them(scene: Scene) -> None:
    known, arm = scene.stands(), scene.arm
    at = {name: known.place(f"{SIDE}/{name}", BASE, 0) for name in ("tip", "tip_predicted")}
    np.testing.assert_allclose(at["tip"], Model(arm).pose(arm.mid), atol=1e-12)
    np.testing.assert_allclose(at["tip_predicted"], scene.model.pose(arm.mid), atol=1e-12)
    assert np.abs(at["tip"] - at["tip_predicted"]).max() > 1e-3
    scene.stage.spin(lambda: scene.urdf)
    assert scene.urdf[-1].data == export_urdf(declared_model(arm))
    links = {name for name in known.names if name.endswith("_link")}
    assert links == {f"{SIDE}/base_link", *(f"{SIDE}/{name}_link" for name in arm.joint_names)}
    for name in links:
        assert f'<link name="{name.removeprefix(f"{SIDE}/")}"' in scene.urdf[-1].data


def test_a_target_is_carried_over_at_its_stamp(scene: Scene) -> None:
    """The cell moves under the arm; the target was true half a second ago."""
    target = scene.model.pose(scene.arm.mid + 0.02)
    now = scene.stage.node.get_clock().now().nanoseconds
    turn = Rotation.from_rotvec([0.1, -0.2, 0.4]).as_quat()
    for seconds, x in ((-1.0, 0.3), (0.0, 0.5)):
        cell = Placed("cell", BASE, np.array([x, 1.0, 0.2]), turn)
        scene.teller.tell([cell], Time(nanoseconds=now + round(1e9 * seconds)).to_msg())
    base_then = quaternion.compute_pose(np.array([0.4, 1.0, 0.2]), turn)
    stamp = Time(nanoseconds=now - 500_000_000)
    answer = scene.ask("cell", base_then @ target, stamp)
    while "is unknown" in answer.message:  # what was told is still on its way
        answer = scene.ask("cell", base_then @ target, stamp)
    assert answer.success, answer.message
    np.testing.assert_allclose(scene.reached(answer), target, atol=2e-6)
    (story,) = scene.stories
    assert story.target.header.frame_id == story.header.frame_id == BASE
    assert story.target.pose.position.x == pytest.approx(target[0, 3])
    assert answer.pseudo_target.header.frame_id == BASE


def test_own_names_of_the_base_need_no_tf(scene: Scene) -> None:
    target = scene.model.pose(scene.arm.mid + 0.02)
    for name in ("base", BASE):
        np.testing.assert_allclose(scene.reached(scene.ask(name, target)), target, atol=2e-6)


@pytest.mark.parametrize(
    ("frame", "ahead_s", "words"),
    [
        ("kitchen", 0.0, "frame 'kitchen' is unknown; allowed: 'left_arm/base', and what tf"),
        ("left_arm/base_link", -3.0, ""),
        ("bench", 1.0, "frame 'bench' was last published"),
    ],
)
def test_a_frame_is_refused_in_words(scene: Scene, frame: str, ahead_s: float, words: str) -> None:
    now = scene.stage.node.get_clock().now()
    standing = np.array([0.0, 0.0, 0.0, 1.0])
    scene.teller.tell([Placed(BASE, "bench", np.zeros(3), standing)], now.to_msg())
    target = scene.model.pose(scene.arm.mid + 0.02)
    stamp = Time(nanoseconds=now.nanoseconds + round(1e9 * ahead_s))
    answer = scene.ask(frame, target, stamp)
    expected = Compensate.Response.BAD_FRAME if words else Compensate.Response.NO_PREDICTOR
    assert answer.status == expected, answer.message
    assert words in answer.message
