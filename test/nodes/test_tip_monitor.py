"""The monitor of the tip: which one drifts, the prediction or the way to the target."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from small_arm import ARM, AWAY

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.target_frame import base_of_graph
from longarm_comp.core.data.rest import RestPose
from longarm_comp.core.effects.placements import CameraPose
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.uncertainty import ModelUncertainty

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseWithCovarianceStamped

from longarm_comp.nodes.clock import stamp_of
from longarm_comp.nodes.health import OK, WARN
from longarm_comp.nodes.messages import joints_message, trajectory_message
from longarm_comp.nodes.monitoring import ReadingsTeller, RingTeller, TipMonitor
from longarm_comp.nodes.predictor_client import NoAnswer
from longarm_interfaces.msg import Motion


def files_of(model: Model) -> SimpleNamespace:
    return SimpleNamespace(loaded=SimpleNamespace(file_hash="", stands=base_of_graph(model)))


def monitor_of(
    settle_s: float = 0.0,
    model: Model = Model(ARM),  # noqa: B008
    sigma_m: float = 1e-3,
) -> TipMonitor:
    """A monitor of an arm without a predictor, warned by one sighting a pose."""
    p = {"settle_s": settle_s, "sightings": 1, "sigma_m": sigma_m, "run_length": 1e4}
    given = {"arm": "arm.yaml", "model": "", **{f"monitor.{k}": v for k, v in p.items()}}
    files = files_of(model)
    node, nobody = SimpleNamespace(get_namespace=lambda: "/"), MagicMock()
    nobody.ask.side_effect = NoAnswer("no error_predictor is running")
    return TipMonitor(SimpleNamespace(p=given, files=files, node=node, predictor=nobody))


def watched(
    model: Model, off_prediction: float, off_target: float, sigma_m: float = 1e-3
) -> TipMonitor:
    """Forty rest poses: the tip is off its prediction, and its prediction off the target."""
    monitor, stands = monitor_of(model=model, sigma_m=sigma_m), base_of_graph(model)
    rng = np.random.default_rng(1)
    for _ in range(40):
        q = ARM.mid + 0.2 * (ARM.upper - ARM.lower) * (rng.random(ARM.n) - 0.5)
        noise = 3e-4 * rng.standard_normal(3)
        seen = model.measured(q) + np.array([0.0, 0.0, off_prediction]) + noise
        monitor.aim_at(q, stands.carry_from_model(model.tip(q)) - [0.0, 0.0, off_target])
        rest = RestPose(q, History.unknown(ARM.n), seen, np.full(3, 1e-8))
        monitor.judge(rest, model, Context())
    assert monitor.sighted is not None
    miss = [0.0, 0.0, off_prediction + off_target]
    turn = stands.motion[:3, :3] if off_prediction else np.eye(3)
    np.testing.assert_allclose(turn @ monitor.sighted.miss, miss, atol=2e-3)
    return monitor


@pytest.fixture(params=[(), (AWAY,)], ids=["declared", "tracked"])
def model(request: pytest.FixtureRequest) -> Model:
    """Whose camera stands 5 mm beside where it is declared, which is no miss; one that reports in
    a frame metres away."""
    return Model(ARM, request.param, (CameraPose(x=5e-3),))


def test_a_healthy_arm_raises_no_alarm(model: Model) -> None:
    monitor = watched(model, 0.0, 0.0)
    assert monitor.report().level == OK
    assert monitor.target_report().level == OK
    assert monitor.target_report().facts["targets"] == 40


def test_a_drifted_arm_is_off_both(model: Model) -> None:
    monitor = watched(model, 4e-3, 0.0)
    assert monitor.report().level == WARN
    assert monitor.target_report().level == WARN
    assert "misses target and prediction" in monitor.target_report().message


@pytest.mark.parametrize(("off", "drifted"), [(4e-3, False), (0.1, True)])
def test_an_arm_that_does_what_its_model_promises_is_not_off(off: float, drifted: bool) -> None:
    """The declared arm promises to come to rest within some 10 mm of its target."""
    monitor = watched(Model(ARM), off, 0.0, sigma_m=0.0)
    assert (monitor.report().level == WARN) == drifted


def test_what_the_model_promises_of_a_pose_is_no_drift_however_often_it_returns(
    model: Model,
) -> None:
    """Two standard deviations of it; then the arm stands aside until it is set back."""
    none, left = np.zeros((3, 3)), 9e-6 * np.eye(3)
    promised = ModelUncertainty((), np.zeros((0, 0)), left, none, 0.0, 0)
    model = replace(model, uncertainty=promised)
    monitor, stands = monitor_of(model=model, sigma_m=0.0), base_of_graph(model)
    rng = np.random.default_rng(1)

    def rests(count: int, off: tuple[float, float, float]) -> tuple[int, int]:
        for _ in range(count):
            seen = model.measured(ARM.mid) + off + 3e-4 * rng.standard_normal(3)
            monitor.aim_at(ARM.mid, stands.carry_from_model(model.tip(ARM.mid)))
            rest = RestPose(ARM.mid, History.unknown(ARM.n), seen, np.full(3, 1e-7))
            monitor.judge(rest, model, Context())
        return monitor.report().level, monitor.target_report().level

    assert rests(60, (6e-3, 0.0, 0.0)) == (OK, OK)
    assert rests(20, (6e-3, 0.0, 8e-3)) == (WARN, WARN)
    assert rests(300, (6e-3, 0.0, 8e-3)) == (WARN, WARN)
    assert "+8." in monitor.report().message or "+7." in monitor.report().message
    monitor.begin_anew()
    assert monitor.report().facts["rest poses"] == 0
    assert rests(20, (-6e-3, 0.0, 0.0)) == (OK, OK)  # nothing is known of it


def test_commands_for_other_circumstances_show_at_the_target_alone(model: Model) -> None:
    monitor = watched(model, 0.0, 4e-3)
    assert monitor.report().level == OK
    assert monitor.target_report().level == WARN
    assert "other circumstances" in monitor.target_report().message
    assert "+4.0" in monitor.target_report().message or "+3.9" in monitor.target_report().message


def test_a_pose_that_is_no_target_is_not_judged_by_one(model: Model) -> None:
    monitor = monitor_of()
    monitor.aim_at(ARM.mid, np.zeros(3))
    q = ARM.mid + 0.01
    rest = RestPose(q, History.unknown(ARM.n), model.measured(q), np.full(3, 1e-8))
    monitor.judge(rest, model, Context())
    assert monitor.target_report().facts["targets"] == 0


def test_images_of_the_way_that_come_late_are_no_rest_pose() -> None:
    """A busy machine hands them over seconds after the joints came to rest."""
    monitor = monitor_of(0.5)
    monitor.on_command(ARM.mid, History.unknown(ARM.n))
    monitor.on_joints(ARM.mid + 0.1, 9.0)
    monitor.on_joints(ARM.mid, 10.0)
    for taken, now, rests in ((9.9, 14.0, False), (10.4, 14.5, False), (10.6, 15.0, True)):
        seen = PoseWithCovarianceStamped()
        seen.header.stamp = stamp_of(int(1e9 * taken))
        monitor._state.now_s = now
        assert (monitor.on_tip(seen) is not None) == rests
    monitor.on_command(ARM.mid, History.unknown(ARM.n))
    monitor.on_joints(ARM.mid, 20.0)
    monitor._state.now_s = 20.4
    assert monitor.on_tip(PoseWithCovarianceStamped()) is None  # no stamp: it is of now
    monitor._state.now_s = 20.6
    assert monitor.on_tip(PoseWithCovarianceStamped()) is not None


def test_images_of_a_clock_that_is_ahead_are_of_now_at_most() -> None:
    """Else the arm on its way would count as settled."""
    monitor = monitor_of(0.5)
    monitor.on_command(ARM.mid, History.unknown(ARM.n))
    monitor.on_joints(ARM.mid, 10.0)
    for now, rests in ((10.1, False), (10.4, False), (10.6, True)):
        seen = PoseWithCovarianceStamped()
        seen.header.stamp = stamp_of(int(1e9 * (now + 3.0)))
        monitor._state.now_s = now
        assert (monitor.on_tip(seen) is not None) == rests


@pytest.mark.parametrize(
    ("said", "rests"),
    [
        (("b",), True),
        (("a",), False),  # of the motion before
        (("b", Motion.BROKEN_OFF), False),  # the arm falls
        (("b", Motion.REPLACED), False),
    ],
)
def test_an_arm_that_gives_way_rests_by_the_word_on_its_own_motion(
    said: tuple[str, ...] | tuple[str, int], rests: bool
) -> None:
    monitor, (name, *ends) = monitor_of(0.5), said
    for motion in ("a", "b"):
        monitor.on_command(ARM.mid, History.unknown(ARM.n))
        monitor.on_motion(Motion(id=motion, event=Motion.ACCEPTED))
    monitor._state.now_s = 10.0
    for event in (Motion.REACHED, *ends):
        monitor.on_motion(Motion(id=name, event=event))
    monitor.on_joints(ARM.mid + 0.1, 10.1)
    monitor._state.now_s = 11.0
    assert (monitor.on_tip(PoseWithCovarianceStamped()) is not None) == rests


@pytest.mark.parametrize("missing", ["a free worker", "a circumstance"])
def test_a_ring_that_could_not_be_computed_at_once_is_told_later(missing: str) -> None:
    """By a model in which nothing bends: only when it is told is asked here."""
    jobs: list[Callable[[], None]] = []
    known = [Context()]
    worker = SimpleNamespace(waiting=0, submit_once=jobs.append)
    state = SimpleNamespace(
        arm=ARM, worker=worker, known_context=lambda: known[0],
        driver=SimpleNamespace(acknowledged=True),
        files=SimpleNamespace(loaded=SimpleNamespace(model=Model(ARM))),
    )  # fmt: skip
    teller = RingTeller(state, shaped=False)
    path = trajectory_message(ARM, np.stack([ARM.mid, ARM.upper]), 0.5, stamp_of(0))
    taken = Motion(id="a", event=Motion.ACCEPTED, start=joints_message(ARM, ARM.lower))
    taken.points = path.points
    if missing == "a free worker":
        worker.waiting = 1
    else:
        known[0] = None
    teller.on_motion(taken)
    teller.on_motion(Motion(id="a", event=Motion.REACHED))

    def worked() -> str:
        """What is said after the worker has done its jobs."""
        while jobs:
            jobs.pop()()
        return teller.report().message

    assert worked() == worked() == "not known, because no move has ended"
    worker.waiting, known[0] = 0, Context()
    teller.report()
    assert worked() == "by this model nothing bends"
    assert not jobs


class Quick:
    """A worker that has done a job before `submit_once` returns, or takes none."""

    takes = True

    def submit_once(self, job: Callable[[], None]) -> None:
        if self.takes:
            job()


def test_the_tip_by_readings_goes_on_whatever_the_worker_does() -> None:
    ticks: list[Callable[[], None]] = []
    told: list[object] = []
    node = SimpleNamespace(
        create_publisher=lambda *given, **more: SimpleNamespace(publish=told.append),
        every=lambda name, tick: ticks.append(tick),
    )
    state = SimpleNamespace(
        node=node, worker=Quick(), standing=(Model(ARM), ARM.mid, Context()),
        stamp=stamp_of(0), base_frame="base", files=files_of(Model(ARM)),
    )  # fmt: skip
    ReadingsTeller(state)
    (tick,) = ticks
    tick()  # where the joints are; whether they rest the next one knows
    for takes, count in ((True, 1), (True, 2), (False, 2), (True, 3)):
        state.worker.takes = takes
        tick()
        assert len(told) == count
