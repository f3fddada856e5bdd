"""`stereo_bridge`: measures the tip, with covariance, in left and right images (base frame)."""

from collections import deque
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import CameraInfo

from longarm_comp.core.arm import quaternion
from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.model.link_frames import Placed
from longarm_comp.devices.camera_info import CameraInfo as Calibration
from longarm_comp.devices.stereo.camera import StereoRig
from longarm_comp.devices.stereo.camera_file import read_camera
from longarm_comp.devices.stereo.eye import StereoEye
from longarm_comp.devices.stereo.found import Limits
from longarm_comp.devices.stereo.pairing import Pair, Side, StereoPairer
from longarm_comp.devices.stereo.refusal import StereoRefusal
from longarm_comp.devices.stereo.target import TagBoard
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import stamp_ns, stamp_of, steady_timer
from longarm_comp.nodes.frames import FrameTeller, prefix_of
from longarm_comp.nodes.health import OK, PERIOD, STALE, WARN, Report
from longarm_comp.nodes.images import ImageInlet, decode, is_same_camera, pixels_of
from longarm_comp.nodes.messages import pose_message, tip_message
from longarm_comp.nodes.node import ArmNode, program
from longarm_comp.nodes.params import Param

_TRANSPORTS = {
    "raw": ((graph.LEFT_IMAGE, graph.RIGHT_IMAGE), pixels_of),
    "compressed": ((graph.LEFT_COMPRESSED, graph.RIGHT_COMPRESSED), decode),
}

MARKER_LOST = "marker lost: "
"""The beginning of the report of the part `stereo` while no tip is measured."""

PARAMS = (
    Param("base_frame", "base", "frame in which the tip is reported"),
    Param("rectified", False, "images are rectified (only P of camera_info is used)"),
    Param("cameras", "", "folder of left.yaml and right.yaml; empty: camera_info is used"),
    Param("image_transport", "raw", "which images to subscribe to", choices=tuple(_TRANSPORTS)),
    Param("reliable_images", True, "reliable transport, for cameras on the same machine"),
    Param("slop_ms", 5.0, "largest difference between the stamps of a pair", 0.0, 1000.0),
    Param("queue", 8, "images of each side that wait for a partner", 1, 100),
    Param("publish_lost", True, "also publish refused pairs, with position NaN"),
    Param("hand_eye.xyz", [0.75, -1.7, 0.3], "left optical frame in the base frame, m"),
    Param(
        "hand_eye.quaternion",
        [-0.7071067811865476, 0.0, 0.0, 0.7071067811865476],
        "its orientation x, y, z, w: x right, y down, z forward",
        -1.0,
        1.0,
    ),
    Param("tip_in_marker", [0.0, 0.0, 0.0], "the tip in the marker frame, m", -10.0, 10.0),
    Param("marker.dictionary", "DICT_4X4_50", "OpenCV's name of the tag family"),
    Param("marker.tag_m", 0.06, "side of a tag's black square, m", 1e-4, 10.0),
    Param("marker.gap_m", 0.012, "white between tags, m", 0.0, 10.0),
    Param("marker.columns", 2, "tags across", 1, 100),
    Param("marker.rows", 2, "tags down", 1, 100),
    Param("marker.first_id", 0, "id of the top left tag", 0, 100000),
    Param("limits.epipolar_px", 1.5, "largest median distance from epipolar lines", 0.01, 100.0),
    Param("limits.rms_px", 0.8, "largest rms reprojection error", 0.01, 100.0),
    Param("limits.edge_px", 2.5, "largest blur", 0.1, 100.0),
    PERIOD,
)

_ENOUGH = 10
"""Number of sightings from which the mean of the marker's seen size is judged."""


