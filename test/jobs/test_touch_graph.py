"""`longarm touch` on a graph: rows of joints at rest, names, undo, end; real rclpy over DDS."""

import dataclasses
import threading
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from quick_arm import QuickArm, quick_arm
from std_msgs.msg import String
from touching import ARM, DISTANCES, EXAMPLE, errors_of_the_drawing, touching

import longarm_comp as la
from longarm_comp.cli import collect
from longarm_comp.core.errors import InputError
from longarm_comp.jobs.client import ArmClient
from longarm_comp.jobs.touch import READINGS, TouchLog, wait_for_rest
from longarm_comp.nodes.interfaces import CONTACT, JOINT_STATES
from longarm_comp.nodes.simulated_arm import numbers
from longarm_comp.sessions.csv import write_csv
from longarm_comp.share import folder
from longarm_comp.sim.cameras import CameraPair, tag_plate
from longarm_comp.sim.plant import Plant, PlantConfig
from longarm_comp.sim.servo_emulator.joints import read_arm


def pressed(arm: QuickArm, monkeypatch: pytest.MonkeyPatch, keys: list[str | np.ndarray]) -> None:
    """Somebody at the keys: joints (n,) move the arm there first, then press Enter."""
    left = iter(keys)

    def asked(prompt: str, _: object) -> str:
        key = next(left, "end")
        if isinstance(key, str):
            return key
        arm.stand(key)
        return ""

    monkeypatch.setattr(collect, "_ask_line", asked)


def run(*words: str) -> str:
    done = CliRunner().invoke(collect.touch, [str(EXAMPLE / "arm.yaml"), *words])
    assert done.exit_code == 0, (done.output, done.exception)
    return done.output + done.stderr


def test_a_session_is_recorded_key_by_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = touching(errors_of_the_drawing(), 10)
    out = tmp_path / "touches.csv"
    keys: list[str | np.ndarray] = []
    for q, name in zip(rows.q, rows.labels["touch"], strict=True):
        keys += [str(name), q]
    wrong = rows.q[0] + 0.2
    with quick_arm(ARM, lambda q: False) as arm:
        pressed(arm, monkeypatch, [*keys[:4], wrong, "undo", *keys[4:], "plane table", rows.q[3]])
        known: list[str] = []
        for one, other, length, _ in DISTANCES:
            known += ["--distance", one, other, str(length)]
        said = run("-o", str(out), *known)
        assert "mm from their points in the mean" in said
        again = [str(EXAMPLE / "arm.yaml"), "-o", str(out)]
        refused = CliRunner().invoke(collect.touch, again)
        assert isinstance(refused.exception, InputError)
        pressed(arm, monkeypatch, ["front_0", rows.q[0]])
        run("-o", str(out), "--resume")
    found = la.read_session(out, ARM)
    assert len(found) == 12
    np.testing.assert_allclose(found.q[:10], rows.q, atol=1e-9)
    assert list(found.labels["touch"]) == [*rows.labels["touch"], "", "front_0"]
    assert list(found.labels["plane"]) == [""] * 10 + ["table", ""]
    assert found.touch_distances == tuple((*d[:3], 1e-4) for d in DISTANCES)
    held = yaml.safe_load((tmp_path / "touches.yaml").read_text(encoding="utf-8"))
    assert len(held["touch_distances"]) == 3


