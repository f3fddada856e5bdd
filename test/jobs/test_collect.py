"""`longarm collect` and `longarm record`: what they leave, also when they are broken off.

The arm goes where it is sent at once (`quick_arm.py`); `test_demo.py` collects with real servos.
"""

import dataclasses
import os
import signal
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

import cobot
from bag_words import offers, put_words
from cli_shell import Shell
from forked import ForkedProgram
from nodes_bench import Bench, bench
from quick_arm import quick_arm

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.calibration.calibrate import declared_model
from longarm_comp.core.data.measurement import compute_tip_errors
from longarm_comp.core.data.plan import Plan, from_both_sides, sobol
from longarm_comp.core.errors import InputError
from longarm_comp.jobs.client import Pace
from longarm_comp.jobs.collect.run import visits_in_bag
from longarm_comp.jobs.collect.visits import Visit, list_visits, plan_checks
from longarm_comp.sessions.bag import bag_info
from longarm_comp.sessions.bag_segments import SegmentedBag
from longarm_comp.sessions.poses import write_poses
from longarm_comp.sessions.read import read_session

POSES = 8


# ------------------------------------------------------------------ visits


def sides_of(visit: Visit) -> tuple[int, ...]:
    """The side that each joint arrives from."""
    assert len(visit.path) == 2
    return tuple(np.sign(visit.path[1] - visit.path[0]).astype(int).tolist())


@pytest.mark.parametrize(("option", "value"), [("sightings", 0), ("dwell_s", -1), ("move_s", -1)])
def test_a_pace_without_rest_is_refused(option: str, value: int) -> None:
    """With a negative rest the arm would be measured while it moves."""
    with pytest.raises(InputError, match=f"--{option.partition('_')[0]}: {value}"):
        Pace(**{option: value})


def test_visits_are_the_plan_with_repeats_in_random_order(arm: Arm) -> None:
    plan = sobol(arm, 8, 3)
    made = list_visits(plan, arm, repeats=2, seed=4)
    assert [visit.index for visit in made] == list(range(8 + 2 * 2))
    again = list_visits(plan, arm, repeats=2, seed=4)
    assert all((a.path == b.path).all() for a, b in zip(made, again, strict=True))
    other = list_visits(plan, arm, repeats=2, seed=5)
    assert any((a.q != b.q).any() for a, b in zip(made, other, strict=True))
    for q, sides in zip(plan.q, plan.approach, strict=True):
        mine = [visit for visit in made if (visit.q == q).all()]
        assert len(mine) in (1, 3)
        assert len({visit.repeat_id for visit in mine}) == 1
        assert (mine[0].repeat_id >= 0) == (len(mine) == 3)
        assert {sides_of(visit) for visit in mine} == {tuple(sides.tolist())}
    in_order = list_visits(plan, arm, shuffle=False)
    np.testing.assert_array_equal([visit.q for visit in in_order], plan.q)


def test_both_sides_measure_every_pose_twice(arm: Arm) -> None:
    plan = dataclasses.replace(sobol(arm, 6, 3), payload_kg=np.arange(6.0))
    made = list_visits(from_both_sides(arm, plan, 1), arm, seed=2)
    assert len(made) == 12
    for q, sides, payload in zip(plan.q, plan.approach, np.arange(6.0), strict=True):
        first, second = (visit for visit in made if (visit.q == q).all())
        assert first.repeat_id == second.repeat_id >= 0
        assert first.payload_kg == second.payload_kg == payload
        room = np.minimum(q - arm.lower, arm.upper - q) > run_up_lengths(arm)
        one, two = np.array(sides_of(first)), np.array(sides_of(second))
        assert (one[room] == -two[room]).all()
        assert (one[~room] == two[~room]).all()
        assert tuple(sides.tolist()) in (sides_of(first), sides_of(second))
    blank = Plan(plan.q, np.zeros(6))
    drawn = np.array(
        [sides_of(visit) for visit in list_visits(from_both_sides(arm, blank, 1), arm)]
    )
    assert (drawn != drawn[:, :1]).any()


