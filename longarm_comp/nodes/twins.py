"""Another node of the same name on the graph: two of them would command the same arm.

The middleware counts a killed process for up to 20 s. So where it counts two, the nodes'
/diagnostics decide: they name the process that they come from.
"""

from __future__ import annotations

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.health import INSTANCE, THIS_INSTANCE
from longarm_comp.nodes.steady import steady_timer

_LOOK_S = 0.25
_ALONE = 3
"""So many reports of its own, and none of another in between: the other is gone."""


class Twins:
    """Whether another `kinematics` publishes; ``node`` is the one that asks."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._topic = node.resolve_topic_name(graph.COMPENSATION.name)
        self._part = f"{node.get_fully_qualified_name()}: process"
        self._listening: Any = None
        self._alone = _ALONE
        steady_timer(node, _LOOK_S, self._look)

    @property
    def refusal(self) -> str:
        """Why the arm must not be moved; empty where no other is on the graph."""
        if self._alone >= _ALONE:
            return ""
        return "a second kinematics is on the graph, both command this arm: end one of them"

    def _look(self) -> None:
        several = self._node.count_publishers(self._topic) > 1
        if several and self._listening is None:
            self._alone = 0
            self._listening = graph.DIAGNOSTICS.subscription(self._node, self._on_diagnostics)
        elif not several and self._listening is not None:
            self._node.destroy_subscription(self._listening)
            self._listening, self._alone = None, _ALONE

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._part:
                told = {pair.key: pair.value for pair in status.values}
                own = told.get(INSTANCE) == THIS_INSTANCE
                self._alone = self._alone + 1 if own else 0
