"""The declared arm: every feature against numbers by hand, every fault in one clear line."""

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.geometry_errors import DhError
from longarm_comp.core.effects.placements import TipOffset
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model, unstack


def mdh(alpha: float, a: float, theta: float, d: float) -> np.ndarray:
    """Craig's row, multiplied out of its four elementary matrices."""
    ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
    turn_x = np.array([[1, 0, 0, 0], [0, ca, -sa, 0], [0, sa, ca, 0], [0, 0, 0, 1]])
    turn_z = np.array([[ct, -st, 0, 0], [st, ct, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return turn_x @ shift(a, 0, 0) @ turn_z @ shift(0, 0, d)


def shift(x: float, y: float, z: float) -> np.ndarray:
    made = np.eye(4)
    made[:3, 3] = x, y, z
    return made


def rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Rz(yaw) Ry(pitch) Rx(roll), degrees."""
    made = np.eye(4)
    for angle, (i, j) in ((yaw, (0, 1)), (pitch, (2, 0)), (roll, (1, 2))):
        turn = np.eye(4)
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        turn[i, i], turn[j, j], turn[i, j], turn[j, i] = c, c, -s, s
        made = made @ turn
    return made


EVERYTHING: dict[str, Any] = {
    "name": "everything",
    "convention": "mdh_craig",
    "base": {"xyz_m": [0.1, -0.2, 0.3], "rpy_deg": [10, -20, 30]},
    "tip": {"frame": 5, "position_m": [0.01, 0.02, 0.03], "rpy_deg": [5, 6, 7]},
    "gravity_mps2": [0, 0, -9.8],
    "reference_temperature_c": 25,
    "payload": {"mass_kg": 0.4, "frame": 5, "position_m": [0, 0, 0.05]},
    "joints": [
        {"id": 1, "type": "revolute", "d_m": 0.2, "theta_offset_deg": 15, "limits_deg": [-170, 90]}
        | {"name": "swing", "tolerance": {"a_m": 2e-3, "alpha_deg": 0.5, "theta_deg": 0.2}},
        {"id": 2, "type": "prismatic", "alpha_deg": -90, "a_m": 0.05, "d_m": 0.4}
        | {"theta_offset_deg": 20, "limits_m": [0.01, 0.3]},
        {"id": 3, "type": "fixed", "pose": {"xyz_m": [0.3, 0.1, -0.1], "rpy_deg": [40, 50, 60]}},
        {"id": 4, "type": "revolute", "alpha_deg": 35, "a_m": 0.2}
        | {"mimic": [{"joint": "swing", "multiplier": -0.5, "offset": 0.1}]}
        | {"tolerance": {"d_m": 5e-4}},
        {"id": 5, "type": "prismatic", "d_m": 0.25, "mimic": {"joint": 2, "multiplier": 2}},
        {"id": 6, "type": "fixed", "a_m": 0.1, "alpha_deg": 12, "theta_offset_deg": 3, "d_m": 0.2},
    ],
    "links": [
        {"name": "post", "row": 1, "role": "d", "length_m": 0.2, "mass_kg": 0.5, "E_pa": 2e9}
        | {"poisson": 0.35, "section": {"type": "tube", "od_m": 0.05, "id_m": 0.04}},
        {"name": "outer", "row": 2, "role": "d", "length_m": 0.3, "E_pa": 7e10, "G_pa": 2.6e10}
        | {"section": {"type": "rect", "width_m": 0.03, "height_m": 0.05, "wall_m": 0.002}},
        {"name": "inner", "row": 2, "role": "d", "length_m": "rest", "EI_nm2": 50, "GJ_nm2": 40}
        | {"mass_kg": 0.3, "body_length_m": 0.5},
        {"name": "bracket", "row": 4, "role": "a", "length_m": 0.2, "EI_nm2": 80, "GJ_nm2": 60},
    ],
    "point_masses": [
        {"name": "motor", "frame": 1, "position_m": [0, 0.1, 0], "mass_kg": 1.2},
        {"name": "trolley", "frame": 2, "mass_kg": 0.7, "position_columns": ["mx", "my", "mz"]},
    ],
    "camera": {"position_m": [2, 0, 1], "optical_axis": [-1, 0, 0]},
    "markers": {
        "left": {"frame": 5, "position_m": [0, 0.1, 0]},
        "elbow": {"frame": 2, "position_m": [0, 0, 0.02]},
    },
}


HASH_OF_THE_DEMO = "9da7a1bff6ef1a2495c0b2c987d2518e1b184795d16ea8057765357bd4023edf"


@pytest.fixture(scope="module")
def arm() -> Arm:
    return Arm.parse(EVERYTHING, "test")


def by_hand(q: np.ndarray) -> list[np.ndarray]:
    """Frames 0..6 of `EVERYTHING`, written out."""
    rad = np.radians
    rows = [
        mdh(0, 0, rad(15) + q[0], 0.2),
        mdh(rad(-90), 0.05, rad(20), 0.4 + q[1]),
        shift(0.3, 0.1, -0.1) @ rpy(40, 50, 60),
        mdh(rad(35), 0.2, -0.5 * q[0] + 0.1, 0),
        mdh(0, 0, 0, 0.25 + 2 * q[1]),
        mdh(rad(12), 0.1, rad(3), 0.2),
    ]
    frames = [shift(0.1, -0.2, 0.3) @ rpy(10, -20, 30)]
    for row in rows:
        frames.append(frames[-1] @ row)
    return frames


def test_every_kind_of_row_against_elementary_matrices(arm: Arm, rng: np.random.Generator) -> None:
    model = Model(arm)
    for q in rng.uniform(arm.lower, arm.upper, (20, arm.n)):
        posture = model.posture(unstack(q))
        frames = by_hand(q)
        for row, frame in enumerate(frames):
            got = posture.frames[posture.frame(row)].matrix()
            np.testing.assert_allclose(got, frame, atol=1e-14)
        tip = frames[5] @ shift(0.01, 0.02, 0.03) @ rpy(5, 6, 7)
        np.testing.assert_allclose(model.pose(q), tip, atol=1e-14)


def test_demo_arm_against_elementary_matrices(
    demo_arm_path: Path, rng: np.random.Generator
) -> None:
    data = yaml.safe_load(demo_arm_path.read_text())
    demo = Arm.load(demo_arm_path)
    for q in rng.uniform(demo.lower, demo.upper, (20, demo.n)):
        frame = np.eye(4)
        for joint, value in zip(data["joints"], q, strict=True):
            turn = np.radians(joint["theta_offset_deg"])
            turn, slide = (turn + value, 0) if joint["type"] == "revolute" else (turn, value)
            frame = frame @ mdh(
                np.radians(joint["alpha_deg"]), joint["a_m"], turn, joint["d_m"] + slide
            )
        np.testing.assert_allclose(Model(demo).pose(q), frame, atol=1e-14)


def test_names_limits_and_hash(arm: Arm) -> None:
    assert arm.commanded == (1, 2)
    assert arm.joint_names == ("swing", "joint2")
    np.testing.assert_allclose(arm.lower, [math.radians(-170), 0.01], rtol=1e-15)
    np.testing.assert_allclose(arm.upper, [math.radians(90), 0.3], rtol=1e-15)
    np.testing.assert_allclose(arm.mid, (arm.lower + arm.upper) / 2)
    assert arm.joints[3].limits == (-math.inf, math.inf)
    again = Arm.parse(json.loads(json.dumps(EVERYTHING)), "another place")
    assert again.hash == arm.hash
    assert Arm.parse(put(EVERYTHING, "payload.mass_kg", 0.41), "test").hash != arm.hash


def test_steps_of_the_servos(arm: Arm, demo_arm_path: Path) -> None:
    np.testing.assert_array_equal(arm.steps, [0.0, 0.0])
    stepped = put(put(EVERYTHING, "joints.0.step_deg", 0.36), "joints.1.step_m", 1e-4)
    made = Arm.parse(stepped, "test")
    np.testing.assert_allclose(made.steps, [2 * math.pi / 1000, 1e-4], rtol=1e-14)
    assert made.hash != arm.hash
    # a file written before steps could be declared keeps the hash that model files refer to
    assert Arm.load(demo_arm_path).hash == HASH_OF_THE_DEMO


def test_several_mimic_terms_are_summed(arm: Arm) -> None:
    terms = [{"joint": 1, "multiplier": 0.3, "offset": 0.2}, {"joint": "joint2", "multiplier": -4}]
    mixed = Arm.parse(put(EVERYTHING, "joints.3.mimic", terms), "test")
    values = Model(mixed).chain.values((0.5, 0.1))
    assert values == pytest.approx([0.5, 0.1, 0.0, 0.3 * 0.5 + 0.2 - 0.4, 0.2, 0.0], abs=1e-15)


def test_stiffness_of_every_section(arm: Arm) -> None:
    post, outer, inner, _ = (beam.stiffness for beam in arm.links)
    i = math.pi / 64 * (0.05**4 - 0.04**4)
    assert post == pytest.approx((2e9 * i, 2e9 * i, 2e9 / (2 * 1.35) * 2 * i))
    first = (0.03 * 0.05**3 - 0.026 * 0.046**3) / 12
    second = (0.05 * 0.03**3 - 0.046 * 0.026**3) / 12
    torsion = 4 * (0.028 * 0.048) ** 2 / (2 * (0.028 + 0.048) / 0.002)  # Bredt: 4 A^2 / int ds/t
    assert outer == pytest.approx((7e10 * first, 7e10 * second, 2.6e10 * torsion))
    assert inner == (50, 50, 40)
    solid = put(EVERYTHING, "links.1.section", {"type": "rect", "width_m": 0.02, "height_m": 0.02})
    square = Arm.parse(solid, "test").links[1].section
    assert square is not None
    assert square.second_moments()[2] == pytest.approx(0.1406 * 0.02**4, rel=2e-3)  # Timoshenko


def test_markers_and_tip_offsets(arm: Arm) -> None:
    q = np.array([[0.3, 0.1], [0.3, 0.1], [0.4, 0.2]])
    context = Context(labels={"marker": np.array(["left", "elbow", "left"])})
    seen = Model(arm).tip(q, context)
    for row, (frame, at) in enumerate(((5, (0, 0.1, 0)), (2, (0, 0, 0.02)), (5, (0, 0.1, 0)))):
        want = by_hand(q[row])[frame] @ np.array([*at, 1])
        np.testing.assert_allclose(seen[row], want[:3], atol=1e-14)
    moved = Model(arm, (TipOffset(marker="elbow", x=1e-3),)).tip(q, context) - seen
    np.testing.assert_allclose(moved[1], 1e-3 * by_hand(q[1])[2][:3, 0], atol=1e-14)
    np.testing.assert_array_equal(moved[[0, 2]], 0)


def test_mass_where_the_columns_say(arm: Arm) -> None:
    context = Context(columns={"mx": 0.1, "my": 0.2, "mz": -0.3})
    posture = Model(arm).posture((0.3, 0.1), context)
    light = Arm.parse(put(EVERYTHING, "point_masses.1.mass_kg", 0.0), "test")
    without = Model(light).posture((0.3, 0.1), context)
    frame = by_hand(np.array([0.3, 0.1]))
    centre = (frame[2] @ np.array([0.1, 0.2, -0.3, 1]))[:3]
    extra = np.array(posture.carried_masses[1][0]) - np.array(without.carried_masses[1][0])
    np.testing.assert_allclose(extra, 0.7 * centre, atol=1e-14)
    with pytest.raises(InputError, match=r"mx.*missing"):
        _ = Model(arm).posture((0.3, 0.1)).carried_masses


def test_tolerances_become_priors(arm: Arm) -> None:
    def priors(row: int) -> dict[str, float]:
        return {p.name: p.prior for p in DhError(row=row).parameters(arm)}

    half = math.radians(0.5)
    turned = {"alpha": half, "beta": half, "theta": 0.0}
    assert priors(1) == {"a": 2e-3, "b": 2e-3, "d": 1e-3, **turned}
    assert priors(2)["d"] == 0.0  # a slide's own zero is joint_zero's
    assert priors(4) == {
        "a": 1e-3,
        "b": 1e-3,
        "alpha": 4e-3,
        "beta": 4e-3,
        "d": 5e-4,
        "theta": 4e-3,
    }


def put(data: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """A copy with one key set, or removed where the value is None."""
    data = copy.deepcopy(data)
    *way, last = (int(p) if p.isdigit() else p for p in path.split("."))
    node: Any = data
    for part in way:
        node = node[part]
    if value is None:
        del node[last]
    else:
        node[last] = value
    return data


MISSING = "'missing'"
# key, what is put there (None: removed), the field, the value and a part of what is allowed
FAULTS: list[tuple[str, Any, str, str, str]] = [
    ("tip", None, "tip", MISSING, "required"),
    ("joints.0.limits_deg", None, "joints.0.limits_deg", MISSING, "revolute"),
    ("joints.1.limits_m", None, "joints.1.limits_m", MISSING, "prismatic"),
    ("joints.0.id", None, "joints.0.id", MISSING, "required"),
    ("gravity_mps2", [0, 0], "gravity_mps2.2", MISSING, "required"),
    ("conventoin", "mdh_craig", "conventoin", "'mdh_craig'", "convention"),
    ("joints.0.alpha_dge", 90, "joints.0.alpha_dge", "90", "alpha_deg"),
    ("links.0.section.od_mm", 50, "links.0.section.od_mm", "50", "od_m"),
    ("joints.1.a_mm", 50, "joints.1.a_mm", "50", "a_m"),
    ("joints.3.mimic.0.factor", 2, "joints.3.mimic.0.factor", "2", "multiplier"),
    ("markers.left.frmae", 2, "markers.left.frmae", "2", "frame"),
    ("joints.1.a_m", math.nan, "joints.1.a_m", "nan", "finite"),
    ("payload.mass_kg", math.inf, "payload.mass_kg", "inf", "finite"),
    ("gravity_mps2.1", math.nan, "gravity_mps2.1", "nan", "finite"),
    ("payload.mass_kg", -1, "payload.mass_kg", "-1", "greater than or equal to 0"),
    ("joints.1.a_m", "5 cm", "joints.1.a_m", "'5 cm'", "number"),
    ("joints.1.limits_deg", [0, 30], "joints.1.limits_deg", "[0.0, 30.0]", "limits_m"),
    ("joints.0.limits_m", [0, 0.3], "joints.0.limits_m", "[0.0, 0.3]", "limits_deg"),
    ("joints.2.limits_deg", [0, 30], "joints.2.limits_deg", "[0.0, 30.0]", "fixed"),
    ("joints.0.limits_deg", [30, 30], "joints.0.limits_deg", "[30.0, 30.0]", "lower < upper"),
    ("joints.0.step_deg", 0, "joints.0.step_deg", "0", "greater than 0"),
    ("joints.0.step_deg", -0.36, "joints.0.step_deg", "-0.36", "greater than 0"),
    ("joints.0.step_deg", math.nan, "joints.0.step_deg", "nan", "finite"),
    ("joints.0.step_deg", math.inf, "joints.0.step_deg", "inf", "finite"),
    ("joints.0.step_deg", "fine", "joints.0.step_deg", "'fine'", "number"),
    ("joints.0.step_deg", 261, "joints.0.step_deg", "261.0", "at most the joint's range"),
    ("joints.1.step_m", 0.3, "joints.1.step_m", "0.3", "at most the joint's range"),
    ("joints.0.step_m", 1e-4, "joints.0.step_m", "0.0001", "step_deg for a revolute joint"),
    ("joints.1.step_deg", 0.1, "joints.1.step_deg", "0.1", "step_m for a prismatic joint"),
    ("joints.2.step_deg", 0.1, "joints.2.step_deg", "0.1", "none in a fixed row"),
    ("joints.3.step_deg", 0.1, "joints.3.step_deg", "0.1", "none in a passive row"),
    ("joints.0.step_dge", 0.1, "joints.0.step_dge", "0.1", "step_deg"),
    ("joints.0.pose", {}, "joints.0.pose", "revolute", "fixed rows only"),
    ("joints.2.mimic", {"joint": 1}, "joints.2.mimic", "joint=1", "none in a fixed row"),
    ("joints.0.type", "hinge", "joints.0.type", "'hinge'", "'revolute', 'prismatic' or 'fixed'"),
    ("joints", [], "joints", "[]", "at least 1"),
    ("joints.1.id", 1, "joints.id", "[1, 1, 3, 4, 5, 6]", "1..6 in order"),
    ("joints.1.name", "swing", "joints.name", "['swing', 'swing']", "differ"),
    ("joints.4.mimic.joint", "nobody", "joints.4.mimic.joint", "'nobody'", "'swing', 'joint2'"),
    ("joints.4.mimic.joint", 3, "joints.4.mimic.joint", "3", "[1, 2]"),
    ("sensors", {"bubble": {"kind": "inclinometer", "row": 7}}, "sensors.bubble.row", "7", "0..6"),
    ("tip.frame", 7, "tip.frame", "7", "0..6"),
    ("payload.frame", 9, "payload.frame", "9", "0..6"),
    ("markers.elbow.frame", 9, "markers.elbow.frame", "9", "0..6"),
    ("point_masses.0.frame", 7, "point_masses.0.frame", "7", "0..6"),
    ("links.0.row", 3, "links.0.row", "3", "[1, 2, 4, 5]"),
    ("links.0.row", 9, "links.0.row", "9", "[1, 2, 4, 5]"),
    ("links.1.name", "post", "links.name", "'post', 'post'", "differ"),
    ("links.0.length_m", 0.21, "links (post).length_m", "0.21 m", "0.2 m, row 1 d"),
    ("links.1.length_m", 0.41, "links (outer, inner).length_m", "0.41 m", "row 2 d at"),
    ("links.1.length_m", "rest", "links (outer, inner).length_m", "2 times", "one rest in row 2"),
    ("links.0.length_m", "whole", "links.0.length_m", "'whole'", "number"),
    ("links.0.section.id_m", 0.05, "links.0.section.id_m", "0.05", "less than od_m 0.05"),
    ("links.0.section.type", "pipe", "links.0.section", "pipe", "'tube', 'rect'"),
    ("links.1.section.wall_m", 0.015, "links.1.section.wall_m", "0.015", "less than half"),
    ("links.0.E_pa", None, "links.0.E_pa", MISSING, "Young"),
    ("links.0.poisson", None, "links.0.poisson", MISSING, "poisson or G_pa"),
    ("links.0.G_pa", 1e9, "links.0.poisson", "beside G_pa", "poisson or G_pa"),
    ("links.0.poisson", 0.5, "links.0.poisson", "0.5", "less than 0.5"),
    ("links.2.GJ_nm2", None, "links.2.GJ_nm2", MISSING, "torsional"),
    ("links.2.EI_nm2", None, "links.2.section", MISSING, "section with E_pa, or EI_nm2"),
    ("links.2.body_length_m", None, "links.2.body_length_m", MISSING, "length"),
    ("camera.optical_axis", [0, 0, 0], "camera.optical_axis", "[0.0, 0.0, 0.0]", "not zero"),
]


@pytest.mark.parametrize(("path", "value", "field", "found", "allowed"), FAULTS)
def test_a_fault_is_one_line(path: str, value: Any, field: str, found: str, allowed: str) -> None:
    with pytest.raises(InputError) as caught:
        Arm.parse(put(EVERYTHING, path, value), "arm.yaml")
    text = str(caught.value)
    assert text.startswith(f"arm.yaml: {field}: ")
    said, may = text.removeprefix(f"arm.yaml: {field}: ").split("; allowed: ")
    assert found in said
    assert allowed in may
    assert "\n" not in text
    assert "pydantic" not in text


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda p: p.write_text(""), "NoneType"),
        (lambda p: p.write_text("- 1\n- 2\n"), "list"),
        (lambda p: p.write_text("name: [1, 2\n"), "valid YAML"),
        (lambda p: p.write_text("name: a: b\n"), "valid YAML"),
        (lambda p: p.write_bytes(b"\xff\xfe\x00\x9f"), "byte 0 is no text"),
        (lambda p: None, "No such file or directory"),
        (lambda p: p.mkdir(), "Is a directory"),
    ],
    ids=["empty", "list", "broken", "colons", "binary", "absent", "folder"],
)
def test_a_file_that_is_no_arm(tmp_path: Path, write: Callable[[Path], Any], said: str) -> None:
    path = tmp_path / "arm.yaml"
    write(path)
    with pytest.raises(InputError) as caught:
        Arm.load(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert said in text
    assert "\n" not in text


def test_a_coupling_is_a_mimic_of_two_commanded_joints() -> None:
    """The forearm that counts with the upper arm, declared in its own row or as rows of its own."""
    from small_arm import ARM

    plain = ARM.model_dump(mode="json", exclude_defaults=True)
    plain["joints"][3]["coupling"] = {"joint": 2, "factor": -1.0}
    coupled = Arm.parse(plain, "coupled")
    q = np.random.default_rng(0).uniform(ARM.lower, ARM.upper, (20, 4))
    turned = q.copy()
    turned[:, 3] -= q[:, 1]
    np.testing.assert_allclose(Model(coupled).tip(q), Model(ARM).tip(turned), atol=1e-12)
    for key, value, told in (
        ({"joint": 9, "factor": 1.0}, 9, "a commanded joint"),
        ({"joint": 4, "factor": 1.0}, 4, "another joint"),
    ):
        plain["joints"][3]["coupling"] = key
        with pytest.raises(InputError, match=rf"joints\.3\.coupling\.joint: {value}.*{told}"):
            Arm.parse(plain, "coupled")
