"""How the arm rings: modes beside finite elements and by hand, rings, shapers, and the true arm."""

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from finite_elements import fe_frequencies
from places import ROOT

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.plays import Backlash, TelescopeClearance
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.vibration.modes import find_modes
from longarm_comp.core.vibration.ring import find_ring, move_straight, ring_after, ring_of_moves
from longarm_comp.core.vibration.seen import (
    SeenWave,
    as_tips,
    correct_modes,
    find_least_steps,
    fit_waves,
)
from longarm_comp.core.vibration.shaper import find_shaper, find_way_modes, shaping
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.cameras import CameraPair, tag_plate
from longarm_comp.sim.hidden import loads
from longarm_comp.sim.plant import Plant, PlantConfig
from longarm_comp.sim.ringing import Ringing, compute_vibration
from longarm_comp.sim.servo_emulator.joints import read_arm
from studies.random_arms import random_arm
from studies.ringing import after

CONFIG = ROOT / "config"
ARM = Arm.load(CONFIG / "arm_demo.yaml")
SOFT = np.array([4e-3, 3e-3, 0.0, 2e-3, 5e-3, 2e-3, 0.0])
SOFT_ARM = declared_model(ARM).plus(
    *(JointCompliance(joint=k, compliance=c) for k, c in enumerate(SOFT.tolist(), 1) if c)
)
LEVER, HEAVY, GIVE = 0.8, 1.5, 4e-3
ONE = Arm.parse(
    {
        "name": "one joint",
        "convention": "mdh_craig",
        "tip": {"frame": 2},
        "joints": [
            {"id": 1, "type": "revolute", "limits_deg": [-170, 170]},
            {"id": 2, "type": "fixed", "a_m": LEVER},
        ],
        "point_masses": [{"name": "head", "frame": 2, "mass_kg": HEAVY}],
    },
    "one joint",
)
UPRIGHT = Model(ONE).plus(JointCompliance(joint=1, compliance=GIVE))
OMEGA = 1.0 / np.sqrt(GIVE * HEAVY * LEVER**2)


@pytest.mark.parametrize("seed", range(3))
def test_frequencies_are_those_of_finite_elements(seed: int) -> None:
    rng = np.random.default_rng(seed)
    arm = random_arm(rng, ARM)
    model = declared_model(arm)
    for q in (arm.lower, arm.upper, arm.lower + rng.random(arm.n) * (arm.upper - arm.lower)):
        found, told = find_modes(model, q).hz[:4], fe_frequencies(arm, q)
        np.testing.assert_allclose(found, told, rtol=0.02)
        np.testing.assert_allclose(found[:2], told[:2], rtol=0.006)


def test_a_mass_on_a_soft_joint_swings_as_by_hand() -> None:
    found = find_modes(UPRIGHT, np.zeros(1))
    assert found.omega == pytest.approx([OMEGA], rel=1e-6)
    assert found.hz == pytest.approx([OMEGA / (2.0 * np.pi)], rel=1e-6)
    np.testing.assert_allclose(np.abs(found.tip), [[0.0, 1.0 / np.sqrt(HEAVY), 0.0]], atol=1e-6)
    assert not len(find_modes(Model(ONE), np.zeros(1)).omega)


def test_what_is_as_good_as_rigid_does_not_ring() -> None:
    """A fit may leave a compliance that is next to nothing."""
    stiff = Model(ONE).plus(JointCompliance(joint=1, compliance=1e-18))
    ((found, ring),) = ring_of_moves(stiff, np.array([[0.4]]), 0.5, 0.02)
    assert len(found.omega) == 0 and ring.size_m() == 0.0
    visible = 0.5 / (9.81 / 1e-4 * HEAVY * LEVER**2)  # half of the least sag that is seen
    bending = Model(ONE).plus(JointCompliance(1, compliance=visible))
    assert len(find_modes(bending, ONE.mid).omega) == 1