def test_visits_with_one_payload_follow_one_another(arm: Arm) -> None:
    plan = dataclasses.replace(sobol(arm, 16, 3), payload_kg=np.tile([2.0, 0.0], 8))
    made = list_visits(plan, arm, repeats=2, seed=4)
    loads = [visit.payload_kg for visit in made]
    assert loads == sorted(loads) and set(loads) == {0.0, 2.0}
    by_pose = {visit.q.tobytes(): visit.payload_kg for visit in made}
    assert [by_pose[q.tobytes()] for q in plan.q] == plan.payload_kg.tolist()
    drawn = [visit.q.tobytes() for visit in made if visit.payload_kg == 2.0]
    in_order = list_visits(plan, arm, shuffle=False)
    np.testing.assert_array_equal([v.q for v in in_order], np.vstack([plan.q[1::2], plan.q[::2]]))
    assert list(dict.fromkeys(drawn)) != [v.q.tobytes() for v in in_order[8:]]


def test_a_run_up_stays_in_the_box_and_comes_from_the_planned_side(arm: Arm) -> None:
    length = run_up_lengths(arm)
    plan = Plan(np.stack([arm.lower, arm.mid, arm.upper]), np.array([1, -1, 1]))
    low, middle, high = list_visits(plan, arm, shuffle=False)
    np.testing.assert_allclose(middle.path[0] - middle.q, length)
    np.testing.assert_allclose(high.path[0] - high.q, -length)
    np.testing.assert_allclose(low.path[0] - low.q, length)  # no room below
    straight = list_visits(Plan(plan.q, np.zeros(3)), arm)
    assert all(len(visit.path) == 1 for visit in straight)


def test_the_run_up_of_an_endless_joint_is_inside_its_limits() -> None:
    arm = cobot.arm(180.0, {1: {"endless": True, "limits_deg": None}})
    q = arm.mid.copy()
    q[0] = np.pi
    visits = list_visits(Plan(q[None], np.array([-1])), arm)
    assert visits[0].path[0, 0] > np.pi
    (limits,) = plan_checks(arm, visits)
    assert limits.faults == ("",)
    beyond = arm.upper + 0.1
    (limits,) = plan_checks(arm, [dataclasses.replace(visits[0], path=beyond[None])])
    assert limits.faults[0].startswith("joint2 outside")


def test_a_joint_without_a_side_stands_still_in_the_run_up(arm: Arm) -> None:
    sides = np.ones((1, arm.n))
    sides[0, 2] = 0
    (visit,) = list_visits(Plan(arm.mid[None], sides), arm)
    assert sides_of(visit) == (1, 1, 0, 1, 1, 1, 1)


def test_more_repeats_than_poses_are_refused(arm: Arm) -> None:
    with pytest.raises(InputError, match="--repeats"):
        list_visits(sobol(arm, 3), arm, repeats=4)


# ------------------------------------------------------------------ bags of others


def test_a_bag_that_collect_did_not_begin_is_not_resumed(tmp_path: Path) -> None:
    with SegmentedBag(tmp_path / "bag") as bag:
        put_words(bag, "/session_row", '{"number": 3}')
    with pytest.raises(InputError, match=r"/session_row: .*index.*longarm collect"):
        visits_in_bag(tmp_path / "bag", [], 7)
    with SegmentedBag(tmp_path / "recorded") as bag:
        put_words(bag, "/payload", "2")
    with pytest.raises(InputError, match=r"session_row: 'none'.*longarm collect"):
        visits_in_bag(tmp_path / "recorded", [], 7)
    with SegmentedBag(tmp_path / "empty"):  # killed before its first visit
        pass
    assert visits_in_bag(tmp_path / "empty", [], 7) == set()


# ------------------------------------------------------------------ on the graph


class Longarm(ForkedProgram):
    """The program `longarm`."""

    def __init__(self, *words: object) -> None:
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115
        asked = ["longarm_comp.__main__", *map(str, words)]
        super().__init__(asked, os.getcwd(), dict(os.environ), self._said)

    def says(self) -> str:
        """What it said, at its end."""
        self.wait(timeout=300)
        with self._said:
            self._said.seek(0)
            return self._said.read()


def begun(bag: Path) -> bool:
    """Whether the bag is there, with a segment at hand."""
    return (bag / "metadata.yaml").exists() and (bag / ".recording").exists()


def wait_for_a_visit(bag: Path, process: Longarm, but: int | None = None) -> int:
    """Until a visit is in the segment at hand: its folder, opened; it is not the folder ``but``.

    A folder that is open keeps its inode, so that no later one gets the same.
    """
    segment, end = bag / ".recording", time.monotonic() + 300.0
    while not (begun(bag) and (but is None or not os.path.samestat(os.fstat(but), segment.stat()))):
        assert process.poll() is None, process.says()
        assert time.monotonic() < end, f"nothing in {segment}"
        time.sleep(0.02)
    return os.open(segment, os.O_RDONLY)


