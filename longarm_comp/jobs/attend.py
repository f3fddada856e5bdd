"""Commands of a person to a running arm (status, hold, stop, reset), and simulated faults."""

import os
import re
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from std_srvs.srv import SetBool, Trigger

from longarm_comp.core.at_work import LEARNED_SAID
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.state_folder import state_folder
from longarm_comp.devices.stop_latch import kept_stops
from longarm_comp.jobs.client import STOPPED
from longarm_comp.jobs.graph_client import ANNOUNCED_S, FOUND_S, GraphClient, Interrupted, Reports
from longarm_comp.nodes import bringup
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.arm_state import UNACKNOWLEDGED
from longarm_comp.nodes.health import INSTANCE, TIP_SAID
from longarm_comp.nodes.interfaces import Service
from longarm_comp.nodes.messages import driver_words
from longarm_interfaces.msg import DriverState

DRIVER, KINEMATICS, SIMULATED = "servo_driver", "kinematics", "simulated_arm"
KNOWN = {*bringup.SIMULATED, bringup.PATHS}
"""Nodes of an arm whose reports `Attendant.standing` waits for."""
_LEVELS = ("ok", "warning", "error", "stale")
_NEXT = {
    DriverState.UNCONFIGURED: "longarm servo scan",
    DriverState.INACTIVE: f"ros2 lifecycle set {DRIVER} activate",
    **dict.fromkeys(STOPPED, "longarm reset"),
}


class Attendant:
    """Receives the state of an arm's driver and the nodes' reports, and commands the driver."""

    def __init__(self, client: GraphClient) -> None:
        self._client, self._namespace = client, client.node.get_namespace().rstrip("/")
        self._driver: DriverState | None = None
        self._reports = Reports(client)
        self._states = graph.DRIVER_STATE.subscription(client.node, self._on_state)

    def _on_state(self, message: DriverState) -> None:
        self._driver = message

    def standing(self) -> dict[str, Any]:
        """Return the state of the arm, once all its nodes on the graph have reported.

        A node that does not report in time is listed as stale. All values are texts or lists:
        ``driver``, ``why``, ``nodes``, ``troubles``, ``next`` (a command), ``tip``, ``learned``.

        Raises:
            JobError: no node of the arm runs.
        """
        client, reports, where = self._client, self._reports, self._namespace or "/"

        def there() -> set[str]:
            found = client.node.get_node_names_and_namespaces()
            return {name for name, space in found if space == where} & KNOWN

        def is_of_others() -> bool:
            return reports.last_message(KINEMATICS, "driver") == UNACKNOWLEDGED

        kept = [str(stop) for stop in kept_stops(state_folder())]
        if not client.wait(there, FOUND_S):
            said = f"no node of an arm runs in namespace {where}"
            running = "does `longarm up` run, in this ROS_DOMAIN_ID?"
            raise JobError("; ".join((f"{said} ({running})", *kept)))
        begun = time.monotonic()

        def heard() -> bool:
            named, announced = there(), time.monotonic() - begun > ANNOUNCED_S
            alone = DRIVER not in named and (is_of_others() or announced)
            known = named if announced else named | {KINEMATICS}
            return (self._driver is not None or alone) and known <= set(reports.nodes)

        if not client.wait(heard, FOUND_S):
            said = f"does not report within {FOUND_S:g} s"
            silent = DiagnosticStatus(level=DiagnosticStatus.STALE, message=said)
            for name in there() - set(reports.nodes):
                reports.nodes[name] = {"process": silent}
        if KINEMATICS not in reports.nodes:
            gone = "is not on the graph: no target is followed until it is started"
            lost = DiagnosticStatus(level=DiagnosticStatus.ERROR, message=gone)
            reports.nodes[KINEMATICS] = {"process": lost}
        words = step = ""
        if self._driver is not None:
            words, why = driver_words(self._driver.state), self._driver.message
            step = _NEXT.get(self._driver.state, "")
            if step == "longarm reset" and self._namespace:
                step += f" --namespace {self._namespace[1:]}"
        elif is_of_others():
            said = "another program drives the arm and does not say how it stands"
            why = "; ".join((said, *kept))
        else:
            why, step = "; ".join((f"no {DRIVER} is on the graph", *kept)), "longarm up ARM"
        return {
            "driver": words,
            "why": why,
            "nodes": sorted(reports.nodes),
            "troubles": [
                {
                    "node": node,
                    "part": part,
                    "level": _LEVELS[min(ord(said.level), 3)],
                    "message": said.message,
                }
                for node, parts in sorted(reports.nodes.items())
                for part, said in parts.items()
                if ord(said.level)
            ],
            "next": step,
            "tip": reports.last_message(KINEMATICS, TIP_SAID),
            "learned": reports.last_message(KINEMATICS, LEARNED_SAID),
        }

    def hold(self) -> str:
        """Stop smoothly and hold the arm, with torque on; return the driver's message."""
        return self._halt_arm(graph.HOLD)

    def stop(self) -> str:
        """Switch the torque off now (emergency stop); return the driver's message."""
        return self._halt_arm(graph.ESTOP)

    def reset(self) -> str:
        """End an emergency stop, a hold and a fault, if any; return the driver's message."""
        if self._hear_driver().state not in STOPPED:
            return "nothing to reset"
        return self._ask_service(graph.RESET, Trigger.Request())

    def _hear_driver(self) -> Any:
        missing = f"no {DRIVER} reports its state: does `longarm up` run, in this namespace?"
        return self._client.until(lambda: self._driver, FOUND_S, missing)

    def hear_stop(self) -> str:
        """Return the driver's description of the stop in force; empty if none is."""
        driver = self._hear_driver()
        return str(driver.message).partition(";")[0] if driver.state in STOPPED else ""

    def let_go(self) -> tuple[str, str]:
        """Switch the torque off until `take_back`; JobError if the arm is stopped already.

        Returns:
            The driver's message, and its description of this stop, which `take_back` needs.
        """
        if others := self.hear_stop():
            raise JobError(f"nothing is done: {others}; to go on: longarm reset")
        with self._client.putting_back():  # interrupted here, nobody would end the stop
            said = self.stop()
            own = self._client.until(self.hear_stop, FOUND_S, "the driver does not say it stopped")
        return said, own

    def take_back(self, own: str) -> str:
        """End the emergency stop of `let_go`, by its description; return the driver's message.

        Raises:
            JobError: the stop was asked for again meanwhile, so it remains in force.
        """
        self._client.spin(1.2)  # the driver publishes its state twice a second
        if (now := self.hear_stop()) != own:
            raise JobError(f"the stop stays: {now}; to go on: longarm reset")
        return self._ask_service(graph.ESTOP, SetBool.Request(data=False))

    def _halt_arm(self, service: Service) -> str:
        """Ask for a stop; return the driver's message. An error also says to cut the power."""
        try:
            return self._ask_service(service, SetBool.Request(data=True), again=True)
        except Interrupted:
            raise
        except JobError as error:
            cure = "if the arm moves or holds somebody, cut its power"
            raise JobError(f"{error}; {cure}") from error

    def _ask_service(self, service: Service, request: Any, *, again: bool = False) -> str:
        answer = self._client.ask(DRIVER, service, request, FOUND_S, again=again)
        if not answer.success:
            raise JobError(f"the driver refuses: {answer.message}")
        return str(answer.message)


