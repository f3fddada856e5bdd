"""Node processes and a client for the node tests: start, ask, wait, and always clean up."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any
from uuid import uuid4

import rclpy
from forked import ForkedProgram
from places import ROOT
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

_ASK_AGAIN_S, _MATCHED_S, _TOLD_S, _BETWEEN_S = 8.0, 0.1, 2.0, 0.05

PATIENCE_S = 180.0
"""With what will come: far above what it takes, so that no busy machine fails a test."""
PATIENT = {"target_max_age_s": 60.0, "joints_max_age_s": 60.0}
"""Parameters of `kinematics` with which nothing is too old on a busy machine."""


class Bench:
    """Processes of nodes, and one node of the test's own that talks to them."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.node = Node("tester", context=self.context)
        self.executor.add_node(self.node)
        self.processes: list[subprocess.Popen[str]] = []
        self.asked: Counter[Any] = Counter()
        """How many requests were sent, by client."""
        self._next: dict[Any, float] = {}
        """When a client may ask again, monotonic s."""
        self.said: dict[subprocess.Popen[str], IO[str]] = {}

    def start(
        self, node: str, params: Mapping[str, Any] | None = None, namespace: str = "",
        words: Sequence[str] = (),
    ) -> subprocess.Popen[str]:  # fmt: skip
        """Start a node of ``longarm_comp.nodes``, with words of its own on its command line."""
        args = ["-m", f"longarm_comp.nodes.{node}", *words, "--ros-args"]
        if namespace:
            args += ["-r", f"__ns:=/{namespace}"]
        usual: dict[str, object] = {}
        if node == "kinematics":  # there is no driver, and a busy machine may be late
            usual = {"compiled": False, "acknowledged": False, **PATIENT}
        for name, value in {**usual, **(params or {})}.items():
            text = str(value).lower() if isinstance(value, bool) else value
            args += ["-p", f"{name}:={text}"]
        return self.python(args)

    def python(self, args: list[str]) -> subprocess.Popen[str]:
        """Start a Python program from the source tree; forked where it is a node's module."""
        if args[:1] != ["-m"] or not args[1].startswith("longarm_comp.nodes."):
            return self.program([sys.executable, *args], ROOT, ROOT)
        said = tempfile.TemporaryFile("w+")  # noqa: SIM115
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        return self._keep(ForkedProgram(args[1:], str(ROOT), env, said), said)

    def program(self, words: list[str], packages: Path, folder: Path) -> subprocess.Popen[str]:
        """Start a program in a folder, with Python's packages from another one."""
        process = subprocess.Popen(
            words,
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(packages), "PYTHONFAULTHANDLER": "1"},
            text=True,
            stdout=(said := tempfile.TemporaryFile("w+")),  # noqa: SIM115
            stderr=subprocess.STDOUT,
        )
        return self._keep(process, said)

    def _keep(self, process: subprocess.Popen[str], said: IO[str]) -> subprocess.Popen[str]:
        self.said[process] = said
        self.processes.append(process)
        return process

    def collect(self, topic: Any, namespace: str = "") -> list[Any]:
        """Messages of a topic of the table, as they come."""
        got: list[Any] = []
        name = f"/{namespace}/{topic.name}" if namespace else topic.name
        kept = DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=topic.depth, durability=kept)
        self.node.create_subscription(topic.type, name, got.append, qos)
        return got

    def spin(self, until: Callable[[], Any], within: float = PATIENCE_S) -> Any:
        """Spin until something is truthy; what it is. Fails after so many seconds."""
        end = time.monotonic() + within
        while not (found := until()):
            if time.monotonic() > end:
                raise AssertionError(f"not within {within:g} s\n{self.state()}")
            self.executor.spin_once(timeout_sec=0.02)
        return found

    def connected(self, publisher: Any, first: Any = None) -> None:
        """Wait until all who are there listen; with a first message, until all have it.

        Who has not matched the publisher yet gets what is sent later than what others send.
        """
        listeners = self.node.count_subscribers
        self.spin(
            lambda: publisher.get_subscription_count() >= max(1, listeners(publisher.topic_name))
        )
        if first is not None:
            publisher.publish(first)
            self.spin(lambda: publisher.wait_for_all_acked(Duration(seconds=0.0)))

    def matched(self, publisher: Any, target: Any, stories: Sequence[Any]) -> None:
        """Publish a target until kinematics tells of it; no other one is on its way then.

        What is sent before the subscriber has matched the publisher too is lost.
        """
        header = target.header

        def told() -> bool:
            return any(story.target.header == header for story in stories)

        while not told():
            header.stamp = self.node.get_clock().now().to_msg()
            publisher.publish(target)
            by = time.monotonic() + _TOLD_S
            self.spin(lambda by=by: told() or time.monotonic() > by)

    def call(self, client: Any, request: Any, within: float = PATIENCE_S) -> Any:
        """The answer of a service.

        The middleware drops an answer to a client that it has not matched yet, although the service
        is there: so a client's first request waits a moment, and is sent again after a while.
        Who asks until the answer is another one leaves the node, and others, time between.
        """
        self.spin(client.service_is_ready, within)
        moment = self._next.get(client, time.monotonic() + _MATCHED_S)
        self.spin(lambda: time.monotonic() > moment)
        end = time.monotonic() + within
        while True:
            future = client.call_async(request)
            self.asked[client] += 1
            patience = time.monotonic() + _ASK_AGAIN_S
            self.spin(lambda done=future.done, by=patience: done() or time.monotonic() > by, within)
            if future.done():
                self._next[client] = time.monotonic() + _BETWEEN_S
                return future.result()
            assert time.monotonic() < end, f"no answer: not within {within:g} s\n{self.stacks()}"

    def until_heard(self, ask: Callable[[], Any]) -> Any:
        """The answer of a driver; asked again while a stop stands, or if it was old when served."""
        for _ in range(12):
            answer = ask()
            if not answer.message.endswith("ask again"):
                break
            by = time.monotonic() + 4.0 * _BETWEEN_S
            self.spin(lambda by=by: time.monotonic() > by)
        return answer

    def action(self, kind: Any, name: str) -> ActionClient:
        """A client of an action that its server answers."""
        return answered(ActionClient(self.node, kind, name), kind, self.spin)

    def output(self, process: subprocess.Popen[str]) -> str:
        """What a process has said so far."""
        self.said[process].seek(0)
        return self.said[process].read()

    def running(self) -> list[subprocess.Popen[str]]:
        """The processes that have not ended."""
        return [process for process in self.processes if process.poll() is None]

    def state(self) -> str:
        """What every process that runs has said, for a failed test."""
        return "\n".join(f"{each.args!r}:\n{self.output(each)}" for each in self.running())

    def stacks(self) -> str:
        """The same, and where the threads of each are: it ends them."""
        ended = self.running()
        for process in ended:
            process.send_signal(signal.SIGABRT)  # Python's fault handler writes it
            process.wait(timeout=60)
        return "\n".join(f"{each.args!r}:\n{self.output(each)}" for each in ended)

    def end_processes(self) -> None:
        """End every process, gently first."""
        for process in self.processes:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process in self.processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=5)
            if process.poll() is None:
                process.kill()
                process.wait()
            self.said.pop(process).close()
        self.processes.clear()

    def close(self) -> None:
        """End everything."""
        self.end_processes()
        self.executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        self.context.try_shutdown()


