"""Boxes that the arm must keep out of: what crosses them, on the way too, and who refuses it."""

from pathlib import Path

import numpy as np
import pytest
from follower_rig import CONFIG, Rig

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.parts import Box
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model import link_frames
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import (
    boxes_entered,
    describe_entry,
    find_entry,
    keeper,
    most_motion,
    outline,
)
from longarm_comp.core.model.model import Model
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.devices.joint_path import JointTrajectory, TrajectoryPoint

UNIT = Box(min_m=(0.0, 0.0, 0.0), max_m=(1.0, 1.0, 1.0))


def test_a_box_is_crossed_by_what_has_a_point_in_it(rng: np.random.Generator) -> None:
    """Against many points of each segment."""
    ends = rng.uniform(-1.0, 2.0, (400, 2, 3))
    ends[:60, 1, 0] = ends[:60, 0, 0]  # along a plane of the box
    ends[60:80, 1] = ends[60:80, 0]  # a point
    found = UNIT.clearance(ends)[:, 0] == 0.0
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
    assert (UNIT.clearance(line) == 0.0).tolist() == [False, True, False]


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


ROWS = (
    {"id": 1, "name": "turn", "type": "revolute", "d_m": 0.3, "limits_deg": [-100, 100]},
    {"id": 2, "name": "lift", "type": "revolute", "alpha_deg": 90, "limits_deg": [-180, 180]},
)
SWINGING = {
    "name": "swing",
    "convention": "mdh_craig",
    "tip": {"frame": 2, "position_m": [1.5, 0, 0]},
    "joints": ROWS,
}


def swinging(**boxes: tuple[tuple[float, ...], tuple[float, ...]]) -> Model:
    """An arm of 1.5 m that turns at a height of 0.3 m, among boxes of least and largest corner."""
    keep_out = {name: {"min_m": low, "max_m": high} for name, (low, high) in boxes.items()}
    return declared_model(Arm.parse(SWINGING | {"keep_out": keep_out}, "arm.yaml"))


SWING = np.array([[-1.5, 0.0], [1.5, 0.0]])


@pytest.mark.parametrize("thick", [0.2, 0.002])
def test_no_box_on_the_way_is_swept_through(thick: float) -> None:
    """A box at any place beside the reach of the tip, looked at by many postures."""
    way = SWING[0] + np.linspace(0.0, 1.0, 9000)[:, None] * np.diff(SWING, axis=0)
    for y in np.arange(-1.2, 1.2, 0.1):
        model = swinging(lamp=((1.2, y, 0.0), (1.6, y + thick, 0.5)))
        swept = any(boxes_entered(model, way))
        assert bool(describe_entry(model, SWING)) is swept, y
        keeps_out = keeper(model, ["lift", "turn"], "arm.yaml")
        assert keeps_out is not None
        assert bool(keeps_out(SWING[:, ::-1])) is swept, y


def test_a_way_close_by_a_box_is_free() -> None:
    for gap in (0.1, 0.01, 0.002):
        over = swinging(table=((-2.0, -2.0, -1.0), (2.0, 2.0, 0.3 - gap)))
        assert not describe_entry(over, np.array([[-1.5, 0.2], [1.5, 0.0], [-1.5, 0.0]]))
        beside = swinging(lamp=((1.5 + gap, -2.0, 0.0), (2.0, 2.0, 0.5)))
        assert not describe_entry(beside, SWING)


def test_a_short_dip_below_a_floor_above_the_foot_is_found() -> None:
    """The only part of the arm begins below the floor, and may; the tip may not."""
    model = swinging(floor=((-9.0, -9.0, -9.0), (9.0, 9.0, 0.5)))
    way = np.array([(0.8 * (-1) ** k, 0.3) for k in range(80)])
    assert not describe_entry(model, way)
    dipped = np.insert(way, 41, [(0.0, 0.3), (0.0, 0.13), (0.0, 0.3)], axis=0)
    row, found = find_entry(model, dipped)
    assert "floor" in found and row in (42, 43)


