"""`longarm collect` on a graph: what it says where the marker is lost, hold, boxes."""

import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from small_arm import ARM

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from cli_shell import Shell
from nodes_bench import facts_of
from quick_arm import QUICK, QuickArm, quick_arm

from longarm_comp.arm_folder.head import view_beside
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.parts import Box
from longarm_comp.core.data.plan import Plan, sobol
from longarm_comp.core.errors import JobError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.client import ArmClient, DriverStopped
from longarm_comp.jobs.collect.run import Collected, Progress, collect
from longarm_comp.jobs.collect.visits import list_visits
from longarm_comp.jobs.recorder import Recorder
from longarm_comp.sessions.read import read_session
from longarm_interfaces.msg import DriverState

KINDS = {
    "tip_measured": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "joint_states": "sensor_msgs/msg/JointState",
    "joint_trajectory": "trajectory_msgs/msg/JointTrajectory",
}


@pytest.fixture
def stage(ros_domain: int) -> Iterator[QuickArm]:
    with quick_arm(ARM, lambda q: True) as arm:
        yield arm


def run(
    bag: Path, plan: Plan, show: Callable[[Progress], None] = lambda now: None, **how: Any
) -> Collected:
    arm = how.pop("arm", ARM)
    with ArmClient(arm, name="collect") as client:
        todo = list_visits(plan, arm, shuffle=False)
        return collect(client, todo, bag, pace=QUICK, progress=show, **how)


def test_where_no_pose_is_seen_it_ends_in_words_and_leaves_nothing(
    stage: QuickArm, tmp_path: Path
) -> None:
    bag, plan = tmp_path / "bag", sobol(ARM, 4, 1)
    stage.sees = lambda q: False
    with pytest.raises(JobError, match="marker lost at 3 of 3 poses: 3 not seen") as told:
        run(bag, plan, give_up=3)
    assert "--seen" in str(told.value) and "--give-up 0" in str(told.value)
    assert not bag.exists()
    ended = stage.heard[-1]
    assert ended.level == b"\x02" and facts_of(ended)["state"] == "ended"
    stage.sees = lambda q: True
    assert run(bag, plan, give_up=3).made == 4
    assert np.isfinite(read_session(bag, ARM).xyz).all()


def test_what_is_lost_has_its_likely_cause_and_the_graph_is_told(
    demo_arm_path: Path, ros_domain: int, tmp_path: Path
) -> None:
    arm = Arm.load(demo_arm_path)
    view = view_beside(demo_arm_path)
    assert view is not None
    plan = sobol(arm, 6, 1)
    tips = declared_model(arm).pose(plan.q)
    ends = (replace(view, size_px=(px, 480)) for px in range(640, 0, -20))
    narrow = next(ending for ending in ends if any(ending.unseen(tips)))
    why = narrow.unseen(tips)
    assert 1 <= sum(map(bool, why)) <= 5
    shown: list[Progress] = []
    with quick_arm(arm, lambda q: not narrow.unseen(declared_model(arm).pose(q[None]))[0]) as stage:
        done = run(tmp_path / "bag", plan, shown.append, arm=arm, view=narrow, give_up=0)
        heard = stage.heard
    assert done.unseen == {k: text for k, text in enumerate(why) if text}
    assert "to the right" in next(iter(done.unseen.values()))
    last = facts_of(heard[-1])
    assert (last["state"], last["done"], last["total"]) == ("done", "6", "6")
    assert int(last["lost"]) == len(done.unseen) == 6 - int(last["seen"])
    assert float(last["eta_s"]) == 0.0
    text = shown[-2].losses
    assert text.startswith(f"marker lost at {len(done.unseen)} of 6 poses: ")
    assert str(shown[-2]).startswith("6 of 6 poses driven") and "marker lost at" in str(shown[-2])