def test_a_payload_slows_the_ring() -> None:
    light, heavy = (
        find_modes(declared_model(ARM), ARM.mid, Context(columns={"payload_kg": kg})).hz[0]
        for kg in (0.0, 1.0)
    )
    assert heavy < 0.75 * light


def test_play_does_not_swing_and_pads_that_give_do() -> None:
    plain = find_modes(SOFT_ARM, ARM.mid).hz
    played = SOFT_ARM.plus(
        Backlash(joint=2, width=5e-3), TelescopeClearance(joint=3, clearance=4e-4, give=0.0)
    )
    np.testing.assert_allclose(find_modes(played, ARM.mid).hz, plain, rtol=1e-3)
    gives = SOFT_ARM.plus(TelescopeClearance(joint=3, clearance=4e-4, give=1e-5))
    assert find_modes(gives, ARM.mid).hz[0] < 0.99 * plain[0]


def test_a_sudden_move_rings_by_its_whole_way_and_settles_by_its_damping() -> None:
    turn, damping = 0.01, 0.02
    found = find_modes(UPRIGHT, np.array([turn]))
    ring = find_ring(
        found, move_straight(np.zeros(1), np.array([turn]), 1e-4 / OMEGA), 1e-4 / OMEGA, damping
    )
    assert ring.at(np.zeros(1))[0] == pytest.approx([0.0, -turn * LEVER, 0.0], abs=1e-4 * LEVER)
    assert ring.size_m() == pytest.approx(turn * LEVER, rel=1e-3)
    expected = np.log(turn * LEVER / 1e-4) / (damping * OMEGA)
    assert ring.settle_s(1e-4) == pytest.approx(expected, rel=1e-3)
    assert ring.settle_s(1.0) == 0.0
    half = np.pi / (OMEGA * np.sqrt(1 - damping**2))
    assert ring.at(np.array([half]))[0, 1] == pytest.approx(
        turn * LEVER * np.exp(-damping * OMEGA * half), rel=1e-3
    )
    slow = find_ring(found, move_straight(np.zeros(1), np.array([turn]), 5.0), 5.0, damping)
    assert slow.size_m() < 0.05 * ring.size_m()


@pytest.mark.parametrize("damping", [0.0, 1.0, -0.1, float("nan")])
def test_a_damping_that_cannot_be_is_refused(damping: float) -> None:
    with pytest.raises(InputError, match="damping"):
        find_ring(
            find_modes(UPRIGHT, np.zeros(1)),
            move_straight(np.zeros(1), np.ones(1), 1.0),
            1.0,
            damping,
        )
    with pytest.raises(InputError, match="damping"):
        Ringing(TrueArm(ARM), damping)


def test_a_shaper_cancels_its_mode_and_forgives_a_wrong_frequency() -> None:
    way, seconds = move_straight(np.zeros(1), np.array([0.5]), 0.2), 0.2
    found = find_way_modes(UPRIGHT, way, seconds)
    assert [each.omega[0] for each in found] == pytest.approx([OMEGA] * len(found), rel=1e-4)
    shaper = find_shaper(found, way, seconds, 0.03)
    assert shaper is not None
    assert shaper.weights.sum() == pytest.approx(1.0) and (shaper.weights > 0.0).all()
    assert shaper.duration == pytest.approx(2.0 * np.pi / OMEGA, rel=1e-4)
    unshaped = find_ring(found[-1], way, seconds, 0.03).size_m()
    for factor, most in ((1.0, 0.01), (1.1, 0.04), (0.9, 0.04)):
        wrong = replace(found[-1], omega=factor * found[-1].omega)
        left = find_ring(wrong, shaper.shape_motion(way, seconds), seconds + shaper.duration, 0.03)
        assert left.size_m() < most * unshaped
    assert find_shaper([find_modes(Model(ONE), np.zeros(1))], way, seconds, 0.03) is None


