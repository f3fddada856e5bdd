"""`make soak` in small, and its ledger: what must never happen is noticed."""

import json
import mmap
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from places import ROOT

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from std_srvs.srv import SetBool

from longarm_comp.core.errors import InputError
from longarm_comp.nodes import interfaces as graph
from soak import run
from soak.leaks import LeakWatch
from soak.ledger import Ledger
from soak.scene import Scene
from soak.setting import SoakSettings

Q = (0.1, 0.2)


def ledger() -> Ledger:
    made = Ledger()
    made.target(1, 0.0, good=True)
    made.target(2, 0.1, good=False)
    return made


def test_good_books_balance() -> None:
    made = ledger()
    made.trajectory(Q)  # may come before its answer
    made.answer(1, 0, False, "", Q)
    made.answer(2, 4, True, "position [nan, 0] is not finite", ())
    made.close()
    assert not made.wrong
    assert dict(made.reasons) == {"position": 1}
    assert not made.waiting


def test_everything_that_must_not_happen_is_noticed() -> None:
    made = ledger()
    made.answer(1, 0, False, "", Q)
    made.answer(1, 0, False, "", Q)
    made.answer(9, 0, False, "", Q)
    made.answer(2, 4, True, "", Q)
    made.close()
    assert dict(made.wrong) == {
        "answered twice": 1,
        "answer to no target": 1,
        "refused without a reason": 1,
        "refused but executed": 1,
        "executed but no trajectory": 2,
    }
    made = ledger()
    made.answer(2, 0, False, "", Q)
    made.trajectory(Q)
    made.trajectory(Q)
    made.close()
    assert dict(made.wrong) == {
        "a bad target was accepted": 1,
        "target without an answer": 1,
        "trajectory that no target asked for": 1,
    }
    made = ledger()
    assert made.late(20.0, 10.0) == 2
    made.answer(1, 0, False, "", ())
    assert dict(made.wrong) == {"accepted but not executed": 1}


def test_a_process_that_grows_is_a_leak() -> None:
    watch = LeakWatch(least=10)
    held: list[mmap.mmap] = []  # pages of their own: the heap has freed ones to give
    files = []
    try:
        for _ in range(20):
            held.append(mmap.mmap(-1, 8_000_000))
            held[-1].write(b"x" * 8_000_000)
            files.append(Path(os.devnull).open())  # noqa: SIM115
            watch.sample("greedy", os.getpid())
        greedy = watch.growth()
    finally:
        for file in files:
            file.close()
    assert greedy[0].leaks
    assert greedy[0].memory_mb[1] - greedy[0].memory_mb[0] > 20
    still = LeakWatch(least=10)
    for _ in range(20):
        still.sample("still", os.getpid())
    assert not still.growth()[0].leaks
    short = LeakWatch(still.least + 20, still._seen).growth()
    assert [(g.judged, g.leaks) for g in short] == [(False, None)]
    still.sample("gone", 2**22 + 1)
    assert len(still.growth()) == 1


def test_settings_are_checked(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="rate_hz"):
        SoakSettings(tmp_path, rate_hz=0.0)


@pytest.mark.long
def test_half_a_minute_of_faults(ros_domain: int, tmp_path: Path) -> None:
    words = ["--hours", "0.008", "--fault-every", "2", "--seed", "2", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "soak", *words, "--out", str(tmp_path)],
        cwd=ROOT / "test",
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads(done.stdout)
    assert report["passed"]
    assert not report["wrong"] and not report["crashes"]
    assert report["targets"] > 20
    assert report["faults"]
    refused = sum(n for status, n in report["answers_by_status"].items() if int(status) > 2)
    assert refused == sum(report["refusals"].values())
    assert report["leaks_judged"] == 0 and all(g["leaks"] is None for g in report["growth"])
    assert {g["name"] for g in report["growth"]} & {"simulated_arm", "kinematics"}


class StuckStop:
    """An emergency stop that is never released."""

    name = "stuck stop"

    def strike(self, scene: Scene) -> None:
        """Stop."""
        client = graph.ESTOP.client(scene.client.node, of="servo_driver")
        assert scene.client.call(client, SetBool.Request(data=True)).success


class DeafPredictor:
    """A predictor that hangs: it is there and never answers."""

    name = "deaf predictor"

    def strike(self, scene: Scene) -> None:
        """Halt the process; the end of the soak kills it."""
        os.kill(scene.supervisor.pid("error_predictor"), signal.SIGSTOP)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        pytest.param(StuckStop(), "servo_driver is stopped", id="stop"),
        pytest.param(DeafPredictor(), "status 1", id="predictor", marks=pytest.mark.long),
    ],
)
@pytest.mark.long
def test_an_arm_that_stays_dead_fails_the_soak(
    fault: StuckStop | DeafPredictor,
    said: str,
    ros_domain: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(run, "faults", lambda setting: [fault])
    setting = SoakSettings(tmp_path, hours=0.02, rate_hz=5.0, fault_s=0.5, patience_s=4.0)
    report = run.soak(setting, threading.Event())
    assert not report["passed"]
    assert not report["crashes"]
    (wrong,) = report["wrong"]
    assert wrong.startswith(f"no recovery after {fault.name}: ") and said in wrong