def test_a_short_way_out_of_the_box_of_the_foot_is_found(looks: list[int]) -> None:
    """The shoulder rises out of a box and the arm crosses its edge; in the box both may be."""
    rows = (
        {"id": 1, "name": "lift", "type": "prismatic", "limits_m": [0.0, 1.0]},
        {"id": 2, "name": "turn", "type": "revolute", "limits_deg": [-100, 100]},
    )
    data = SWINGING | {"joints": rows, "tip": {"frame": 2, "position_m": [1.5, 0, -0.9]}}
    data |= {"keep_out": {"plinth": {"min_m": [-0.2, -0.2, -0.1], "max_m": [0.2, 0.2, 0.5]}}}
    model = declared_model(Arm.parse(data, "arm.yaml"))
    way = np.array([(0.4, 1.5 * (-1) ** k) for k in range(40)])
    assert not describe_entry(model, way[:1])
    looks.clear()
    assert not describe_entry(model, way[:2])
    assert sum(looks) == 65  # none beside the box that the arm is in
    for k in range(10, 30):
        risen = np.insert(way, k, [(0.56, way[k - 1, 1]), way[k - 1]], axis=0)
        row, found = find_entry(model, risen)
        assert "plinth" in found and row in (k, k + 1)


def test_an_arm_that_stands_in_a_box_is_not_moved() -> None:
    row, found = find_entry(
        swinging(lamp=((1.4, -0.01, 0.2), (1.6, 0.01, 0.4))), np.array([(0.0, 0.0), (0.0, 1.5)])
    )
    assert row == 0 and found.endswith("at joints 0, 0")


def test_the_arm_is_a_line_whatever_its_markers_are_on() -> None:
    marked = SWINGING | {"markers": {"column": {"frame": 1}, "hand": {"frame": 2}}}
    model, plain = declared_model(Arm.parse(marked, "arm.yaml")), swinging()
    np.testing.assert_array_equal(outline(model, SWING), outline(plain, SWING))
    assert np.linalg.norm(np.diff(outline(plain, SWING[0]), axis=0), axis=1).sum() == 1.8


def test_random_ways_among_random_boxes_are_judged_as_by_many_looks(
    demo_arm_path: Path, rng: np.random.Generator
) -> None:
    """A sagging arm of seven joints; what goes into a box by 3 mm is found, what does not, not."""
    plain = declared_model(Arm.load(demo_arm_path))
    lower, upper = plain.arm.lower, plain.arm.upper
    seen = [0, 0]
    for _ in range(16):
        start, end = rng.uniform(lower, upper, (2, len(lower)))
        way = start + np.linspace(0.0, 1.0, 1000)[:, None] * (end - start)
        centre = outline(plain, rng.uniform(lower, upper))[rng.integers(10, 32)]
        model = declared_model(boxed(demo_arm_path, centre, half=0.08))
        box, lines = model.arm.keep_out["lamp"], outline(plain, way)
        core = Box(min_m=tuple(centre - 0.077), max_m=tuple(centre + 0.077))
        found = describe_entry(model, np.array([start, end]))
        assert found or not (core.clearance(lines) == 0.0).any()
        assert not found or (box.clearance(lines) == 0.0).any()
        seen[bool(found)] += 1
    assert min(seen) > 3


def test_no_part_moves_by_more_than_is_reckoned_with(
    demo_arm_path: Path, rng: np.random.Generator
) -> None:
    """Rows that turn, slide and follow others, with sag, and with much of it."""
    soft = dict(read_yaml(demo_arm_path))
    soft["links"] = [beam | {"E_pa": 0.05 * beam["E_pa"]} for beam in soft["links"]]
    follows = {"id": 3, "type": "revolute", "a_m": 1.0, "mimic": {"joint": 2, "multiplier": -2.0}}
    data = SWINGING | {"joints": [*ROWS, follows], "tip": {"frame": 3, "position_m": [1, 0, 0]}}
    arms = (Arm.load(demo_arm_path), Arm.parse(soft, "soft"), Arm.parse(data, "arm.yaml"))
    for arm, tight in zip(arms, (0.9, 0.7, 0.7), strict=True):
        model = declared_model(arm)
        lower, upper = model.arm.lower, model.arm.upper
        a, b = rng.uniform(lower, upper, (2, 4000, len(lower)))
        b = np.where(rng.random(a.shape) < 0.2, a + 0.2 * (b - a), a)
        moved = np.linalg.norm(outline(model, b) - outline(model, a), axis=-1)
        most = np.abs(b - a) @ most_motion(model).T
        assert (np.diff(most_motion(model), axis=0) >= 0.0).all()  # as a part's beginning moves
        assert (moved[:, 1:] <= most[:, :-1] + 1e-9).all()
        assert (moved[:, -1] > tight * most[:, -1])[most[:, -1] > 0.05].any()


