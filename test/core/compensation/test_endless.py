"""Joints that turn on and on: no limit of theirs ends a path, a search or a reading."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from cobot import TIMES, arm, follow, wrapped
from urdf_robots import CHAIN

from longarm_comp.arm_folder.make import narrow_limits
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.arm.moves import plan_move, run_up_lengths, wanted_sides
from longarm_comp.core.arm.parts import Box
from longarm_comp.core.compensation.arrive import compensate_move
from longarm_comp.core.compensation.online import JointTrust, check_inside
from longarm_comp.core.compensation.result import CompensationOptions, Method
from longarm_comp.core.data.admission import admit
from longarm_comp.core.data.plan import Plan, from_both_sides, outside_boxes, with_room
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik.solver import Engine, solve, solve_many, warm_up
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.urdf import import_urdf
from longarm_comp.urdf_export import export_urdf
from longarm_comp.urdf_file import UrdfRobot

ENDLESS = {"endless": True, "limits_deg": None}
BENT = np.array([0.0, -1.3, 1.4, -1.7, -1.5, 0.2])


def turning(**more: object) -> Arm:
    """A cobot whose first and last joint turn on and on."""
    return arm(180.0, {1: ENDLESS | more, 6: ENDLESS})


def at(first: float, last: float = 0.2) -> np.ndarray:
    return np.array([first, *BENT[1:5], last])


def test_where_poses_are_planned_is_no_limit() -> None:
    made = turning()
    np.testing.assert_allclose(made.upper, np.pi)
    assert np.isinf(made.bounds[1]).tolist() == [True, False, False, False, False, True]
    own = arm(180.0, {1: {"endless": True, "limits_deg": [-90, 90]}})
    assert own.upper[0] == pytest.approx(np.pi / 2) and own.bounds[0][0] == -np.inf
    for wrong in (
        {2: {"endless": True, "type": "prismatic", "limits_deg": None, "limits_m": [0, 1]}},
        {2: {"endless": True, "mimic": {"joint": "joint1"}, "limits_deg": None}},
        {1: ENDLESS | {"moves": False},
         2: {"mimic": {"joint": "joint1", "multiplier": 0.5}, "limits_deg": None}},
    ):  # fmt: skip
        with pytest.raises(InputError, match="endless"):
            arm(180.0, wrong)


def test_a_run_up_goes_past_the_end_of_the_poses_that_are_planned() -> None:
    made = turning()
    q = np.stack([at(np.pi), at(-np.pi)])
    for side in (1, -1):
        sides = np.full(q.shape, side)
        assert (with_room(made, q, sides)[:, 0] == side).all()
    plan = Plan(q, np.array([-1, 1]))
    first, second = from_both_sides(made, plan).approach.reshape(2, 2, -1)[0]
    assert (first[[0, 5]] == -second[[0, 5]]).all()  # each pose is measured from either side
    begun = Model(made).tip(q + run_up_lengths(made))
    box = Box(min_m=tuple(begun[0] - 0.02), max_m=tuple(begun[0] + 0.02))
    kept_out = Model(made.model_copy(update={"keep_out": {"shelf": box}}))
    assert outside_boxes(kept_out, plan).tolist() == [False, True]


def test_rows_turns_away_are_admitted_and_degrees_are_not() -> None:
    made = turning()
    q = np.random.default_rng(1).uniform(-0.9, 0.9, (30, 6)) * made.upper
    tip = declared_model(made).tip(q)
    turned, degrees, elbow = q.copy(), q.copy(), q.copy()
    turned[5, 0] += 4.0 * np.pi
    turned[6, 5] -= 2.0 * np.pi
    admitted = admit(Session.record(turned, tip), made)
    assert not [finding for finding in admitted.findings if finding.field == "limits"]
    np.testing.assert_array_equal(admitted.session.q, turned)
    degrees[:, 0] = np.degrees(q[:, 0])
    elbow[7, 1] += 4.0 * np.pi
    for wrong, words in ((degrees, "q1.*looks like degrees"), (elbow, "row 8, q2")):
        with pytest.raises(InputError, match=words):
            admit(Session.record(wrong, tip), made)


def test_a_path_goes_on_for_turns() -> None:
    model = declared_model(turning())
    goes = at(0.0) + np.outer(TIMES, [10.0, 0, 0, 0, 0, -8.0])
    found = follow(model, wrapped(goes), goes[0])
    np.testing.assert_allclose(found.timed.joints, goes, atol=1e-7)
    np.testing.assert_allclose(found.timed.times, TIMES)
    sways = at(0.0) + np.outer(np.sin(5.0 * TIMES), [0.8, 0, 0, 0, 0, 0])
    near, far = (follow(model, q, q[0]).timed for q in (sways, sways + at(12.0) - at(0.0)))
    np.testing.assert_allclose(far.velocities, near.velocities, atol=1e-7)


@pytest.mark.parametrize("engine", list(Engine))
def test_a_search_stays_beside_where_it_begins(engine: Engine) -> None:
    model = declared_model(turning())
    if engine is Engine.COMPILED:
        warm_up(model)
    for first in (3.1, 7.0, -12.0, 0.4):
        here = at(first, first)
        target = model.pose(here + 0.1)
        for seed in (here, here - 0.05):
            found = solve(model, target, seed=seed, engine=engine)
            np.testing.assert_allclose(found.q, here + 0.1, atol=1e-7)
        many = solve_many(model, target[None], seed=here[None], engine=engine)
        np.testing.assert_allclose(many.q[0], here + 0.1, atol=1e-7)


@pytest.mark.parametrize("step_deg", [None, 0.05])
def test_a_move_over_the_seam_is_short(step_deg: float | None) -> None:
    steps = {} if step_deg is None else {"step_deg": step_deg}
    model = declared_model(turning(**steps))
    start = at(3.1, 20.0)
    arrival = compensate_move(
        model, None, model.pose(start + 0.1), start=start, history=History.unknown(6),
        context_after=lambda history: Context(), options=CompensationOptions(Method.DEFLECTION),
    )  # fmt: skip
    np.testing.assert_allclose(arrival.outcome.command, start + 0.1, atol=2e-3)
    assert arrival.move.run_up is None


def test_a_run_up_has_room_beyond_the_seam() -> None:
    made, plain = turning(), arm(180.0)
    for seam in (np.pi, -np.pi):
        side = -np.sign(seam) * np.array([1.0, 0, 0, 0, 0, 0])
        move = plan_move(made, None, at(seam), side)
        assert move.run_up is not None and abs(move.run_up[0]) > np.pi and not move.doubtful[0]
        assert plan_move(plain, None, at(seam), side).doubtful[0]
        known = np.array([[3.0, 1.0], [1.0, 3.0]])[[int(seam < 0)] * 6]
        sides = partial(wanted_sides, start=None, q=at(seam), known=known * 2, sure=side)
        assert sides(made)[0] == side[0] != sides(plain)[0]


def test_readings_may_wind_up_or_begin_again() -> None:
    made = turning()
    check_inside(at(50.0), made, "joint_states")
    with pytest.raises(InputError, match="joint2"):
        check_inside(np.where(np.arange(6) == 1, 4.0, at(50.0)), made, "joint_states")
    trust = JointTrust(made, rate=1.0)
    for k in range(400):  # an encoder of one turn
        assert trust.read(wrapped(at(0.05 * k)), 0.02 * k), trust.doubt
    assert not trust.read(wrapped(at(2.0 + 0.05 * 400)), 8.0)
    assert "joint1 jumped" in trust.doubt


def test_a_urdf_keeps_it_and_only_a_range_takes_it_away(tmp_path: Path) -> None:
    path = tmp_path / "lift.urdf"
    path.write_text(CHAIN.replace('"revolute"', '"continuous"'))
    data = import_urdf(path, "base", "c")
    made = Arm.parse(data, "lift")
    turns = {row["name"] for row in data["joints"] if row.get("endless")}
    assert turns and np.isinf(made.bounds[1]).sum() == len(turns)
    (tmp_path / "again.urdf").write_text(export_urdf(declared_model(made)))
    again = UrdfRobot(tmp_path / "again.urdf")
    assert {name for name, joint in again.joints.items() if joint.type == "continuous"} == turns
    geared = CHAIN.replace('name="ja" type="prismatic"', 'name="ja" type="continuous"')
    path.write_text(geared.replace('name="jb" type="prismatic"', 'name="jb" type="revolute"'))
    assert not any(row.get("endless") for row in import_urdf(path, "base", "c")["joints"])
    path.write_text(path.read_text().replace('multiplier="1.5"', 'multiplier="2"'))
    assert Arm.parse(import_urdf(path, "base", "c"), "lift").bounds[1][0] == np.inf
    less = Arm.parse(narrow_limits(data, 45.0, {})[0], "lift")
    assert np.isfinite(less.bounds[1]).all()
    assert np.ptp([less.lower, less.upper], axis=0).max() == pytest.approx(np.radians(45.0))
    same = Arm.parse(narrow_limits(data, 0.0, {})[0], "lift")
    np.testing.assert_array_equal(same.bounds, made.bounds)
