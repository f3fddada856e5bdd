"""`longarm init` and `longarm check`: files that fit together, for any arm; what is assumed."""

import io
import math
import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from arm_folders import NODES, levels, replaced
from cli_shell import Shell
from sight import seen_from
from some_arms import COLUMN, HOBBY, NINE
from urdf_robots import example

from longarm_comp.arm_folder.check import check_folder
from longarm_comp.arm_folder.marker_sheet import PAPERS, lay_out_sheet
from longarm_comp.arm_folder.parameter_file import own_parameters, parameters_of, read_parameters
from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.typical_loads import reach
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.stereo.target import TagBoard

UR5 = ("--urdf", "UR5", "--base", "base_link", "--tip", "tool0")


def in_full(words: Sequence[str]) -> list[str]:
    """The words of a call, with the path of the UR5's file."""
    return [str(example("ur_description/urdf/ur5_robot.urdf")) if w == "UR5" else w for w in words]


def made(shell: Shell, folder: str, *words: str) -> Path:
    assert shell("init", folder, *in_full(words)) == 0, shell.err
    return shell.folder / folder


@pytest.mark.parametrize(
    ("words", "joints", "seen"),
    [
        pytest.param(UR5, 6, 0.95, marks=pytest.mark.long),
        (HOBBY, 6, 0.85),
        (NINE, 9, 0.8),
        pytest.param(COLUMN, 4, 0.7, marks=pytest.mark.long),
        (("--like", "demo"), 7, 1),
    ],
    ids=["ur5", "hobby", "nine", "column", "demo"],
)
def test_files_fit_together(shell: Shell, words: tuple[str, ...], joints: int, seen: float) -> None:
    folder = made(shell, "mine", *words)
    arm = Arm.load(folder / "arm.yaml")
    servos = ServoConfig.load(folder / "servo_driver.yaml")
    assert arm.n == joints
    assert tuple(servos.joints) == arm.joint_names
    lower = [servos.joints[name].lower for name in arm.joint_names]
    np.testing.assert_allclose(lower, arm.lower, atol=1e-6)
    given = {n: own_parameters(n) | read_parameters(folder / f"{n}.yaml") for n in NODES[1:]}
    sight = seen_from(arm, given["stereo_bridge"], given["simulated_arm"], poses=24)
    assert sight.seen >= seen
    assert sight.off_mm < 0.3
    carried = arm.payload.mass_kg if arm.payload else 0.0
    assert given["simulated_arm"]["payload_kg"] == carried
    assert shell("check", folder) == 0


def test_a_dh_table_has_tubes_and_servos_with_their_masses(shell: Shell) -> None:
    arm = Arm.load(made(shell, "given", *HOBBY, "--name", "hobby") / "arm.yaml")
    assert arm.name == "hobby"
    tube = arm.links[0]
    assert tube.mass_kg == pytest.approx(1270 * math.pi / 4 * (0.02**2 - 0.017**2) * 0.16, rel=1e-3)
    assert [mass.mass_kg for mass in arm.point_masses] == [0.06, 0.06, 0.06, 0.05, 0.05, 0.02]
    assert arm.payload is not None and arm.payload.mass_kg == 0.03
    assert "source: 'none'" in shell.refused("init", "cut")
    assert not (shell.folder / "cut").exists()


def test_a_urdf_is_narrowed_about_its_home(shell: Shell) -> None:
    words = ("--home", "elbow_joint=60", "--range", "30", "--name", "left")
    folder = made(shell, "ur5", *UR5, *words)
    arm = Arm.load(folder / "arm.yaml")
    assert arm.name == "left"
    elbow = arm.joint_names.index("elbow_joint")
    np.testing.assert_allclose(np.degrees([arm.lower[elbow], arm.upper[elbow]]), [45, 75])
    np.testing.assert_allclose(np.degrees(arm.upper[0]), 15)
    assert "whole range -360 to 360 deg" in (folder / "arm.yaml").read_text()
    whole = Arm.load(made(shell, "whole", *UR5, "--range", "0") / "arm.yaml")
    np.testing.assert_allclose(np.degrees(whole.upper[0]), 360)
    wide = ServoConfig.load(shell.folder / "whole" / "servo_driver.yaml")
    assert wide.joints["shoulder_pan_joint"].gear_ratio < 10
    word = "--home", "elbow_joint=200"
    assert "--home elbow_joint" in shell.refused("init", "no", *in_full(UR5), *word)
    assert "shoulder_pan_joint" in shell.refused("init", "no", *in_full(UR5), "--home", "knee=2")


