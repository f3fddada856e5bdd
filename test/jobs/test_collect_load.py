"""`longarm collect` of a plan with payloads: who says what the arm carries."""

import contextlib
import io
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from loaded_arm import arm_data

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from asked_terminal import at_terminal
from cli_shell import Shell
from nodes_bench import facts_of
from quick_arm import QUICK, QuickArm, quick_arm
from rclpy.node import Node
from std_msgs.msg import Float64

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.parts import Box
from longarm_comp.core.data.plan import outside_boxes, sobol
from longarm_comp.core.errors import JobError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.client import ArmClient
from longarm_comp.jobs.collect.run import Collected, collect
from longarm_comp.jobs.collect.visits import list_visits
from longarm_comp.jobs.loop import Loop, LoopSettings
from longarm_comp.jobs.loop_plan import plan_round
from longarm_comp.nodes import interfaces as graph
from longarm_comp.sessions.bag_segments import SegmentedBag
from longarm_comp.sessions.poses import write_poses
from longarm_comp.sessions.read import read_session

ARM = Arm.parse({**arm_data(), "payload": {"frame": 4, "mass_kg": 0.5}}, "loaded")
LOADS = np.tile([2.0, 0.0], 3)
PLAN = replace(sobol(ARM, len(LOADS), 1), payload_kg=LOADS)


@pytest.fixture
def stage(ros_domain: int) -> Iterator[QuickArm]:
    with quick_arm(ARM, lambda q: True) as arm:
        arm.told: list[float] = []  # type: ignore[attr-defined]
        graph.PAYLOAD.subscription(arm.node, lambda said: arm.told.append(said.data))  # type: ignore[attr-defined]
        yield arm


@contextlib.contextmanager
def scales(arm: QuickArm, kg: Callable[[], float]) -> Iterator[None]:
    """A node beside the arm that publishes what it weighs."""
    node = Node("scales", context=arm.context)
    weighed = graph.PAYLOAD.publisher(node)
    timer = arm.node.create_timer(0.05, lambda: weighed.publish(Float64(data=kg())))
    try:
        yield
    finally:
        arm.node.destroy_timer(timer)
        node.destroy_node()


def run(bag: Path, attach: Callable[[float, int], bool], **how: Any) -> Collected:
    with ArmClient(ARM, name="collect") as client:
        todo = list_visits(PLAN, ARM, seed=3)
        return collect(client, todo, bag, pace=QUICK, attach=attach, **how)


def loads_of(bag: Path) -> list[float]:
    """The recorded payload of each row, which must be what the plan asked for at its pose."""
    session = read_session(bag, ARM)
    wanted = [float(LOADS[np.abs(PLAN.q - q).sum(axis=1).argmin()]) for q in session.q]
    found = session.columns["payload_kg"].tolist()
    np.testing.assert_allclose(found, wanted, atol=0.021)
    return [round(kg, 6) for kg in found]


def test_each_payload_is_asked_for_once_and_published_only_after_the_answer(
    stage: QuickArm, tmp_path: Path
) -> None:
    asked: list[tuple[float, int, set[float], int]] = []

    def attach(kg: float, visits: int) -> bool:
        asked.append((kg, visits, set(stage.told), len(stage.visited)))
        return True

    assert run(tmp_path / "bag", attach).made == 6
    assert asked == [(0.0, 3, set(), 0), (2.0, 3, {0.0}, 3)]
    assert loads_of(tmp_path / "bag") == [0.0] * 3 + [2.0] * 3
    waited = [status for status in stage.heard if facts_of(status)["state"] == "waiting"]
    assert "3 poses need 2 kg" in waited[-1].message


def test_what_nobody_attaches_is_left_for_later(stage: QuickArm, tmp_path: Path) -> None:
    asked: list[float] = []
    bag = tmp_path / "bag"

    def attach(kg: float, visits: int) -> bool:
        asked.append(kg)
        return False

    done = run(bag, attach, payload_kg=0.0)
    assert (done.made, asked, set(stage.told)) == (3, [2.0], {0.0})
    assert done.blocked == dict.fromkeys(range(3, 6), "2 kg at the tool are missing")
    again = run(bag, attach, payload_kg=2.0, resume=True)
    assert (again.before, again.made, again.blocked, asked) == (3, 3, {}, [2.0])
    assert loads_of(bag) == [0.0] * 3 + [2.0] * 3


