"""`longarm view` in a real browser, on a graph of the real kinematics and a driver of this test's.

The driver hurries to where it is sent and says what it is asked; its camera sees the tip 1 mm
beside where the model has it, so that the page's numbers are known.
"""

from __future__ import annotations

import math
import re
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from browser import browser
from geometry_msgs.msg import PoseWithCovarianceStamped
from nodes_bench import PATIENCE_S, Bench, bench
from own_graph import own_graph
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger
from target_requests import pose
from trajectory_msgs.msg import JointTrajectory
from walking import Walk

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.vibration.ring import MoveRing
from longarm_comp.jobs.collect.run import Progress, progress_message
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.health import ERROR, OK, RING_SAID, Health, Report
from longarm_comp.nodes.messages import joints_message, pose_message
from longarm_comp.view.scene import BLUE, GREEN, ORANGE
from longarm_interfaces.msg import DriverState

if TYPE_CHECKING:
    from playwright.sync_api import Page, ViewportSize

NAMESPACE = "left_arm"
BESIDE = np.array([0.0008, -0.0006, 0.0])
MEAN_WORDS = '<img src="x" onerror="window.planted = true">'
FEW_FRAMES = (
    "window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 700)"
)
"""Without a GPU 60 frames a second take all of a machine."""
WIDE: ViewportSize = {"width": 800, "height": 500}

RING = MoveRing(4.8, 2.1e-3, 10.1, 0.01, declared=False)