def test_turned_through_all_of_its_range_a_marker_hides_from_any_head(shell: Shell) -> None:
    """That is to be known, not to be mended; a head that sees less than another could is both."""
    folder = made(shell, "whole", *UR5, "--range", "0")
    assert "limits_deg: [-360.0, 360.0]" in (folder / "arm.yaml").read_text()
    assert shell("check", folder / "arm.yaml") == 0, shell.out
    assert re.search(r"unmeasured .*the marker is seen at (2|3)\d of 64 poses.*--seen", shell.out)
    replaced(folder / "simulated_arm.yaml", r"position: .*", "position: [50.0, 0.0, 0.0]")
    assert shell("check", folder) == 3
    assert re.search(r"implausible .* of 64 poses, .*: \d+ could be seen", shell.out)


def test_an_arm_that_others_drive_and_measure_is_one_file(shell: Shell) -> None:
    folder = made(shell, "ur5", *UR5, "--only-arm")
    assert [file.name for file in folder.iterdir()] == ["arm.yaml"]
    np.testing.assert_allclose(np.degrees(Arm.load(folder / "arm.yaml").upper[0]), 360)
    assert "longarm import-data FILE --arm" in shell.err
    assert "(docs/arm.md)\n# can lie along row" in (folder / "arm.yaml").read_text()
    assert Arm.load(folder / "arm.yaml").camera is None
    assert shell("check", folder) == 0 and "another program drives" in shell.out
    (folder / "servo_driver.yaml").write_text("")
    assert shell("check", folder) == 3


def test_a_camera_that_the_arm_declares_stays_where_it_is(shell: Shell) -> None:
    data = yaml.safe_load((made(shell, "first", *UR5) / "arm.yaml").read_text())
    data["camera"] = {"position_m": [0.2, -3.0, 0.5], "optical_axis": [0.0, 2.0, 0.0]}
    (shell.folder / "mine.yaml").write_text(yaml.safe_dump(data))
    folder = made(shell, "second", "--arm", "mine.yaml")
    shell("check", folder)
    assert "arm.yaml: camera" not in shell.out


def test_a_camera_that_looks_away_from_the_tip_is_refused(shell: Shell) -> None:
    data = yaml.safe_load((made(shell, "first", *UR5, "--only-arm") / "arm.yaml").read_text())
    data["camera"] = {"position_m": [0.2, 3.0, 0.5], "optical_axis": [0.0, 1.0, 0.0]}
    (shell.folder / "mine.yaml").write_text(yaml.safe_dump(data))
    assert "camera: 'looks away" in shell.refused("init", "second", "--arm", "mine.yaml")
    assert not (shell.folder / "second").exists()


@pytest.mark.parametrize("down", [-1.0, 1.0])
def test_a_camera_may_look_straight_down_or_up(shell: Shell, down: float) -> None:
    """No direction is level then by itself: the pose of the head was not a number."""
    data = yaml.safe_load((made(shell, "first", *UR5, "--only-arm") / "arm.yaml").read_text())
    data["camera"] = {"position_m": [0.4, 0.0, -3.0 * down], "optical_axis": [0.0, 0.0, down]}
    (shell.folder / "mine.yaml").write_text(yaml.safe_dump(data))
    bridge = parameters_of(
        "stereo_bridge", made(shell, "second", "--arm", "mine.yaml") / "stereo_bridge.yaml"
    )
    axis = quaternion.compute_pose(np.zeros(3), np.array(bridge["hand_eye.quaternion"]))[:3, 2]
    assert bridge["hand_eye.xyz"] == data["camera"]["position_m"]
    np.testing.assert_allclose(axis, [0.0, 0.0, down], atol=1e-9)


def test_gearing_and_cameras_are_those_of_the_packages_own_files(shell: Shell) -> None:
    words = "type=prismatic alpha=90 d=0.1 limits=0..0.1", "a=0.3 limits=-30..30"
    folder = made(shell, "mine", *(word for row in words for word in ("--joint", row)))
    own = ServoConfig.load(made(shell, "demo", "--like", "demo") / "servo_driver.yaml").joints
    lift, swing = ServoConfig.load(folder / "servo_driver.yaml").joints.values()
    assert lift.si_per_tick == own["joint3"].si_per_tick
    assert swing.si_per_tick == own["joint1"].si_per_tick
    assert lift.zero_ticks == own["joint3"].zero_ticks
    simulated = read_parameters(folder / "simulated_arm.yaml")
    for key in ("camera.focal_px", "camera.width", "camera.height"):
        assert simulated[key] == own_parameters("simulated_arm")[key]


def test_a_payload_that_is_commented_out_fits_the_arm(shell: Shell) -> None:
    file = made(shell, "mine", "--joint", "d=0.1 limits=-60..60") / "arm.yaml"
    replaced(file, "# payload: {", "payload: {")
    payload = Arm.load(file).payload
    assert payload is not None and payload.frame == 1


