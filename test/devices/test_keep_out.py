"""Boxes that the arm must keep out of: what crosses them, on the way too, and who refuses it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from follower_rig import CONFIG, Rig

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.parts import Box
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import describe_entry, keeper, outline
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.devices.joint_path import JointTrajectory, TrajectoryPoint

UNIT = Box(min_m=(0.0, 0.0, 0.0), max_m=(1.0, 1.0, 1.0))


def test_a_box_is_crossed_by_what_has_a_point_in_it(rng: np.random.Generator) -> None:
    """Against many points of each segment."""
    ends = rng.uniform(-1.0, 2.0, (400, 2, 3))
    ends[:60, 1, 0] = ends[:60, 0, 0]  # along a plane of the box
    ends[60:80, 1] = ends[60:80, 0]  # a point
    found = np.array([UNIT.crosses_segments(pair)[0] for pair in ends])
    share = np.linspace(0.0, 1.0, 2001)[:, None]
    inside = [
        bool((((a + share * (b - a)) >= 0.0) & ((a + share * (b - a)) <= 1.0)).all(axis=1).any())
        for a, b in ends
    ]
    assert (found != inside).mean() < 0.01  # a corner cut between two of the points
    assert all(found[inside])
    assert 50 < sum(inside) < 350


def test_every_part_of_a_polyline_is_looked_at() -> None:
    line = np.array([[-1.0, 0.5, 0.5], [-0.5, 0.5, 0.5], [2.0, 0.5, 0.5], [3.0, 0.5, 0.5]])
    assert UNIT.crosses_segments(line).tolist() == [False, True, False]


def boxed(path: Path, centre: np.ndarray, half: float = 0.02) -> Arm:
    data = dict(read_yaml(path))
    low, high = (centre - half).tolist(), (centre + half).tolist()
    data["keep_out"] = {"lamp": {"min_m": low, "max_m": high}}
    return Arm.parse(data, "arm.yaml")


def test_a_move_through_a_box_is_found_on_its_way(demo_arm_path: Path) -> None:
    plain = Arm.load(demo_arm_path)
    start, end = plain.mid.copy(), plain.mid.copy()
    start[0], end[0] = plain.lower[0], plain.upper[0]
    tip = outline(declared_model(plain), plain.mid)[-1]
    model = declared_model(boxed(demo_arm_path, tip))
    assert "lamp" in describe_entry(model, np.array([start, end]))
    assert "lamp" in describe_entry(model, np.array([start, plain.mid]))
    assert "lamp" in describe_entry(model, np.array([start, start, end]))
    assert not describe_entry(model, np.array([end, end]))
    assert not describe_entry(declared_model(plain), np.array([start, end]))


def test_joints_in_the_order_of_the_servos_are_kept_out_too(demo_arm_path: Path) -> None:
    plain = declared_model(Arm.load(demo_arm_path))
    mid, names = plain.arm.mid, [*plain.arm.joint_names, "gripper"]
    assert keeper(plain, names, "arm.yaml") is None
    model = declared_model(boxed(demo_arm_path, outline(plain, mid)[-1]))
    away = mid.copy()
    away[0] = plain.arm.lower[0]
    for turn in (names, names[::-1]):
        keeps_out = keeper(model, turn, "arm.yaml")
        assert keeps_out is not None
        at, beside = (np.append(q, 9.9)[[names.index(name) for name in turn]] for q in (mid, away))
        assert "lamp" in keeps_out(np.array([beside, at]))
        assert not keeps_out(beside[None])
    with pytest.raises(InputError, match=f"servo of {names[1]}"):
        keeper(model, names[:1], "arm.yaml")


def test_a_box_is_declared_from_its_least_to_its_largest_corner(demo_arm_path: Path) -> None:
    with pytest.raises(InputError, match="max_m"):
        boxed(demo_arm_path, np.zeros(3), half=-0.1)


def test_the_follower_takes_no_way_that_it_must_keep_out_of() -> None:
    asked: list[np.ndarray] = []

    def keeps_out(path: np.ndarray) -> str:
        asked.append(path)
        return "lamp" if path[-1, 0] > 0.5 else ""

    rig = Rig(CONFIG, keeps_out)
    with pytest.raises(JobError, match="lamp"):
        rig.send((1.0, {"turn": 0.6}))
    np.testing.assert_allclose(asked[0][-1], [0.6, 0.03], atol=1e-3)
    assert (np.diff(asked[0][:, 0]) >= 0.0).all() and asked[0][0, 0] == pytest.approx(0.2, abs=0.01)
    assert all(step.goals is None for step in rig.run(0.2))
    rig.send((1.0, {"turn": 0.4}))
    assert rig.run(0.2)[-1].goals is not None


def test_the_way_that_is_judged_is_the_way_that_is_gone() -> None:
    """From the middle of a motion and with given velocities: neither is straight."""
    asked: list[np.ndarray] = []
    rig = Rig(CONFIG, lambda way: asked.append(way) or "")
    rig.send((1.5, {"turn": 0.7}))
    rig.run(0.7)
    before = len(rig.trace)
    here = rig.trace[-1]["turn"]
    names = ("turn", "slide")
    points = (
        TrajectoryPoint(6.0, (here, 0.05), (-0.1, 0.0)),
        TrajectoryPoint(9.0, (here, 0.03), (0.0, 0.0)),
    )
    rig.follower.accept(JointTrajectory(names, points), rig.now)
    rig.run(10.0)
    gone = np.array([[row[name] for name in names] for row in rig.trace[before:]])
    assert gone[:25, 0].max() > here + 0.02  # it was under way
    assert np.ptp(gone[25:, 0]) > 0.1  # although every way-point has the same angle
    for part, near in ((gone[:10], 0.005), (gone[25:], 0.02)):  # blended; then sampled coarser
        far = np.abs(part[:, None] - asked[-1][None]).max(axis=2)
        assert far.min(axis=1).max() < near
    np.testing.assert_allclose(asked[-1][15], gone[9], atol=0.005)  # where the blend ends
    far = np.abs(asked[-1][:, None] - gone[None]).max(axis=2)
    assert far.min(axis=1).max() < 0.01
    rig.follower.accept(JointTrajectory((), ()), rig.now)
    assert len(asked) == 2  # a stop is never refused