@dataclass
class Driver:
    """Plays servo_driver and stereo_bridge: joints, state, services, sightings."""

    node: Node
    other: Node
    arm: Arm
    asked: list[tuple[str, object]] = field(default_factory=list)
    state: int = DriverState.READY

    def __post_init__(self) -> None:
        self.model, self.walk = declared_model(self.arm), Walk(self.arm)
        self.joints = graph.JOINT_STATES.publisher(self.node)
        self.states = graph.DRIVER_STATE.publisher(self.node)
        self.tips = graph.TIP_MEASURED.publisher(self.node)
        self.targets = graph.TARGET_POSE.publisher(self.node)
        self.collecting = graph.COLLECT_PROGRESS.publisher(self.node)
        mean, foreign = Report(ERROR, MEAN_WORDS), Report(ERROR, "of another namespace")
        self.own, self.foreign = Health(self.node, 600.0), Health(self.other, 600.0)
        self.own.parts["part"], self.foreign.parts["part"] = lambda: mean, lambda: foreign
        graph.JOINT_TRAJECTORY.subscription(self.node, self.on_trajectory)
        self.node.create_service(SetBool, "servo_driver/estop", self.on_estop)
        self.node.create_service(SetBool, "servo_driver/hold", self.on_hold)
        self.timer = self.node.create_timer(0.1, self.speak)

    def speak(self) -> None:
        self.walk.step()
        now = self.node.get_clock().now().to_msg()
        self.joints.publish(joints_message(self.arm, self.walk.q, now))
        self.states.publish(DriverState(state=self.state))
        seen = PoseWithCovarianceStamped()
        seen.header.stamp = now
        seen.pose.pose = pose_message(self.model.tip(self.walk.q) + BESIDE)
        self.tips.publish(seen)

    def on_trajectory(self, message: JointTrajectory) -> None:
        self.walk.go(point.positions for point in message.points)

    def on_estop(self, request: SetBool.Request, answer: SetBool.Response) -> SetBool.Response:
        self.asked.append(("estop", request.data))
        self.state = DriverState.ESTOP if request.data else DriverState.READY
        answer.success, answer.message = True, "torque off, commands refused"
        return answer

    def on_hold(self, request: SetBool.Request, answer: SetBool.Response) -> SetBool.Response:
        self.asked.append(("hold", request.data))
        answer.success = False
        answer.message = "the driver is not active, so there is no torque to hold the arm"
        return answer

    def offer_reset(self) -> None:
        self.node.create_service(Trigger, "servo_driver/reset", self.on_reset)

    def on_reset(self, request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        self.asked.append(("reset", None))
        answer.success, answer.message = True, "ready"
        return answer

    def aim(self, q: np.ndarray) -> None:
        target = pose(self.model.pose(q))
        target.header.stamp = self.node.get_clock().now().to_msg()
        self.targets.publish(target)


@dataclass
class Stand:
    """The graph, the page, and what has been said by its console."""

    stage: Bench
    driver: Driver
    page: Page
    view: Any
    faults: list[str] = field(default_factory=list)

    def shows(self, text: str) -> None:
        """Wait until the page shows a text."""
        self.until(lambda: text in self.words(), f"the page does not show {text!r}")

    def until(self, condition: Any, what: str) -> None:
        """Look again until something is so."""
        end = time.monotonic() + PATIENCE_S
        while not condition():
            said = f"{self.words()}\n{self.faults}\n{self.stage.state()}"
            assert time.monotonic() < end, f"{what}:\n{said}"
            self.page.wait_for_timeout(50)

    def words(self) -> str:
        return self.page.inner_text("body")

    def press(self, button: str) -> None:
        self.page.get_by_role("button", name=button, exact=True).click()

    def pixels(self, rgb: tuple[int, int, int]) -> int:
        """How many pixels of the scene are of about that hue: light and shade change the rest."""
        shot = np.frombuffer(self.page.screenshot(), np.uint8)
        image = cv2.imdecode(shot, cv2.IMREAD_COLOR)
        assert image is not None
        scene = cv2.cvtColor(image[:, : image.shape[1] * 59 // 100], cv2.COLOR_BGR2HSV)
        ((hue, _, _),) = cv2.cvtColor(np.array([[rgb]], np.uint8), cv2.COLOR_RGB2HSV)[0]
        apart = np.abs(scene[..., 0].astype(int) - int(hue))
        strong = (scene[..., 1] > 120) & (scene[..., 2] > 60)
        return int(((np.minimum(apart, 180 - apart) <= 8) & strong).sum())


@pytest.fixture
def stand(tmp_path: Path, demo_arm_path: Path) -> Iterator[Stand]:
    from playwright.sync_api import sync_playwright

    seen_by = browser()
    with own_graph(tmp_path), bench() as stage, sync_playwright() as play:
        quick = {"arm": demo_arm_path, "markers.period_s": 0.2, "diagnostics_period_s": 0.3}
        stage.start("kinematics", quick | {"monitor.settle_s": 0.1}, NAMESPACE)
        words = ["view", "--namespace", NAMESPACE, "--port", "0", "--no-open"]
        view = stage.python(["-u", "-m", "longarm_comp", *words])
        node = Node("servo_driver", context=stage.context, namespace=NAMESPACE)
        stage.executor.add_node(node)
        flags = ["--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"]
        chromium = play.chromium.launch(executable_path=seen_by, args=flags)
        page = chromium.new_page(viewport=WIDE)
        page.add_init_script(FEW_FRAMES)
        page.set_default_timeout(1e3 * PATIENCE_S)
        made = Stand(stage, Driver(node, stage.node, Arm.load(demo_arm_path)), page, view)
        page.on("pageerror", lambda error: made.faults.append(str(error)))
        page.on("requestfailed", lambda request: made.faults.append(request.url))
        stage.spin(lambda: "?code=" in stage.output(view), within=PATIENCE_S)
        with served(stage):
            page.goto(stage.output(view).strip())
            yield made
        chromium.close()
        stage.executor.remove_node(node)
        node.destroy_node()


@contextmanager
def served(stage: Bench) -> Iterator[None]:
    """The bench's nodes go on while the test waits for the browser."""
    done = threading.Event()

    def spin() -> None:
        while not done.is_set():
            stage.executor.spin_once(timeout_sec=0.05)

    thread = threading.Thread(target=spin, name="driver")
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def test_the_page_shows_the_graph_and_its_buttons_reach_the_driver(stand: Stand) -> None:
    driver, page = stand.driver, stand.page
    shows_the_arm_and_its_errors(stand)
    says_how_well_the_nodes_are(stand)
    buttons_call_the_services(stand)
    narrow_page_does_not_run_over(stand)
    says_that_the_graph_is_silent(stand)
    assert stand.faults == [] and page.evaluate("window.planted") is None
    stand.view.send_signal(signal.SIGINT)
    assert stand.view.wait(timeout=PATIENCE_S) == 0
    called = ["estop", "hold", "estop", "reset"]
    once = [each for each, _ in groupby(driver.asked)]  # asked again where no answer came
    assert once == list(zip(called, [True, True, False, None], strict=True))


def shows_the_arm_and_its_errors(stand: Stand) -> None:
    driver, page = stand.driver, stand.page
    stand.shows("The driver is ready.")
    page.add_style_tag(content=".mantine-Notification-root {display: none}")  # "no GPU", in orange
    stand.shows("tip − predicted: 1.00 mm (x +0.80, y -0.60, z")
    stand.shows("tip − target: no target was heard")
    stand.until(lambda: driver.targets.get_subscription_count(), "deaf")
    assert stand.pixels(GREEN) < 10
    driver.aim(0.4 * driver.arm.lower + 0.6 * driver.arm.upper)
    stand.shows("Last target: NO_PREDICTOR")
    stand.shows("tip − target: 1.00 mm (x +0.80, y -0.60, z")
    stand.until(lambda: stand.pixels(BLUE) > 200, "no arm is drawn")
    stand.until(lambda: stand.pixels(GREEN) > 20, "no target is drawn")
    stand.until(lambda: stand.pixels(ORANGE) > 20, "no error is drawn")
    stand.shows("drawn 10 times larger than it is, error arrows 100 times longer")
    page.locator("input:visible").first.fill("1")
    page.keyboard.press("Enter")
    stand.shows("The blue arm's deflection is drawn to scale, error arrows 100 times longer")
    stand.shows("After the last move: not known, because the driver does not say when it ends.")
    driver.own.parts[RING_SAID] = lambda: Report(OK, RING.describe())
    rings = "After the last move: the tip swings by 2.1 mm at most, 4.8 Hz; within 0.1 mm after"

    def told() -> bool:
        driver.own.publish()  # kinematics goes on to say that nobody knows
        return rings in stand.words()

    stand.until(told, rings)
    driver.walk.go([driver.walk.q + 0.01])
    stand.shows("tip − target: the arm is not at the last target")
    stand.shows("tip − predicted: 1.00 mm")


def says_how_well_the_nodes_are(stand: Stand) -> None:
    driver = stand.driver
    stand.shows("▲ kinematics: warning\n▲ targets: no error_predictor")
    stand.shows("▲ model: not calibrated yet: plan, collect, diagnose")
    stand.shows("Drift: evidence 0.")
    driver.own.publish()
    driver.foreign.publish()
    stand.shows(f"✖ servo_driver: error\n✖ part: {MEAN_WORDS}")
    assert "tester" not in stand.words() and "another namespace" not in stand.words()
    where = Progress(7, 24, visit=6, made=dict(enumerate(["too far"] * 2 + [""] * 5)))
    driver.collecting.publish(progress_message(where, f"/{NAMESPACE}"))
    stand.shows("collect: 7 of 24 poses driven; marker lost at 2 of 7 poses: ")


def buttons_call_the_services(stand: Stand) -> None:
    driver = stand.driver
    stand.press("Software stop (torque off)")
    stand.shows("Software stop (torque off): torque off, commands refused")
    stand.shows("The driver is stopped: trajectories refused.")
    stand.press("Hold")
    stand.shows("Hold: refused: the driver is not active, so there is no torque to hold the arm")
    stand.press("Release stop")
    stand.shows("The driver is ready.")
    stand.press("Reset fault")
    stand.shows(f"Reset fault: not done, nobody offers /{NAMESPACE}/servo_driver/reset")
    driver.offer_reset()
    last = [-math.inf]

    def pressed() -> bool:
        """The view must have discovered the service first: a press before that is refused in words.

        One that was not refused may be on its way, so the next comes late.
        """
        if ("reset", None) not in driver.asked and time.monotonic() - last[0] > 15.0:
            stand.press("Reset fault")
            last[0] = time.monotonic()
        return "Reset fault: ready" in stand.words()

    stand.until(pressed, "reset is not reached")


def narrow_page_does_not_run_over(stand: Stand) -> None:
    page = stand.page
    page.set_viewport_size({"width": 400, "height": 800})
    for button in ("Software stop (torque off)", "Hold", "Release hold", "Release stop"):
        shown = page.get_by_role("button", name=button, exact=True)
        shown.wait_for(state="visible")
        stand.until(lambda where=shown: inside(where.bounding_box()), f"{button} is cut off")
    assert page.evaluate("document.documentElement.scrollWidth") <= 400
    page.set_viewport_size(WIDE)


def inside(box: Any) -> bool:
    return bool(box) and box["x"] >= 0 and box["x"] + box["width"] <= 400 and box["y"] < 800


def says_that_the_graph_is_silent(stand: Stand) -> None:
    stand.until(lambda: stand.pixels(BLUE) > 200, "no arm is drawn")
    (kinematics,) = (p for p in stand.stage.processes if p is not stand.view)
    kinematics.send_signal(signal.SIGINT)
    kinematics.wait(timeout=PATIENCE_S)
    stand.driver.timer.cancel()
    stand.shows("The graph is silent for")
    stand.until(lambda: re.search(r"■ kinematics: silent for \d+ s", stand.words()), "not silent")
    stand.until(lambda: stand.pixels(BLUE) < 20, "the arm is drawn as if it was now")
    assert stand.pixels(ORANGE) < 20
