"""`stereo_bridge` as a process, on rendered pairs with a known truth and with every fault."""

import math
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from nodes_bench import Bench, bench, facts_of, last_status
from own_graph import own_graph
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage

from longarm_comp.devices.stereo.camera_file import camera_text
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import stamp_of
from longarm_comp.nodes.images import image_message, info_message
from longarm_comp.nodes.messages import sighting_of
from longarm_comp.sim.cameras import CameraPair, Conditions, render, tag_plate

PAIR = CameraPair(focal_px=640.0)
PLATE = tag_plate(0.06, 0.012, 2, 2)
FACING = np.array([[1.0, 0, 0, 1.0], [0, 0, -1, 0.05], [0, 1, 0, 0.2], [0, 0, 0, 1]])


class Cameras:
    """Publishes pairs of images and collects what the bridge makes of them."""

    def __init__(self, stage: Bench, rng: np.random.Generator) -> None:
        self.stage, self.rng = stage, rng
        self.process = stage.start("stereo_bridge", {"diagnostics_period_s": 0.1})
        self.tips = stage.collect(graph.TIP_MEASURED)
        self.diagnostics = stage.collect(graph.DIAGNOSTICS)
        if graph.HAS_TF:
            self.transforms, self.fixed = stage.collect(graph.TF), stage.collect(graph.TF_STATIC)
        node = stage.node
        self.images = [t.publisher(node) for t in (graph.LEFT_IMAGE, graph.RIGHT_IMAGE)]
        self.infos = [t.publisher(node) for t in (graph.LEFT_INFO, graph.RIGHT_INFO)]
        for publisher in (*self.images, *self.infos):
            stage.connected(publisher)
        self.ns = 1_000_000_000

    def calibrated(self, scale: float = 1.0, baseline: float = 1.0) -> None:
        """Publish calibrations until the bridge has both (best effort: one may be lost)."""
        for _ in range(3):
            for publisher, info, side in zip(
                self.infos, PAIR.camera_infos(), ("left", "right"), strict=True
            ):
                message = info_message(info, self.ns, side)
                message.p[0] *= scale
                message.p[3] *= baseline
                publisher.publish(message)

    def render(self, pose: np.ndarray = FACING, **conditions: object) -> tuple:
        return render(pose, PLATE, PAIR, self.rng, Conditions(**conditions))

    def show(self, left: np.ndarray | None, right: np.ndarray | None, apart_ns: int = 0) -> int:
        """Publish a pair; its stamp."""
        self.ns += 100_000_000
        for publisher, image, later in zip(self.images, (left, right), (0, apart_ns), strict=True):
            if image is not None:
                publisher.publish(image_message(image, self.ns + later, "camera"))
        return self.ns

    def seen(self, left: np.ndarray, right: np.ndarray, apart_ns: int = 0) -> np.ndarray:
        """What becomes of a pair: the tip, NaN where it was refused."""
        self.tips.clear()
        self.show(left, right, apart_ns)
        self.stage.spin(lambda: self.tips)
        self.covariance = sighting_of(self.tips[0])[1]
        return sighting_of(self.tips[0])[0]

    def facts(self, space: str = "/") -> dict[str, str]:
        """The bridge's last report."""
        return facts_of(last_status(self.diagnostics, f"{space}stereo_bridge: stereo"))

    def counted(self, what: str) -> None:
        """Wait until a refusal or drop is reported."""
        self.stage.spin(lambda: any(what in key for key in self.facts()))


@pytest.fixture(scope="module")
def cameras(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cameras]:
    with own_graph(tmp_path_factory.mktemp("stereo")), bench() as stage:
        yield Cameras(stage, np.random.default_rng(5))


def test_without_calibration_nothing_is_measured(cameras: Cameras) -> None:
    assert math.isnan(cameras.seen(*cameras.render())[0])
    cameras.counted("no calibration")
    cameras.calibrated(scale=0.0)
    assert math.isnan(cameras.seen(*cameras.render())[0])
    cameras.counted("not calibrated")
    cameras.calibrated()
    cameras.stage.spin(lambda: math.isfinite(cameras.seen(*cameras.render())[0]))