def test_what_a_file_holds_stays_when_touches_are_added(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "touches.csv"
    rows = touching(errors_of_the_drawing(), 3)
    role, operator = np.array(["train", "", "test"]), np.array(["anna"] * 3)
    written = dataclasses.replace(
        rows,
        index=np.array([10, 11, 14]),
        repeat_id=np.array([7, -1, 7]),
        labels={**rows.labels, "role": role, "operator": operator},
        columns={"incl_2_x": np.array([0.1, np.nan, 0.2])},
        touch_distances=DISTANCES[:1],
    )
    write_csv(written, out)
    one, other, length, _ = DISTANCES[0]
    with quick_arm(ARM, lambda q: False) as arm:
        pressed(arm, monkeypatch, ["plane table", rows.q[0], "undo", "undo", "a", rows.q[1]])
        run("-o", str(out), "--resume", "--distance", "a", "b", "0.07")
    found = la.read_session(out, ARM)
    assert found.index.tolist() == [10, 11, 12] and found.repeat_id.tolist() == [7, -1, -1]
    np.testing.assert_allclose(found.q, rows.q[[0, 1, 1]], atol=1e-9)
    assert found.labels["role"].tolist() == ["train", "", ""]
    assert found.labels["operator"].tolist() == ["anna", "anna", ""]
    assert found.labels["touch"].tolist() == [*rows.labels["touch"][:2], "a"]
    np.testing.assert_array_equal(found.columns["incl_2_x"], [0.1, np.nan, np.nan])
    assert found.touch_distances == (DISTANCES[0], ("a", "b", 0.07, 1e-4))
    text = out.read_text()
    monkeypatch.setattr(collect, "_ask_line", lambda *_: pytest.fail("it was asked"))
    longer = ("--distance", other, one, str(length + 0.01))
    for words in (("--resume", *longer), ("-o", str(tmp_path / "new.csv"), *longer)):
        given = [str(EXAMPLE / "arm.yaml"), "-o", str(out), "--by-hand", *words]
        refused = CliRunner().invoke(collect.touch, given)
        assert "as it is written already" in str(refused.exception)
    loaded = dataclasses.replace(found, columns={"temperature_c": np.full(3, 21.5)})
    write_csv(loaded, out)
    given = [str(EXAMPLE / "arm.yaml"), "-o", str(out), "--resume"]
    refused = CliRunner().invoke(collect.touch, given)
    assert "temperature_c: 'given'; allowed: a new file" in str(refused.exception)
    write_csv(found, out)
    assert out.read_text() == text


def test_known_distances_are_refused_before_a_row_is_written(tmp_path: Path) -> None:
    rows = touching(errors_of_the_drawing(), 3)
    write_csv(dataclasses.replace(rows, touch_distances=DISTANCES[:2]), tmp_path / "one.csv")
    with pytest.raises(InputError, match="other ones"):
        write_csv(dataclasses.replace(rows, touch_distances=DISTANCES[:1]), tmp_path / "two.csv")
    assert not (tmp_path / "two.csv").exists()


def test_a_row_is_what_the_joints_read_after_they_came_to_rest() -> None:
    with quick_arm(ARM, lambda q: False) as arm, ArmClient(ARM, "", None, "touch") as client:
        ways = ARM.mid + np.linspace(0.0, 0.4, 12)[:, None] * np.ones(ARM.n)
        arm.move(ways)  # it moves while it is asked
        found = wait_for_rest(client)
    np.testing.assert_allclose(found, ways[-1], atol=1e-9)
    assert READINGS > 1


def test_readings_that_waited_to_be_heard_are_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody listens while a calibration is computed; what was queued then is of the last pose."""
    monkeypatch.setattr("longarm_comp.jobs.touch.READINGS", JOINT_STATES.depth // 2)
    queued: list[object] = []
    full = threading.Event()
    with quick_arm(ARM, lambda q: False) as arm, ArmClient(ARM, "", None, "touch") as client:
        wait_for_rest(client)
        publish = arm._joints.publish

        def counted(message: object) -> None:
            publish(message)
            queued.append(message)
            if len(queued) > 2 * JOINT_STATES.depth:
                full.set()

        monkeypatch.setattr(arm._joints, "publish", counted)
        assert full.wait(300.0)
        arm.stand(ARM.mid + 0.3)
        found = wait_for_rest(client)
    np.testing.assert_allclose(found, ARM.mid + 0.3, atol=1e-9)


def test_a_bad_touch_shows_in_the_spread() -> None:
    rows = touching(errors_of_the_drawing(), 48)
    touches = TouchLog(ARM, DISTANCES)
    touches.begin_with(rows)
    before = touches.spread_m()
    assert before is not None
    assert before.mean() < 3e-4
    touches.rows.append((rows.q[0] + 0.01, "touch", "front_0"))
    after = touches.spread_m()
    assert after is not None
    assert after[-1] > 2e-3
    assert np.median(after[:-1]) < 5e-4


def test_rows_of_something_else_are_not_touches() -> None:
    seen = la.Session.record(ARM.mid[None], np.zeros((1, 3)))
    with pytest.raises(InputError, match="row 1: 'no touch'"):
        TouchLog(ARM).begin_with(seen)


def test_a_touch_outside_the_socket_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the graph feels for the ball: what was asked for outside is told and not written."""
    out = tmp_path / "touches.csv"
    with quick_arm(ARM, lambda q: False) as arm:
        felt = CONTACT.publisher(arm.node)
        seat = {"": ""}
        arm.node.create_timer(0.05, lambda: felt.publish(String(data=seat[""])))
        keys = iter([("", ARM.mid), ("a", ARM.mid + 0.1), ("", ARM.mid + 0.2)])

        def asked(prompt: str, _: object) -> str:
            key = next(keys, None)
            if key is None:
                return "end"
            seat[""], q = key
            arm.stand(q)
            return ""

        monkeypatch.setattr(collect, "_ask_line", asked)
        said = run("-o", str(out), "--name", "a")
    assert "touch a: the ball sits in no socket; nothing was recorded" in said
    np.testing.assert_allclose(la.read_session(out, ARM).q, [ARM.mid + 0.1], atol=1e-9)


def test_the_simulated_ball_slides_into_a_socket_where_servos_let_go(tmp_path: Path) -> None:
    arm = la.Arm.load(folder("config") / "arm_demo.yaml")
    servos = read_arm(folder("config") / "servo_driver.yaml")
    cameras = CameraPair(
        position_m=(0.75, -1.7, 0.3), optical_axis=(0, 1, 0), baseline_m=0.3, focal_px=640.0,
        size=(640, 480),
    )  # fmt: skip
    config = PlantConfig(arm, servos, cameras, tag_plate(0.06, 0.012, 2, 2), np.eye(4))
    tip = Plant(config, tmp_path / "bus", np.random.default_rng(0)).tip_pose(0.0)[:3, 3]
    near = tip + np.array([0.003, -0.004, 0.005])
    plant = Plant(config, tmp_path / "bus", np.random.default_rng(0))
    plant.carry(0.5)
    assert plant.payload_kg == 0.5
    assert 1e-4 < tip[2] - plant.tip_pose(0.0)[2, 3] < 0.1  # it hangs lower at once
    plant.carry(0.0)
    np.testing.assert_array_equal(plant.tip_pose(0.0)[:3, 3], tip)
    sockets = {"far": tip + np.array([0.0, 0.0, 0.02]), "near": near}
    config = dataclasses.replace(config, sockets=sockets)
    plant = Plant(config, tmp_path / "bus", np.random.default_rng(0))
    monkey = {j.servo_id: True for j in servos.joints}
    plant.emulator.torques_on = lambda: monkey  # type: ignore[method-assign]
    assert plant.contact(0.0) == ""
    np.testing.assert_allclose(plant.tip_pose(0.0)[:3, 3], tip, atol=1e-9)
    monkey.clear()
    assert [plant.contact(0.0) for _ in range(4)][-1] == "near"
    np.testing.assert_allclose(plant.tip_pose(0.0)[:3, 3], near, atol=5e-5)
    with pytest.raises(InputError, match=r"sockets: 'a=1,2'; allowed: name=x,y,z"):
        numbers("sockets", "a=1,2", 3, "name=x,y,z")
    found = numbers("sockets", "a=1,2,3 b=0,0,-0.5", 3, "name=x,y,z")
    assert found == {"a": [1, 2, 3], "b": [0, 0, -0.5]}
