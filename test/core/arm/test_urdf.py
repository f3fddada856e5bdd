"""Arms from URDF against pinocchio: tip poses, and the torques that masses and COMs make."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from urdf_robots import CHAIN, compare, drawn, example

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.strict_yaml import MOST_BYTES
from longarm_comp.urdf import chain_ends, describe_drive, import_urdf, read_drives
from longarm_comp.urdf_file import UrdfRobot

ROBOTS = (
    ("panda_description/urdf/panda.urdf", "panda_link0", "panda_hand_tcp", 7),
    ("z1_description/urdf/z1.urdf", "link00", "gripperStator", 6),
    ("so_arm_description/urdf/so101.urdf", "base_link", "gripper_frame_link", 5),
    ("tiago_description/robots/tiago.urdf", "torso_fixed_link", "arm_tool_link", 8),
    ("tiago_pro_description/robots/tiago_pro.urdf", "base_link", "arm_left_tool_link", 8),
    ("kinova_description/robots/kinova.urdf", "base", "j2s6s200_end_effector", 6),
)


def written(folder: Path, text: str) -> Path:
    path = folder / "robot.urdf"
    path.write_text(text)
    return path


def refusal(folder: Path, text: str, base: str = "base", tip: str = "c") -> str:
    with pytest.raises(InputError) as caught:
        import_urdf(written(folder, text), base, tip)
    return str(caught.value)


@pytest.mark.parametrize(("name", "base", "tip", "n"), ROBOTS)
def test_public_robots(name: str, base: str, tip: str, n: int, rng: np.random.Generator) -> None:
    path = example(name)
    data = import_urdf(path, base, tip)
    arm = Arm.parse(yaml.safe_load(yaml.safe_dump(data)), str(path))
    assert arm.n == n
    assert sum(m.mass_kg for m in arm.point_masses) > 0
    compare(path, base, tip, arm, drawn(arm, rng))


def test_mimic_side_branch_and_odd_axes(tmp_path: Path, rng: np.random.Generator) -> None:
    path = written(tmp_path, CHAIN)
    arm = Arm.parse(import_urdf(path, "base", "c"), "lift")
    assert arm.joint_names == ("ja", "jc")
    assert np.allclose(arm.lower, [-0.1, -2])
    assert {m.name: m.mass_kg for m in arm.point_masses} == {"a": 1.5, "b": 0.5, "side": 0.3}
    compare(path, "base", "c", arm, drawn(arm, rng))


TELESCOPE = """<robot name="boom">
  <link name="base"/><link name="slew"/><link name="outer"/><link name="inner"/><link name="tip"/>
  <joint name="swing" type="revolute"><parent link="base"/><child link="slew"/>
    <origin xyz="0 0 0.4"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="luff" type="revolute"><parent link="slew"/><child link="outer"/>
    <origin xyz="0.1 0 0.8"/><axis xyz="0 -1 0"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <joint name="ext" type="prismatic"><parent link="outer"/><child link="inner"/>
    <origin xyz="3.2 0 0"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="2.5" effort="1" velocity="1"/></joint>
  <joint name="head" type="revolute"><parent link="inner"/><child link="tip"/>
    <origin xyz="0.5 0.1 0"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>
"""


def test_a_telescope_has_rows_that_hold_its_beams(tmp_path: Path, rng: np.random.Generator) -> None:
    """All lengths lie along a or d of the joints' own rows; the beams sag as a clamped one."""
    path = written(tmp_path, TELESCOPE)
    data = import_urdf(path, "base", "tip")
    assert not any(any(row["pose"]["xyz_m"]) for row in data["joints"] if row["type"] == "fixed")
    lengths = {row["name"]: (row.get("a_m", 0.0), row.get("d_m", 0.0)) for row in data["joints"]}
    assert lengths["ext"] == pytest.approx((0.0, 3.2))
    assert lengths["luff"] == pytest.approx((0.8, 0.0), abs=0.11)
    straight = Arm.parse(data, "boom")
    compare(path, "base", "tip", straight, drawn(straight, rng))
    row = next(row["id"] for row in data["joints"] if row["name"] == "ext")
    tube = {"row": row, "role": "d", "EI_nm2": 4e5, "GJ_nm2": 3e5}
    data["links"] = [{**tube, "name": "outer", "length_m": 3.0},
                     {**tube, "name": "inner", "length_m": "rest"}]  # fmt: skip
    data["point_masses"] = [{"name": "load", "frame": row, "mass_kg": 50.0}]
    arm = Arm.parse(data, "boom")
    q = np.array([[0.0, 0.0, 1.3, 0.0]])
    sag = (
        declared_model(arm).pose(q)[0, 2, 3]
        - declared_model(arm, deflection=False).pose(q)[0, 2, 3]
    )
    at_load = -50.0 * 9.80665 * 4.5**3 / (3 * 4e5)
    slope = -50.0 * 9.80665 * 4.5**2 / (2 * 4e5)
    assert sag == pytest.approx(at_load + 0.5 * slope, rel=0.01)