def spoil(client: GraphClient, fault: str, name: str, back: bool) -> str:
    """Add a simulated fault, or remove it (`back`); return all that have it now, in words.

    Args:
        fault: parameter of `simulated_arm`: ``unplugged`` (joints) or ``covered`` (cameras).
        name: the joint or the camera.
    """
    (told,) = client.parameters(SIMULATED, fault, within_s=FOUND_S)
    names = [word for word in str(told).split() if word != name] + [name] * (not back)
    client.set_parameter(SIMULATED, fault, " ".join(names))
    return f"{fault}: {', '.join(names) or 'nothing'}"


@contextmanager
def freeze_node(client: GraphClient, node: str) -> Iterator[int]:
    """Suspend the process of a node in this context, as if it hangs; only with a simulated arm.

    Yields the id of the process. Raises JobError if no such node with a simulated arm reports, or
    if it runs on another machine: there another program may have this id.
    """
    if node not in KNOWN:
        raise InputError("sim freeze", "NODE", node, ", ".join(sorted(KNOWN)))
    reports = Reports(client)
    missing = f"no simulated arm with a {node} reports (`longarm up`)"
    client.until(lambda: {SIMULATED, node} <= reports.nodes.keys(), FOUND_S, missing)
    reports.close()
    told = {pair.key: pair.value for pair in reports.nodes[node]["process"].values}
    process = int(told[INSTANCE].split("-")[0])
    try:
        program = Path(f"/proc/{process}/cmdline").read_text()
        if not re.search(rf"longarm_comp(\.nodes\.|/){node}\b", program):
            raise ProcessLookupError
        os.kill(process, signal.SIGSTOP)
    except OSError as error:
        raise JobError("the node runs on another machine", node=node) from error
    try:
        yield process
    finally:
        os.kill(process, signal.SIGCONT)
