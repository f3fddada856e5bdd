"""Faults of a soak test, one class each: it breaks something and repairs it."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from std_srvs.srv import SetBool

from longarm_comp.core.files import write_text
from longarm_comp.jobs.soak.scene import Scene
from longarm_comp.nodes import interfaces as graph

_BROKEN_S = 1.5


class Fault(Protocol):
    """Interface of a fault."""

    @property
    def name(self) -> str:
        """In the report."""

    def strike(self, scene: Scene) -> None:
        """Cause the fault and end it, or leave a state that recovers by itself."""


@dataclass(frozen=True)
class Kill:
    """SIGKILL of a node, which the supervisor restarts. With ``quiet`` no target is in work then.

    A killed process cannot answer the target that it works on. So the kinematics node is killed
    between targets, and the driver after its counters were checked.
    """

    node: str
    quiet: bool = False

    @property
    def name(self) -> str:
        """In the report."""
        return f"kill {self.node}"

    def strike(self, scene: Scene) -> None:
        """Kill the node; with ``quiet``, wait until it is back."""
        if self.quiet:
            scene.audit()
        before = scene.supervisor.pid(self.node)
        scene.expected_deaths[self.node] += 1
        os.kill(before, signal.SIGKILL)
        if self.quiet:
            scene.wait_back(self.node, before)


@dataclass(frozen=True)
class BreakFile:
    """Overwrites a file with invalid contents, then restores it."""

    path: Path

    @property
    def name(self) -> str:
        """In the report."""
        return f"break {self.path.name}"

    def strike(self, scene: Scene) -> None:
        """Break and restore the file. Targets go on: the last good version is used."""
        good = self.path.read_bytes()
        write_text(self.path, "rubbish: [")
        scene.go_on(_BROKEN_S)
        partial = self.path.with_suffix(".good")
        partial.write_bytes(good)
        partial.replace(self.path)


@dataclass(frozen=True)
class EmergencyStop:
    """Emergency stop, then release. The driver refuses and reports commands in between."""

    name: str = "emergency stop"

    def strike(self, scene: Scene) -> None:
        """Stop and release. Targets go on meanwhile."""
        client = graph.ESTOP.client(scene.client.node, of="servo_driver")
        if not client.wait_for_service(timeout_sec=0.0):
            return
        client.call_async(SetBool.Request(data=True))
        scene.go_on(_BROKEN_S)
        client.call_async(SetBool.Request(data=False))
