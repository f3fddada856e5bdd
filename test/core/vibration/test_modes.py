"""`longarm modes`, and the rest that it gives to measurements."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from bag_robot import command, robot, sighting, state
from cli_shell import Shell
from places import DEMO_ARM as ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.vibration.modes import find_modes
from longarm_comp.core.vibration.ring import REST_S, rest_s, ring_of_moves


@pytest.fixture
def shell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Shell:
    (tmp_path / "arm.yaml").write_text(ARM.read_text() + "damping: 0.02\n")
    return Shell(tmp_path, capsys)


def test_the_command_prints_modes_and_the_time_to_rest(shell: Shell) -> None:
    arm = Arm.load(ARM)
    printed = shell.json("modes", shell.folder / "arm.yaml")
    assert printed["damping"] == 0.02
    rows = printed["rows"]
    assert [(row["posture"], row["mode"]) for row in rows[:7:6]] == [(0, 1), (1, 1)]
    assert rows[6]["hz"] == pytest.approx(find_modes(declared_model(arm), arm.mid).hz[0])
    (_, lower), (_, middle), _ = ring_of_moves(
        declared_model(arm), np.stack([arm.lower, arm.mid, arm.upper]), 0.5, 0.02
    )
    assert rows[0]["settle_s"] == pytest.approx(lower.settle_s())
    assert rows[6]["settle_s"] == pytest.approx(middle.settle_s()) and middle.settle_s() > 1.0
    assert np.linalg.norm([rows[0][f"tip_{axis}"] for axis in "xyz"]) == pytest.approx(1.0)
    quick = shell.json("modes", shell.folder / "arm.yaml", "--damping", 0.2)["rows"]
    assert quick[6]["settle_s"] < 0.2 * rows[6]["settle_s"]


def test_a_ring_that_was_seen_is_printed_and_corrects(shell: Shell) -> None:
    arm = Arm.load(ARM)
    hz = 0.9 * find_modes(declared_model(arm), arm.lower).hz[0]
    times = np.arange(0.0, 4.0, 0.03)
    way = find_modes(declared_model(arm), arm.lower).tip[0]
    wave = np.exp(-0.03 * 2 * np.pi * hz * times) * np.cos(2 * np.pi * hz * times)
    noise = 1e-4 * np.random.default_rng(0).standard_normal((len(times), 3))
    xyz = [*(0.4 + 5e-3 * np.outer(wave, way / np.linalg.norm(way)) + noise)]
    rows = [",".join(map(str, (t, *p))) for t, p in zip(times, xyz, strict=True)]
    (shell.folder / "tip.csv").write_text("\n".join(["t_s,x,y,z", *rows, "9,,,"]) + "\n")
    at = shell.folder / "tip.csv"
    printed = shell.json("modes", shell.folder / "arm.yaml", "--ring", at)
    (seen,) = printed["seen"]
    assert seen["hz"] == pytest.approx(hz, rel=0.01)
    assert seen["damping"] == pytest.approx(0.03, rel=0.1)
    assert printed["rows"][0]["hz"] == pytest.approx(hz, rel=0.01)
    at.write_text("t_s,x,y,z\n0,1,1,1\n")
    assert "12 or more" in shell.refused("modes", shell.folder / "arm.yaml", "--ring", at)


def test_a_ring_of_joint_readings_is_printed_with_what_encoders_cannot_see(shell: Shell) -> None:
    times, arm = np.arange(0.0, 4.0, 0.02), Arm.load(ARM)
    wave = np.exp(-0.02 * 30.0 * times) * np.cos(30.0 * times)
    at, size = shell.folder / "joints.csv", np.array([2e-3, 1e-3, 0, 0, 0, 0, 0])

    def told(step: float) -> list[dict[str, object]]:
        readings = step * np.round((arm.lower + np.outer(wave, size)) / step)
        rows = [",".join(map(str, (t, *p))) for t, p in zip(times, readings, strict=True)]
        names = [f"read_q{k}" for k in range(1, 8)]
        at.write_text("\n".join([",".join(["t_s", *names]), *rows]) + "\n")
        printed = shell.json("modes", shell.folder / "arm.yaml", "--ring", at)
        assert "encoder sees only what bends before it" in shell.err
        return printed["seen"]

    seen, *_ = told(1e-5)
    assert seen["hz"] == pytest.approx(30.0 / (2 * np.pi), rel=0.01)
    np.testing.assert_allclose(seen["size_rad_m"], size, atol=2e-4)
    assert "than one step" not in shell.err
    assert told(1e-2) == [] and "than one step" in shell.err
    at.write_text("t_s,read_q1\n0,1\n")
    assert "read_q2" in shell.refused("modes", shell.folder / "arm.yaml", "--ring", at)


def recorded_ring(
    path: Path, arm: Arm, *, camera_hz: float, swing: tuple[float, float], states: bool = True
) -> None:
    """A bag of two commands, and of the ring after the second: of the tip, m, and the joints, rad.

    The first also leaves one, at another frequency.
    """
    with robot(path) as put:
        for begin, q, w in ((0.0, arm.lower, 11.0), (5.0, arm.mid, 19.0)):
            command(put, begin, [*q], names=arm.joint_names)
            before = arm.mid if begin == 0.0 else arm.lower
            for k in range(250):
                t = begin + 0.02 * k
                since = 0.02 * (k - 50)
                wave = (k >= 50) * np.exp(-0.02 * w * since) * np.cos(w * since)
                way = before + min(1.0, t - begin) * (q - before)
                if states:
                    state(put, t, [*(way + swing[1] * wave)], known=arm.joint_names)
                if k % round(50 / camera_hz) == 0:
                    tip = [0.4, 0.3 * min(1.0, t - begin), 0.2 + swing[0] * wave]
                    sighting(put, t + 1e-3, tip)


def test_a_ring_is_taken_from_a_bag_after_its_last_command(shell: Shell) -> None:
    arm, hz = Arm.load(shell.folder / "arm.yaml"), 19.0 / (2.0 * np.pi)
    ask = ("modes", shell.folder / "arm.yaml", "--ring")
    recorded_ring(shell.folder / "tip", arm, camera_hz=25, swing=(4e-3, 0.0))
    printed = shell.json(*ask, shell.folder / "tip")
    (seen,) = printed["seen"]
    assert seen["hz"] == pytest.approx(hz, rel=0.01)
    assert seen["damping"] == pytest.approx(0.02, rel=0.05)
    assert seen["size_mm"] == pytest.approx([0.0, 0.0, 4.0], abs=0.2)
    rows, unseen = printed["rows"], shell.json(*ask[:2])["rows"]
    assert [row["posture"] for row in rows[::6]] == [0, 1, 2, 3]  # where it rang comes first
    factor = rows[0]["hz"] / find_modes(declared_model(arm), arm.mid).hz[0]
    assert factor != pytest.approx(1.0, abs=0.01)
    assert rows[6]["hz"] == pytest.approx(factor * unseen[0]["hz"])

    recorded_ring(shell.folder / "joints", arm, camera_hz=1, swing=(0.0, 1e-3))
    (seen,) = shell.json(*ask, shell.folder / "joints")["seen"]
    assert seen["hz"] == pytest.approx(hz, rel=0.01) and len(seen["size_rad_m"]) == arm.n

    recorded_ring(shell.folder / "blind", arm, camera_hz=25, swing=(4e-3, 0.0), states=False)
    assert "joint_states" in shell.refused(*ask, shell.folder / "blind")
    with robot(shell.folder / "idle") as put:
        sighting(put, 1.0, [0.4, 0.0, 0.2])
    assert "joint_trajectory" in shell.refused(*ask, shell.folder / "idle")


def test_bad_input_is_refused_in_words(shell: Shell) -> None:
    arm = shell.folder / "arm.yaml"
    assert "damping" in shell.refused("modes", arm, "--damping", 0)
    assert "time of a move" in shell.refused("modes", arm, "--move", 0)
    arm.write_text(ARM.read_text() + "damping: 1.5\n")
    assert "damping" in shell.refused("modes", arm)


def test_rest_is_computed_where_the_damping_is_declared() -> None:
    arm = Arm.load(ARM)
    q = np.stack([arm.lower, arm.upper] * 5)
    known = arm.model_copy(update={"damping": 0.02})
    assert rest_s(declared_model(arm), q, 0.5, None) == REST_S
    assert rest_s(declared_model(known), q, 0.5, 1.5) == 1.5
    ring = ring_of_moves(declared_model(known), q, 0.5, 0.02)
    longest = max(left.settle_s() for _, left in ring)
    assert REST_S < 0.5 * longest < rest_s(declared_model(known), q, 0.5, None) <= longest
    assert rest_s(Model(known), q, 0.5, None) == REST_S  # rigid


def test_the_damping_makes_no_other_arm_of_it(tmp_path: Path) -> None:
    held = yaml.safe_load(ARM.read_text())
    assert Arm.parse(held | {"damping": 0.02}, "arm").hash == Arm.load(ARM).hash
