"""What `kinematics` has at hand for the next target: at first, after a fault, with any /clock."""

import signal
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from builtin_interfaces.msg import Time
from kinematics_inside import kinematics_inside
from nodes_bench import Bench
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature
from watched_kinematics import Watched

from bench.dummy_predictor import train_dummy
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.nodes import compensator, predictor_client
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.compensator import Readiness
from longarm_comp.nodes.kinematics import Kinematics
from longarm_comp.nodes.messages import joints_message
from longarm_comp.nodes.predictor_client import NoAnswer, PredictorClient
from longarm_interfaces.srv import Compensate, PredictError

STATUS = Compensate.Response


@pytest.fixture(scope="module")
def learned(arm: Arm, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("learned") / "predictor.npz"
    train_dummy(arm, path)
    return path


def test_ready_means_compiled_and_the_predictor_probed_also_after_its_return(
    stage: Bench, arm: Arm, demo_arm_path: Path, learned: Path
) -> None:
    files = {"arm": demo_arm_path, "predictor": learned}
    predictor = stage.start("error_predictor", files)
    given = {"arm": demo_arm_path, "compiled": True, "diagnostics_period_s": 0.1}
    stage.start("kinematics", given)
    seen = Watched(stage, arm)
    joints = graph.JOINT_STATES.publisher(stage.node)
    stage.node.create_timer(0.2, lambda: joints.publish(joints_message(arm, arm.mid)))
    seen.says("ready", "ready")
    seen.says("targets", "compensating")
    seen.says("ready", "ready")
    before = seen.programs
    assert before > 0
    answer = seen.ask()  # the first
    assert answer.status == STATUS.SUCCESS, answer.message
    assert seen.programs == before

    warm = graph.TEMPERATURE.publisher(stage.node)
    stage.connected(warm)

    def other_programs() -> bool:
        warm.publish(Temperature(temperature=20.0))
        return seen.programs > before

    stage.spin(other_programs)  # without a target
    seen.says("ready", "ready")
    before = seen.programs
    assert seen.ask().status == STATUS.SUCCESS
    assert seen.programs == before

    predictor.send_signal(signal.SIGKILL)
    predictor.wait()
    stage.spin(lambda: seen.ask().status == STATUS.NO_PREDICTOR)
    seen.says("targets", "no error_predictor answers", level=b"\1")
    stage.start("error_predictor", files)
    seen.says("targets", "compensating")  # found without a target
    answer = seen.ask()
    assert answer.status == STATUS.SUCCESS, answer.message


class Eager:
    """A worker that has done a job before `submit_once` returns."""

    def submit_once(self, job: Callable[[], None]) -> None:
        job()


def test_a_worker_that_is_quick_is_asked_again(stage: Bench) -> None:
    probed, rehearsed = [], []
    predictor = SimpleNamespace(answers=False, probe=lambda: probed.append(1))
    kinds = iter([*["one model"] * 4, *["another"] * 4])  # told to a look, and to what it begins
    compute = SimpleNamespace(kind=lambda: next(kinds), rehearse=lambda: rehearsed.append(1))
    state = SimpleNamespace(
        node=stage.node, worker=Eager(), predictor=predictor, p={"compiled": True}
    )
    ready = Readiness(state, compute)
    for _ in range(3):
        ready.look()
    assert len(probed) == 4
    assert len(rehearsed) == 2


def test_a_silent_predictor_is_probed_by_targets_and_ever_less_often(
    arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, sent = [0.0], []
    monkeypatch.setattr(predictor_client, "sleepless_s", lambda: now[0])
    caller = SimpleNamespace(present=True, answer=lambda number, within_s: None)
    caller.send = lambda request: sent.append(now[0]) or len(sent)
    client = PredictorClient(caller, arm, 0.5)
    for tick in range(100):  # 10 s
        now[0] = 0.1 * tick
        with pytest.raises(NoAnswer, match="does not answer" if tick else "did not answer"):
            client.ask(arm.mid, Context())
    gaps = [b - a for a, b in pairwise(sent[1:])]
    assert gaps == pytest.approx([0.6, 1.1, 2.1, 4.1], abs=0.11)
    caller.answer = lambda number, within_s: PredictError.Response(
        sigma=1.0, success=True, beside_deflection=True
    )
    client.probe()
    assert client.answers
    asked = len(sent)
    client.ask(arm.mid, Context())  # the very next target
    assert len(sent) == asked + 1
    caller.present = False
    with pytest.raises(NoAnswer, match="no error_predictor"):
        client.ask(arm.mid, Context())
    assert not client.answers


def test_the_first_order_of_another_driver_waits_for_nothing(
    stage: Bench, demo_arm_path: Path
) -> None:
    with kinematics_inside(arm=demo_arm_path, acknowledged="false", method="deflection") as node:
        kept = node._arm.files.loaded.model.commandable.memo
        stage.spin(lambda: "most_motion" in kept)


@pytest.fixture
def inside(stage: Bench, demo_arm_path: Path) -> Iterator[Kinematics]:
    """The node in this process, on a clock that the test tells."""
    with kinematics_inside(
        arm=demo_arm_path, compiled="false", acknowledged="false", method="deflection",
        use_sim_time="true", joints_max_age_s=1.0, diagnostics_period_s=0.1,
    ) as node:  # fmt: skip
        yield node


def test_whatever_the_clock_does_targets_and_joints_are_judged_by_it_and_loops_go_on(
    inside: Kinematics, stage: Bench, arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = Watched(stage, arm)
    joints = graph.JOINT_STATES.publisher(stage.node)
    clocks = stage.node.create_publisher(Clock, "/clock", 10)
    stage.connected(joints)
    stage.connected(clocks)

    def stands(stamp: Time, *, at: int, status: int, words: str = "") -> None:
        """Tell the clock and joints until an executed target of that stamp is answered so."""

        def answered() -> bool:
            if at:
                clocks.publish(Clock(clock=Time(sec=at)))
            joints.publish(joints_message(arm, arm.mid, Time(sec=at)))
            answer = seen.ask(execute=True, stamp=stamp)
            return bool(answer.status == status and words in answer.message)

        stage.spin(answered)

    stands(Time(), at=0, status=STATUS.SUCCESS)  # nobody tells the clock: it stands at 0
    stands(Time(sec=900), at=0, status=STATUS.STALE_TARGET, words="in the future")
    # without joints the watch on them bites, though no time passes on the node's clock
    stage.spin(lambda: "joint_states is" in (told := seen.ask(execute=True)).message and told)
    stands(Time(sec=1000), at=1000, status=STATUS.SUCCESS)
    stands(Time(sec=994), at=1000, status=STATUS.STALE_TARGET, words="6.0 s old")
    for now in range(1001, 1030, 2):  # it runs away
        stands(Time(sec=now), at=now, status=STATUS.SUCCESS)
    stands(Time(sec=500), at=500, status=STATUS.SUCCESS)  # it jumps back
    stands(Time(sec=1029), at=500, status=STATUS.STALE_TARGET, words="in the future")

    def broken(*given: object, **more: object) -> None:
        raise RuntimeError("broken on purpose")

    with monkeypatch.context() as patch:
        patch.setattr(compensator, "compensate_move", broken)
        assert seen.ask().status == STATUS.INTERNAL_ERROR
        seen.says("targets", "RuntimeError: broken", level=b"\2")
        seen.says("process", "survived 1 faults", level=b"\2")
    assert seen.ask().status == STATUS.SUCCESS
    assert seen.part("targets").level < b"\2"
    seen.says("process", "running")
