"""Why the marker is lost at a pose: by the cameras' geometry, or as `stereo_bridge` says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from sensor_msgs.msg import CameraInfo

from longarm_comp.arm_folder.visible import Lens, View
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.graph_client import GraphClient, Reports
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.stereo_bridge import MARKER_LOST
from longarm_comp.sessions.settled import NO_REST


class Causes:
    """Listens to the cameras' calibration and to what `stereo_bridge` says.

    Args:
        view: cameras by the files beside arm.yaml; their lens is replaced by the one on the graph.
    """

    def __init__(self, client: GraphClient, arm: Arm, view: View | None) -> None:
        self._model, self._view = declared_model(arm), view
        self._reports = Reports(client)
        self._infos: dict[str, CameraInfo] = {}
        graph.LEFT_INFO.subscription(client.node, lambda m: self._on_info("left", m))
        graph.RIGHT_INFO.subscription(client.node, lambda m: self._on_info("right", m))

    def of(self, q: np.ndarray, recorded: str = "") -> str:
        """The likely cause at joints q (n,); ``recorded`` is what the recording says."""
        if recorded == NO_REST:
            return recorded
        why = "" if self._view is None else self._view.unseen(self._model.pose(q[None]))[0]
        if why:
            return why
        near = "in view, but " if self._view is not None else ""
        said = self._reports.said("stereo_bridge", "stereo")
        why = said.removeprefix(MARKER_LOST)
        return near + (why.partition(" (")[0] if why != said else "not seen")

    def _on_info(self, side: str, message: CameraInfo) -> None:
        self._infos[side] = message
        if self._view is None or len(self._infos) < 2:
            return
        lens = Lens.of(self._infos["left"], self._infos["right"])
        self._view = self._view if lens is None else replace(self._view, lens=lens)