def test_who_publishes_a_payload_is_believed_and_not_contradicted(
    stage: QuickArm, tmp_path: Path
) -> None:
    there = 2.02  # a scale's reading of 2 kg

    def attach(kg: float, visits: int) -> bool:
        nonlocal there
        asked.append(kg)
        there = now.pop()
        return True

    with scales(stage, lambda: there):
        asked: list[float] = []
        now = [0.0]
        assert run(tmp_path / "bag", attach).made == 6
        assert asked == [0.0]  # it begins with what is there
        assert sorted(loads_of(tmp_path / "bag")) == [0.0] * 3 + [2.02] * 3
        assert set(stage.told) == {2.02, 0.0}
        now = [0.5]
        with pytest.raises(JobError, match=r"`payload` says 0\.5 kg, not 2 kg"):
            run(tmp_path / "other", attach)
        assert read_session(tmp_path / "other", ARM).columns["payload_kg"].tolist() == [0.0] * 3
        assert set(stage.told) == {2.02, 0.0, 0.5}


@pytest.fixture
def words(tmp_path: Path) -> list[object]:
    """The command over the plan, whose bag is `bag`."""
    arm, poses = tmp_path / "arm.yaml", tmp_path / "poses.csv"
    arm.write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_defaults=True)))
    write_poses(PLAN, poses)
    quick = ("--sightings", 1, "--dwell", 0.1, "--move", 0.05)
    return ["collect", arm, poses, "-o", tmp_path / "bag", *quick]


def test_on_a_terminal_it_asks(stage: QuickArm, words: list[object], tmp_path: Path) -> None:
    question = b"Does the arm carry it now? (y/N): "
    ended, answers, shown = at_terminal(["-m", "longarm_comp", *words], question, b"y")
    assert (ended, answers) == (0, 2), shown
    assert b"3 poses need 2 kg at the tool" in shown
    assert loads_of(tmp_path / "bag") == [0.0] * 3 + [2.0] * 3


def test_without_a_terminal_it_ends_and_says_how_to_go_on(
    stage: QuickArm, words: list[object], tmp_path: Path, shell: Shell,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    assert "0 kg at the tool" in shell.refused(*words, "--payload", 2, code=3)
    assert "3 of 6 poses were not driven" in shell.err and "--resume" in shell.err
    assert loads_of(tmp_path / "bag") == [2.0] * 3
    assert shell(*words, "--payload", 0, "--resume") == 0
    assert sorted(loads_of(tmp_path / "bag")) == [0.0] * 3 + [2.0] * 3


def test_a_round_takes_what_the_arm_can_do_as_it_is(
    stage: QuickArm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    masses = np.tile([0.0, 0.5], 10)
    wanted = replace(sobol(ARM, 20, 5), payload_kg=masses)
    side = float(np.quantile(declared_model(ARM).tip(wanted.q)[:, 1], 0.75))
    assert side > 0.01
    wall = Box(min_m=(-9.0, side, -9.0), max_m=(9.0, 9.0, 9.0))
    boxed = ARM.model_copy(update={"keep_out": {"wall": wall}})
    write_poses(wanted, tmp_path / "next.csv")
    before = outside_boxes(declared_model(boxed), wanted)
    assert 4 < before.sum() < 16
    with ArmClient(boxed, name="loop") as client:

        def check(kg: float) -> None:
            plan, left_out = plan_round(client, 30, 1, tmp_path / "next.csv")
            mine = before & (masses == kg)
            assert len(plan) == 30 and plan.payload_kg is None
            np.testing.assert_allclose(plan.q[: mine.sum()], wanted.q[mine])
            np.testing.assert_array_equal(plan.approach[: mine.sum()], wanted.approach[mine])
            assert outside_boxes(declared_model(boxed), plan).all()
            assert left_out == {
                "asked for in a keep-out box": (~before).sum(),
                "asked for with another payload": (before & (masses != kg)).sum(),
            }

        check(0.5)  # as arm.yaml declares
        with scales(stage, lambda: 0.0):
            client.until(lambda: client.node.count_publishers("payload") > 1, 180.0, "scales")
            check(0.0)
        assert plan_round(client, 30, 1, tmp_path / "none.csv")[1] == {}
        first, _ = plan_round(client, 30, 1, None)
        assert outside_boxes(declared_model(boxed), first).all() and len(first) == 30
        blocked = {k: f"wall: the arm would enter it near {k} m" for k in range(4)}
        done = Collected(50, 10, 70, {}, blocked)
        given: dict[str, bool] = {}

        def collected(client: ArmClient, todo: object, bag: Path, **how: Any) -> Collected:
            with SegmentedBag(bag, resume=how["resume"]):
                given.update(resume=how["resume"])
            return done

        monkeypatch.setattr("longarm_comp.jobs.loop.collect", collected)
        loop = Loop(client, LoopSettings(tmp_path / "loop"), lambda report: True)
        made = {"made": 60, "not_driven": {"no way there: wall": 4}}
        assert loop._collect_rows(1) == made and not given["resume"]
        shutil.rmtree(tmp_path / "loop" / "session")
        (tmp_path / "loop" / "session").mkdir()  # as a kill leaves it before the first message
        assert loop._collect_rows(1) == made