def test_continuous_joints_get_half_a_turn(tmp_path: Path) -> None:
    path = written(tmp_path, CHAIN.replace('"revolute"', '"continuous"'))
    arm = Arm.parse(import_urdf(path, "base", "c"), "lift")
    assert arm.joint_names == ("ja", "jc")
    assert arm.upper[1] == pytest.approx(np.pi)


BARE = """<robot name="cad">
  <link name="base"/><link name="l1"/><link name="l2"/><link name="l3"/><link name="tip"/>
  <joint name="waist" type="revolute"><parent link="base"/><child link="l1"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 0 1"/><limit lower="-2" upper="2"/></joint>
  <joint name="shoulder" type="revolute"><parent link="l1"/><child link="l2"/>
    <origin xyz="0 0 0.1" rpy="1.5708 0 0"/><axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint>
  <joint name="elbow" type="revolute"><parent link="l2"/><child link="l3"/>
    <origin xyz="0.3 0 0"/><axis xyz="0 0 1"/><limit lower="-2" upper="2"/></joint>
  <joint name="end" type="fixed"><parent link="l3"/><child link="tip"/>
    <origin xyz="0.25 0 0"/></joint>
</robot>
"""
SHOULDER = '<limit lower="-1" upper="1"/>'


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (SHOULDER, "", "joint shoulder limit: 'missing'; allowed: lower < upper, or type fixed"),
        (SHOULDER, '<limit effort="9" velocity="1"/>', "joint shoulder limit: 'missing'"),
        (SHOULDER, '<limit lower="0" upper="0"/>', "joint shoulder limit: '0 to 0'"),
        (SHOULDER, '<limit lower="0.3" upper="0.3"/>', "joint shoulder limit: '0.3 to 0.3'"),
        ('lower="-2" upper="2"', "", "joint waist limit: 'missing'; allowed: lower < upper, or "
         "type fixed where it stands still; so too joint elbow"),
        (SHOULDER, '<limit lower="-90" upper="90"/>', "joint shoulder limit: '-90 to 90'; allowed: "
         "rad, two turns (12.6) to either side at most, not degrees"),
        (SHOULDER, '<limit lower="-1e16" upper="1e16"/>', "continuous where it turns on and on"),
        (SHOULDER, '<limit lower="-inf" upper="inf"/>', "joint shoulder limit: '-inf to inf'"),
        (SHOULDER, '<limit lower="nan" upper="1"/>', "joint shoulder limit: 'nan'; allowed: lower"),
        (SHOULDER, '<limit lower="low" upper="1"/>', "joint shoulder limit: 'low'; allowed: lower"),
        ('rpy="1.5708 0 0"', 'rpy="90 0 0"', "joint shoulder origin: [90.0, 0.0, 0.0]; allowed: "
         "rpy in rad, a turn (6.28) at most, not degrees"),
    ],
)  # fmt: skip
def test_limits_that_give_no_range_or_degrees_are_said(
    old: str, new: str, words: str, tmp_path: Path
) -> None:
    assert Arm.parse(import_urdf(written(tmp_path, BARE), "base", "tip"), "cad").n == 3
    assert old in BARE
    assert words in refusal(tmp_path, BARE.replace(old, new), tip="tip")


def test_a_slide_in_millimetres_is_refused(tmp_path: Path) -> None:
    slide = BARE.replace('"shoulder" type="revolute"', '"shoulder" type="prismatic"')
    path = written(tmp_path, slide.replace(SHOULDER, '<limit lower="0" upper="100"/>'))
    assert Arm.parse(import_urdf(path, "base", "tip"), "cad").upper[1] == 100.0
    said = refusal(tmp_path, slide.replace(SHOULDER, '<limit lower="0" upper="500"/>'), tip="tip")
    assert "shoulder limit: '0 to 500'; allowed: m, 100 to either" in said