def test_the_tip_is_where_it_is_and_its_covariance_is_honest(cameras: Cameras) -> None:
    squares = []
    for shift in np.linspace(-0.15, 0.15, 8):
        pose = FACING.copy()
        pose[:3, 3] += [shift, 0.3 * shift, -0.5 * shift]
        off = cameras.seen(*cameras.render(pose)) - pose[:3, 3]
        assert np.linalg.norm(off) < 1e-3
        squares.append(off**2 / cameras.covariance)
    # chi-square of 24 numbers: the claimed sigma is neither ten times too small nor too large
    assert 0.01 < np.mean(squares) < 4.0


def test_a_wrong_baseline_shows_in_the_size_of_the_marker(cameras: Cameras) -> None:
    def said() -> str:
        status = last_status(cameras.diagnostics, "/stereo_bridge: stereo")
        return "" if status is None else str(status.message)

    cameras.stage.spin(lambda: said().startswith("tip measured"))
    assert float(cameras.facts()["seen in declared size"]) == pytest.approx(1.0, abs=2e-3)
    pair = cameras.render()

    def seen_with(baseline: float) -> str:
        cameras.calibrated(baseline=baseline)
        cameras.seen(*pair)
        return said()

    cameras.stage.spin(lambda: "too large: measure the print" in seen_with(1.02))
    cameras.stage.spin(lambda: seen_with(1.0).startswith("tip measured"))


@pytest.mark.skipif(not graph.HAS_TF, reason="tf2_msgs is not installed: run make setup")
def test_cameras_and_the_measured_tip_are_frames(cameras: Cameras) -> None:
    tip = cameras.seen(*cameras.render())
    stamp = cameras.tips[0].header.stamp
    told = cameras.stage.spin(
        lambda: [t for m in cameras.transforms for t in m.transforms if t.header.stamp == stamp]
    )[0]
    assert (told.header.frame_id, told.child_frame_id) == ("base", "tip_measured")
    at = told.transform.translation
    assert [at.x, at.y, at.z] == tip.tolist()
    fixed = cameras.fixed[-1].transforms
    assert [t.child_frame_id for t in fixed] == ["left", "right"]  # as camera_info names them
    half = math.sqrt(0.5)  # x right, y down, z forward: the arm's y
    for sent, x in zip(fixed, (0.75, 1.05), strict=True):
        at, turn = sent.transform.translation, sent.transform.rotation
        assert [at.x, at.y, at.z] == pytest.approx([x, -1.7, 0.3], abs=1e-9)
        assert [turn.x, turn.y, turn.z, turn.w] == pytest.approx([-half, 0, 0, half], abs=1e-9)


@pytest.mark.parametrize(
    ("conditions", "reason"),
    [
        ({"exposure": 0.02}, "too dark"),
        ({"blur_px": 6.0}, "blurred"),
        ({"covered": (0.9, 0.0)}, "left image"),
        ({"covered": (0.9, 0.9)}, "left image"),
    ],
)
def test_a_bad_picture_is_refused_and_counted(
    cameras: Cameras, conditions: dict[str, object], reason: str
) -> None:
    assert math.isnan(cameras.seen(*cameras.render(**conditions))[0])
    cameras.counted(reason)


def test_wrong_size_and_nonsense_are_refused(cameras: Cameras) -> None:
    left, right = cameras.render()
    assert math.isnan(cameras.seen(left[:240, :320], right)[0])
    cameras.counted("size differs")
    message = image_message(left, cameras.ns + 50_000_000, "camera")
    message.encoding = "nv12"
    cameras.images[0].publish(message)
    message = image_message(right, cameras.ns + 50_000_000, "camera")
    cameras.images[1].publish(message)
    cameras.counted("not 8-bit")


def test_unsynchronised_and_lonely_images_are_counted_and_do_no_harm(cameras: Cameras) -> None:
    left, right = cameras.render()
    cameras.show(left, right, apart_ns=40_000_000)
    cameras.show(left, None)
    assert math.isfinite(cameras.seen(left, right)[0])
    cameras.counted("dropped: no partner")
    cameras.show(left, right)
    cameras.ns -= 200_000_000
    cameras.show(left, right)
    cameras.counted("dropped: stamp older")
    cameras.ns += 300_000_000
    assert math.isfinite(cameras.seen(left, right)[0])
    assert cameras.process.poll() is None


