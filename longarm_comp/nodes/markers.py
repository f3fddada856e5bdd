"""Markers for RViz: the arm as declared and as it hangs, target, pseudo-target, tip, error."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, PoseWithCovarianceStamped, Vector3
from rclpy.node import Node
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from longarm_comp.core.arm.context import Context
from longarm_comp.core.model.link_frames import exaggerated, outline
from longarm_comp.core.model.model import Model
from longarm_comp.nodes.interfaces import MARKERS
from longarm_comp.nodes.messages import Answer, sighting_of
from longarm_comp.nodes.params import Param

PARAMS = (
    Param("markers.period_s", 0.5, "between two pictures; 0: none", 0.0, 60.0),
    Param("markers.sag_factor", 1.0, "sag is drawn so many times larger", 0.0, 1000.0, live=True),
    Param(
        "markers.error_factor", 50.0, "the error arrow is drawn so many times longer", 1.0, 1e4,
        live=True,
    ),
)  # fmt: skip

Colour = tuple[float, float, float, float]
DECLARED: Colour = (0.6, 0.6, 0.6, 0.5)
HANGING: Colour = (0.1, 0.4, 0.9, 1.0)
TARGET: Colour = (0.1, 0.7, 0.2, 1.0)
_PSEUDO: Colour = (0.9, 0.7, 0.1, 1.0)
TIP: Colour = (0.9, 0.1, 0.1, 1.0)


class Markers:
    """Keeps the latest target and tip; `publish` draws them with the arm."""

    def __init__(self, node: Node, frame: str) -> None:
        self._node, self._frame = node, frame
        self._publisher = MARKERS.publisher(node)
        self._target: np.ndarray | None = None
        self._pseudo: np.ndarray | None = None
        self._tip: np.ndarray | None = None

    def on_answer(self, answer: Answer) -> None:
        """Keep the target of the latest answer."""
        if answer.outcome is not None and answer.status.success:
            self._target = _position(answer.outcome.target)
            self._pseudo = _position(answer.outcome.pseudo_target)

    def on_tip(self, message: PoseWithCovarianceStamped) -> None:
        """Keep the latest sighting of the tip, or that it was lost."""
        tip, _ = sighting_of(message)
        self._tip = tip if all(map(math.isfinite, tip.tolist())) else None

    def publish(
        self, declared: Model, model: Model, q: np.ndarray, context: Context, sag: float,
        error: float,
    ) -> None:  # fmt: skip
        """Draw the arm at q (n,). Without a subscriber nothing is computed."""
        if not self._publisher.get_subscription_count():
            return
        straight = outline(declared, q)
        hanging = exaggerated(outline(model, q, context), straight, sag)
        drawn = [
            self._marker(0, "declared", Marker.LINE_STRIP, DECLARED, 0.008, straight),
            self._marker(1, "hanging", Marker.LINE_STRIP, HANGING, 0.012, hanging),
        ]
        drawn[1].text = f"{sag:g}"  # so that whoever reads it can undo the exaggeration
        spots = (("target", TARGET, self._target), ("pseudo_target", _PSEUDO, self._pseudo),
                 ("tip_measured", TIP, self._tip))  # fmt: skip
        for number, (name, colour, at) in enumerate(spots, 2):
            drawn.append(self._spot(number, name, colour, at))
        target, tip, arrow = self._target, self._tip, []
        if target is not None and tip is not None:
            arrow = [target, target + error * (tip - target)]
        drawn.append(self._marker(5, "error", Marker.ARROW, TIP, 0.004, arrow))
        self._publisher.publish(MarkerArray(markers=drawn))

    def _spot(self, number: int, name: str, colour: Colour, at: np.ndarray | None) -> Marker:
        return self._marker(
            number, name, Marker.SPHERE_LIST, colour, 0.015, [] if at is None else [at]
        )

    def _marker(
        self, number: int, name: str, kind: int, colour: Colour, size: float,
        points: Sequence[np.ndarray] | np.ndarray,
    ) -> Marker:  # fmt: skip
        """A marker. Without points it is removed."""
        marker = Marker(ns=name, id=number, type=kind, action=Marker.ADD)
        marker.header.frame_id = self._frame
        marker.header.stamp = self._node.get_clock().now().to_msg()
        marker.pose.orientation.w = 1.0
        marker.scale = Vector3(x=size, y=size if kind != Marker.ARROW else 2 * size, z=size)
        marker.color = ColorRGBA(**dict(zip("rgba", colour, strict=True)))
        marker.lifetime = Duration(sec=5)
        marker.points = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in points]
        if not marker.points:
            marker.action = Marker.DELETE
        return marker


def _position(target: np.ndarray) -> np.ndarray:
    return target if target.ndim == 1 else target[:3, 3]