def test_a_shaped_move_of_the_arm_leaves_little_straight_to_where_it_was_sent() -> None:
    """The true arm, by its own physics; its frequencies change by a fifth on the way."""
    true, took = TrueArm(ARM, [loads.JointCompliance(SOFT)]), 0.7
    start, end = ARM.mid + 0.2 * (ARM.upper - ARM.lower), ARM.mid - 0.1 * (ARM.upper - ARM.lower)
    way = move_straight(start, end, took)
    shaper = find_shaper(find_way_modes(SOFT_ARM, way, took), way, took, 0.01)
    assert shaper is not None
    ways = (way, took), (shaper.shape_motion(way, took), took + shaper.duration)
    plain, shaped = (
        np.abs(after(true, *sent).tip_ring(np.arange(0.0, 1.0, 0.01))).max() for sent in ways
    )
    assert plain > 0.01 and shaped < 0.02 * plain
    places = shaper.shape_motion(way, took)(np.linspace(0.0, took + shaper.duration, 50))
    np.testing.assert_allclose(places[[0, -1]], [start, end], atol=1e-12)
    shares = (places - start) / (end - start)
    np.testing.assert_allclose(shares, np.repeat(shares[:, :1], ARM.n, axis=1), atol=1e-12)


def test_the_true_arm_rings_as_the_model_says() -> None:
    true = TrueArm(ARM, [loads.JointCompliance(SOFT)])
    for q in (ARM.mid, ARM.upper):
        hz = compute_vibration(true, q).omega[:4] / (2.0 * np.pi)
        np.testing.assert_allclose(find_modes(SOFT_ARM, q).hz[:4], hz, rtol=0.03)
    start, end, took = ARM.mid + 0.015 * (ARM.upper - ARM.lower), ARM.mid, 0.5
    way = move_straight(start, end, took)
    ring = Ringing(true, 0.01)
    times = np.arange(0.0, took + 1.0, 2e-3)
    seen = np.array(
        [ring.move_joints(t, q) for t, q in zip(times.tolist(), way(times), strict=True)]
    )
    late = times >= took
    told = find_ring(find_modes(SOFT_ARM, end), way, took, 0.01).at(times[late] - took)
    assert np.abs(told).max() > 3e-4
    assert np.abs(seen[late] - told).max() < 0.15 * np.abs(told).max()


def test_the_true_arms_wave_goes_on_as_its_modes_change() -> None:
    true = TrueArm(ARM, [loads.JointCompliance(SOFT)])
    step, ring = 0.019 * (ARM.upper - ARM.lower), Ringing(true, 0.01)
    ring.move_joints(0.0, ARM.mid)
    before = [ring.move_joints(0.1 + 0.01 * k, ARM.mid + step) for k in range(2)]
    after = ring.move_joints(0.12, ARM.mid + 1.06 * step)  # beyond what one set of modes serves
    speed = np.linalg.norm(before[1] - before[0])
    assert np.linalg.norm(before[1]) > 1e-3
    assert np.linalg.norm(after - before[1]) < 2.0 * speed + 0.1 * np.linalg.norm(before[1])


def test_two_waves_are_found_in_noisy_sightings_with_what_is_known_of_them() -> None:
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.025, 0.045, 150))
    since = times - times[0]
    first = np.exp(-0.02 * 18.0 * since) * np.cos(18.0 * np.sqrt(1 - 0.02**2) * since)
    second = np.exp(-0.01 * 26.0 * since) * np.sin(26.0 * np.sqrt(1 - 0.01**2) * since)
    xyz = np.outer(first, [0.0, 1e-3, 6e-3]) + np.outer(second, [0.0, 3e-3, 0.0]) + 0.4
    found = fit_waves(times, xyz + 2e-4 * rng.standard_normal(xyz.shape))
    assert len(found) == 2
    for wave, omega, damping, size in zip(
        found, (18.0, 26.0), (0.02, 0.01), ([0.0, 1e-3, 6e-3], [0.0, 3e-3, 0.0]), strict=True
    ):
        assert abs(wave.hz - omega / (2 * np.pi)) < 4 * wave.hz_sd < 0.02
        assert abs(wave.damping - damping) < 4 * wave.damping_sd < 0.01
        np.testing.assert_allclose(wave.size, size, atol=2e-4)


