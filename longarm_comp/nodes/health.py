"""Reports of a node's state on /diagnostics, by default once a second."""

import os
import time
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import steady_timer
from longarm_comp.nodes.params import Param

_ALONE = 3
"""After this many own reports in a row, the other `kinematics` is gone."""


class Twins:
    """Watches whether another `kinematics` besides the own ``node`` commands the arm."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._topic = node.resolve_topic_name(graph.COMPENSATION.name)
        self._part = f"{node.get_fully_qualified_name()}: process"
        self._listening: Any = None
        self._alone = _ALONE
        steady_timer(node, 0.25, self._look_for_twins)

    @property
    def refusal(self) -> str:
        """The reason not to move the arm, or "" where no second `kinematics` commands it."""
        if self._alone >= _ALONE:
            return ""
        return "two kinematics command this arm: end one of them"

    def _look_for_twins(self) -> None:
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


TIP_SAID = "tip by readings"
"""Part of `kinematics` on /diagnostics that states the tip computed from the joints' readings."""
RING_SAID = "ring"
"""Part of `kinematics` on /diagnostics that states how the tip rings after the last move."""
PERIOD = Param("diagnostics_period_s", 1.0, "time between two reports on /diagnostics", 0.05, 60.0)
"""A parameter of every node."""

OK, WARN = DiagnosticStatus.OK, DiagnosticStatus.WARN
ERROR, STALE = DiagnosticStatus.ERROR, DiagnosticStatus.STALE

INSTANCE = "instance"
"""Key of a value of the part `process`: the identity of the reporting process.

A restarted process has the same node name, but another identity.
"""

THIS_INSTANCE = f"{os.getpid()}-{uuid.uuid4().hex[:8]}"


@dataclass(frozen=True)
class Report:
    """The state of one part of a node: level, message, and values by name (``facts``)."""

    level: bytes
    message: str
    facts: Mapping[str, object] = field(default_factory=dict)

    def status(self, name: str, namespace: str) -> DiagnosticStatus:
        values = [KeyValue(key=key, value=str(value)) for key, value in self.facts.items()]
        return DiagnosticStatus(
            level=self.level, name=name, message=self.message, hardware_id=namespace, values=values
        )


_WARNED_S = 10.0
"""Time for which `Tally.report` warns about a dropped message, s."""


class Tally:
    """Counts events by name, keeps the last reason, and logs the reasons."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self.counts: dict[str, int] = {}
        self.last = ""
        self._dropped = "", -_WARNED_S

    def count(self, what: str, why: str) -> None:
        """Count one event of the name ``what``; keep and log the reason unless it is empty."""
        self.counts[what] = self.counts.get(what, 0) + 1
        if why:
            self.last = why
            self._node.get_logger().warning(why, throttle_duration_sec=1.0)

    def count_dropped(self, topic: str, why: str) -> None:
        """Count a message of a topic that is not used, and warn about it for `_WARNED_S`."""
        self.count(f"bad {topic}", why)
        self._dropped = why, time.monotonic()

    def report(self) -> Report:
        """Return a report that warns if a message was dropped in the last `_WARNED_S`."""
        why, at_s = self._dropped
        if time.monotonic() - at_s < _WARNED_S:
            return Report(WARN, f"not used: {why}")
        return Report(OK, "every message is used")

    @property
    def facts(self) -> dict[str, object]:
        return {**self.counts, "last refusal": self.last}


class Health:
    """Publishes the reports of a node's `parts`, under the names ``<node>: <part>``."""

    def __init__(self, node: Node, period_s: float) -> None:
        self._node = node
        self.parts: dict[str, Callable[[], Report]] = {"process": self._report_process}
        self._publisher = graph.DIAGNOSTICS.publisher(node)
        self._timer = steady_timer(node, period_s, self.publish)
        self.faults = 0
        self.last_fault = ""
        self._fault_s: float | None = None

    def fault(self, error: Exception) -> None:
        """Count and log an exception after which the node continues."""
        self.faults += 1
        self._fault_s = time.monotonic()
        self.last_fault = f"{type(error).__name__}: {error}"
        self._node.get_logger().error(f"survived {self.last_fault}")

    def clear_fault(self) -> None:
        """Report the process as healthy again; the count of faults stays."""
        self._fault_s = None

    def publish(self) -> None:
        name = self._node.get_fully_qualified_name()
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        where = self._node.get_namespace()
        for part, ask in self.parts.items():
            try:
                report = ask()
            except Exception as error:  # in one part: the other parts are still reported
                why = f"{type(error).__name__}: {error}"
                report = Report(ERROR, f"its state cannot be told: {why}")
                self._node.get_logger().error(f"{part}: {why}", throttle_duration_sec=10.0)
            array.status.append(report.status(f"{name}: {part}", where))
        self._publisher.publish(array)

    def _report_process(self) -> Report:
        facts: dict[str, object] = {
            INSTANCE: THIS_INSTANCE,
            "faults": self.faults,
            "last fault": self.last_fault,
        }
        # A fault is an error on /diagnostics for this time, s, or until `clear_fault`
        if self._fault_s is not None and time.monotonic() - self._fault_s < 60.0:
            return Report(ERROR, f"survived {self.faults} faults, last {self.last_fault}", facts)
        return Report(OK, "running", facts)
