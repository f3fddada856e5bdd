"""Every URDF of `example-robot-data`: read as pinocchio does, or refused for a stated reason."""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from cli_shell import Shell
from places import ROOT
from urdf_robots import compare, drawn, public_robots

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik.solver import Engine, solve_many
from longarm_comp.core.model.model import Model
from longarm_comp.urdf import read_chain
from longarm_comp.urdf_file import UrdfRobot

REFUSED = {
    "double_pendulum.urdf": "joint joint1 limit: '0 to 0'",
    "double_pendulum_simple.urdf": "joint joint1 limit: '0 to 0'",
    "iris.urdf": "joint iris__rotor_0_joint limit: '-1e+16 to 1e+16'",
    "iris_simple.urdf": "a link that moves against",
    "quadrotor_base.urdf": "a link that moves against",
    "quadruped.urdf": "joint FL_KFE limit: 'missing'",
    "ur3.urdf": "--base: ''",
}
"""Files of which no chain is read, and the reason of one."""
REASONS = (
    "a link that moves against",  # the end is part of the base
    " limit: ",
    r"(Left|Right)_\w+_q2 mimic: '\w+_q1'",  # no joint of the file
)
PAGE = ROOT / "docs" / "your_own_arm.md"
MOST_STARTS = 256  # beside a singularity most searches end early
each_robot = pytest.mark.parametrize("path", public_robots(), ids=lambda path: path.name)


def base_of(robot: UrdfRobot) -> str:
    return next((link for link in robot.links if link not in robot.above), "")


@cache
def chains(path: Path) -> tuple[dict[str, Arm], list[str]]:
    """Arms from the base to all ends that one is read to, most joints first; the other errors."""
    robot, arms, errors = UrdfRobot(path), {}, []
    for end in [link for link in robot.links if link not in robot.children] or [""]:
        try:
            arms[end] = Arm.parse(read_chain(robot, base_of(robot), end), robot.where)
        except InputError as error:
            errors.append(str(error))
    return dict(sorted(arms.items(), key=lambda item: -item[1].n)), errors


def check(robot: UrdfRobot, tip: str, arm: Arm) -> None:
    """Eight postures as pinocchio has them; two back again from the middle of the limits."""
    q = drawn(arm, np.random.default_rng(0), 8)
    compare(Path(robot.where), base_of(robot), tip, arm, q)
    model, q = Model(arm), q[:2]
    found = solve_many(model, model.pose(q), engine=Engine.MODEL, max_starts=MOST_STARTS)
    assert found.ok.all(), f"{tip}: {found.reason}"
    np.testing.assert_allclose(model.pose(found.q), model.pose(q), atol=1e-8)
    lower, upper = arm.bounds
    assert ((lower <= found.q) & (found.q <= upper)).all()


@each_robot
def test_a_public_robot_is_read_or_refused_for_a_reason(path: Path) -> None:
    arms, errors = chains(path)
    reasons = (*REASONS, re.escape(REFUSED.get(path.name, REASONS[0])))
    assert all(any(re.search(reason, error) for reason in reasons) for error in errors)
    assert (path.name in REFUSED) == (not arms)
    if arms:
        check(UrdfRobot(path), *next(iter(arms.items())))
    else:
        assert any(REFUSED[path.name] in error for error in errors)


@pytest.mark.long
@each_robot
def test_so_is_every_chain_of_it(path: Path) -> None:
    robot = UrdfRobot(path)
    for tip, arm in list(chains(path)[0].items())[1:]:
        check(robot, tip, arm)


@pytest.mark.long
@each_robot
def test_a_folder_of_it_passes_the_check(path: Path, shell: Shell) -> None:
    """Of the chain of most joints: no head or rotor, whose tip is on a joint's axis."""
    if path.name in REFUSED:
        return
    ends = ("--base", base_of(UrdfRobot(path)), "--tip", next(iter(chains(path)[0])))
    assert shell("init", "arm", "--urdf", path, *ends) == 0, shell.err
    assert shell("check", "arm") == 0, shell.out


@pytest.mark.skipif(not public_robots(), reason="example-robot-data is not installed")
def test_the_page_says_how_many_are_read() -> None:
    read = [chains(path)[0] for path in public_robots()]
    table = dict(re.findall(r"^\| ([^|]+) \| (\d+) \|$", PAGE.read_text("utf-8"), re.MULTILINE))
    counted = {
        "URDFs": len(read),
        "read": sum(map(bool, read)),
        "chains of these, from the base to an end that moves": sum(map(len, read)),
    }
    assert {name: int(table[name]) for name in counted} == counted