def test_a_driver_shapes_by_the_damping_that_the_arm_declares() -> None:
    arm = SOFT_ARM.arm.model_copy(update={"damping": 0.2})
    way, took = move_straight(ARM.mid, ARM.mid + 0.1 * (ARM.upper - ARM.lower), 0.5), 0.5
    model = dataclasses.replace(SOFT_ARM, arm=arm)
    own = shaping(model, list(arm.joint_names), "a test")(way, took)
    wanted = find_shaper(find_way_modes(model, way, took), way, took, 0.2)
    assert own is not None and wanted is not None
    np.testing.assert_allclose(own.weights, wanted.weights)
    stood = move_straight(ARM.mid, ARM.mid, took)
    assert shaping(model, list(arm.joint_names), "a test")(stood, took) is None


def test_noise_is_no_wave_and_slow_cameras_are_refused() -> None:
    rng = np.random.default_rng(4)
    times = np.arange(100) / 30.0
    for _ in range(5):
        assert fit_waves(times, 2e-4 * rng.standard_normal((100, 3))) == []
    with pytest.raises(InputError, match="12 or more"):
        fit_waves(times[:11], np.zeros((11, 3)))
    with pytest.raises(InputError, match="one after the other"):
        fit_waves(times[::-1], np.zeros((100, 3)))


def test_what_numbers_are_rounded_by_is_no_wave_and_a_tiny_one_beyond_it_is() -> None:
    times = np.arange(300) / 100.0
    wave = (np.exp(-0.02 * 18.0 * times) * np.sin(18.0 * times))[:, None] * np.ones(3)
    for still, rounded in ((0.0, 1.0), (0.35, 0.0), (0.3, 1.0), (700.0, 0.6)):
        assert fit_waves(times, still + rounded * np.spacing(still) * wave) == []
    assert fit_waves(times[::3], 0.3 * np.ones((100, 3))) == []
    (tiny,) = fit_waves(times, 1.0 + 1e-10 * wave)
    assert tiny.hz == pytest.approx(18.0 / (2.0 * np.pi), rel=1e-3)
    assert tiny.damping == pytest.approx(0.02, rel=1e-3)


def test_encoders_at_the_joints_see_the_ring_and_those_at_motors_or_too_coarse_do_not() -> None:
    way, took = move_straight(ARM.mid, ARM.mid + 0.1 * (ARM.upper - ARM.lower), 0.5), 0.5
    end, since = way(np.array([took]))[0], np.arange(0.0, 3.0, 0.01)
    true = TrueArm(ARM, [loads.JointCompliance(SOFT)])
    read = end + after(true, way, took).joint_ring(since)
    slowest = compute_vibration(true, end).omega[:2] / (2.0 * np.pi)
    fine, coarse = (step * np.round(read / step) for step in (2e-5, 5e-2))
    found = fit_waves(since, fine)
    np.testing.assert_allclose(sorted(wave.hz for wave in found), slowest, rtol=0.01)
    np.testing.assert_allclose([wave.damping for wave in found], 0.01, rtol=0.1)
    assert (found[0].size[SOFT == 0.0] < 1e-5).all() and found[0].size.max() > 1e-4
    assert fit_waves(since, coarse) == []
    np.testing.assert_allclose(find_least_steps(fine)[SOFT > 0.0], 2e-5)
    model, other = declared_model(ARM), ARM.lower
    tips = as_tips(found, find_modes(model, end))
    told = correct_modes(find_modes(model, other), find_modes(model, end), tips).hz[0]
    stiff, soft = find_modes(model, other).hz[0], find_modes(SOFT_ARM, other).hz[0]
    assert abs(told - soft) < 0.5 * abs(stiff - soft)  # its frequency is carried to other postures
    assert not after(TrueArm(ARM), way, took).joint_ring(since).any()  # what bends is behind them