def answered(client: ActionClient, kind: Any, spin: Callable[[Callable[[], Any]], Any]) -> Any:
    """A client of an action, once its server answers it.

    As of a service, answers to a client that is not matched yet are lost; so it asks of a goal that
    there is not, until it is told so.
    """
    spin(client.server_is_ready)
    answers: list[Any] = []
    while not any(answer.done() for answer in answers):
        none = kind.Impl.SendGoalService.Request().goal_id
        none.uuid = list(uuid4().bytes)
        handle = ClientGoalHandle(client, none, kind.Impl.SendGoalService.Response())
        answers.append(handle.get_result_async())
        patience = time.monotonic() + _MATCHED_S
        spin(lambda by=patience: answers[-1].done() or time.monotonic() > by)
    return client


def last_status(heard: Sequence[Any], ending: str) -> Any:
    """The last report of the part whose name ends so, of messages on /diagnostics; None: none."""
    told = (s for array in reversed(heard) for s in array.status if s.name.endswith(ending))
    return next(told, None)


def facts_of(status: Any) -> dict[str, str]:
    """The values of a report on /diagnostics by name; none where there is no report."""
    return {} if status is None else {value.key: value.value for value in status.values}


def children(process: subprocess.Popen[str]) -> list[int]:
    """Process ids of what a process has started."""
    return [
        int(pid)
        for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    ]


def gone(pid: int) -> bool:
    """Whether there is no such process."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@contextlib.contextmanager
def bench() -> Iterator[Bench]:
    """A bench that is cleaned up whatever happens."""
    made = Bench()
    try:
        yield made
    finally:
        made.close()
