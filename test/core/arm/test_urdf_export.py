"""Calibrated arms as URDF: pinocchio finds the tip where the model's rigid part has it."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from cli_shell import Shell
from small_arm import ARM

from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.catalogue import BUILT_IN
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.link_frames import BASE_LINK, TIP, link_frames
from longarm_comp.core.model.model import Model
from longarm_comp.urdf import import_urdf
from longarm_comp.urdf_export import export_urdf, zero_offsets

pin = pytest.importorskip("pinocchio")

NEAR = 1e-9


def disturbed(arm: Arm, rng: np.random.Generator) -> Model:
    """Every geometry effect that the arm may have, with random values, and a compliant joint."""
    kinds = [kind for kind in BUILT_IN.values() if kind.geometry]
    model = Model(arm).plus(*(term for kind in kinds for term in kind.for_arm(arm)))
    model = model.plus(*BUILT_IN["joint_compliance"].for_arm(arm)[:1])
    assert len(model.slots) > 2 * arm.n
    return model.with_values(0.02 * rng.standard_normal(len(model.slots)))


def check(path: Path, model: Model, rng: np.random.Generator, **labels: str) -> None:
    """The tip of the URDF is the model's, at random joints."""
    arm, known = model.arm, model.rigid
    robot = pin.buildModelFromUrdf(str(path))
    data = robot.createData()
    weights, offset = arm.mixing
    for _ in range(10):
        q = arm.lower + rng.random(arm.n) * (arm.upper - arm.lower)
        v = np.zeros(robot.nv)
        for joint, value in zip(arm.joints, weights @ q + offset, strict=True):
            if joint.type != "fixed":
                v[robot.joints[robot.getJointId(joint.name or f"joint{joint.id}")].idx_v] = value
        pin.framesForwardKinematics(robot, data, pin.integrate(robot, pin.neutral(robot), v))
        tip = data.oMf[robot.getFrameId("tip", pin.BODY)].homogeneous
        assert np.abs(tip - known.pose(q, Context(labels=labels))).max() < NEAR
        if not model.effects:  # tf tells the links of the declared arm by the same names
            at = {BASE_LINK: np.eye(4)}
            for link in link_frames(model, q):
                at[link.name] = at[link.parent] @ quaternion.compute_pose(link.position, link.turn)
                same = data.oMf[robot.getFrameId(link.name, pin.BODY)].homogeneous
                assert np.abs(at[link.name] - same).max() < NEAR
            assert TIP in at


def written(path: Path, model: Model, **chosen: str) -> Path:
    path.write_text(export_urdf(model, **chosen))
    return path


def test_the_demonstration_arm(
    demo_arm_path: Path, tmp_path: Path, rng: np.random.Generator
) -> None:
    arm = Arm.load(demo_arm_path)
    check(written(tmp_path / "declared.urdf", Model(arm)), Model(arm), rng)
    model = disturbed(arm, rng)
    check(written(tmp_path / "a.urdf", model), model, rng)
    assert np.abs(model.pose(arm.mid) - Model(arm).pose(arm.mid)).max() > 1e-2


def test_the_urdf_weighs_what_the_arm_weighs(
    demo_arm_path: Path, tmp_path: Path, rng: np.random.Generator
) -> None:
    """Torques against gravity: pinocchio's of the URDF, and the loads of the model at its rows."""
    data = yaml.safe_load(demo_arm_path.read_text())
    data["payload"]["mass_kg"] = 0.0
    short = {"name": "spur", "row": 5, "role": "a", "length_m": 0.02, "EI_nm2": 900.0,
             "GJ_nm2": 700.0, "mass_kg": 0.3}  # fmt: skip
    data["joints"][4]["a_m"] = 0.03
    data["links"].append(short)
    arm = Arm.parse(data, "weighed")
    robot = pin.buildModelFromUrdf(str(written(tmp_path / "a.urdf", Model(arm))))
    for _ in range(5):
        q = arm.lower + rng.random(arm.n) * (arm.upper - arm.lower)
        torques = pin.computeGeneralizedGravity(robot, robot.createData(), q)
        posture = Model(arm).posture(list(q))
        for k, joint in enumerate(arm.joints):
            at = posture.frame(joint.id)
            load = posture.moment(at)[2]
            if joint.type == "prismatic":  # its own sliding beam hangs before its frame
                own = sum(b.mass_kg for b in arm.links if (b.row, b.length_m) == (joint.id, "rest"))
                load = posture.force(at)[2] + own * posture.gravity_in(at)[2]
            assert torques[k] == pytest.approx(-float(load), abs=1e-9)