def test_two_turns_are_a_range_and_what_is_off_the_chain_needs_none(tmp_path: Path) -> None:
    wheel = '<link name="wheel"/><joint name="roll" type="revolute"><parent link="base"/>'
    wheel += '<child link="wheel"/><limit lower="-1e16" upper="1e16"/></joint>'
    text = BARE.replace('"-1" upper="1"', '"-12.56" upper="12.56"')
    path = written(tmp_path, text.replace("</robot>", f"{wheel}</robot>"))
    arm = Arm.parse(import_urdf(path, "base", "tip"), "cad")
    assert arm.joint_names == ("waist", "shoulder", "elbow")
    assert arm.upper[1] == pytest.approx(12.56)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<robot", "<machine", "machine"),
        ('name="lift">', 'name="lift">\n<broken', "a URDF (XML)"),
        ('type="revolute"', 'type="floating"', "joint jc: 'floating'"),
        ('lower="-2" upper="2"', 'lower="2" upper="-2"', "joint jc limit"),
        ('xyz="1 1 1"', 'xyz="0 0 0"', "joint jc axis"),
        ('xyz="1 1 1"', 'xyz="1 1"', "joint jc axis"),
        ('value="1.5"', 'value="heavy"', "link a mass: 'heavy'"),
        ('value="1.5"', 'value="-1"', "link a mass"),
        ('value="1.5"', 'value="nan"', "link a mass: 'nan'"),
        ('<child link="c"/>', '<child link="d"/>', "joint jc: 'd'"),
        ('<link name="c"/>', '<link name="b"/>', "link: 'a name is missing or twice'"),
        ('mimic joint="ja"', 'mimic joint="jz"', "joint jb mimic: 'jz'; allowed: a joint: ja, jc"),
    ],
)
def test_bad_urdf(old: str, new: str, words: str, tmp_path: Path) -> None:
    assert old in CHAIN
    text = CHAIN.replace(old, new)
    said = refusal(tmp_path, text.replace("</robot>", "</machine>") if "<machine" in new else text)
    assert words in said and said.startswith(str(tmp_path / "robot.urdf"))


@pytest.mark.parametrize(
    ("base", "tip", "words"),
    [
        ("basis", "c", "--base: 'basis'; allowed: a link: base, a, b, c, side"),
        ("base", "tcp", "--tip: 'tcp'"),
        ("c", "base", "a link below c"),
        ("b", "side", "a link that moves against b"),
    ],
)
def test_bad_ends(base: str, tip: str, words: str, tmp_path: Path) -> None:
    assert words in refusal(tmp_path, CHAIN, base, tip)


