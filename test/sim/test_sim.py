"""The simulated arm against textbooks, an FE library, another simulator, and its own claims."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from finite_elements import fe_sag, stiffened
from scipy.integrate import solve_bvp

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext

G = 9.81
EI, GJ = 2.0, 1.5


def one_beam(length: float = 1.0, mass: float = 0.0, tip_mass: float = 0.0, **more: Any) -> Arm:
    """A beam along -y of the base (z of row 1 after Rx(90 deg)), turned by q about itself."""
    return Arm.parse(
        {
            "name": "beam",
            "convention": "mdh_craig",
            "tip": {"frame": 1},
            "gravity_mps2": [0, 0, -G],
            "joints": [
                {"id": 1, "type": "revolute", "alpha_deg": 90, "d_m": length}
                | {"limits_deg": [-180, 180]}
            ],
            "links": [
                {"name": "rod", "row": 1, "role": "d", "length_m": length, "mass_kg": mass}
                | {"body_length_m": length, "EI_nm2": EI, "GJ_nm2": GJ}
            ],
            "point_masses": [{"name": "load", "frame": 1, "mass_kg": tip_mass}],
            **more,
        },
        "test",
    )


def test_small_tip_load_is_the_cantilever_formula() -> None:
    mass = 1e-4
    pose = TrueArm(one_beam(0.8, tip_mass=mass)).pose(np.zeros(1))
    assert pose[2, 3] == pytest.approx(-mass * G * 0.8**3 / (3 * EI), rel=1e-6)
    assert pose[1, 3] == pytest.approx(-0.8, abs=1e-7)
    slope = np.arctan2(pose[2, 2], -pose[1, 2])
    assert slope == pytest.approx(-mass * G * 0.8**2 / (2 * EI), rel=1e-6)


def test_small_dead_weight_is_the_cantilever_formula() -> None:
    mass = 1e-4
    pose = TrueArm(one_beam(0.8, mass=mass)).pose(np.zeros(1))
    assert pose[2, 3] == pytest.approx(-mass * G * 0.8**3 / (8 * EI), rel=1e-6)


def test_offset_load_twists_the_rod() -> None:
    mass = 1e-5
    load = {"name": "arm", "frame": 1, "mass_kg": mass, "position_m": [0.3, 0, 0]}
    pose = TrueArm(one_beam(point_masses=[load])).pose(np.zeros(1))
    assert pose[2, 0] == pytest.approx(-mass * G * 0.3 * 1.0 / GJ, rel=1e-6)


def test_rectangle_is_stiff_on_edge() -> None:
    section = {"type": "rect", "width_m": 0.01, "height_m": 0.03}
    rod = {"name": "rod", "row": 1, "role": "d", "length_m": 1.0, "section": section}
    arm = one_beam(tip_mass=1e-4, links=[rod | {"E_pa": 2e9, "poisson": 0.3}])
    flat, on_edge = (-TrueArm(arm).tip(np.array([[np.pi / 2], [0.0]])))[:, 2]
    assert on_edge == pytest.approx(1e-4 * G / (3 * 2e9 * 0.01 * 0.03**3 / 12), rel=1e-5)
    assert flat / on_edge == pytest.approx(9.0, rel=1e-5)


@pytest.mark.parametrize(
    ("alpha", "drop", "shortening", "slope"),
    [
        (1.0, 0.30172, 0.05643, 0.46135),
        (2.0, 0.49346, 0.16064, 0.78175),
        (5.0, 0.71379, 0.38763, 1.21537),
        (10.0, 0.81061, 0.55500, 1.43029),
    ],
)
def test_elastica(alpha: float, drop: float, shortening: float, slope: float) -> None:
    """Bisshopp and Drucker (1945), as tabulated by Mattiasson (1981); alpha = P L^2 / EI."""
    arm = one_beam(tip_mass=alpha * EI / G)
    pose = TrueArm(arm, steps=60).pose(np.zeros(1))
    assert -pose[2, 3] == pytest.approx(drop, abs=1e-5)
    assert 1 + pose[1, 3] == pytest.approx(shortening, abs=1e-5)
    assert np.arctan2(-pose[2, 2], -pose[1, 2]) == pytest.approx(slope, abs=1e-5)


def test_heavy_elastica_solves_its_boundary_value_problem() -> None:
    """EI theta'' = w (L - s) cos theta, theta(0) = 0, theta'(L) = 0, by collocation."""
    w = 8.0

    def rate(s: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack([y[1], w * (1 - s) * np.cos(y[0]) / EI, np.cos(y[0]), np.sin(y[0])])

    mesh = np.linspace(0, 1, 50)
    solved = solve_bvp(
        rate,
        lambda a, b: np.array([a[0], b[1], a[2], a[3]]),
        mesh,
        np.zeros((4, 50)),
        tol=1e-10,
        max_nodes=20000,
    )
    tip = TrueArm(one_beam(mass=w / G), steps=60).tip(np.zeros(1))
    assert tip[2] == pytest.approx(solved.sol(1.0)[3], abs=1e-8)
    assert -tip[1] == pytest.approx(solved.sol(1.0)[2], abs=1e-8)


def test_sliding_body_hangs_in_the_beam_before_it() -> None:
    """Small load, by hand: outer beam 0.4 m, inner 0.2 m out of a body of 0.3 m."""
    outer = {"name": "outer", "row": 1, "role": "d", "length_m": 0.4, "EI_nm2": 4.0, "GJ_nm2": 1.0}
    inner = {"name": "inner", "row": 1, "role": "d", "length_m": "rest", "EI_nm2": 1.0}
    inner |= {"GJ_nm2": 1.0, "mass_kg": 3e-5, "body_length_m": 0.3}
    joint = {"id": 1, "type": "prismatic", "alpha_deg": 90, "d_m": 0.5, "limits_m": [0, 0.2]}
    arm = one_beam(joints=[joint], links=[outer, inner], point_masses=[])
    drop = -TrueArm(arm).tip(np.array([0.1]))[2]
    w = 3e-5 / 0.3 * G
    # unit-load theorem: integral of M(s) (0.6 - s) / EI with M = w (0.6 - max(s, 0.3))^2 / 2 ...
    s = np.linspace(0, 0.6, 600_001)
    moment = np.where(s < 0.3, w * 0.3 * (0.45 - s), w * (0.6 - s) ** 2 / 2)
    curvature = moment / np.where(s < 0.4, 4.0, 1.0)
    assert drop == pytest.approx(np.trapezoid(curvature * (0.6 - s), s), rel=1e-5)


def test_body_behind_the_bearing_keeps_its_weight() -> None:
    """A bar of 1 m that sticks out by 0.3 m pulls the other way: torque of its centre at -0.2."""
    rod = {"name": "rod", "row": 1, "role": "d", "length_m": "rest", "EI_nm2": 1e9, "GJ_nm2": 1e9}
    joint = {"id": 2, "type": "prismatic", "alpha_deg": 90, "d_m": 0.2, "limits_m": [0, 0.5]}
    lift = {"id": 1, "type": "revolute", "alpha_deg": 90, "limits_deg": [-90, 90]}
    rod |= {"row": 2, "mass_kg": 2.0, "body_length_m": 1.0}
    arm = one_beam(joints=[lift, joint], links=[rod], tip={"frame": 2}, point_masses=[])
    q = np.array([np.pi / 2, 0.1])
    assert abs(TrueArm(arm).tip(q)[0]) == pytest.approx(0.3)
    torque = TrueArm(arm).settle(q).torques[0, 0]
    assert abs(torque) == pytest.approx(2.0 * G * 0.2, rel=1e-6)
    rise = TrueArm(arm).tip(q + np.array([1e-3, 0.0]))[2] - TrueArm(arm).tip(q)[2]
    assert torque * rise > 0  # the weight behind the bearing lifts the tip


def test_more_steps_change_nothing(twin: Arm, rng: np.random.Generator) -> None:
    q = rng.uniform(twin.lower, twin.upper, (30, twin.n))
    assert np.abs(TrueArm(twin).tip(q) - TrueArm(twin, steps=24).tip(q)).max() < 1e-9


def test_single_and_batch_agree(twin: Arm, rng: np.random.Generator) -> None:
    q = rng.uniform(twin.lower, twin.upper, (7, twin.n))
    true = TrueArm(twin)
    batch = true.pose(q)
    for one, pose in zip(q, batch, strict=True):
        assert np.allclose(true.pose(one), pose, atol=1e-11)
    rotation = batch[:, :3, :3]
    assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-9)