class _StereoBridge(ArmNode):
    """The node. Its worker measures pairs of images; two may wait, a further one is dropped."""

    def __init__(self, executor: SingleThreadedExecutor) -> None:
        super().__init__(executor, "stereo_bridge", PARAMS)
        p = self.p
        self._prefix, self._publish_lost = prefix_of(self), p["publish_lost"]
        self._base_frame, self._frames = self._prefix + p["base_frame"], FrameTeller(self)
        self._rectified = p["rectified"]
        self._target = TagBoard.of(p)
        turn = np.array(p["hand_eye.quaternion"])
        if not quaternion.is_unit(turn):
            where = "parameters of stereo_bridge"
            raise InputError(where, "hand_eye.quaternion", turn.tolist(), "a unit quaternion")
        self._hand_eye = quaternion.compute_pose(np.array(p["hand_eye.xyz"]), turn)
        self._tip_in_marker = p["tip_in_marker"]
        limits = ("epipolar_px", "rms_px", "edge_px")
        self._limits = Limits(**{name: p[f"limits.{name}"] for name in limits})
        self._pairer: StereoPairer[Any] = StereoPairer(round(p["slop_ms"] * 1e6), p["queue"])
        self._infos: dict[Side, CameraInfo] = {}
        self._files: dict[Side, Calibration] = {}
        if folder := p["cameras"]:
            self._files = {s: read_camera(Path(folder) / f"{s.name.lower()}.yaml") for s in Side}
        self._eye: StereoEye | None = None
        self._sightings = 0
        self._sizes: deque[float] = deque(maxlen=50)  # seen size / declared size, last sightings
        self._last = "no pair of images yet"
        self._lost = True
        if self._files:
            try:
                self._use_calibration(self._files)
            except LongarmError as error:
                raise InputError(p["cameras"], "cameras", error, "a calibrated pair") from error
        self._worker = self.worker(2)
        self._worker.start()
        self._tips = graph.TIP_MEASURED.publisher(self)
        topics, self._pixels = _TRANSPORTS[p["image_transport"]]
        self._inlets = {
            side: ImageInlet(
                self, topic, partial(self._on_image, side), reliable=p["reliable_images"]
            )
            for side, topic in zip(Side, topics, strict=True)
        }
        for inlet in self._inlets.values():
            # Interval, s, at which the publishers' reliability is checked
            steady_timer(self, 0.5, inlet.adapt)
        for side, topic in zip(Side, (graph.LEFT_INFO, graph.RIGHT_INFO), strict=True):
            topic.subscription(self, partial(self._on_info, side))
        self.health.parts["stereo"] = self._report_stereo

    def _on_info(self, side: Side, message: CameraInfo) -> None:
        known = self._infos.get(side)
        if known is not None and is_same_camera(known, message):
            return
        self._infos[side] = message
        cameras = self._files or self._infos  # beside files, a message names its camera's frame
        self._eye = None
        if len(cameras) < 2:
            return
        try:
            self._use_calibration(cameras)
        except LongarmError as error:
            self._refuse_pair(error, None)

    def _use_calibration(self, cameras: Mapping[Side, Calibration]) -> None:
        """Use this calibration from now on, and publish the cameras' frames."""
        rig = StereoRig.from_camera_info(
            cameras[Side.LEFT], cameras[Side.RIGHT], rectified=self._rectified
        )
        self._eye = StereoEye(rig, self._target, self._hand_eye, self._tip_in_marker, self._limits)
        # Publish the cameras' poses, under the frame names in their camera_info
        told = {side: info.header.frame_id for side, info in self._infos.items()}
        names = [told.get(s) or f"{self._prefix}{s.name.lower()}_optical" for s in Side]
        placed = zip(names, self._eye.cameras, strict=True)
        self._frames.tell_static([Placed.at(self._base_frame, *camera) for camera in placed])

    def _on_image(self, side: Side, message: Any) -> None:
        for pair in self._pairer.add(side, stamp_ns(message.header.stamp), message):
            eye = self._eye
            if eye is None:
                self._count_lost("camera_info is missing or no calibration", pair.stamp_ns)
            elif not self._worker.submit(partial(self._measure_pair, eye, pair)):
                self._count_lost("a new pair came before the last one was measured", None)

    def _measure_pair(self, eye: StereoEye, pair: Pair[Any]) -> None:
        """Measure a pair and publish the tip, on the worker's thread."""
        try:
            seen = eye.measure(self._pixels(pair.left), self._pixels(pair.right))
        except LongarmError as error:
            self._refuse_pair(error, pair.stamp_ns)
            return
        self._sightings += 1
        self._sizes.append(seen.scale)
        self._lost = False
        self._last = f"{seen.corners} corners, rms {seen.rms_px:.3f} px"
        message = tip_message(
            seen.point, seen.pose_covariance, stamp_of(pair.stamp_ns), self._base_frame
        )
        message.pose.pose.orientation = pose_message(seen.pose).orientation
        self._tips.publish(message)
        turn = quaternion.from_rotation(seen.pose[:3, :3])
        tip = Placed(self._base_frame, f"{self._prefix}tip_measured", seen.point, turn)
        self._frames.tell([tip], message.header.stamp)

    def _refuse_pair(self, error: LongarmError, ns: int | None) -> None:
        self._last = str(error)
        self._count_lost(error.reason.value if isinstance(error, StereoRefusal) else str(error), ns)

    def _count_lost(self, why: str, ns: int | None) -> None:
        self.tally.count(f"refused: {why}", "")
        self._lost = True
        if ns is None or not self._publish_lost:
            return
        lost = np.full(3, np.nan)
        self._tips.publish(tip_message(lost, np.zeros((6, 6)), stamp_of(ns), self._base_frame))

    def _report_stereo(self) -> Report:
        calibration = "files" if self._files else "camera_info"
        told = ((self._files.get(side), info) for side, info in self._infos.items() if info.k[0])
        if any(file is not None and not is_same_camera(info, file) for file, info in told):
            calibration = "files; camera_info tells another one"
        facts: dict[str, object] = {
            "sightings": self._sightings,
            "pairs": self._pairer.pairs,
            "seen in declared size": round(self._size, 4),
            **dict(sorted(self.tally.counts.items())),
            **{f"dropped: {why}": n for why, n in self._pairer.drops.items()},
            **{f"lost on the way: {s.name.lower()}": i.watch.lost for s, i in self._inlets.items()},
            "calibration": calibration,
            **{f"images {s.name.lower()}": i.reliability for s, i in self._inlets.items()},
        }
        if not self._pairer.pairs:
            return Report(STALE, self._last, facts)
        if self._lost:
            return Report(WARN, MARKER_LOST + self._last, facts)
        off = self._size - 1.0
        if len(self._sizes) >= _ENOUGH and abs(off) > self._limits.size_tolerance:
            said = f"the marker looks {abs(off):.1%} too {'large' if off > 0 else 'small'}: "
            return Report(WARN, said + "measure the print, or calibrate the cameras again", facts)
        return Report(OK, f"tip measured: {self._last}", facts)

    @property
    def _size(self) -> float:
        """Seen / declared size of the marker, mean of the last sightings; 1 before the first."""
        return float(np.mean(self._sizes)) if self._sizes else 1.0


main = program(_StereoBridge)

if __name__ == "__main__":
    main()
