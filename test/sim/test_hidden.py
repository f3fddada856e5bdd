"""Every hidden effect: its dose, its sign, and by hand where a hand can."""

from typing import Any

import numpy as np
import pytest

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import State, TrueContext
from longarm_comp.sim.hidden import catalogue, drives, geometry, loads
from longarm_comp.sim.hidden.catalogue import OUTSIDE_EVERY_LIBRARY, typical_context
from studies import true_camera as camera
from studies.random_arms import paper_mix, random_arm
from studies.true_camera import HIDDEN, CameraEffect, draw, hidden, make_truth, seen_tip

G = 9.81
LIBRARY = (
    *("joint_zero", "dh_error", "base_pose", "camera_pose"),
    *(
        "joint_compliance",
        "bearing_tilt",
        "link_stiffness",
        "tip_payload",
        "link_mass",
        "telescope_clearance",
    ),
    *("base_compliance", "measured_tilt", "gravity_direction", "backlash", "friction_hysteresis"),
    *(
        "gear_eccentricity",
        "joint_gain",
        "joint_coupling",
        "prismatic_pitch",
        "servo_droop",
        "servo_deadband",
        "servo_quantisation",
    ),
    *(
        "friction_memory",
        "servo_lag",
        "base_settling",
        "thermal_growth",
        "thermal_softening",
        "creep",
        "camera_scale",
        "camera_radial",
        "camera_drift",
    ),
)


def lever(**more: Any) -> Arm:
    """A rigid lever of 0.5 m that a horizontal motor lifts, with 2 kg at its end.

    q = 0 is level along x; the motor's axis is -y, so that q lifts.
    """
    return Arm.parse(
        {
            "name": "lever",
            "convention": "mdh_craig",
            "tip": {"frame": 1, "position_m": [0.5, 0, 0]},
            "gravity_mps2": [0, 0, -G],
            "joints": [{"id": 1, "type": "revolute", "alpha_deg": 90, "limits_deg": [-90, 90]}],
            "point_masses": [{"name": "w", "frame": 1, "mass_kg": 2.0, "position_m": [0.5, 0, 0]}],
            "camera": {"position_m": [0.5, -2.0, 0.0]},
        }
        | more,
        "test",
    )


def angle(arm: Arm, effect: Any, q: float = 0.0, **context: Any) -> float:
    """Angle at which the lever comes to rest."""
    tip = TrueArm(arm, [effect]).tip(np.array([q]), TrueContext(**context))
    return float(np.arctan2(tip[2], tip[0]))


def test_the_library_and_more_are_there() -> None:
    assert set(LIBRARY) | set(OUTSIDE_EVERY_LIBRARY) == set(HIDDEN)


@pytest.mark.parametrize("name", HIDDEN)
def test_dose(twin: Arm, name: str) -> None:
    """No dose no shift; the wanted size is met; half the dose is about half the shift."""
    rng = np.random.default_rng(5)
    poses = rng.uniform(twin.lower, twin.upper, (25, twin.n))
    context = typical_context(len(poses), twin, rng)
    effect = draw(name, twin, rng, 3.0, poses)
    assert effect.name == name
    sound = TrueArm(twin, steps=2).tip(poses, context)  # as sizes are drawn

    def rms_mm(dose: float) -> float:
        moved = seen_tip(effect.scale_by(dose), twin, poses, context, sound) - sound
        return 1e3 * float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))

    assert rms_mm(0.0) < 1e-9
    slack = 0.3 if name == "servo_quantisation" else 0.2  # another draw of the context
    assert rms_mm(1.0) == pytest.approx(3.0, rel=slack)
    assert rms_mm(0.5) == pytest.approx(0.5 * rms_mm(1.0), rel=slack)


def test_unknown_name_lists_the_known_ones(twin: Arm, rng: np.random.Generator) -> None:
    with pytest.raises(InputError, match="joint_compliance"):
        hidden("joint_complaince", twin, 1.0, rng)
    with pytest.raises(InputError, match="moves this arm"):
        draw("prismatic_pitch", lever(), rng, 1.0)


