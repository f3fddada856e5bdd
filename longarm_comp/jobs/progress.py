"""Tells the graph on /diagnostics how far a job is, for `longarm view` and other tools."""

from __future__ import annotations

from rclpy.node import Node

from longarm_comp.nodes.health import OK, PROGRESS, Report, reports
from longarm_comp.nodes.interfaces import DIAGNOSTICS


class ProgressTeller:
    """Publishes under the name of the job's node, as its part ``progress``."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = DIAGNOSTICS.publisher(node)

    def tell(self, done: int, of: int, words: str) -> None:
        """So many steps of so many are done."""
        report = Report(OK, words, {"done": done, "of": of})
        self._publisher.publish(reports(self._node, {PROGRESS: report}))
