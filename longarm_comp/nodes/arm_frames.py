"""The arm's own frames: its links, the tip as declared and as predicted; its URDF."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from rclpy.node import Node
from std_msgs.msg import String

from longarm_comp.core.arm.context import Context
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import BASE_LINK, Placed, link_frames
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.frames import FrameTeller, prefix_of
from longarm_comp.nodes.model_files import ModelFiles
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.ticks import steady_timer
from longarm_comp.urdf_export import export_urdf

PARAMS = (
    Param("frames.period_s", 0.1, "between two transforms on /tf; 0: none", 0.0, 60.0),
    Param("frames.wait_s", 0.5, "patience with tf that is older than a target", 0.0, 60.0),
)

_TIP_PREDICTED = "tip_predicted"


class ArmFrames:
    """Publishes where the links stand, and the arm's URDF once.

    Args:
        base_frame: full name of the base frame.
        joints: the last joint reading (n,), or None.
        context: circumstances of now; None while one that the model needs is unknown.
    """

    def __init__(
        self, node: Node, files: ModelFiles, base_frame: str, period_s: float,
        joints: Callable[[], np.ndarray | None], context: Callable[[], Context | None],
    ) -> None:  # fmt: skip
        self._node, self._files, self._base_frame = node, files, base_frame
        self._joints, self._context = joints, context
        self._prefix, self._teller = prefix_of(node), FrameTeller(node)
        self._description = graph.ROBOT_DESCRIPTION.publisher(node)
        try:
            self._description.publish(String(data=export_urdf(declared_model(files.arm))))
        except InputError as error:
            node.get_logger().warning(f"no robot_description: {error}")
        if period_s and graph.HAS_TF:
            foot = Placed.at(base_frame, self._prefix + BASE_LINK, np.eye(4))
            self._teller.tell_static([foot])
            steady_timer(node, period_s, self._tell)

    def _tell(self) -> None:
        q = self._joints()
        if q is None:
            return
        placed = link_frames(self._files.rigid, q, self._prefix)
        others = self._teller.listeners > 1  # one is this node's own
        if others and (context := self._context()) is not None:
            tip = self._files.loaded.model.pose(q, context)  # takes 10 times as long as the links
            placed.append(Placed.at(self._base_frame, self._prefix + _TIP_PREDICTED, tip))
        self._teller.tell(placed, self._node.get_clock().now().to_msg())