def test_servos_stand_at_the_steps_that_the_arm_declares(shell: Shell) -> None:
    folder = made(shell, "mine", *COLUMN)
    file = folder / "arm.yaml"
    replaced(file, r"limits_deg: \[-60.0, 60.0\]", "limits_deg: [-60.0, 60.0], step_deg: 0.01")
    replaced(file, r"limits_m: \[0.0, 0.4\]", "limits_m: [0.0, 0.4], step_m: 2.0e-5")
    assert levels(folder, "implausible")  # the gearing of before cannot stand there
    again = made(shell, "again", "--arm", str(file))
    assert (again / "arm.yaml").read_text() == file.read_text()
    assert not [f for f in check_folder(again) if f.blocks]
    joint = ServoConfig.load(again / "servo_driver.yaml").joints["swing"]
    assert math.degrees(joint.si_per_tick) == pytest.approx(0.01)
    replaced(file, "step_m: 2.0e-5", "step_m: 1.0e-6")
    assert "step of lift" in shell.refused("init", "fine", "--arm", file)
    assert shell("init", "fine", "--arm", file, "--servos", "xm430-w350") == 0
    assert ServoConfig.load(shell.folder / "fine" / "servo_driver.yaml").bus.protocol == "dynamixel"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--joint", "type=spherical"), "joint 1: type"),
        (("--joint", "limits=30..-30"), "joint 1: limits"),
        (("--joint", "d=0.1", "--joint", "a=x"), "joint 2: a"),
        (("--joint", "a=0.1 tube_a=3/4"), "joint 1: tube_a"),
        (("--joint", "tube_a=30/26"), "because a is 0"),
        (("--joint", "colour=red"), "known keys: a, alpha"),
        (("--joint", "d=1 tube_d=9 material=gold"), "aluminium"),
        (("--like", "demo", "--joint", "d=1"), "--like and --joint"),
        (("--joint", "d=0.1", "--servos", "ax12"), "--servos"),
        (("--urdf", "no.urdf"), "no.urdf"),
        (("--arm", "no.yaml"), "no.yaml"),
        (("--joint", "a=0.1 d=0.1", "--home", "joint1"), "--home"),
        (("--like", "demo", "--name", "mine"), "--name: 'mine'; allowed: with --urdf or --joint"),
        (("--arm", "a.yaml", "--range", "30"), "--range: 30.0; allowed: with --urdf or --joint"),
        (("--joint", "d=0.1", "--tip", "tool"), "--tip: 'tool'; allowed: with --urdf alone"),
        (("--urdf", "a.urdf", "--payload", "1"), "--payload: 1.0; allowed: with --joint alone"),
        (("--like", "demo", "--hobby"), "--hobby: True; allowed: with --urdf or --arm or --joint"),
    ],
)
def test_a_wrong_answer_is_one_line_and_leaves_nothing(
    shell: Shell, words: tuple[str, ...], said: str
) -> None:
    assert said in shell.refused("init", "mine", *words)
    assert list(shell.folder.iterdir()) == []


def test_nothing_is_overwritten(shell: Shell) -> None:
    mine = shell.folder / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("")
    assert "new or empty" in shell.refused("init", "mine", "--like", "demo")
    assert [p.name for p in mine.iterdir()] == ["thesis.txt"]


def test_a_printed_arm_has_horns_small_paper_and_cameras_on_the_table(shell: Shell) -> None:
    assert shell("init", "printed", *HOBBY, "--hobby") == 0, shell.err
    folder = shell.folder / "printed"
    arm, servos = Arm.load(folder / "arm.yaml"), ServoConfig.load(folder / "servo_driver.yaml")
    length = reach(arm)
    for joint in servos.joints.values():
        assert (joint.gear_ratio, joint.multi_turn) == (1.0, False)
        assert joint.max_velocity * length < 0.26  # m/s at the tip
    bridge = parameters_of("stereo_bridge", folder / "stereo_bridge.yaml")
    tips = declared_model(arm).tip(np.vstack([arm.lower, arm.mid, arm.upper]))
    assert np.linalg.norm(tips[1] - bridge["hand_eye.xyz"]) < 1.5 * length
    assert lay_out_sheet(TagBoard.of(bridge))[0] == "A4"
    found = check_folder(folder)
    assert not [finding.text for finding in found if finding.blocks]
    replaced(folder / "stereo_bridge.yaml", r"tag_m: .*", "tag_m: 0.006")
    replaced(folder / "simulated_arm.yaml", r"tag_m: .*", "tag_m: 0.006")
    said = [finding.text for finding in check_folder(folder) if finding.blocks]
    assert re.search(r"seen at 0 of 64 poses, at most others too far: .* a tag is \d px, 13 needed",
                     said[0])  # fmt: skip