def test_no_file_and_xacro(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        import_urdf(tmp_path / "none.urdf", "a", "b")
    path = tmp_path / "robot.xacro"
    path.write_text(
        '<robot name="r" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:macro name="m"/></robot>'
    )
    with pytest.raises(InputError, match=r"xacro xacro \S*robot.xacro > robot.urdf"):
        import_urdf(path, "a", "b")


def test_a_file_without_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "long.urdf"
    path.write_bytes(b"<robot>" + b" " * MOST_BYTES)
    with pytest.raises(InputError, match="a smaller file"):
        import_urdf(path, "base", "c")


def test_a_joint_turns_and_slides_along_its_own_axis(tmp_path: Path) -> None:
    path = written(tmp_path, CHAIN)
    joints = UrdfRobot(path).joints
    turn = Rotation.from_rotvec(np.full(3, 0.7 / np.sqrt(3.0))).as_matrix()
    np.testing.assert_allclose(joints["jc"].at(0.7)[:3, :3], turn, atol=1e-14)
    slid = joints["jb"].at(0.4)[:3, 3] - joints["jb"].origin[:3, 3]
    np.testing.assert_allclose(slid, joints["jb"].origin[:3, :3] @ [0, -0.4, 0], atol=1e-14)


COLUMN = """<robot name="column">
  <link name="base"/><link name="handle"/><link name="one"/><link name="two"/><link name="tool"/>
  <joint name="lift" type="prismatic"><parent link="base"/><child link="handle"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <joint name="first" type="prismatic"><parent link="base"/><child link="one"/>
    <axis xyz="0 0 1"/><mimic joint="lift" multiplier="0.5"/></joint>
  <joint name="second" type="prismatic"><parent link="one"/><child link="two"/>
    <origin xyz="0 0 0.3" rpy="0 0 0.2"/><axis xyz="0 0 1"/>
    <mimic joint="lift" multiplier="0.5" offset="0.01"/></joint>
  <joint name="flange" type="fixed"><parent link="two"/><child link="tool"/>
    <origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/></joint>
</robot>
"""


def test_a_mimic_of_a_joint_beside_the_chain_and_a_fixed_tool(tmp_path: Path) -> None:
    path = written(tmp_path, COLUMN)
    arm = Arm.parse(import_urdf(path, "base", "tool"), "column")
    assert arm.joint_names == ("lift",)
    low, high = Model(arm).pose(np.array([[0.0], [1.0]]))
    np.testing.assert_allclose(high[:3, 3] - low[:3, 3], [0, 0, 1], atol=1e-12)
    c, s = np.cos(0.2), np.sin(0.2)
    at = [c * 0.1 - s * 0.2, s * 0.1 + c * 0.2, 0.3 + 0.01 + 0.3]
    np.testing.assert_allclose(low[:3, 3], at, atol=1e-12)
    still = COLUMN.replace('upper="1"', 'upper="0"')
    assert "joint lift limit: '0 to 0'" in refusal(tmp_path, still, tip="tool")
    lid = COLUMN.replace('joint="lift" multiplier="0.5"/>', 'joint="lid"/>')
    said = refusal(tmp_path, lid, tip="tool")
    assert "joint first mimic: 'lid'; allowed: a joint: lift" in said


def test_a_cycle_is_refused_and_a_long_side_chain_is_not(tmp_path: Path) -> None:
    link = '<link name="{0}"/><joint name="j{0}" type="fixed">'
    link += '<parent link="{1}"/><child link="{0}"/></joint>'
    cycle = link.format("p", "r") + link.format("r", "p")
    text = CHAIN.replace("</robot>", cycle + "</robot>")
    assert "link p: 'in a cycle of joints'" in refusal(tmp_path, text)
    side = "".join(link.format(f"s{k}", f"s{k - 1}" if k else "b") for k in range(3000))
    path = written(tmp_path, CHAIN.replace("</robot>", side + "</robot>"))
    assert len(import_urdf(path, "base", "c")["point_masses"]) == 3


def test_a_centre_of_mass_in_millimetres_is_refused(tmp_path: Path) -> None:
    said = refusal(tmp_path, CHAIN.replace('xyz="0 0.2 0"', 'xyz="0 200 0"'))
    assert "link b inertial origin: '200 m'; allowed: metres; all" in said
    import_urdf(written(tmp_path, CHAIN.replace('xyz="0 0.2 0"', 'xyz="0 20 0"')), "base", "c")
    path = written(tmp_path, '\n \n<?xml version="1.0"?>\n' + CHAIN)
    assert import_urdf(path, "base", "c")["name"] == "lift"


MIMICS = """<robot name="mimics"><link name="b"/><link name="l1"/><link name="l2"/><link name="l3"/>
<link name="l4"/><link name="loose"/>
<joint name="a" type="revolute"><parent link="b"/><child link="l1"/><origin xyz="0 0 .1"/>
  <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="s1" type="prismatic"><parent link="l1"/><child link="l2"/><origin xyz=".1 0 0"/>
  <axis xyz="0 0 1"/><limit lower="0" upper=".5" effort="1" velocity="1"/></joint>
<joint name="s2" type="prismatic"><parent link="l2"/><child link="l3"/><origin xyz="0 0 .5"/>
  <axis xyz="0 0 1"/><limit effort="1" velocity="1"/>
  <mimic joint="s1" multiplier="-2" offset="0.03"/></joint>
<joint name="s3" type="prismatic"><parent link="l3"/><child link="l4"/><origin xyz="0 0 .5"/>
  <axis xyz="0 0 1"/><limit lower="0" upper="0" effort="1" velocity="1"/>
  <mimic joint="s2" multiplier="0.8" offset="0.01"/></joint>
</robot>"""


def test_a_mimic_of_a_mimic_follows_the_first(tmp_path: Path) -> None:
    """By hand: s2 = 0.03 - 2 s1, s3 = 0.01 + 0.8 s2; without limits of their own too."""
    path = written(tmp_path, MIMICS)
    assert chain_ends(path, "", "") == ("b", "l4")  # the loose link hangs on nothing
    arm = Arm.parse(import_urdf(path, "b", "l4"), "mimics")
    assert arm.joint_names == ("a", "s1")
    for s1 in (0.0, 0.2, 0.5):
        s2 = 0.03 - 2 * s1
        height = 0.1 + s1 + 0.5 + s2 + 0.5 + 0.01 + 0.8 * s2
        assert Model(arm).tip(np.array([0.3, s1]))[2] == pytest.approx(height, abs=1e-12)
    for leader in ("s3", "s2"):
        said = refusal(
            tmp_path, MIMICS.replace('mimic joint="s1"', f'mimic joint="{leader}"'), "b", "l4"
        )
        assert f"joint {leader} mimic: 's2'; allowed: a joint: a, s1" in said


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('<robot name="r"/>', "link: 'none'"),
        ('<robot name="r"><link name="a"/></robot>', "--tip: 'a'; allowed: a link that moves"),
        ('<robot name="r"><link name="a"/><link name="b"/></robot>', "--base: 'missing'; allowed: "
         "one of a, b"),
    ],
)  # fmt: skip
def test_a_file_without_a_chain_is_refused(text: str, words: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        import_urdf(path, *chain_ends(path, "", ""))
    assert words in str(caught.value)


LIFT = """<robot name="a"><link name="base"/><link name="l1"/><link name="tool"/>
<joint name="lift" type="revolute"><parent link="base"/><child link="l1"/><axis xyz="0 1 0"/>
<limit lower="0.2" upper="1.5" effort="1" velocity="0.3"/>SOFT</joint>
<joint name="slide" type="prismatic"><parent link="l1"/><child link="tool"/>
<origin xyz="0.3 0 0"/><axis xyz="1 0 0"/>
<limit lower="0" upper="0.15" effort="1" velocity="0"/></joint></robot>"""


@pytest.mark.parametrize(
    ("soft", "expected"),
    [
        ('soft_lower_limit="0.3" soft_upper_limit="0.6"', (0.3, 0.6)),
        ('soft_lower_limit="-1" soft_upper_limit="0.6"', (0.2, 0.6)),
        ('soft_lower_limit="0.3"', (0.3, 1.5)),
        ('soft_lower_limit="0" soft_upper_limit="0"', (0.2, 1.5)),
        ("", (0.2, 1.5)),
    ],
)
def test_the_tighter_of_hard_and_soft_limits_is_taken(
    soft: str, expected: tuple[float, float], tmp_path: Path
) -> None:
    path = written(tmp_path, LIFT.replace("SOFT", f'<safety_controller {soft} k_velocity="1"/>'))
    data = import_urdf(path, "base", "tool")
    arm = Arm.parse(data, "lift")
    assert (arm.lower[0], arm.upper[0]) == pytest.approx(expected)
    lift, slide = read_drives(path, data).values()
    assert (lift.velocity, slide.velocity) == (0.3, np.inf)
    assert ("hard ones are 11.4592 to 85.9437 deg" in describe_drive(lift)) is (
        expected != (0.2, 1.5)
    )
    assert describe_drive(lift).endswith("at most 17.1887 deg/s") and not describe_drive(slide)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("SOFT", '<safety_controller soft_lower_limit="1.6" soft_upper_limit="2"/>',
         "joint lift safety_controller: [1.6, 2.0]; allowed: soft limits that leave a range of "
         "0.2 to 1.5"),
        ("SOFT", '<safety_controller soft_lower_limit="low"/>', "lift safety_controller: 'low'"),
        ('velocity="0.3"', 'velocity="-1"', "joint lift limit: -1.0; allowed: velocity, 0"),
    ],
)  # fmt: skip
def test_bad_soft_limits_and_velocities_are_named(
    old: str, new: str, words: str, tmp_path: Path
) -> None:
    assert words in refusal(tmp_path, LIFT.replace(old, new).replace("SOFT", ""), tip="tool")
