"""`kinematics` and its driver: what is sent, what was accepted, and what counts as commanded.

The driver's side is played by the test, so that it can be absent, in fault, silent or double.
"""

import math
import signal
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from places import DEMO_ARM as ARM

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from nodes_bench import Bench, bench
from own_graph import own_graph
from played_driver import Driver, is_away
from rclpy.duration import Duration
from std_msgs.msg import String
from target_requests import pose, request
from wind_up import there_and_back

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.plays import FrictionHysteresis
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import trajectory_message
from longarm_comp.nodes.orders import order_id
from longarm_interfaces.action import Reach
from longarm_interfaces.msg import DriverState, Motion
from longarm_interfaces.srv import Compensate, PredictError

STATUS = Compensate.Response


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory, arm: Arm) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp("link")
    friction = FrictionHysteresis(joint=2, width=0.02, inner=0.01, outer=0.01)
    save_model(folder / "model.yaml", store(declared_model(arm).plus(friction)))
    with own_graph(folder, freezes=True), bench() as made:
        options = {"arm": ARM, "model": folder / "model.yaml", "method": "deflection"}
        made.start(
            "kinematics", {**options, "run_up": False, "acknowledged": True, "acknowledge_s": 0.3,
                           "target_max_age_s": 60.0}
        )  # fmt: skip
        yield made


@pytest.fixture(scope="module")
def driver(stage: Bench, arm: Arm) -> Driver:
    return Driver(stage, arm)


def test_nothing_is_called_sent_or_accepted_that_was_not(
    stage: Bench, arm: Arm, driver: Driver
) -> None:
    client = graph.COMPENSATE.client(stage.node)
    stories = stage.collect(graph.COMPENSATION)
    target = declared_model(arm).pose(arm.mid)

    def asked(execute: bool = True) -> Compensate.Response:
        return stage.call(client, request(target, arm, execute=execute))

    def says(status: int, words: str, executed: bool = False) -> Compensate.Response:
        found: list[Compensate.Response] = []

        def heard() -> bool:
            found[:] = [asked()]
            return found[0].status == status and words in found[0].message

        stage.spin(heard)
        stage.spin(lambda: stories and stories[-1].message == found[0].message)
        assert bool(stories[-1].executed.name) == executed
        assert stories[-1].accepted == found[0].success == bool(found[0].command.name)
        return found[0]

    says(STATUS.NO_DRIVER, "no servo_driver")
    assert asked(execute=False).success
    driver.instances = ("a",)
    for state, word in (
        (DriverState.UNCONFIGURED, "not configured: so"), (DriverState.INACTIVE, "inactive: so"),
        (DriverState.HOLDING, "held: so"), (DriverState.FAULT, "in fault: so"),
        (DriverState.ESTOP, "stopped: so"), (99, "in the unknown state 99: so"),
    ):  # fmt: skip
        driver.state = state
        says(STATUS.NO_DRIVER, word)
    assert not driver.got
    driver.state, driver.answers = DriverState.READY, False
    says(STATUS.NOT_ACCEPTED, "not acknowledged", executed=True)
    driver.answers, driver.event = True, Motion.REFUSED
    says(STATUS.NOT_ACCEPTED, "refused it: the fake says so", executed=True)
    driver.event = Motion.ACCEPTED
    answer = says(STATUS.SUCCESS, "", executed=True)
    names = answer.id, stories[-1].id, order_id(driver.got[-1])
    assert names[0] and len(set(names)) == 1
    assert len({story.id for story in stories}) == len(stories)

    # One that does not report for three periods is taken for gone, and it may be busy at first
    second = stage.start("kinematics", {"arm": ARM, "acknowledged": True})
    try:
        kept_back = says(STATUS.NO_DRIVER, "two kinematics")
        # either may answer, and the new one has heard no joint_states at first
        stage.spin(lambda: asked(execute=False).success)
        stage.spin(lambda: asked().status == STATUS.NO_DRIVER)
    finally:
        second.send_signal(signal.SIGINT)  # it takes its leave: one that is killed counts for 20 s
        second.wait(timeout=300)
    sent = says(STATUS.SUCCESS, "", executed=True)
    ids = [order_id(message) for message in driver.got]
    assert sent.id in ids and kept_back.id and kept_back.id not in ids

    driver.instances = ("a", "b")
    says(STATUS.NO_DRIVER, "two drivers")
    driver.instances = ("b",)
    says(STATUS.SUCCESS, "", executed=True)
    driver.instances = ()
    says(STATUS.NO_DRIVER, "silent")


@pytest.mark.parametrize(
    ("after", "status", "words"),
    [
        ("a stop and its end", STATUS.NO_DRIVER, "the arm was stopped after this was asked"),
        ("what ended unheard", STATUS.NO_DRIVER, "the arm was stopped after this was asked"),
        ("another driver", STATUS.NO_DRIVER, "the arm was stopped after this was asked"),
        ("a withdrawal", STATUS.NOT_READY, "cancelled before anything was sent"),
    ],
)
@pytest.mark.parametrize("by", ["compensate", "reach", "target_pose"])
def test_a_target_that_waits_moves_nothing_after_a_stop_or_a_withdrawal(
    stage: Bench, arm: Arm, driver: Driver, by: str, after: str, status: int, words: str
) -> None:
    for story in told_after(stage, arm, driver, 0.1, by, after):
        assert (story.status, words in story.message) == (status, True), story


