"""Turns the messages of an arm's graph into the page's record."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray

from longarm_comp.core.at_work import LEARNED_SAID
from longarm_comp.core.compensation.result import Status
from longarm_comp.core.model.link_frames import exaggerated
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.health import RING_SAID
from longarm_comp.nodes.messages import driver_words, sighting_of
from longarm_comp.nodes.monitoring import EVIDENCE
from longarm_comp.view.state import CollectProgress, LastAnswer, PageState, Part, Picture, SeenTip
from longarm_interfaces.msg import Compensation, DriverState


class Listener:
    """Subscribes to an arm's topics; `state` is what they have said last."""

    def __init__(self, node: Node, clock: Callable[[], float] = time.monotonic) -> None:
        self.state = PageState()
        self._clock = clock
        self._namespace = node.get_namespace().rstrip("/") + "/"
        for topic, callback in (
            (graph.MARKERS, self._on_markers),
            (graph.TIP_MEASURED, self._on_tip),
            (graph.JOINT_STATES, self._on_joints),
            (graph.DRIVER_STATE, self._on_driver),
            (graph.COMPENSATION, self._on_answer),
            (graph.DIAGNOSTICS, self._on_diagnostics),
            (graph.COLLECT_PROGRESS, self._on_progress),
        ):
            topic.subscription(node, callback)

    def _heard(self, **changes: Any) -> None:
        self.state = replace(self.state, heard=self._clock(), **changes)

    def _on_markers(self, message: MarkerArray) -> None:
        lines = {marker.ns: marker for marker in message.markers}
        points = {
            name: np.array([[p.x, p.y, p.z] for p in marker.points]).reshape(-1, 3)
            for name, marker in lines.items()
        }
        declared, drawn = points.get("declared", _NONE), points.get("hanging", _NONE)
        factor = _number(lines["hanging"].text) if "hanging" in lines else math.nan
        if declared.shape != drawn.shape or not len(drawn) or not factor > 0.0:
            return
        hanging = exaggerated(drawn, declared, 1.0 / factor)
        target, pseudo = (
            points[name][0] if len(points.get(name, _NONE)) else None
            for name in ("target", "pseudo_target")
        )
        self._heard(picture=Picture(declared, hanging, target, pseudo, self._clock()))

    def _on_tip(self, message: PoseWithCovarianceStamped) -> None:
        self._heard(tip=SeenTip(sighting_of(message)[0], self._clock()))

    def _on_joints(self, message: JointState) -> None:
        joints = dict(zip(message.name, message.position, strict=False))
        self.state = self.state.with_joints(joints, self._clock())
        self._heard()

    def _on_driver(self, message: DriverState) -> None:
        self._heard(driver=(driver_words(message.state), message.message))

    def _on_answer(self, message: Compensation) -> None:
        known = message.status in set(Status)
        status = Status(message.status).name if known else f"status {message.status}"
        sent = dict(zip(message.executed.name, message.executed.position, strict=False))
        self._heard(answer=LastAnswer(status, message.message, sent))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        reports: dict[str, list[DiagnosticStatus]] = {}
        for status in message.status:
            node, colon, _ = status.name.partition(": ")
            inside = node.removeprefix(self._namespace)
            if colon and inside != node and "/" not in inside:
                reports.setdefault(inside, []).append(status)
        for node, statuses in reports.items():
            self._on_report(node, statuses)

    def _on_report(self, node: str, statuses: list[DiagnosticStatus]) -> None:
        now, parts = self._clock(), []
        for status in statuses:
            part = status.name.partition(": ")[2]
            facts = {value.key: value.value for value in status.values}
            if EVIDENCE in facts and part == "monitor":
                self._heard(evidence=_number(facts[EVIDENCE]))
            if part == LEARNED_SAID:
                self._heard(learned=status.message)
            if part == RING_SAID:
                self._heard(ring=status.message)
            parts.append(Part(part, ord(status.level), status.message))
        if parts:
            self.state = self.state.with_report(node, tuple(parts), now)
            self._heard()

    def _on_progress(self, message: DiagnosticStatus) -> None:
        facts = {value.key: value.value for value in message.values}
        done, of = _number(facts.get("done", "")), _number(facts.get("total", ""))
        if math.isfinite(done) and of > 0:
            job, words = message.name.rpartition("/")[2], message.message
            self._heard(progress=CollectProgress(job, int(done), int(of), words, self._clock()))


_NONE = np.empty((0, 3))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