def test_torques_are_the_slope_of_potential_energy(twin: Arm, rng: np.random.Generator) -> None:
    """Virtual work: at rest, with joints held, torque = dE/dq' by the payload's share."""
    stiff = stiffened(twin, 4e4)  # as stiff as arm.yaml can say
    q = rng.uniform(twin.lower, twin.upper, (1, twin.n))[0]
    true = TrueArm(stiff)
    heavy, light = (true.settle(q, TrueContext(payload_kg=m)).torques[0] for m in (0.35, 0.25))
    step = 1e-5
    for k in range(twin.n):
        dq = step * np.eye(twin.n)[k]
        rise = (TrueArm(stiff).tip(q + dq)[2] - TrueArm(stiff).tip(q - dq)[2]) / (2 * step)
        assert heavy[k] - light[k] == pytest.approx(-0.1 * G * rise, abs=1e-5)


def test_overload_is_an_error_not_a_number() -> None:
    with pytest.raises(JobError, match="no equilibrium"):
        TrueArm(one_beam(tip_mass=1e6)).tip(np.zeros(1))


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((2, 2)), np.array([np.nan] * 7)])
def test_bad_joints_are_refused(twin: Arm, bad: np.ndarray) -> None:
    with pytest.raises(InputError, match="q"):
        TrueArm(twin).tip(bad)