@pytest.mark.parametrize(
    "after", ["nothing", "a stop and its end", "another driver", "a withdrawal"]
)
@pytest.mark.parametrize("by", ["compensate", "reach", "target_pose"])
def test_a_target_from_before_a_long_absence_moves_nothing(
    stage: Bench, arm: Arm, driver: Driver, by: str, after: str
) -> None:
    """What was said meanwhile is lost, or heard later: of the driver's states the last is kept."""
    for story in told_after(stage, arm, driver, 2.0, by, after):
        assert story.status != STATUS.SUCCESS
        assert after != "nothing" or "this node was away" in story.message, story


def told_after(
    stage: Bench, arm: Arm, driver: Driver, pause_s: float, by: str, after: str
) -> list[Any]:
    """The answer to a target that waited while `kinematics` was frozen; none if it was aborted."""
    driver.instances, driver.event = (f"before {by}",), Motion.ACCEPTED
    driver.state, driver.answers = DriverState.READY, True
    client, stories = graph.COMPENSATE.client(stage.node), stage.collect(graph.COMPENSATION)
    target = declared_model(arm).pose(arm.mid)
    ask = request(target, arm, execute=True)
    stage.spin(lambda: stage.call(client, ask).success)
    withdraw, poses = graph.WITHDRAWN.publisher(stage.node), graph.TARGET_POSE.publisher(stage.node)
    stage.connected(withdraw, String(data="nothing"))
    stage.connected(poses)
    reach = stage.action(Reach, graph.REACH.name)
    stage.matched(poses, pose(target), stories)
    last = stage.call(client, ask).id
    stage.spin(lambda: stories[-1].id == last)
    del stories[:]
    goals = list[Any]()

    def aborted() -> bool:
        """Whether `reach` aborted its goal at once: it had not heard the driver again yet."""
        ended = goals and goals[0].done() and goals[0].result().status
        return ended == GoalStatus.STATUS_ABORTED

    send = {
        "compensate": lambda: client.call_async(ask),
        "reach": lambda: goals.append(reach.send_goal_async(Reach.Goal(target=pose(target)))),
        "target_pose": lambda: poses.publish(pose(target)),
    }[by]
    meanwhile: dict[str, tuple[Callable[[], object], ...]] = {
        "a stop and its end": (
            lambda: driver.says(DriverState.ESTOP),
            lambda: driver.says(DriverState.READY),
        ),
        "what ended unheard": (lambda: setattr(driver, "stops", driver.stops + 2), driver.beat),
        "another driver": (lambda: setattr(driver, "instances", (f"after {by}",)), driver.beat),
        "a withdrawal": (lambda: withdraw.publish(String()),),
        "nothing": (),
    }
    driver.got.clear()
    is_away(stage, stage.processes[0], pause_s, send, *meanwhile[after])
    stage.spin(lambda: stories or aborted())
    told = list(stories)
    assert not driver.got
    stage.spin(lambda: stage.call(client, ask).success)
    reach.destroy()
    return told


def test_a_target_is_not_sent_if_a_stop_or_a_withdrawal_came_while_it_was_computed(
    stage: Bench, arm: Arm, driver: Driver
) -> None:
    driver.instances, driver.event = ("with a predictor",), Motion.ACCEPTED
    driver.state, driver.answers = DriverState.READY, True
    client, happens = graph.compensate_by("both").client(stage.node), list[Callable[[], object]]()
    withdraw = graph.WITHDRAWN.publisher(stage.node)
    stage.connected(withdraw, String(data="nothing"))

    def predict(asked: Any, answer: PredictError.Response) -> PredictError.Response:
        while happens:
            happens.pop(0)()
        for publisher in stage.node.publishers:
            publisher.wait_for_all_acked(Duration(seconds=10.0))
        answer.sigma, answer.message = math.nan, "it has no file"
        return answer

    server = graph.PREDICT_ERROR.server(stage.node, predict)
    ask = request(declared_model(arm).pose(arm.mid), arm, execute=True)

    def asked() -> bool:
        answer = stage.call(client, ask)
        return answer.success and "it has no file" in answer.message

    for event, status, words in (
        (
            (partial(driver.says, DriverState.ESTOP), partial(driver.says, DriverState.READY)),
            STATUS.NO_DRIVER,
            "the arm was stopped after this was asked",
        ),
        ((partial(withdraw.publish, String()),), STATUS.NOT_READY, "cancelled before anything"),
    ):
        stage.spin(asked)
        driver.got.clear()
        happens.extend(event)
        answer = stage.call(client, ask)
        assert (answer.status, words in answer.message) == (status, True), answer.message
        assert not happens and not driver.got
    stage.node.destroy_service(server)