def test_sides_are_not_mixed_up(twin: Arm, rng: np.random.Generator) -> None:
    one, two = (hidden(n, twin, 1.0, rng) for n in ("camera_scale", "joint_zero"))
    true, eye = make_truth(twin, (one, two))
    assert (list(true.hidden), eye.effects) == ([two], (one,))
    with pytest.raises(InputError, match="CameraScale"):
        TrueArm(twin, [one])  # type: ignore[list-item]


def test_same_seed_same_effect(twin: Arm) -> None:
    one, two = (draw("gear_eccentricity", twin, np.random.default_rng(3), 2.0) for _ in range(2))
    assert np.array_equal(one.amplitude, two.amplitude)  # type: ignore[union-attr]


def test_joint_compliance_yields_under_the_true_torque() -> None:
    """theta = -c m g l cos(theta), solved by iteration."""
    c = 0.02
    theta = 0.0
    for _ in range(100):
        theta = -c * 2.0 * G * 0.5 * np.cos(theta)
    found = angle(lever(), loads.JointCompliance(np.array([c])))
    assert found == pytest.approx(theta, abs=1e-9)
    assert TrueArm(lever()).settle(np.zeros(1)).torques[0, 0] == pytest.approx(-2.0 * G * 0.5)


def test_base_compliance_tilts_the_same_lever() -> None:
    same = angle(lever(), loads.BaseCompliance(np.full(2, 0.02)))
    assert same == pytest.approx(angle(lever(), loads.JointCompliance(np.array([0.02]))), abs=1e-9)


def test_bearing_tilt_leans_across_the_axis() -> None:
    """A standing post with an offset load leans by c m g times the offset that it then has."""
    post = lever(
        joints=[{"id": 1, "type": "revolute", "d_m": 1.0, "limits_deg": [-90, 90]}],
        tip={"frame": 1},
        point_masses=[{"name": "w", "frame": 1, "mass_kg": 1.0, "position_m": [0.2, 0, 0]}],
    )
    tip = TrueArm(post, [loads.BearingTilt(np.array([0.01]))]).tip(np.zeros(1))
    lean = np.arctan2(tip[0], tip[2])
    assert lean == pytest.approx(0.01 * G * (np.sin(lean) + 0.2 * np.cos(lean)), abs=1e-9)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("q", [0.0, np.radians(89.0)])
def test_backlash_follows_the_load_else_the_approach(side: float, q: float) -> None:
    effect = drives.Backlash(np.array([0.01]), gate=1.0)
    loaded = 2.0 * G * 0.5 * np.cos(q) > 1.0
    expected = -0.01 if loaded else -0.01 * side
    assert angle(lever(), effect, q, approach=np.array([side])) - q == pytest.approx(expected)


def test_friction_stops_short_of_the_command() -> None:
    effect = drives.FrictionHysteresis(np.array([0.01]))
    assert angle(lever(), effect, approach=np.array([1.0])) == pytest.approx(-0.01)
    assert angle(lever(), effect, approach=np.array([-1.0])) == pytest.approx(0.01)
    assert angle(lever(), effect) == pytest.approx(0.0)


def test_a_servo_that_lags_has_a_share_of_its_way_to_go() -> None:
    effect = drives.ServoLag(np.array([0.01]))
    assert angle(lever(), effect, 0.3, way=np.array([0.5])) == pytest.approx(0.295)
    assert angle(lever(), effect, 0.3, way=np.array([-0.2])) == pytest.approx(0.302)
    assert angle(lever(), effect, 0.3) == pytest.approx(0.3)


def test_a_servo_sags_and_rests_at_the_edge_of_its_deadband() -> None:
    sag = drives.ServoDroop(np.array([0.001]))
    edge = drives.ServoDeadband(np.array([0.004]), gate=0.1)
    assert angle(lever(), sag) == pytest.approx(-0.001 * 2 * G * 0.5, rel=1e-3)
    assert angle(lever(), edge) == pytest.approx(-0.004, rel=1e-3)


def test_servo_steps_gain_and_eccentricity() -> None:
    assert angle(lever(), drives.ServoQuantisation(np.array([0.1])), 0.27) == pytest.approx(0.3)
    assert angle(lever(), drives.JointGain(np.array([0.1])), 0.2) == pytest.approx(0.22)
    eccentric = drives.GearEccentricity(np.array([[0.01], [0.002]]), np.array([[0.3], [-0.5]]))
    expected = 0.2 + 0.01 * np.sin(0.5) + 0.002 * np.sin(-0.1)
    assert angle(lever(), eccentric, 0.2) == pytest.approx(expected)