def test_a_move_tells_what_ring_it_leaves_in_numbers_and_words() -> None:
    start, end, took = ARM.mid + 0.1 * (ARM.upper - ARM.lower), ARM.mid, 0.4
    points, times = np.stack([start, end]), np.array([0.0, took])
    found = ring_after(SOFT_ARM, Context(), start, points, times)
    own = find_ring(find_modes(SOFT_ARM, end), move_straight(start, end, took), took, 0.01)
    assert found is not None and found.hz == pytest.approx(find_modes(SOFT_ARM, end).hz[0])
    assert found.size_m == pytest.approx(own.size_m(), rel=1e-6)
    assert found.settle_s == pytest.approx(own.settle_s(), rel=1e-5)
    assert f"{found.settle_s:.1f} s" in found.describe() and "assumed" in found.describe()
    slow = ring_after(SOFT_ARM, Context(), start, points[1:], np.array([5.0]))
    assert slow is not None and slow.size_m < 0.1 * found.size_m
    stays = ring_after(SOFT_ARM, Context(), end, end[None], np.zeros(1))
    assert stays is not None and stays.size_m == stays.settle_s == 0.0
    assert ring_after(Model(ONE), Context(), np.zeros(1), np.ones((1, 1)), np.ones(1)) is None


def test_a_ring_tells_what_weight_does_not() -> None:
    """Joint 1 turns about the vertical: at rest no weight bends it."""
    unknown = declared_model(ARM)
    soft = unknown.plus(JointCompliance(joint=1, compliance=6e-3))
    q, other = ARM.mid, ARM.lower + 0.7 * (ARM.upper - ARM.lower)
    np.testing.assert_allclose(unknown.tip(q), soft.tip(q), atol=2e-5)
    here, there = find_modes(unknown, q), find_modes(unknown, other)
    seen = [SeenWave(float(hz), 0.0, 0.01, 0.0, np.abs(tip)) for hz, tip in
            zip(find_modes(soft, q).hz[:2], find_modes(soft, q).tip[:2], strict=True)]  # fmt: skip
    true = find_modes(soft, other).hz[:2]
    assert np.abs(np.sort(there.hz[:2]) / true - 1.0).max() > 0.1
    found = np.sort(correct_modes(there, here, seen).hz[:2])
    np.testing.assert_allclose(found, true, rtol=0.06)
    assert correct_modes(there, here, []) is there


def test_the_running_simulation_rings_and_comes_to_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = CameraPair(
        position_m=(0.75, -1.7, 0.3), optical_axis=(0, 1, 0), baseline_m=0.3, focal_px=640.0,
        size=(640, 480),
    )  # fmt: skip
    servos = read_arm(CONFIG / "servo_driver.yaml")
    config = PlantConfig(ARM, servos, cameras, tag_plate(0.06, 0.012, 2, 2), np.eye(4), damping=0.1)
    plant = Plant(config, tmp_path / "bus", np.random.default_rng(0))
    q, still = plant.joints(), plant.tip_pose(0.0)[:3, 3]
    moved = q + 1e-3

    def off(t_s: float, now: np.ndarray) -> float:
        monkeypatch.setattr(plant, "joints", lambda: now)
        plant.ring(t_s)
        monkeypatch.setattr(plant, "joints", lambda: q)
        return float(np.linalg.norm(plant.tip_pose(t_s)[:3, 3] - still))

    assert off(0.0, q) == 0.0
    assert off(0.01, moved) > 1e-5
    assert off(20.0, moved) < 1e-7