def test_what_is_withdrawn_while_the_driver_takes_it_is_broken_off(
    stage: Bench, arm: Arm, driver: Driver
) -> None:
    driver.instances, driver.event = ("at it",), Motion.ACCEPTED
    driver.state, driver.answers = DriverState.READY, True
    client, ask = (
        graph.COMPENSATE.client(stage.node),
        request(declared_model(arm).pose(arm.mid), arm, execute=True),
    )
    stage.spin(lambda: stage.call(client, ask).success)
    withdraw = graph.WITHDRAWN.publisher(stage.node)
    stage.connected(withdraw, String(data="nothing"))
    stage.spin(lambda: driver.withdrawn[-1:] == ["nothing"])
    driver.withdrawn.clear()
    driver.answers = False
    driver.got.clear()
    client.call_async(ask)
    stage.spin(lambda: driver.got)
    withdraw.publish(String())
    stage.spin(lambda: driver.withdrawn)
    driver.tell(Motion.ACCEPTED, order_id(driver.got[-1]), driver.got[-1])
    stage.spin(lambda: len(driver.withdrawn) == 2)
    assert driver.withdrawn == ["", order_id(driver.got[-1])]
    driver.answers = True


@pytest.mark.parametrize(
    ("event", "said"),
    [
        (Motion.REACHED, "cancelled: the arm was stopped"),
        (Motion.REFUSED, "cancelled: the arm was not stopped as asked: the fake says so"),
        (Motion.BROKEN_OFF, "cancelled: the arm was not stopped as asked: the fake says so"),
        (None, "cancelled: the arm was not stopped as asked: servo_driver has been silent"),
    ],
)
def test_a_cancelled_reach_calls_an_arm_stopped_only_at_rest(
    stage: Bench, arm: Arm, driver: Driver, event: int | None, said: str
) -> None:
    driver.instances, driver.event = ("a",), Motion.ACCEPTED
    driver.state, driver.answers = DriverState.READY, True
    client = graph.COMPENSATE.client(stage.node)
    target = declared_model(arm).pose(arm.mid)
    stage.spin(lambda: stage.call(client, request(target, arm, execute=True)).success)
    reach = stage.action(Reach, graph.REACH.name)
    heard, goals = list[int](), list[Any]()

    def moves() -> bool:
        """Send the goal, and again where `reach` takes it for older than this driver."""
        if not goals or (
            goals[-1].done() and goals[-1].result().status == GoalStatus.STATUS_ABORTED
        ):
            asked = Reach.Goal(target=pose(target))
            goals.append(
                reach.send_goal_async(asked, lambda told: heard.append(told.feedback.phase))
            )
        return goals[-1].done() and Reach.Feedback.MOVING in heard

    stage.spin(moves)
    if event is None:
        driver.answers, driver.instances = False, ()
    else:
        driver.event = event
    goal = goals[-1].result()
    goal.cancel_goal_async()
    ended = goal.get_result_async()
    stage.spin(ended.done)
    assert ended.result().result.message.startswith(said)
    assert not driver.got[-1].points
    driver.answers = True
    reach.destroy()


def test_what_the_driver_accepted_is_the_history_of_the_joints(
    stage: Bench, arm: Arm, driver: Driver
) -> None:
    driver.instances = ("c",)
    client = graph.COMPENSATE.client(stage.node)
    sender = graph.JOINT_TRAJECTORY.publisher(stage.node)
    stage.connected(sender)
    target = declared_model(arm).pose(arm.mid)

    def doubts(expected: bool) -> Compensate.Response:
        """An answer that says, or does not say, that the tip depends on what is not known."""
        found: list[Compensate.Response] = []

        def heard() -> bool:
            found[:] = [stage.call(client, request(target, arm))]
            return found[0].success and ("not known" in found[0].message) is expected

        stage.spin(heard)
        return found[0]

    driver.event = Motion.REFUSED
    ask = request(target, arm, execute=True)
    stage.spin(lambda: stage.call(client, ask).status == STATUS.NOT_ACCEPTED)  # it knows of "c"
    doubts(True)
    now = stage.node.get_clock().now().to_msg()
    way = trajectory_message(arm, there_and_back(arm, arm.mid), 0.1, now)
    for event in (Motion.BROKEN_OFF, Motion.REPLACED):
        driver.event = Motion.REFUSED
        got = len(driver.got)
        sender.publish(way)
        stage.spin(lambda got=got: len(driver.got) > got)
        assert "not known" in doubts(True).message  # sent by somebody, and not taken up
        driver.event = Motion.ACCEPTED
        sender.publish(way)
        sure = doubts(False).sigma  # the tolerances of the arm as declared
        driver.tell(Motion.REACHED, "")
        driver.tell(Motion.REFUSED, "another")
        doubts(False)
        driver.tell(event, "")
        assert doubts(True).sigma ** 2 > sure**2 + 1e-6 / 3.0