def test_mimic_and_fixed_rows() -> None:
    """A doubled telescope and a fixed row equal the same arm written out."""
    rows: list[dict[str, Any]] = [
        {"id": 1, "type": "revolute", "alpha_deg": 90, "limits_deg": [-90, 90], "d_m": 0.1},
        {"id": 2, "type": "prismatic", "alpha_deg": 30, "d_m": 0.5, "limits_m": [0, 0.2]},
        {"id": 3, "type": "fixed", "pose": {"xyz_m": [0.1, 0.2, 0.3], "rpy_deg": [10, 20, 30]}},
        {"id": 4, "type": "prismatic", "d_m": 0.3, "mimic": {"joint": 2, "multiplier": 2.0}},
    ]
    beams = [
        {"name": n, "row": r, "role": "d", "length_m": "rest", "EI_nm2": EI, "GJ_nm2": GJ}
        for n, r in (("one", 2), ("two", 4))
    ]
    shared: dict[str, Any] = {"tip": {"frame": 4}, "links": beams}
    load = [{"name": "load", "frame": 4, "mass_kg": 0.3}]
    mimic = one_beam(joints=rows, point_masses=load, **shared)
    free = [*rows[:3], {"id": 4, "type": "prismatic", "d_m": 0.3, "limits_m": [0, 0.4]}]
    written = one_beam(joints=free, point_masses=load, **shared)
    assert np.allclose(
        TrueArm(mimic).pose(np.array([0.3, 0.1])), TrueArm(written).pose(np.array([0.3, 0.1, 0.2]))
    )


def read_noise_free(folder: Path, n: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Joints of the rows that have an answer, and the answers' three positions by prefix."""
    q = {}
    for part in ("samples", "test"):
        with (folder / f"{part}.csv").open(encoding="utf-8") as file:
            for row in csv.DictReader(file):
                q[part, row["index"]] = [float(row[f"q{k + 1}"]) for k in range(n)]
    with (folder / "answer" / "noise_free.csv").open(encoding="utf-8") as file:
        answers = [r for r in csv.DictReader(file) if (r["set"], r["index"]) in q]
    joints = np.array([q[r["set"], r["index"]] for r in answers])
    return joints, {
        p: np.array([[float(r[p + axis]) for axis in "xyz"] for r in answers])
        for p in ("", "declared_", "rigid_")
    }


def test_another_authors_simulator(data_dir: Path, twin: Arm) -> None:
    """Its beams also shear: with shear 0.005 mm apart, without 0.05 mm, at 13 mm of sag."""
    q, answer = read_noise_free(data_dir / "twin" / "none_mid_300", twin.n)
    weightless = twin.model_copy(update={"gravity_mps2": (0.0, 0.0, 0.0)})
    assert np.abs(TrueArm(weightless).tip(q) - answer["rigid_"]).max() < 2e-7  # its last digit
    for shear, allowed in ((True, 5e-6), (False, 5e-5)):
        tip = TrueArm(twin, shear=shear).tip(q)
        assert np.linalg.norm(tip - answer[""], axis=1).max() < allowed


@pytest.mark.parametrize("case", range(8))
def test_finite_elements(twin: Arm, case: int) -> None:
    """PyNite is linear, so the arm is made stiff: 13 um of sag instead of 13 mm."""
    stiff = stiffened(twin, 1e3)
    q = np.random.default_rng(case).uniform(twin.lower, twin.upper)
    weightless = stiff.model_copy(update={"gravity_mps2": (0.0, 0.0, 0.0)})
    ours = TrueArm(stiff).tip(q) - TrueArm(weightless).tip(q)
    theirs = fe_sag(stiff, q)
    assert np.linalg.norm(ours - theirs) < 1e-4 * np.linalg.norm(theirs)