def test_the_distance_from_a_box_is_never_overrated(rng: np.random.Generator) -> None:
    box = Box(min_m=(0.0, 0.0, 0.0), max_m=(1.0, 0.4, 2.0))
    ends = rng.uniform(-2.0, 3.0, (3000, 2, 3))
    ends[:100, 1, 0] = ends[:100, 0, 0]
    ends[100:200, 1] = ends[100:200, 0]
    share = np.linspace(0.0, 1.0, 400)[:, None, None]
    points = ends[:, 0] + share * (ends[:, 1] - ends[:, 0])
    real = np.linalg.norm(points - np.clip(points, 0.0, box.max_m), axis=-1).min(axis=0)
    told = box.clearance(ends)[:, 0]
    assert (told <= real + 1e-9).all()
    assert (told >= real / np.sqrt(3.0) - 0.01).all()
    inside = rng.uniform(0.0, box.max_m, (100, 3))
    walls = np.concatenate([inside, np.array(box.max_m) - inside], axis=1).min(axis=1)
    np.testing.assert_allclose(box.depth(inside), walls)


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of postures that were looked at together."""
    made: list[int] = []

    def count(model: Model, q: np.ndarray) -> np.ndarray:
        made.append(int(np.size(q) // model.arm.n))
        return outline(model, q)

    monkeypatch.setattr(link_frames, "outline", count)
    return made


def test_looks_depend_on_the_way_and_not_on_its_points(looks: list[int]) -> None:
    model = swinging(lamp=((1.4, 1.0, 0.0), (2.0, 2.0, 0.5)))
    needed = []
    assert not describe_entry(model, np.zeros((1, 2)))
    for count in (2, 20_000):
        share = np.linspace(0.0, 1.0, count)[:, None]
        looks.clear()
        assert not describe_entry(model, [-1.5, 0.0] + share * [1.7, 0.0])
        needed.append(sum(looks))
    assert needed[0] == needed[1] < 100


def count_looks(model: Model, looks: list[int]) -> int:
    assert not describe_entry(model, SWING[:1])
    looks.clear()
    assert not describe_entry(model, SWING)
    return sum(looks)


def test_a_thin_box_asks_for_closer_looks_beside_itself_alone(looks: list[int]) -> None:
    boxes = {"table": ((-2.0, -2.0, -1.0), (2.0, 2.0, 0.297))}
    needed = []
    for more in ({}, {"film": ((3.0, 3.0, 3.0), (3.1, 3.1, 3.00001))}):
        needed.append(count_looks(swinging(**boxes, **more), looks))
    assert needed[0] == needed[1] < 2000


def test_a_servos_steps_ask_for_no_closer_looks(looks: list[int]) -> None:
    needed = []
    for step in ({}, {"step_deg": 0.5}):
        data = SWINGING | {"joints": (ROWS[0] | step, ROWS[1])}
        data |= {"keep_out": {"table": {"min_m": [-2, -2, -1], "max_m": [2, 2, 0.25]}}}
        needed.append(count_looks(declared_model(Arm.parse(data, "arm.yaml")), looks))
    assert needed[0] == needed[1]


def test_beside_a_film_the_check_ends_and_needs_little_memory(looks: list[int]) -> None:
    model = swinging(film=((0.5, -2.0, 0.3 - 2e-12), (2.0, 2.0, 0.3 - 1e-12)))
    assert not describe_entry(model, SWING[:1])
    looks.clear()
    assert "thicker box" in find_entry(model, SWING, 10_000)[1]
    assert 5_000 < sum(looks) <= 10_000 and max(looks) <= 4096


def test_a_driver_gives_up_on_a_way_that_takes_too_long_to_check(looks: list[int]) -> None:
    model = swinging(table=((-2.0, -2.0, -1.0), (2.0, 2.0, 0.295)))
    way = np.array([(0.8 * (-1) ** k, 0.0) for k in range(10)])
    assert not describe_entry(model, way)
    keeps_out = keeper(model, ["turn", "lift"], "arm.yaml")
    assert keeps_out is not None and not keeps_out(way[:2])
    looks.clear()
    assert "too long to check" in keeps_out(way)
    assert sum(looks) <= 800


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
    np.testing.assert_allclose(asked[-1][16], gone[9], atol=0.005)  # where the blend ends
    far = np.abs(asked[-1][:, None] - gone[None]).max(axis=2)
    assert far.min(axis=1).max() < 0.01
    rig.follower.accept(JointTrajectory((), ()), rig.now)
    assert len(asked) == 2  # a stop is never refused
