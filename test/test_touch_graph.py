"""`longarm touch` on a graph: rows of joints at rest, names, undo, end; real rclpy over DDS."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from quick_arm import QuickArm, quick_arm
from touching import ARM, DISTANCES, EXAMPLE, errors_of_the_drawing, touching

import longarm_comp as la
from longarm_comp.cli import touch as touch_command
from longarm_comp.core.errors import InputError
from longarm_comp.jobs.client import ArmClient
from longarm_comp.jobs.touch import READINGS, TouchLog, resting
from longarm_comp.nodes.interfaces import JOINT_STATES


def pressed(arm: QuickArm, monkeypatch: pytest.MonkeyPatch, keys: list[str | np.ndarray]) -> None:
    """Somebody at the keys: joints (n,) move the arm there first, then press Enter."""
    left = iter(keys)

    def asked(prompt: str) -> str:
        key = next(left, "end")
        if isinstance(key, str):
            return key
        arm.stand(key)
        return ""

    monkeypatch.setattr(touch_command, "_asked", asked)


def run(*words: str) -> str:
    done = CliRunner().invoke(touch_command.command, [str(EXAMPLE / "arm.yaml"), *words])
    assert done.exit_code == 0, (done.output, done.exception)
    return done.output + done.stderr


def test_a_session_is_recorded_key_by_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = touching(errors_of_the_drawing(), 16)
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
        refused = CliRunner().invoke(touch_command.command, again)
        assert isinstance(refused.exception, InputError)
        pressed(arm, monkeypatch, ["front_0", rows.q[0]])
        run("-o", str(out), "--resume")
    found = la.read_session(out, ARM)
    assert len(found) == 18
    np.testing.assert_allclose(found.q[:16], rows.q, atol=1e-9)
    assert list(found.labels["touch"]) == [*rows.labels["touch"], "", "front_0"]
    assert list(found.labels["plane"]) == [""] * 16 + ["table", ""]
    assert found.touch_distances == tuple((*d[:3], 1e-4) for d in DISTANCES)
    held = yaml.safe_load((tmp_path / "touches.yaml").read_text(encoding="utf-8"))
    assert len(held["touch_distances"]) == 3


def test_a_row_is_what_the_joints_read_after_they_came_to_rest() -> None:
    with quick_arm(ARM, lambda q: False) as arm, ArmClient(ARM, "", None, "touch") as client:
        ways = ARM.mid + np.linspace(0.0, 0.4, 12)[:, None] * np.ones(ARM.n)
        arm._way = [q.copy() for q in ways]  # it moves while it is asked
        found = resting(client)
    np.testing.assert_allclose(found, ways[-1], atol=1e-9)
    assert READINGS > 1


def test_readings_that_waited_to_be_heard_are_passed_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nobody listens while a calibration is computed; what was queued then is of the last pose."""
    monkeypatch.setattr("longarm_comp.jobs.touch.READINGS", JOINT_STATES.depth // 2)
    queued: list[object] = []
    full = threading.Event()
    with quick_arm(ARM, lambda q: False) as arm, ArmClient(ARM, "", None, "touch") as client:
        resting(client)
        publish = arm._joints.publish

        def counted(message: object) -> None:
            publish(message)
            queued.append(message)
            if len(queued) > 2 * JOINT_STATES.depth:
                full.set()

        monkeypatch.setattr(arm._joints, "publish", counted)
        assert full.wait(60.0)
        arm.stand(ARM.mid + 0.3)
        found = resting(client)
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
