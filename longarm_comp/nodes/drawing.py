"""Publishes pictures of the arm: its links and URDF on /tf, markers for RViz."""

from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, PoseWithCovarianceStamped, Vector3
from std_msgs.msg import ColorRGBA, String
from visualization_msgs.msg import Marker, MarkerArray

from longarm_comp.core.errors import InputError
from longarm_comp.core.ik.solver import position_of
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import (
    BASE_LINK,
    Placed,
    exaggerate_sag,
    link_frames,
    outline,
)
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.answers import Answer
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.frames import FrameTeller, prefix_of
from longarm_comp.nodes.interfaces import MARKERS
from longarm_comp.nodes.messages import sighting_of
from longarm_comp.nodes.params import Param
from longarm_comp.urdf_export import export_urdf

PARAMS = (
    Param("frames.period_s", 0.1, "time between two transforms on /tf; 0: none", 0.0, 60.0),
    Param("frames.wait_s", 0.5, "longest wait for a tf as new as the target", 0.0, 60.0),
    Param("markers.period_s", 0.5, "time between two pictures; 0: none", 0.0, 60.0),
    Param("markers.sag_factor", 1.0, "factor of the drawn deflection", 0.0, 1000.0, live=True),
    Param("markers.error_factor", 50.0, "factor of the drawn error arrow", 1.0, 1e4, live=True),
)

_TIP_PREDICTED = "tip_predicted"


class ArmFrames:
    """Publishes the poses of the links and other frames, and the arm's URDF once."""

    def __init__(self, state: ArmState) -> None:
        self._state, node = state, state.node
        self._prefix, self._teller = prefix_of(node), FrameTeller(node)
        self._description = graph.ROBOT_DESCRIPTION.publisher(node)
        try:
            self._description.publish(String(data=export_urdf(declared_model(state.arm))))
        except InputError as error:
            node.get_logger().warning(f"no robot_description: {error}")
        self._tells = bool(state.p["frames.period_s"] and graph.HAS_TF)
        self.standing: set[str] = set()
        self.tell_standing([])
        if self._tells:
            node.every("frames.period_s", self._publish_links)

    def tell_standing(self, frames: Sequence[Placed]) -> None:
        """Publish fixed frames, together with the arm's foot; `standing` then holds their names."""
        self.standing = {frame.name for frame in frames}
        foot = Placed.at(self._state.base_frame, self._prefix + BASE_LINK, np.eye(4))
        if self._tells:
            self._teller.tell_static([foot, *frames])

    def _publish_links(self) -> None:
        state, q = self._state, self._state.joints
        if q is None:
            return
        placed = link_frames(state.files.rigid, q, self._prefix)
        others = self._teller.listeners > 1  # one is this node's own
        if others and (context := state.known_context()) is not None:
            loaded = state.files.loaded
            pose = loaded.model.pose(q, context)  # takes 10 times as long
            tip = loaded.stands.carry_from_model(pose)
            placed.append(Placed.at(state.base_frame, self._prefix + _TIP_PREDICTED, tip))
        self._teller.tell(placed, state.stamp)


Points = Sequence[np.ndarray] | np.ndarray
Colour = tuple[float, float, float, float]
DECLARED: Colour = (0.6, 0.6, 0.6, 0.5)
HANGING: Colour = (0.1, 0.4, 0.9, 1.0)
TARGET: Colour = (0.1, 0.7, 0.2, 1.0)
_PSEUDO: Colour = (0.9, 0.7, 0.1, 1.0)
TIP: Colour = (0.9, 0.1, 0.1, 1.0)


class Markers:
    """Keeps the latest target and tip, and draws them with the arm at a constant interval."""

    def __init__(self, state: ArmState) -> None:
        self._state, self._node = state, state.node
        self._publisher = MARKERS.publisher(self._node)
        self._node.every("markers.period_s", self._draw_arm)
        self._target: np.ndarray | None = None
        self._pseudo: np.ndarray | None = None
        self._tip: np.ndarray | None = None

    def on_answer(self, answer: Answer) -> None:
        if answer.outcome is not None and answer.status.success:
            self._target = answer.outcome.position
            self._pseudo = position_of(answer.outcome.pseudo_target)

    def on_tip(self, message: PoseWithCovarianceStamped) -> None:
        tip, _ = sighting_of(message)
        own = message.header.frame_id == self._state.base_frame
        self._tip = tip if own and np.isfinite(tip).all() else None

    def _draw_arm(self) -> None:
        """Publish the markers of the arm's present state; nothing without a subscriber."""
        if not self._publisher.get_subscription_count() or (now := self._state.standing) is None:
            return
        model, q, context = now
        sag, error = (
            self._node.get_parameter(f"markers.{name}_factor").value for name in ("sag", "error")
        )
        straight = outline(self._state.files.rigid, q)
        stands = self._state.files.loaded.stands
        hanging = exaggerate_sag(stands.carry_from_model(outline(model, q, context)), straight, sag)
        drawn = [
            self._make_marker(0, "declared", Marker.LINE_STRIP, DECLARED, 0.008, straight),
            self._make_marker(1, "hanging", Marker.LINE_STRIP, HANGING, 0.012, hanging),
        ]
        drawn[1].text = f"{sag:g}"  # so that a reader of the marker can undo the exaggeration
        spots = (
            ("target", TARGET, self._target),
            ("pseudo_target", _PSEUDO, self._pseudo),
            ("tip_measured", TIP, self._tip),
        )
        for number, (name, colour, at) in enumerate(spots, 2):
            place = [] if at is None else [at]
            drawn.append(self._make_marker(number, name, Marker.SPHERE_LIST, colour, 0.015, place))
        target, tip, arrow = self._target, self._tip, []
        if target is not None and tip is not None:
            arrow = [target, target + error * (tip - target)]
        drawn.append(self._make_marker(5, "error", Marker.ARROW, TIP, 0.004, arrow))
        self._publisher.publish(MarkerArray(markers=drawn))

    def _make_marker(
        self, number: int, name: str, kind: int, colour: Colour, size: float, points: Points
    ) -> Marker:
        """Make a marker of points (m, base frame); without points, one that removes the old one."""
        marker = Marker(ns=name, id=number, type=kind, action=Marker.ADD)
        marker.header.frame_id = self._state.base_frame
        marker.header.stamp = self._state.stamp
        marker.pose.orientation.w = 1.0
        marker.scale = Vector3(x=size, y=size if kind != Marker.ARROW else 2 * size, z=size)
        marker.color = ColorRGBA(**dict(zip("rgba", colour, strict=True)))
        marker.lifetime = Duration(sec=5)
        marker.points = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in points]
        if not marker.points:
            marker.action = Marker.DELETE
        return marker
