"""What goes wrong in a soak, one class a fault: each breaks something and mends it."""

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
    """Something that breaks."""

    @property
    def name(self) -> str:
        """In the report."""

    def strike(self, scene: Scene) -> None:
        """Break it, and leave it so that it heals."""


@dataclass(frozen=True)
class Kill:
    """SIGKILL of a node; the supervisor starts it again. ``quiet``: no target is under way then.

    A target inside a process that is killed cannot be answered, so that the kinematics node is
    killed between targets, and the driver after its books are checked.
    """

    node: str
    quiet: bool = False

    @property
    def name(self) -> str:
        """In the report."""
        return f"kill {self.node}"

    def strike(self, scene: Scene) -> None:
        """Kill, and wait until it is back where it was quiet."""
        if self.quiet:
            scene.audit()
        before = scene.supervisor.pid(self.node)
        scene.expected_deaths[self.node] += 1
        os.kill(before, signal.SIGKILL)
        if self.quiet:
            scene.wait_back(self.node, before)


@dataclass(frozen=True)
class BreakFile:
    """A file is overwritten with rubbish, then put back."""

    path: Path

    @property
    def name(self) -> str:
        """In the report."""
        return f"break {self.path.name}"

    def strike(self, scene: Scene) -> None:
        """Targets go on meanwhile: the last good version is used."""
        good = self.path.read_bytes()
        write_text(self.path, "rubbish: [")
        scene.go_on(_BROKEN_S)
        partial = self.path.with_suffix(".good")
        partial.write_bytes(good)
        partial.replace(self.path)


@dataclass(frozen=True)
class EmergencyStop:
    """Pressed, and released; the driver refuses everything between, and says so."""

    name: str = "emergency stop"

    def strike(self, scene: Scene) -> None:
        """Targets go on meanwhile."""
        client = graph.ESTOP.client(scene.client.node, of="servo_driver")
        if not client.wait_for_service(timeout_sec=0.0):
            return
        client.call_async(SetBool.Request(data=True))
        scene.go_on(_BROKEN_S)
        client.call_async(SetBool.Request(data=False))
