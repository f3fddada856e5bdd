"""What a running collection tells, on its terminal and on a topic, and why a marker is lost."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from sensor_msgs.msg import CameraInfo

from longarm_comp.arm_folder.visible import Lens, View
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.rest import NO_REST
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.collect.preview import in_words
from longarm_comp.jobs.graph_client import GraphClient, Reports
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.stereo_bridge import MARKER_LOST

_LEVELS = {"ended": DiagnosticStatus.ERROR, "waiting": DiagnosticStatus.WARN}


def progress_message(now: Progress, namespace: str) -> DiagnosticStatus:
    """Name ``collect``; what is not known yet has no value (docs/ros.md)."""
    losing = DiagnosticStatus.WARN if now.lost else DiagnosticStatus.OK
    values = {
        "state": now.state, "done": now.done, "total": now.total, "seen": now.seen,
        "lost": len(now.lost), "pose": now.visit,
    }  # fmt: skip
    if math.isfinite(now.seconds_left):
        values["eta_s"] = f"{now.seconds_left:.3f}"
    return DiagnosticStatus(
        level=_LEVELS.get(now.state, losing),
        name="collect",
        message=str(now),
        hardware_id=namespace,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )


@dataclass(frozen=True, eq=False)
class Progress:
    """Where a collection is.

    Attributes:
        done, total: visits in the bag, of the plan.
        q: (n,) joints it goes to, rad and m; None before the first and after the last.
        made: visits of this run by their index, the last one last: why the marker was lost there,
            or "" where it was seen.
        seconds_left: NaN: not known yet.
        state: "running", "waiting", "done" or "ended".
        why: why it waits or ended.
    """

    done: int
    total: int
    visit: int = -1
    q: np.ndarray | None = None
    made: Mapping[int, str] = field(default_factory=dict)
    seconds_left: float = float("nan")
    state: str = "running"
    why: str = ""

    @property
    def share(self) -> float:
        """Of the plan, 0 to 1."""
        return self.done / max(1, self.total)

    @property
    def lost(self) -> list[str]:
        """Why the marker was lost, for each visit at which it was."""
        return [why for why in self.made.values() if why]

    @property
    def seen(self) -> int:
        """Visits of this run at which the marker was seen."""
        return len(self.made) - len(self.lost)

    @property
    def losses(self) -> str:
        """How often the marker was lost, and why; empty if never."""
        if not self.lost:
            return ""
        return f"marker lost at {len(self.lost)} of {len(self.made)} poses: {in_words(self.lost)}"

    def __str__(self) -> str:
        if self.state != "running":
            return f"{self.state}: {self.why}" if self.why else self.state
        left = f", {self.seconds_left:.0f} s left" if math.isfinite(self.seconds_left) else ""
        poses = f"{self.done} of {self.total} poses driven{left}"
        return "; ".join(filter(None, (poses, self.losses)))


class Causes:
    """Why the marker is lost: by the cameras' geometry, or as `stereo_bridge` says.

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