CHAIN: dict[str, Any] = {
    "name": "chain",
    "convention": "mdh_craig",
    "base": {"xyz_m": [20, -3, 1], "rpy_deg": [10, 80, -170]},
    "tip": {"frame": 5, "position_m": [0, 0.02, 0.05], "rpy_deg": [0, -30, 0]},
    "joints": [
        {"id": 1, "name": "lift", "type": "prismatic", "limits_m": [0.1, 0.6], "moves": False},
        {"id": 2, "name": "one", "type": "prismatic", "d_m": 0.3,
         "mimic": {"joint": "lift", "multiplier": 0.5, "offset": 0.05}},
        {"id": 3, "name": "two", "type": "prismatic", "alpha_deg": 90, "a_m": 0.1,
         "mimic": {"joint": "lift", "multiplier": -0.5}},
        {"id": 4, "name": "bend", "type": "fixed",
         "pose": {"xyz_m": [0, 0.1, 0], "rpy_deg": [5, 6, 7]}},
        {"id": 5, "name": "wrist", "type": "revolute", "a_m": 0.2, "limits_deg": [-1, 1]},
    ],
    "point_masses": [
        {"name": "m1", "frame": 3, "position_m": [0.1, 0, 0], "mass_kg": 1.0},
        {"name": "m2", "frame": 3, "position_m": [-0.1, 0.2, 0], "mass_kg": 2.0},
    ],
    "markers": {
        "near": {"frame": 5, "position_m": [0.1, 0, 0]},
        "far": {"frame": 5, "position_m": [0, 0.3, 0]},
    },
}  # fmt: skip


def test_coupled_stages_fixed_rows_and_a_far_base(tmp_path: Path, rng: np.random.Generator) -> None:
    arm = Arm.parse(CHAIN, "chain.yaml")
    assert arm.joint_names == ("lift", "wrist")
    lifted = Model(arm).tip(np.array([[0.2, 0.0], [0.4, 0.0]]))
    assert np.linalg.norm(lifted[1] - lifted[0]) == pytest.approx(0.1 * np.sqrt(2))  # two halves
    check(written(tmp_path / "chain.urdf", Model(arm)), Model(arm), rng)
    model = disturbed(Arm.parse({**CHAIN, "markers": {}}, "chain.yaml"), rng)
    path = written(tmp_path / "moved.urdf", model)
    check(path, model, rng)
    root = ET.parse(path).getroot()
    mimics = {j.get("name"): j.find("mimic") for j in root.findall("joint")}
    assert mimics["one"].attrib == {"joint": "lift", "multiplier": "0.5", "offset": "0.05"}  # type: ignore[union-attr]
    robot = pin.buildModelFromUrdf(str(path))
    (body,) = [b for b in robot.inertias if b.mass > 0]
    assert body.mass == pytest.approx(3.0)
    # m1 and m2 are sqrt(0.08) m apart: the reduced mass 2/3 kg gives both larger moments.
    assert np.sort(np.linalg.eigvalsh(body.inertia)) == pytest.approx([0, 0.16 / 3, 0.16 / 3])


def test_groups_and_markers(tmp_path: Path, rng: np.random.Generator) -> None:
    arm = Arm.parse(CHAIN, "chain.yaml")
    base, tip = BUILT_IN["base_pose"], BUILT_IN["tip_offset"]
    placements = base(group="a", x=0.3), base(group="b", rz=0.4)
    tips = tip(marker="near", y=0.01), tip(marker="far", x=0.02)
    model = Model(arm).plus(*placements, *tips)
    with pytest.raises(InputError, match="--group: 'missing'; allowed: a, b"):
        export_urdf(model)
    with pytest.raises(InputError, match="--marker: 'missing'; allowed: far, near"):
        export_urdf(model, "a")
    with pytest.raises(InputError, match="--group: 'c'"):
        export_urdf(model, "c", "near")
    for group in "ab":
        path = written(tmp_path / f"{group}.urdf", model, group=group, marker="near")
        check(path, model, rng, group=group, marker="near")
    one = Model(arm).plus(base(group="a", x=0.3), tip(marker="near", y=0.01))
    check(written(tmp_path / "one.urdf", one), one, rng)


def test_a_joint_that_follows_two_cannot_be_said(tmp_path: Path) -> None:
    data = {**CHAIN, "joints": [dict(joint) for joint in CHAIN["joints"]]}
    data["joints"][1]["mimic"] = [{"joint": "lift"}, {"joint": "wrist"}]
    with pytest.raises(InputError, match="joint one: 'lift, wrist'"):
        export_urdf(Model(Arm.parse(data, "chain.yaml")))


def test_the_command_and_the_way_back(work: Path, shell: Shell, rng: np.random.Generator) -> None:
    found = shell.json("export-urdf", work / "arm.yaml", "--model", work / "model.yaml")
    assert [z["joint"] for z in found["zero_offsets"]] == list(ARM.joint_names)
    model = yaml.safe_load((work / "model.yaml").read_text())
    stored = [t["parameters"] for t in model["geometry"] if t["effect"] == "joint_zero"]
    assert [z["offset"] for z in found["zero_offsets"]] == [p["offset"]["value"] for p in stored]
    again = Arm.parse(import_urdf("calibrated.urdf", "base_link", "tip"), "calibrated.urdf")
    from longarm_comp.core.model.model_file import load_model

    calibrated = load_model(work / "model.yaml", ARM)
    q = ARM.lower + rng.random((20, 4)) * (ARM.upper - ARM.lower)
    assert np.abs(Model(again).pose(q) - calibrated.rigid.pose(q)).max() < NEAR
    assert len(zero_offsets(calibrated)) == 4
    assert shell("export-urdf", work / "arm.yaml", "--model", work / "model.yaml") == 0
    assert "joint1" in shell.out