def test_images_that_are_lost_on_the_way_are_counted(cameras: Cameras) -> None:
    """The bridge is held up; its queue keeps the last images only."""
    os.kill(cameras.process.pid, signal.SIGSTOP)
    try:
        small = np.zeros((4, 4), np.uint8)
        for _ in range(40):
            cameras.show(small, None)
    finally:
        os.kill(cameras.process.pid, signal.SIGCONT)

    def lost() -> bool:
        cameras.show(small, None)
        facts = cameras.facts()
        return int(facts.get("lost on the way: left", 0)) >= 20 and (
            facts["lost on the way: right"] == "0"
        )

    cameras.stage.spin(lost)


def test_cameras_that_publish_with_best_effort_are_heard_too(cameras: Cameras) -> None:
    cameras.stage.spin(lambda: cameras.facts().get("images left") == "reliable")
    node, reliable = cameras.stage.node, cameras.images
    qos = QoSProfile(depth=5, reliability=graph.BEST_EFFORT)
    topics = (graph.LEFT_IMAGE, graph.RIGHT_IMAGE)
    cameras.images = [node.create_publisher(t.type, t.name, qos) for t in topics]
    try:
        for side in ("left", "right"):
            cameras.stage.spin(
                lambda side=side: cameras.facts().get(f"images {side}") == "best effort"
            )
        for publisher in cameras.images:
            cameras.stage.connected(publisher)
        left, right = cameras.render()
        cameras.ns += 1_000_000_000

        shown = 0.0

        def heard() -> bool:
            """Shown again every second: what is published with best effort may be lost."""
            nonlocal shown
            if time.monotonic() > shown + 1.0:
                cameras.show(left, right)
                shown = time.monotonic()
            return any(np.isfinite(sighting_of(tip)[0]).all() for tip in cameras.tips)

        cameras.tips.clear()
        cameras.stage.spin(heard)
    finally:
        for publisher in cameras.images:
            node.destroy_publisher(publisher)
        cameras.images = reliable
    cameras.stage.spin(lambda: cameras.facts().get("images left") == "reliable")


def test_compressed_images_are_measured_in_a_namespace_by_the_files_of_the_pair(
    cameras: Cameras, tmp_path: Path
) -> None:
    """Whatever calibration the cameras tell, and if they tell none."""
    stage, name = cameras.stage, "packed"
    for side, info in zip(("left", "right"), PAIR.camera_infos(), strict=True):
        (tmp_path / f"{side}.yaml").write_text(camera_text(side, info))
    given = {"image_transport": "compressed", "cameras": str(tmp_path)}
    stage.start("stereo_bridge", given | {"diagnostics_period_s": 0.1}, name)
    tips = stage.collect(graph.TIP_MEASURED, name)
    node = stage.node

    def publisher(topic: graph.Topic) -> Any:
        made = node.create_publisher(topic.type, f"/{name}/{topic.name}", 5)
        stage.connected(made)
        return made

    images = [publisher(topic) for topic in (graph.LEFT_COMPRESSED, graph.RIGHT_COMPRESSED)]
    infos = [publisher(topic) for topic in (graph.LEFT_INFO, graph.RIGHT_INFO)]
    pictures = [cv2.imencode(".png", picture)[1].tobytes() for picture in cameras.render()]

    def measured() -> bool:
        cameras.ns += 100_000_000
        for to, data in zip(images, pictures, strict=True):
            message = CompressedImage(format="mono8; png compressed ", data=data)
            message.header.stamp = stamp_of(cameras.ns)
            to.publish(message)
        return bool(tips) and math.isfinite(sighting_of(tips[-1])[0][0])

    def another_is_told() -> bool:
        for to, info in zip(infos, PAIR.camera_infos(), strict=True):
            message = info_message(info, cameras.ns, "camera")
            message.p[0] *= 1.1
            to.publish(message)
        return "another one" in cameras.facts(f"/{name}/")["calibration"]

    stage.spin(measured)
    stage.spin(lambda: cameras.facts(f"/{name}/").get("calibration") == "files")
    stage.spin(another_is_told)
    tips.clear()
    stage.spin(measured)
    assert np.linalg.norm(sighting_of(tips[-1])[0] - FACING[:3, 3]) < 1e-3
    assert tips[-1].header.frame_id == f"{name}/base"