def held_back(topic: str, for_s: float) -> Callable[..., None]:
    """`Recorder.put` of a busy machine, which hears one topic so much later; inf: never."""
    put, waiting = Recorder.put, list[tuple[float, bytes, str]]()

    def late(recorder: Recorder, name: str, kind: str, raw: bytes) -> None:
        now = time.monotonic()
        if name.endswith(topic):
            waiting.append((now + for_s, raw, name))
        else:
            put(recorder, name, kind, raw)
        while waiting and waiting[0][0] <= now:
            _, old, its = waiting.pop(0)
            put(recorder, its, KINDS[topic], old)

    return late


@pytest.mark.parametrize("topic", ["tip_measured", "joint_states", "joint_trajectory"])
def test_what_is_recorded_late_is_waited_for(
    topic: str, stage: QuickArm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Recorder, "put", held_back(topic, 0.7))
    with ArmClient(ARM, name="collect") as client:
        todo = list_visits(sobol(ARM, 2, 1), ARM, shuffle=False)
        done = collect(client, todo, tmp_path / "bag", pace=replace(QUICK, sightings=4))
    session = read_session(tmp_path / "bag", ARM)
    assert (done.made, done.unseen) == (2, {}) and session.index.tolist() == [0, 1]
    assert session.sigma is not None and (session.sigma <= 1.001e-4 / np.sqrt(4)).all()  # of all
    tips = declared_model(ARM).tip(session.q)
    np.testing.assert_allclose(session.xyz, tips, atol=1e-6)


def test_what_is_never_recorded_is_told_and_a_blank_row(
    stage: QuickArm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Recorder, "put", held_back("tip_measured", float("inf")))
    shown: list[Progress] = []
    pace = replace(QUICK, look_s=0.2)
    with ArmClient(ARM, name="collect") as client:
        todo = list_visits(sobol(ARM, 4, 1), ARM, shuffle=False)
        collect(client, todo[:1], tmp_path / "bag", pace=pace)  # nothing at all is no session
        monkeypatch.undo()
        collect(client, todo[:2], tmp_path / "bag", pace=QUICK, resume=True)
        monkeypatch.setattr(Recorder, "put", held_back("tip_measured", float("inf")))
        done = collect(
            client, todo, tmp_path / "bag", pace=pace, resume=True, progress=shown.append
        )
    session = read_session(tmp_path / "bag", ARM)
    assert session.index.tolist() == list(range(4)) and done.made == 2
    assert session.seen.tolist() == [False, True, False, False]
    assert set(done.unseen) == {2, 3} and set(session.lost) == {0, 2, 3}
    assert "lost at 2 of 2" in shown[-1].losses


def test_it_waits_while_the_driver_is_held_and_ends_with_a_fault(
    stage: QuickArm, tmp_path: Path
) -> None:
    states: list[str] = []

    def show(now: Progress) -> None:
        states.append(now.state)
        if now.done == 2 and "waiting" not in states:
            stage.hold(True)
        if now.state == "waiting":
            stage.hold(False)

    done = run(tmp_path / "bag", sobol(ARM, 5, 1), show)
    assert done.made == 5 and states.count("waiting") == 1
    assert read_session(tmp_path / "bag", ARM).index.tolist() == list(range(5))

    def fault(now: Progress) -> None:
        if now.done == 2:
            stage.hold(True, DriverState.FAULT)

    with pytest.raises(JobError, match=r"fault.*by the test"):
        run(tmp_path / "other", sobol(ARM, 5, 1), fault)
    stage.hold(False)
    again = run(tmp_path / "other", sobol(ARM, 5, 1), resume=True)
    assert (again.before, again.made) == (2, 3)


def test_a_stop_that_ended_while_it_computed_ends_it_before_it_moves_the_arm(
    stage: QuickArm, tmp_path: Path
) -> None:
    def show(now: Progress) -> None:
        if now.done == 2 and len(stage.visited) == 2:
            stage.stops += 2
            time.sleep(0.2)  # the arm tells it, and nobody listens

    with pytest.raises(DriverStopped, match="was stopped meanwhile") as ended:
        run(tmp_path / "bag", sobol(ARM, 5, 1), show)
    assert not ended.value.held and len(stage.visited) == 2
    assert run(tmp_path / "bag", sobol(ARM, 5, 1), resume=True).made == 3