def test_a_servo_rounds_what_it_is_told_wherever_it_stands_in_the_list() -> None:
    """0.27 rad is told as 0.3 rad; gain, zero and lost motion come after that."""
    told = drives.ServoQuantisation(np.array([0.1]))
    after = (
        drives.JointGain(np.array([0.1])),
        geometry.JointZero(np.array([0.04])),
        drives.FrictionHysteresis(np.array([0.02])),
    )
    up = TrueContext(np.array([[1.0]]))
    for chain in ((told, *after), (*after, told)):
        tip = TrueArm(lever(), chain).tip(np.array([0.27]), up)
        assert np.arctan2(tip[2], tip[0]) == pytest.approx(0.3 * 1.1 + 0.04 - 0.02)


def test_lengths_grow_with_temperature(twin: Arm) -> None:
    effect = geometry.ThermalGrowth(1e-4)
    weightless = twin.model_copy(update={"gravity_mps2": (0.0, 0.0, 0.0)})
    q = np.zeros((1, twin.n))
    cold = TrueArm(weightless, [effect]).tip(q, TrueContext(temperature_c=22.0))
    warm = TrueArm(weightless, [effect]).tip(q, TrueContext(temperature_c=32.0))
    assert np.allclose(cold, TrueArm(weightless).tip(q), atol=1e-12)
    assert np.allclose(warm, cold * (1 + 1e-3), rtol=0, atol=1e-12)


def test_creep_and_softness_act_on_the_sag(twin: Arm) -> None:
    q = twin.mid[None]
    sag = TrueArm(twin).tip(q) - _rigid(twin, q)
    soft = TrueArm(twin, [loads.LinkStiffness({b.name: 0.1 for b in twin.links})]).tip(q)
    assert (soft - _rigid(twin, q))[0, 2] == pytest.approx(1.1 * sag[0, 2], rel=2e-3)
    creep = TrueArm(twin, [loads.Creep(0.1, 100.0)])
    assert creep.tip(q, TrueContext(t_s=0.0))[0, 2] == pytest.approx(TrueArm(twin).tip(q)[0, 2])
    assert np.allclose(creep.tip(q, TrueContext(t_s=1e5)), soft, atol=1e-9)


def test_undeclared_payload_is_payload(twin: Arm) -> None:
    q = twin.mid[None]
    more = TrueArm(twin, [loads.TipPayload(0.1)]).tip(q)
    assert np.allclose(more, TrueArm(twin).tip(q, TrueContext(payload_kg=0.35)), atol=1e-12)


def test_telescope_droops_less_with_more_overlap(twin: Arm) -> None:
    effect = loads.TelescopeClearance(5e-4)
    q = np.repeat(twin.mid[None], 2, axis=0)
    q[:, 2] = twin.lower[2], twin.upper[2]
    droop = (TrueArm(twin, [effect]).tip(q) - TrueArm(twin).tip(q))[:, 2]
    assert droop[1] < droop[0] < 0


def test_tilted_gravity_is_a_tilted_base(twin: Arm, rng: np.random.Generator) -> None:
    """Tilting down and turning the result equals tilting the base the other way."""
    q = rng.uniform(twin.lower, twin.upper, (5, twin.n))
    level = TrueArm(twin, [geometry.GravityDirection(np.array([0.1, 0.0]))]).tip(q)
    tilted = TrueArm(twin, [geometry.BasePose(np.array([0, 0, 0, -0.1, 0, 0]))]).tip(q)
    c, s = np.cos(-0.1), np.sin(-0.1)
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    assert np.allclose(level @ turn.T, tilted, atol=1e-9)


