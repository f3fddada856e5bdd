"""`longarm servo scan` and `setup` on emulated buses: what is found is what is true there."""

from __future__ import annotations

import contextlib
import io
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import servo_bench
from cli_shell import Shell
from servo_bench import POSE_FLAGS, TRUE, bus, folder, hand, off_by, through_the_stops

from longarm_comp.arm_folder.check import of_record
from longarm_comp.arm_folder.measured import read_measured
from longarm_comp.cli import sweep_table
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_setup import ServoSetup
from longarm_comp.sim.servo_emulator import ServoEmulator

MODELS = {"feetech": "sts3215", "dynamixel": "xl430-w250"}
RIGHT = ("--id", "joint1=2", "--id", "joint2=1", "--direction", "joint1=-", "--direction",
         "joint2=+", "--direction", "joint3=-", "--yes", "--ids", "1-3")  # fmt: skip


@pytest.fixture(autouse=True)
def nobody_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    monkeypatch.setattr(sweep_table, "_STILL_S", 0.3)


@pytest.fixture(params=MODELS)
def emulator(request: pytest.FixtureRequest) -> Iterator[ServoEmulator]:
    with bus(request.param) as made:
        yield made


@pytest.fixture
def swept(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Ways along which a hand turns the servos once a sweep has begun; it ends no sooner."""
    ways: dict[str, Any] = {}
    original = sweep_table.swept

    def begun(setup: Any, seconds: float | None) -> object:
        turning, sweep = hand(ways["emulator"], ways["ways"]), setup.sweep
        setup.sweep = lambda done, seen: sweep(
            lambda *now: not turning.is_alive() and done(*now), seen
        )
        return original(setup, seconds)

    monkeypatch.setattr(sweep_table, "swept", begun)
    return ways


# ---- scan ---------------------------------------------------------------------------------------


def test_scan_finds_protocol_ids_models_and_two_servos_with_one_id(
    shell: Shell, emulator: ServoEmulator
) -> None:
    found = shell.json("servo", "scan", "--port", emulator.port, "--ids", "1-4")
    assert (found["protocol"], [s["servo_id"] for s in found["servos"]]) == (
        emulator.protocol, [1, 2, 3],
    )  # fmt: skip
    assert {s["model"] for s in found["servos"]} == {MODELS[emulator.protocol]}
    assert {s["firmware"] for s in found["servos"]} <= {"3.10", "45"}
    assert not any(s["clash"] for s in found["servos"])
    emulator.add_twin(2, 700.0)
    words = ("--port", emulator.port, "--protocol", emulator.protocol, "--baud", 1000000)
    said = shell.refused("servo", "scan", *words, "--ids", "1-3", code=3)
    assert "id" in said and "[2]" in said
    assert "two servos with this id" in shell.out


def test_scan_says_what_is_missing(shell: Shell, tmp_path: Path) -> None:
    with bus("feetech") as emulator:
        words = ("--port", emulator.port, "--protocol", "feetech", "--baud", 1000000)
        assert "powered" in shell.refused("servo", "scan", *words, "--ids", "7", code=3)
        assert "--ids" in shell.refused("servo", "scan", *words, "--ids", "5-2")
        assert "protocol" in shell.refused("servo", "scan", *words[:2], "--protocol", "can")
    assert "--port" in shell.refused("servo", "scan")
    assert "not usable" in shell.refused("servo", "scan", "--port", tmp_path / "no", code=3)


# ---- setup by flags -----------------------------------------------------------------------------


@pytest.mark.parametrize(("protocol", "zero"), [("feetech", "pose"), ("dynamixel", "sweep")])
def test_setup_finds_the_true_zeros(
    shell: Shell, swept: dict[str, object], protocol: str, zero: str
) -> None:
    mine = folder(shell, MODELS[protocol])
    with bus(protocol) as emulator:
        swept |= {"emulator": emulator, "ways": through_the_stops()}
        words = ("--port", emulator.port, "--sweep-s", 60, "--zero", zero, *RIGHT)
        pose = POSE_FLAGS if zero == "pose" else ()
        found = shell.json("servo", "setup", mine, *words, *pose)
        off = off_by(mine / "servo_driver.yaml", emulator)
        assert not any(emulator.torques_on().values())
    assert max(map(abs, off.values())) <= 1.0, off
    for name, stops in servo_bench.STOPS.items():
        ends = [value / servo_bench.UNITS[name] for value in found["joints"][name]["travel"]]
        assert ends == pytest.approx(stops, abs=0.2)
    text = (mine / "servo_driver.yaml").read_text()
    assert "# cycles a second" in text and f"port: {emulator.port}" in text
    file = mine / "servo_driver.yaml"
    assert [f.level for f in of_record(mine) if file.name in f.where] == ["measured"]
    file.write_text(text.replace("direction: -1", "direction: 1", 1))
    (listed,) = (f for f in of_record(mine) if file.name in f.where)
    assert listed.level == "unmeasured" and "joint1.direction" in listed.text
    measured = read_measured(mine)["servo_driver.yaml"]
    assert measured.values["joints.joint1.servo_id"] == 2 and measured.facts["zero"] == zero


def untouched(mine: Path, shell: Shell, *words: object, code: int = 3) -> str:
    """The error line of a setup that must leave the file as it was."""
    before = (mine / "servo_driver.yaml").read_bytes()
    said = shell.refused("servo", "setup", mine, *words, code=code)
    assert (mine / "servo_driver.yaml").read_bytes() == before
    assert sorted(p.name for p in mine.iterdir() if "measured" in p.name) == []
    return said


def test_the_end_of_the_turn_within_the_travel_is_refused(
    shell: Shell, swept: dict[str, object], emulator: ServoEmulator
) -> None:
    mine = folder(shell, MODELS[emulator.protocol])
    file = mine / "servo_driver.yaml"
    line = "joint2: {servo_id: 2, model: MODEL, type: revolute, zero_ticks: 2048.0, lower: -0.5, "
    line = line.replace("MODEL", MODELS[emulator.protocol]) + "upper: 0.8, max_velocity: 1.0}"
    file.write_text(re.sub(r"joint2: {.*}", line, file.read_text()))
    # Directly driven: 800 ticks to either side of 4000, so over the end of the turn.
    emulator.push(1, 4000.0)
    ways = through_the_stops() | {1: [3200.0, 4800.0, 4000.0]}
    swept |= {"emulator": emulator, "ways": ways}
    words = ("--port", emulator.port, "--sweep-s", 60, "--zero", "pose", *RIGHT)
    said = untouched(mine, shell, *words)
    assert "joint2" in said and "3200 to 4800" in said and "-1952 ticks" in said
    assert not any(emulator.torques_on().values())


def test_a_sweep_that_does_not_fit_is_refused(shell: Shell, swept: dict[str, object]) -> None:
    mine = folder(shell, "sts3215")
    with bus("feetech") as emulator:
        words = ("--port", emulator.port, "--sweep-s", 60, "--zero", "sweep", *RIGHT)
        ways = through_the_stops()
        swept |= {"emulator": emulator, "ways": ways | {2: [w + 2000 * (k == 0) for k, w in
                                                           enumerate(ways[2])]}}  # fmt: skip
        stops = ("--stops", "joint1=-60..60")
        assert "joint1 was swept over" in untouched(mine, shell, *words, *stops, code=2)
        swept["ways"] = {2: ways[2], 3: ways[3]}
        short = (*words[:2], "--sweep-s", 1, *words[4:])
        assert "joint2 did not move: is servo 1" in untouched(mine, shell, *short)


def test_an_arm_that_moves_and_torque_that_stays_on_are_told(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = folder(shell, "sts3215")
    original = ServoSetup.rest
    with bus("feetech") as emulator:
        words = ("--port", emulator.port, "--no-sweep", "--zero", "pose", *RIGHT)

        def shaken(setup: ServoSetup) -> object:
            read = setup._bus.read

            def moved(ids: list[int]) -> object:
                emulator.push(1, emulator.positions()[1] + 2.0)
                return read(ids)

            monkeypatch.setattr(setup._bus, "read", moved)
            return original(setup)

        monkeypatch.setattr(ServoSetup, "rest", shaken)
        assert "joint2 moves: hold the arm still" in untouched(mine, shell, *words)

        def unplugged(setup: ServoSetup) -> object:
            emulator.faults.silent.add(2)
            return original(setup)

        monkeypatch.setattr(ServoSetup, "rest", unplugged)
        assert "cut the power" in untouched(mine, shell, *words)


def test_what_nobody_is_there_to_answer_names_its_flag(shell: Shell) -> None:
    mine = folder(shell, "sts3215")
    with bus("feetech") as emulator:
        words = ["--port", emulator.port, "--no-sweep", "--zero", "pose", *RIGHT]
        for flag, count in (("--port", 2), ("--no-sweep", 1), ("--zero", 2), ("--direction", 2),
                            ("--yes", 1)):  # fmt: skip
            at = words.index(flag)
            named = "--sweep-s" if flag == "--no-sweep" else flag
            left = [*words[:at], *words[at + count :]]
            assert f"{named}: 'missing'" in untouched(mine, shell, *left, code=2)
        assert "--direction: 'up'" in untouched(
            mine, shell, *words, "--direction", "joint1=up", code=2
        )
        assert "--pose" in untouched(mine, shell, *words, "--pose", "elbow=3", code=2)
        wrong = [word.replace("joint1=2", "joint1=1") for word in words]
        assert "an id that no other joint has" in untouched(mine, shell, *wrong, code=2)
        half = [word.replace("joint1=2", "joint1=2.5") for word in words]
        assert "--id: '2.5'; allowed: JOINT=ID, a whole" in untouched(mine, shell, *half, code=2)
        for flag in ("--nudge", "--sweep-s"):
            for size in ("nan", "inf", "0"):
                assert f"{flag}: " in untouched(mine, shell, *words, flag, size, code=2)
        lost = [word.replace("joint1=2", "joint1=9") for word in words]
        assert "servo 9 of joint1 is not on the bus" in untouched(mine, shell, *lost)
        assert shell("servo", "setup", mine, *words) == 0
        assert "now" in shell.out
    assert "servo file" in shell.refused("servo", "setup", shell.folder)


# ---- setup in a dialogue ------------------------------------------------------------------------


class Terminal:
    """``longarm`` in a process of its own, on a terminal."""

    def __init__(self, *words: object) -> None:
        self._master, slave = pty.openpty()
        self._text = ""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "longarm_comp", *map(str, words)],
            stdin=slave, stdout=slave, stderr=slave, start_new_session=True,
            env={**os.environ, "COLUMNS": "200", "TERM": "xterm"},
        )  # fmt: skip
        os.close(slave)

    def until(self, *words: str) -> str:
        """Read until one of the words was said since the last one, and return it."""
        while not (found := [word for word in words if word in self._text]):
            assert select.select([self._master], [], [], 60.0)[0], self._text
            self._text += os.read(self._master, 4096).decode(errors="replace")
        self._text = self._text.split(found[0], 1)[1]
        return found[0]

    def say(self, text: str) -> None:
        os.write(self._master, f"{text}\n".encode())

    def read_while(self, lasting: Callable[[], bool]) -> None:
        while lasting():
            if select.select([self._master], [], [], 0.05)[0]:
                with contextlib.suppress(OSError):
                    self._text += os.read(self._master, 4096).decode(errors="replace")

    def stop(self) -> int:
        """SIGTERM until it ends: one that comes just before a read of the terminal waits for it."""
        ends = time.monotonic() + 300.0
        while self.process.poll() is None and time.monotonic() < ends:
            self.process.send_signal(signal.SIGTERM)
            again = time.monotonic() + 5.0
            self.read_while(lambda by=again: self.process.poll() is None and time.monotonic() < by)
        return self.end()

    def end(self) -> int:
        ends = time.monotonic() + 300.0
        self.read_while(lambda: self.process.poll() is None and time.monotonic() < ends)
        assert self.process.poll() is not None, self._text
        os.close(self._master)
        return self.process.returncode


def test_a_dialogue_finds_exchanged_servos_and_a_broken_off_one_leaves_nothing(
    shell: Shell,
) -> None:
    mine = folder(shell, "sts3215")
    before = (mine / "servo_driver.yaml").read_bytes()
    with bus("feetech") as emulator:
        words = ("servo", "setup", mine, "--ids", "1-3", "--nudge", 1)
        broken = Terminal(*words, "--port", emulator.port, "--no-sweep", "--zero", "pose", "--yes",
                          "--id", "joint1=1", "--id", "joint2=2", "--id", "joint3=3")  # fmt: skip
        broken.until("joint1: which way")
        assert all(emulator.torques_on().values())
        assert broken.stop() == 130
        assert not any(emulator.torques_on().values())
        assert (mine / "servo_driver.yaml").read_bytes() == before
        at = emulator.positions()
        for servo_id in at:
            emulator.push(servo_id, through_the_stops()[servo_id][-1])

        talk = Terminal(*words, *POSE_FLAGS)
        talk.until("serial port")
        talk.say(emulator.port)
        for name in TRUE:
            talk.until(f"{name}: servo id")
            talk.say("")
        talk.until("hold or support")
        talk.say("y")
        talk.until("joint3", "silent")
        turning = hand(emulator, through_the_stops())
        talk.read_while(turning.is_alive)
        talk.until("✓")
        talk.say("")
        talk.until("zeros from")
        talk.say("pose")
        talk.until("hold it still")
        talk.say("")
        talk.until("Stand clear")
        talk.say("")
        rest, told = emulator.positions(), []
        while talk.until("which way", "goes off again") == "which way":
            at = emulator.positions()
            servo_id = max(at, key=lambda i: abs(at[i] - rest[i]))
            name = next(n for n, true in TRUE.items() if true.servo_id == servo_id)
            asked = ("joint1", "joint1", "joint2", "joint3")[len(told)]
            grew = (at[servo_id] - rest[servo_id]) * TRUE[name].direction > 0
            told.append(name if name != asked else "+" if grew else "-")
            talk.say(told[-1])
        assert told[0] == "joint2" and set(told[1:]) == {"+", "-"}
        talk.say("")
        talk.until("will be written")
        talk.say("y")
        talk.until("read back")
        assert talk.end() == 0
        off = off_by(mine / "servo_driver.yaml", emulator)
        assert not any(emulator.torques_on().values())
    assert max(map(abs, off.values())) <= 1.0, off
    config = ServoConfig.load(mine / "servo_driver.yaml")
    assert {n: (j.servo_id, j.direction) for n, j in config.joints.items()} == {
        n: (true.servo_id, true.direction) for n, true in TRUE.items()
    }