@pytest.mark.parametrize("limits", ["60..120", "-120..-60", "18..80", "-80..-18", "-30..50"])
def test_a_servo_counts_from_its_first_turn_where_its_joint_is_nearest_to_0(
    shell: Shell, limits: str
) -> None:
    assert shell("init", "away", "--joint", f"d=0.1 limits={limits}", "--tip-at", 0.1, 0, 0) == 0
    (joint,) = ServoConfig.load(shell.folder / "away" / "servo_driver.yaml").joints.values()
    assert (joint.gear_ratio, joint.zero_ticks % 4096) == (10.0, 2048)
    nearest = max(joint.lower, min(joint.upper, 0.0))
    assert -0.5 < joint.zero_ticks + nearest / joint.si_per_tick < 4095.5
    assert "servo_driver.yaml: zero_ticks" in levels(shell.folder / "away", "unmeasured")


SLOW = """<robot name="slow"><link name="base"/><link name="l1"/><link name="l2"/>
<joint name="lift" type="revolute"><parent link="base"/><child link="l1"/><axis xyz="0 1 0"/>
<limit lower="0.2" upper="1.5" effort="1" velocity="0.0123"/>
<safety_controller soft_lower_limit="0.3" soft_upper_limit="0.6" k_velocity="1"/></joint>
<joint name="slide" type="prismatic"><parent link="l1"/><child link="l2"/>
<origin xyz="0.3 0 0"/><axis xyz="1 0 0"/>
<limit lower="0" upper="0.15" effort="1" velocity="9"/></joint></robot>"""


def test_soft_limits_and_velocities_of_a_urdf_are_kept(shell: Shell) -> None:
    (shell.folder / "slow.urdf").write_text(SLOW)
    folder = made(shell, "slow", "--urdf", shell.folder / "slow.urdf")
    assert "joint lift: soft limits; the hard ones are 11.4592 to 85.9437 deg" in shell.err
    assert "# soft limits; the hard ones are" in (folder / "arm.yaml").read_text()
    servos = ServoConfig.load(folder / "servo_driver.yaml").joints
    assert (servos["lift"].lower, servos["lift"].upper) == pytest.approx((0.3, 0.6))
    assert servos["lift"].max_velocity == 0.0123
    assert servos["slide"].max_velocity < 0.05  # as fast as its servo
    assert not [finding for finding in check_folder(folder) if finding.blocks]
    links = ("--base", "base", "--tip", "l2")
    assert shell("import-urdf", shell.folder / "slow.urdf", *links, "-o", "slow.yaml") == 0
    assert "joint lift: taken are soft limits; the hard ones are 11.4592 to" in shell.err
    assert "slide:" not in shell.err


def test_the_marker_is_printed_in_true_size(shell: Shell, hobby: Path, mine: Path) -> None:
    """The page, scanned at 300 dpi, through the real detector."""
    given = own_parameters("stereo_bridge") | read_parameters(hobby / "stereo_bridge.yaml")
    board = TagBoard.of(given)
    paper, page = lay_out_sheet(board)
    scan = io.BytesIO()
    page.savefig(scan, format="png", dpi=300)
    grey = cv2.imdecode(np.frombuffer(scan.getvalue(), np.uint8), cv2.IMREAD_GRAYSCALE)
    seen = board.detect(grey)
    assert len(seen) == board.n_corners
    drawn = seen.pixels * [1, -1] * 0.0254 / 300
    known = board.points(seen.ids)[:, :2]
    np.testing.assert_allclose(drawn - drawn.mean(axis=0), known - known.mean(axis=0), atol=5e-5)
    assert shell("stereo", "marker", hobby, "-o", "marker.pdf") == 0
    width, height = PAPERS[paper]
    printed = Path("marker.pdf").read_bytes()
    assert max(map(int, re.findall(rb"/Width (\d+)", printed))) >= board.tag_m / 0.0254 * 600
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+)", printed)
    assert box is not None
    np.testing.assert_allclose(np.array(box.groups(), float) * 25.4 / 72, [width, height], atol=0.1)
    replaced(mine / "stereo_bridge.yaml", r"tag_m: [\d.]+", "tag_m: 0.9")
    assert "fits on A0" in shell.refused("stereo", "marker", mine)


def test_the_arm_file_says_what_it_means(hobby: Path) -> None:
    text = (hobby / "arm.yaml").read_text()
    assert "# Modified DH (Craig)" in text and "# Elastic beams" in text
    arm = Arm.load(hobby / "arm.yaml")
    assert np.linalg.norm(declared_model(arm).tip(arm.mid)) < 0.6
    comments = (hobby / "stereo_bridge.yaml").read_text()
    assert "# left optical frame in the base frame, m" in comments