def test_inclinometer_reads_the_tilt_that_acts(twin: Arm, rng: np.random.Generator) -> None:
    effect = hidden("measured_tilt", twin, 1.0, rng)
    assert isinstance(effect, loads.MeasuredTilt)
    q = rng.uniform(twin.lower, twin.upper, (1, twin.n))
    true = TrueArm(_weightless(twin), [effect])
    read = effect.readings(State.of(twin, q, TrueContext(t_s=500.0)))
    w = np.array([read["incl_0_x"][0], read["incl_0_y"][0], 0.0])
    tip, moved = _rigid(twin, q)[0], true.tip(q, TrueContext(t_s=500.0))[0]
    assert np.allclose(moved - tip, np.cross(w, tip + np.cross(w, tip) / 2), atol=1e-7)


def test_camera_effects_by_hand() -> None:
    points, t = np.array([[0.1, 0.2, 2.0], [0.0, 0.0, 1.5]]), np.array([0.0, 3600.0])
    radial = camera.CameraRadial(0.1).seen(points, t)
    assert np.allclose(radial, [[0.1 * 1.00125, 0.2 * 1.00125, 2.0], [0, 0, 1.5]])
    assert np.allclose(camera.CameraScale(0.01).seen(points, t), 1.01 * points)
    drift = camera.CameraDrift(np.array([1e-3, 0, 0, 0, 0, 0])).seen(points, t)
    assert np.allclose(drift, [points[0], [-1e-3, 0, 1.5]])
    turned = camera.CameraPose(np.array([0, 0, 0, 0, 0, np.pi / 2])).seen(points, t)
    assert np.allclose(turned[0], [0.2, -0.1, 2.0])


def test_arm_side_and_camera_side_are_apart() -> None:
    side = {
        n: isinstance(HIDDEN[n](lever6(), np.random.default_rng(0)), CameraEffect) for n in HIDDEN
    }
    assert {n for n, seen in side.items() if seen} == {n for n in HIDDEN if n.startswith("camera_")}


def lever6() -> Arm:
    """An arm with enough motors for every effect."""
    joints = [
        {"id": k, "type": "revolute", "alpha_deg": 90, "limits_deg": [-90, 90]} for k in (1, 2, 3)
    ]
    slide = {"id": 4, "type": "prismatic", "d_m": 0.3, "limits_m": [0, 0.1]}
    return lever(joints=[*joints, slide], tip={"frame": 4})


@pytest.mark.parametrize("name", ["link_mass", "cable_drag", "loose_screw", "cogging_bump"])
def test_effect_without_a_place_on_the_arm_is_refused(name: str) -> None:
    slides = [
        {"id": k, "type": "prismatic", "alpha_deg": 90 * (k - 1), "limits_m": [0, 0.3]}
        for k in (1, 2)
    ]
    with pytest.raises(InputError, match=f"{name}.* allowed: an effect that moves this arm"):
        catalogue.draw(name, lever(joints=slides), np.random.default_rng(0), 3.0)


def test_paper_mix_errs_as_the_paper_did(twin: Arm) -> None:
    """Table I: 17.7 mm uncompensated, 15.39 mm with the deflection alone."""
    rng = np.random.default_rng(2)
    arm = random_arm(rng, twin)
    assert arm.hash != twin.hash
    true, _ = make_truth(arm, paper_mix(rng, arm))
    poses = rng.uniform(arm.lower, arm.upper, (150, arm.n))
    tip = true.tip(poses, typical_context(len(poses), arm, rng))
    left = 1e3 * np.abs((tip - TrueArm(arm).tip(poses))[:, 2]).mean()
    raw = 1e3 * np.abs((tip - _rigid(arm, poses))[:, 2]).mean()
    assert left == pytest.approx(15.4, rel=0.15)
    assert 14.0 < raw < 23.0


def test_random_arms_differ_and_stand(twin: Arm) -> None:
    sags = []
    for seed in range(5):
        arm = random_arm(np.random.default_rng(seed), twin)
        q = arm.mid[None]
        sags.append(1e3 * (TrueArm(arm).tip(q) - _rigid(arm, q))[0, 2])
    assert np.std(sags) > 0.5
    assert np.all((np.array(sags) < -5) & (np.array(sags) > -30))


def _weightless(arm: Arm) -> Arm:
    return arm.model_copy(update={"gravity_mps2": (0.0, 0.0, 0.0)})


def _rigid(arm: Arm, q: np.ndarray) -> np.ndarray:
    return TrueArm(_weightless(arm)).tip(q)