def test_no_way_enters_a_box(stage: QuickArm, tmp_path: Path) -> None:
    """Straight over joint 1 there is a lamp: what lies beyond it is reached another way, or not."""
    low, high = ARM.mid.copy(), ARM.mid.copy()
    low[0], high[0] = ARM.lower[0], ARM.upper[0]
    tip = declared_model(ARM).tip(ARM.mid)
    lamp = Box(min_m=tuple((tip - 0.02).tolist()), max_m=tuple((tip + 0.02).tolist()))
    boxed = ARM.model_copy(update={"keep_out": {"lamp": lamp}})
    bent = np.where(np.arange(ARM.n) == 1, ARM.upper, ARM.mid)
    round_it = [np.where(np.arange(ARM.n) == 0, end, bent) for end in (low, high)]
    stage.stand(low)
    plan = Plan(np.array([high, *round_it]), np.zeros(3))
    done = run(tmp_path / "bag", plan, arm=boxed)
    assert done.made == 3 and not done.blocked
    np.testing.assert_allclose(stage.visited[0], round_it[0])
    assert any(np.allclose(q, high) for q in stage.visited)
    stage.stand(low)
    alone = run(tmp_path / "other", Plan(high[None], np.zeros(1)), arm=boxed)
    assert alone.made == 0 and "lamp" in alone.blocked[0]


def test_a_full_disk_ends_it_with_cause_what_is_kept_and_the_next_command(
    stage: QuickArm, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """The system's limit of a file's size, as a full disk: nothing more can be written."""
    shell = Shell(tmp_path, capsys)
    arm, poses, bag = tmp_path / "arm.yaml", tmp_path / "poses.csv", tmp_path / "bag"
    arm.write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_defaults=True)))
    assert shell("plan", arm, "--kind", "sobol", "-n", 6, "-o", poses) == 0
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    kept, visits = Recorder.keep, []

    def keep(recorder: Recorder, *words: Any, **more: Any) -> Any:
        visits.append(1)
        if len(visits) == 4:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
        return kept(recorder, *words, **more)

    monkeypatch.setattr(Recorder, "keep", keep)
    try:
        code = shell("collect", arm, poses, "-o", bag, "--sightings", 1, "--dwell", 0.1,
                     "--move", 0.05, "--in-order")  # fmt: skip
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert code == 3
    lines = shell.err.splitlines()
    assert "File too large" in lines[-1]
    assert "of 6 visits" in shell.err and "--resume adds the others" in shell.err


def test_an_arm_that_is_still_trimmed_is_not_measured(stage: QuickArm) -> None:
    """On a busy computer the trim came after the rest that was waited for."""
    stage.trim = np.full(ARM.n, 1e-3)
    with ArmClient(ARM) as client:
        client.ready()
        for q in sobol(ARM, 2).q:
            start = client.joints
            client.send(q[None])
            _, looks = client.look(q[None], QUICK, start)
            trimmed = declared_model(ARM).tip(q + stage.trim)
            np.testing.assert_allclose(looks, [trimmed] * len(looks), atol=1e-6)


@pytest.mark.parametrize("ahead_s", [5.0, 20.0])
def test_cameras_whose_clock_is_ahead_show_the_arm_at_rest(
    ahead_s: float, stage: QuickArm, tmp_path: Path
) -> None:
    """By their stamps they would have seen the poses before this one after it was reached."""
    stage.ahead_s = ahead_s
    plan = sobol(ARM, 4)
    with ArmClient(ARM) as client:
        client.ready()
        for q in plan.q:
            start = client.joints
            client.send(q[None])
            _, looks = client.look(q[None], QUICK, start)
            np.testing.assert_allclose(looks, [stage.true] * len(looks), atol=1e-6)
    run(tmp_path / "bag", plan)
    session = read_session(tmp_path / "bag", ARM)
    assert session.has_position.all()
    tips = declared_model(ARM).tip(session.q, session.context())
    np.testing.assert_allclose(session.xyz, tips, atol=1e-6)