def test_a_session_survives_interruptions_and_is_resumed(
    ros_domain: int, arm: Arm, demo_arm_path: Path, tmp_path: Path, shell: Shell
) -> None:
    plan = sobol(arm, POSES, 2)
    write_poses(plan, tmp_path / "poses.csv")
    bag = tmp_path / "bag"
    words = ("collect", demo_arm_path, tmp_path / "poses.csv", "-o", bag, "--sightings", 2)
    words += ("--dwell", 0.1, "--move", 0.05, "--seed", 3, "--resume")
    with quick_arm(arm, lambda q: True):
        first = Longarm(*words)
        killed = wait_for_a_visit(bag, first)
        os.kill(first.pid, signal.SIGKILL)
        first.says()
        assert bag_info(bag)["messages"] == 0

        second = Longarm(*words)
        os.close(wait_for_a_visit(bag, second, killed))
        os.close(killed)
        second.send_signal(signal.SIGINT)
        said = second.says()
        assert "Traceback" not in said
        half = read_session(bag, arm)
        assert 1 <= len(half) <= POSES

        for changed in ((*words[:-2], 4, "--resume"), (*words, "--sides", "random")):
            # another order; the same poses from other sides
            assert "seed" in shell.refused(*changed)

        third = Longarm(*words)
        said = third.says()
        assert third.returncode == 0, said
    session = read_session(bag, arm)
    todo: list[Visit] = list_visits(plan, arm, seed=3)
    assert session.index.tolist() == list(range(POSES))
    np.testing.assert_allclose(session.q, [visit.q for visit in todo], atol=1e-9)
    sides = np.array([sides_of(visit) for visit in todo])
    np.testing.assert_array_equal(session.approach, sides)
    assert (sides != sides[:, :1]).any()  # each joint has its own
    assert session.sigma is not None
    assert np.abs(compute_tip_errors(declared_model(arm), session)).max() < 0.02
    assert "temperature_c" in session.columns


def spin_for(stage: Bench, seconds: float) -> None:
    end = time.monotonic() + seconds
    stage.spin(lambda: time.monotonic() > end)


def test_record_keeps_every_message_and_resumes(ros_domain: int, tmp_path: Path) -> None:
    from geometry_msgs.msg import PoseStamped
    from rclpy.duration import Duration

    from longarm_comp.nodes import interfaces as graph

    bag, sent = tmp_path / "bag", 0
    target = PoseStamped()
    target.header.frame_id = "base"
    with bench() as stage:
        commands = graph.JOINT_TRAJECTORY.publisher(stage.node)
        targets = graph.TARGET_POSE.publisher(stage.node)
        for _ in range(2):
            process = Longarm("record", "-o", bag, "--segment", 0.5, "--resume")
            stage.connected(commands)
            stage.connected(targets)
            spin_for(stage, 0.5)
            for _ in range(400):  # a topic that is reliable: best effort promises nothing
                targets.publish(target)
            sent += 400
            assert targets.wait_for_all_acked(Duration(seconds=60))
            process.send_signal(signal.SIGINT)
            said = process.says()
            assert process.returncode == 0, said
            stage.spin(lambda: commands.get_subscription_count() == 0)
    assert {t["topic"]: t["count"] for t in bag_info(bag)["topics"]} == {"/target_pose": sent}


def test_what_still_holds_is_not_dropped_between_visits(ros_domain: int, tmp_path: Path) -> None:
    from rclpy.node import Node
    from sensor_msgs.msg import Temperature

    from longarm_comp.jobs.recorder import Recorder
    from longarm_comp.nodes import interfaces as graph

    with bench() as stage, SegmentedBag(tmp_path / "bag") as bag:
        recorder = Recorder(stage.node, bag)
        assert recorder.waits_for() == []
        other = Node("sensor", context=stage.context)
        sensor = graph.TEMPERATURE.publisher(other)
        stage.spin(lambda: recorder.waits_for() == ["/temperature"])
        stage.connected(sensor)
        for celsius in (20.0, 21.0):
            sensor.publish(Temperature(temperature=celsius))
        stage.spin(lambda: len(recorder.waiting) == 2)
        assert recorder.waits_for() == []
        recorder.drop()  # a visit begins, and ends before the next temperature
        recorder.keep(since_ns=time.time_ns(), finish=True)
        assert recorder.counts == {"/temperature": 1}
        other.destroy_node()
    assert offers(tmp_path / "bag") == {"/temperature": (5, "reliable", "volatile")}
