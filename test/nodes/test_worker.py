"""The calls of rclpy that its documentation does not list."""

import ast
import threading
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import pytest
from places import ROOT

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from geometry_msgs.msg import PoseStamped
from nodes_bench import Bench

from longarm_comp.core.errors import JobError
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes import worker as worker_module
from longarm_comp.nodes.worker import CHECKED, Worker, check_rclpy
from longarm_interfaces.srv import PredictError


def test_this_rclpy_is_the_one_that_the_calls_were_checked_against() -> None:
    """With another version: read its `executors.py`, run the node tests, then change `CHECKED`."""
    assert version("rclpy").startswith(f"{CHECKED}.")
    check_rclpy()


def test_a_call_that_is_missing_is_named() -> None:
    part = SimpleNamespace(**vars(worker_module.rclpy_implementation))
    part.Client = SimpleNamespace(send_request=None)
    with pytest.raises(JobError, match=r"no Client\.take_response; use rclpy 7\.1"):
        check_rclpy(part)


def test_nothing_else_looks_inside_rclpy() -> None:
    """Neither its implementation nor names with an underscore of what it hands out."""
    for path in sorted((ROOT / "longarm_comp").rglob("*.py")):
        if path.name != Path(worker_module.__file__).name:
            assert not list(_inside(path)), path


def _inside(path: Path) -> Iterator[ast.AST]:
    source = path.read_text("utf-8")
    if "rclpy" not in source:
        return
    for node in ast.walk(ast.parse(source)):
        name = node.module if isinstance(node, ast.ImportFrom) else None
        if name is not None and name.startswith(("rclpy.impl", "rclpy._")):
            yield node
        if isinstance(node, ast.Attribute) and node.attr.startswith("take_"):
            yield node
        if isinstance(node, ast.Attribute) and node.attr == "handle":
            yield node


def test_a_worker_hears_serves_asks_and_counts(stage: Bench) -> None:
    errors: list[Exception] = []
    heard: list[PoseStamped] = []
    threads = set()

    def serve(
        request: PredictError.Request, reply: Callable[[PredictError.Response], None],
        sent: float,
    ) -> None:  # fmt: skip
        assert time.monotonic() - 60.0 < sent <= time.monotonic()
        threads.add(threading.current_thread())
        reply(PredictError.Response(sigma=2.0 * request.temperature_c))

    node, executor = stage.node, stage.executor
    server = Worker(node, executor, 10, errors.append)
    server.serve(graph.PREDICT_ERROR, serve)
    server.hear(graph.TARGET_POSE, lambda message, sent: heard.append(message))
    server.start()
    asker = Worker(node, executor, 10, errors.append)
    caller = asker.caller(graph.PREDICT_ERROR)
    asker.start()
    good = graph.TARGET_POSE.publisher(node)
    answers: list[float] = []

    def ask() -> None:
        forgotten = caller.send(PredictError.Request(temperature_c=-1.0))
        number = caller.send(PredictError.Request(temperature_c=float(len(answers))))
        answer = caller.answer(number, 10.0)
        assert caller.answer(forgotten, 0.0) is None
        answers.append(answer.sigma)

    try:
        stage.spin(lambda: caller.present)
        for count in (1, 2):
            assert asker.submit(ask)
            stage.spin(lambda count=count: len(answers) == count or errors)
        assert answers == [0.0, 2.0] and not errors
        assert len(threads) == 1 and threading.current_thread() not in threads
        stage.connected(good)
        good.publish(PoseStamped())
        stage.spin(lambda: heard)
        assert server.lost_messages == 0 and len(heard) == 1
    finally:
        for worker in (server, asker):
            worker.close()
    assert not errors


def test_of_two_publishers_every_target_is_heard_or_counted_as_lost(stage: Bench) -> None:
    """More than the queue holds, while nobody takes them."""
    heard: list[PoseStamped] = []
    errors: list[Exception] = []
    go_on = threading.Event()
    worker = Worker(stage.node, stage.executor, 10, errors.append)
    worker.hear(graph.TARGET_POSE, lambda message, sent: heard.append(message))
    worker.start()
    both = [graph.TARGET_POSE.publisher(stage.node) for _ in range(2)]
    try:
        for count, one in enumerate(both, 1):
            stage.spin(lambda one=one: one.get_subscription_count())
            one.publish(PoseStamped())
            stage.spin(lambda count=count: len(heard) == count)
        assert worker.lost_messages == 0
        worker.submit(go_on.wait)
        stage.spin(lambda: worker.waiting == 0)
        sent = graph.TARGET_POSE.depth + 600
        for number in range(sent):
            both[number % 2].publish(PoseStamped())
        go_on.set()
        stage.spin(lambda: len(heard) - 2 + worker.lost_messages >= sent)
        assert len(heard) - 2 + worker.lost_messages == sent
        assert worker.lost_messages > 0
    finally:
        go_on.set()
        worker.close()
    assert not errors
