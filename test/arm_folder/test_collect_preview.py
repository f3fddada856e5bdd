"""A plan looked at before anything moves: what the cameras see, boxes, floor, limits."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from cli_shell import Shell

from longarm_comp.arm_folder.head import View, view_beside
from longarm_comp.arm_folder.measured import SIDES, camera_path
from longarm_comp.arm_folder.parameter_file import own_parameters
from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.parts import Box
from longarm_comp.core.data.plan import Plan, sobol, with_floor
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import write_text
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import outline
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.stereo.camera import StereoRig
from longarm_comp.devices.stereo.camera_file import camera_text
from longarm_comp.devices.stereo.eye import StereoEye
from longarm_comp.devices.stereo.refusal import StereoRefusal
from longarm_comp.devices.stereo.target import TagBoard
from longarm_comp.jobs.collect.visits import (
    PlanCheck,
    Visit,
    blocked_visits,
    list_visits,
    plan_checks,
    refuse_blocked,
    servos_beside,
)
from longarm_comp.sessions.poses import read_poses
from longarm_comp.sim.cameras import CameraPair, render, tag_plate
from longarm_comp.sim.plant import mount_plate


def facing(head: CameraPair, rng: np.random.Generator, turned: float) -> np.ndarray:
    """(4, 4) marker somewhere about what the cameras see, turned by an angle (rad) from them."""
    depth = rng.uniform(0.8, 4.0)
    x, y = rng.uniform(-0.65, 0.65, 2) * depth
    axis = rng.normal(size=2)
    turn = turned * axis / np.linalg.norm(axis)
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([*turn, 0.0]))[0] @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = x, 0.75 * y, depth
    return head.left_in_base @ pose


def test_geometry_knows_what_the_detector_finds_in_rendered_pictures() -> None:
    bridge, simulated = own_parameters("stereo_bridge"), own_parameters("simulated_arm")
    head = CameraPair(tuple(simulated["camera.position"]), tuple(simulated["camera.axis"]),
                      simulated["camera.baseline_m"], simulated["camera.focal_px"])  # fmt: skip
    hand_eye = quaternion.compute_pose(
        np.array(bridge["hand_eye.xyz"]), np.array(bridge["hand_eye.quaternion"])
    )
    rig = StereoRig.from_camera_info(*head.camera_infos(), rectified=False)
    eye = StereoEye(rig, TagBoard.of(bridge), hand_eye, bridge["tip_in_marker"])
    plate = tag_plate(*(simulated[f"marker.{k}"] for k in ("tag_m", "gap_m", "columns", "rows")))
    on_tip = np.linalg.inv(mount_plate(simulated["marker.mounting"]))
    rng = np.random.default_rng(5)
    angles = [*rng.uniform(0.0, 0.9, 30), *rng.uniform(0.9, 1.7, 10)]
    markers = [facing(head, rng, angle) for angle in angles]
    why = View.of(bridge, simulated).unseen(np.array([marker @ on_tip for marker in markers]))
    found = []
    for marker in markers:
        try:
            eye.measure(*render(marker, plate, head, rng))
            found.append("")
        except StereoRefusal as refusal:
            found.append(str(refusal.reason))
    assert np.mean([bool(a) == bool(b) for a, b in zip(why, found, strict=True)]) >= 0.85
    assert 8 < found.count("") < 32
    kinds = {text.partition(" (")[0].partition(": ")[0] for text in why}
    assert kinds >= {"", "turned away", "too far", "out of view of the left camera",
                     "out of view of the right camera", "out of view of both cameras"}  # fmt: skip
    sides = {side for side in ("left", "right", "above", "below") if any(side in w for w in why)}
    assert len(sides) == 4
    for text, seen, marker in zip(why, found, markers, strict=True):
        local = np.linalg.inv(head.left_in_base) @ marker
        if "above)" in text or "below)" in text:
            assert (local[1, 3] > 0) == ("below)" in text)
        if text.startswith("out of view of the right"):
            assert "left image" not in seen


def asked(checks: list[PlanCheck]) -> dict[str, int]:
    return {check.question: check.passed_count for check in checks}


def test_every_question_is_asked_of_every_pose(hobby: Path) -> None:
    standing = Arm.load(hobby / "arm.yaml")
    base = standing.base.model_copy(update={"rpy_deg": (180.0, 0.0, 0.0)})
    hung, plan = standing.model_copy(update={"base": base}), sobol(standing, 30, 2)
    tips = declared_model(hung).tip(plan.q)
    floor = float(np.sort(tips[:, 2])[3]) - 1e-4
    lamp = tips[7]
    box = Box(min_m=tuple((lamp - 1e-3).tolist()), max_m=tuple((lamp + 1e-3).tolist()))
    arm = with_floor(hung.model_copy(update={"keep_out": {"lamp": box}}), floor)
    todo = [Visit(k, q[None]) for k, q in enumerate(plan.q)]
    view, servos = (
        view_beside(hobby / "arm.yaml"),
        servos_beside(hobby / "arm.yaml", arm.joint_names),
    )
    assert view is not None and servos is not None
    found = plan_checks(arm, todo, view=view, servos=servos)
    lines = outline(declared_model(arm), plan.q)
    low = [int(k) for k in np.flatnonzero(lines[..., 2].min(axis=1) <= floor)]
    assert len(low) >= 3 and 7 not in low and set(blocked_visits(found, todo)) == {*low, 7}
    told = asked(found)
    assert told["over the floor"] == 30 - len(low) and told["outside the keep-out boxes"] == 29
    assert told["inside the limits of arm.yaml"] == told["inside the servos' limits"] == 30
    seen = view.unseen(declared_model(arm).pose(plan.q))
    assert told["seen by both cameras"] == seen.count("")
    assert told["way there is free"] <= 29 - len(low)
    with pytest.raises(InputError, match=rf"visit {min(*low, 7)}: .*and {len(low)} more poses"):
        refuse_blocked(found, todo, "poses.csv")
    bare = plan_checks(Arm.load(hobby / "arm.yaml"), todo)
    assert list(asked(bare)) == ["inside the limits of arm.yaml"] and not blocked_visits(bare, todo)


def test_poses_outside_are_counted_with_the_joint(hobby: Path) -> None:
    arm = Arm.load(hobby / "arm.yaml")
    q = np.array([arm.mid, arm.mid, arm.mid])
    q[1, 2] = arm.upper[2] + 0.1
    servos = ServoConfig.load(hobby / "servo_driver.yaml")
    todo = list_visits(Plan(q, np.zeros(3)), arm, shuffle=False)
    found = plan_checks(arm, todo, servos=servos)
    assert [len(c.faults) - c.passed_count for c in found] == [1, 1]
    assert "joint3 outside" in blocked_visits(found, todo)[1]


@pytest.mark.parametrize("ticks", [-1.0, 0.3, 0.8])
def test_a_run_up_beyond_the_servos_limits_is_found_before_the_driver_refuses_it(
    hobby: Path, ticks: float
) -> None:
    """A run-up that begins so many ticks beyond the limit of its servo, and a pose inside."""
    arm, servos = Arm.load(hobby / "arm.yaml"), ServoConfig.load(hobby / "servo_driver.yaml")
    name, sides = arm.joint_names[0], np.zeros((1, arm.n))
    sides[0, 0] = -1.0
    (visit,) = list_visits(Plan(arm.mid[None], sides), arm)
    assert visit.path[0, 0] > visit.q[0]
    joint = servos.joints[name]
    joint = joint.model_copy(update={"upper": visit.path[0, 0] - ticks * joint.si_per_tick})
    servos = servos.model_copy(update={"joints": {**servos.joints, name: joint}})
    refused = False
    try:
        joint.check_inside(float(visit.path[0, 0]), "joint_trajectory", "points[0]")
    except InputError:
        refused = True
    assert refused == (ticks > 0.5)
    assert set(blocked_visits(plan_checks(arm, [visit], servos=servos), [visit])) == (
        {0} if refused else set()
    )


def test_the_commands_show_a_plan_and_move_nothing(hobby: Path, shell: Shell) -> None:
    arm = hobby / "arm.yaml"
    view = view_beside(arm)
    assert view is not None
    assert shell("plan", arm, "--kind", "sobol", "-n", 20, "-o", "all.csv", "--seed", 3) == 0
    told = shell.json("collect", arm, "all.csv", "--dry-run")
    seen = next(c for c in told["checks"] if c["question"] == "seen by both cameras")
    assert seen["passed"] == 20 - len(seen["faults"]) < 20  # else --seen has nothing to do
    words = ("plan", arm, "--kind", "sobol", "-n", 20, "-o", "seen.csv", "--seed", 3, "--seen")
    assert shell(*words, "--floor", -0.02) == 0
    declared = Arm.load(arm)
    poses = declared_model(declared).pose(read_poses(shell.folder / "seen.csv", declared).q)
    assert not any(view.unseen(poses))
    assert shell("collect", arm, "seen.csv", "--dry-run", "--floor", -0.02) == 0
    assert "20 of 20" in shell.out and "over the floor" in shell.out
    for words, text in (
        (("collect", arm, "seen.csv"), "--dry-run"),
        (("collect", arm, "seen.csv", "-o", "bag", "--floor", "inf"), "a finite number"),
    ):
        assert text in shell.refused(*words)
    alone = shell.folder / "arm.yaml"
    alone.write_text(arm.read_text())
    refusal = shell.refused("plan", alone, "--kind", "sobol", "-n", 3, "--seen")
    assert "stereo_bridge.yaml" in refusal
    lines = (shell.folder / "seen.csv").read_text().splitlines()
    column = lines[0].split(",").index("q2")
    cells = lines[1].split(",")
    cells[column] = "9"
    (shell.folder / "out.csv").write_text("\n".join([lines[0], ",".join(cells), *lines[2:]]))
    assert "1 of 20" in shell.refused("collect", arm, "out.csv", "--dry-run", code=3)
    assert "q2" in shell.refused("collect", arm, "out.csv", "-o", "bag")
    assert not (shell.folder / "bag").exists()


def test_the_lens_of_the_graph_replaces_the_files(hobby: Path) -> None:
    view = view_beside(hobby / "arm.yaml")
    assert view is not None
    arm = Arm.load(hobby / "arm.yaml")
    tips = declared_model(arm).pose(sobol(arm, 40, 0).q)
    wide = replace(view, focal_px=0.3 * view.focal_px)
    assert all("too far" in text or "turned" in text for text in wide.unseen(tips))


def test_the_calibration_beside_an_arm_is_its_lens(hobby: Path, tmp_path: Path) -> None:
    for name in ("arm", "stereo_bridge", "simulated_arm"):
        shutil.copy(hobby / f"{name}.yaml", tmp_path)
    pair = CameraPair(focal_px=512.0, size=(800, 600), baseline_m=0.17)
    for side, info in zip(SIDES, pair.camera_infos(), strict=True):
        write_text(camera_path(tmp_path, side), camera_text(side, info))
    view = view_beside(tmp_path / "arm.yaml")
    assert view is not None
    assert (view.focal_px, view.middle_px, view.size_px) == (512.0, (399.5, 299.5), (800, 600))
    assert view.baseline_m == pytest.approx(0.17)
