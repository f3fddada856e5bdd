"""Faults of a simulated arm, to rehearse what one does: a servo, a camera, a node."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

from diagnostic_msgs.msg import DiagnosticArray

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.jobs.client import GraphClient
from longarm_comp.jobs.parameters import read_parameters, set_parameter
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.health import INSTANCE

SIMULATED = "simulated_arm"
_HEARD_S = 10.0


def spoil(client: GraphClient, fault: str, name: str, back: bool) -> str:
    """Add a joint to those ``unplugged`` or a camera to those ``covered``, or take it ``back``.

    Returns:
        What has the fault now, in words.

    Raises:
        JobError: no simulated arm runs, or it knows no such name.
    """
    (told,) = read_parameters(client, SIMULATED, fault, within_s=_HEARD_S)
    names = [word for word in str(told).split() if word != name] + [name] * (not back)
    set_parameter(client, SIMULATED, fault, " ".join(names))
    return f"{fault}: {', '.join(names) or 'nothing'}"


@contextmanager
def frozen(client: GraphClient, node: str) -> Iterator[int]:
    """A node of a simulated arm's graph stands still, as a process that hangs does.

    Yields:
        The process.

    Raises:
        InputError: no such node. JobError: it does not report, or runs on another machine.
    """
    pids: dict[str, int] = {}

    def heard(message: DiagnosticArray) -> None:
        for status in message.status:
            name, _, part = status.name.partition(": ")
            if part == "process":
                told = {pair.key: pair.value for pair in status.values}
                pids[name.rsplit("/", 1)[-1]] = int(told[INSTANCE].split("-")[0])

    listening = graph.DIAGNOSTICS.subscription(client.node, heard)
    client.until(lambda: SIMULATED in pids, _HEARD_S, "no simulated arm reports (`longarm up`)")
    if node != SIMULATED:
        client.spin(2.0)
    client.node.destroy_subscription(listening)
    if node not in pids:
        raise InputError("sim freeze", "NODE", node, ", ".join(sorted(pids)))
    try:
        os.kill(pids[node], signal.SIGSTOP)
    except OSError as error:
        raise JobError("the node runs on another machine", node=node) from error
    try:
        yield pids[node]
    finally:
        os.kill(pids[node], signal.SIGCONT)
