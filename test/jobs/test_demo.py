"""`longarm demo` in small: the whole loop over real processes, its clean-up, its verdict."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from cli_shell import Shell

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model_file import load_model
from longarm_comp.jobs import demo as table
from longarm_comp.jobs.demo import DemoSettings, demonstrate, prepare
from longarm_comp.jobs.targets import Trial
from longarm_comp.sessions.read import read_session

SMALL = ("--poses", "60", "--targets", "6")


def demo(*words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "longarm_comp", "demo", *words],
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def nodes_of(process: subprocess.Popen[str]) -> list[int]:
    """Living processes that this one's supervisor started."""
    mark = f"LONGARM_SUPERVISOR={process.pid}".encode()
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if mark in (entry / "environ").read_bytes().split(b"\0"):
                    found.append(int(entry.name))
            except OSError:  # ended meanwhile, or not ours
                continue
    return found


@pytest.mark.long
def test_the_loop_brings_the_arm_nearer_to_its_targets(ros_domain: int, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    process = demo("--out", str(out), *SMALL, "--json")
    said, noise = process.communicate(timeout=1500)  # a busy machine
    assert process.returncode == 0, noise
    report = json.loads(said)
    assert report == json.loads((out / "demo.json").read_text())
    rows = {row["model"]: row for row in report["rows"]}
    learned = [] if report["network_refused"] else [table.LEARNED]
    assert list(rows) == [table.ORIGINAL, table.DECLARED, table.FOUND, *learned]
    true_mm = [row["true_mean_mm"] for row in rows.values()]
    assert true_mm[1] < 0.7 * true_mm[0]
    assert max(true_mm[2:]) < 0.05 * true_mm[1]
    for row in rows.values():  # the cameras tell nearly what is true
        assert row["n"] == 6
        assert abs(row["mean_mm"] - row["true_mean_mm"]) < 0.3
    assert true_mm[-1] < true_mm[2] + 0.05  # a network that does not help is not put to work
    named = {name for names in report["effects_found"] for name in names}
    assert {"joint_compliance", "backlash"} <= named
    assert "servo_droop" not in named  # readings tell a servo that gives way from a shaft
    assert report["hidden"] == "joint_compliance=8.0 backlash=3.0"
    page = Path(report["files"]["report"]).read_text()
    assert report["diagnosis"].split(":")[0] in page
    assert "ERROR" not in noise
    assert "poses driven, " in noise and "targets driven" in noise  # what the job does ...
    assert "programs" not in noise  # ... and not what a node is busy with
    assert "no joint_states" not in noise
    arm = Arm.load(DemoSettings(out).arm)
    assert (arm.steps > 0).all()
    session = read_session(out / "session", arm)
    assert len(session) == report["collected"]
    assert len(session) >= 60
    assert (session.approach != session.approach[:, :1]).any()
    load_model(out / "model.yaml", arm)
    assert not nodes_of(process)

    again = demo("--out", str(out), *SMALL)
    assert again.wait(timeout=300) == 2  # what is there is not overwritten


def test_it_drives_both_runs_and_collects_until_ctrl_c_ends_every_process(
    ros_domain: int, tmp_path: Path
) -> None:
    out = tmp_path / "demo"
    process = demo("--out", str(out), "--poses", "60", "--targets", "2")
    end = time.monotonic() + 300.0  # a busy machine
    while not (out / "session" / "metadata.yaml").is_file():
        assert time.monotonic() < end and process.poll() is None
        time.sleep(0.1)
    assert len(nodes_of(process)) == 5
    os.kill(process.pid, signal.SIGINT)
    os.kill(process.pid, signal.SIGINT)
    _, noise = process.communicate(timeout=300)
    assert process.returncode == 130, noise
    assert noise.splitlines()[-1] == "longarm: interrupted"
    assert not nodes_of(process)
    done = json.loads((out / "steps.json").read_text())
    original, declared = (
        {key: np.array(value) for key, value in done[f"run: {name}"].items() if key != "name"}
        for name in (table.ORIGINAL, table.DECLARED)
    )
    for run in (original, declared):  # the cameras tell nearly what is true
        np.testing.assert_allclose(run["seen"], run["true"], atol=5e-4)
    misses = [np.linalg.norm(run["true"] - run["target"], axis=1) for run in (original, declared)]
    assert misses[1].mean() < 0.7 * misses[0].mean()


@pytest.mark.parametrize(
    "words",
    [("--poses", "3"), ("--targets", "0"), ("--hidden", "ghosts=2"), ("--arm", "no_such_arm")],
)
def test_bad_input_is_one_line(words: tuple[str, str], shell: Shell) -> None:
    shell.refused("demo", "--out", "demo", *words)


def test_the_logs_of_a_failed_start_block_no_other(tmp_path: Path) -> None:
    (tmp_path / "demo" / "log").mkdir(parents=True)
    settings = DemoSettings(tmp_path / "demo", arm=tmp_path / "no.yaml")
    with pytest.raises(InputError, match=r"no\.yaml"):
        demonstrate(settings, threading.Event())
    prepare(settings)
    (tmp_path / "demo" / "model.yaml").write_text("")
    with pytest.raises(InputError, match="new or empty"):
        prepare(settings)


def test_a_worse_arm_is_told() -> None:
    rng = np.random.default_rng(1)
    target = rng.normal(size=(10, 3))

    def trial(name: str, size: float) -> Trial:
        moved = target + size * rng.normal(size=target.shape)
        return Trial(name, target, moved, moved, np.zeros(10))

    assert table.is_improved([trial("original", 1e-2), trial("effect found + network", 1e-3)])
    assert not table.is_improved([trial("original", 1e-3), trial("effect found + network", 1e-2)])
    seen = trial("original", 1e-3)
    lost = Trial("original", target, np.where(np.arange(10)[:, None] < 4, np.nan, seen.seen),
                 seen.true, seen.status)  # fmt: skip
    assert table.table_row(lost)["n"] == 6
