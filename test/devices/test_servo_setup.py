"""`longarm servo scan` and `setup` on emulated buses: what is found is what is true there."""

import math
import re
from collections.abc import Iterator
from contextlib import closing
from itertools import cycle
from pathlib import Path

import pytest
from cli_shell import Shell
from faulty_bus import FaultyBus
from servo_bench import MODELS, POSE, POSE_FLAGS, TRUE, bus, folder, off_by, store
from servo_terminal import RIGHT, Terminal

from longarm_comp.arm_folder.check import check_record
from longarm_comp.arm_folder.measured import read_measured
from longarm_comp.devices.kept_turns import KeptTurns
from longarm_comp.devices.servo_bus.registry import models, open_bus, scan_line
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_setup import ServoSetup
from longarm_comp.devices.state_folder import state_folder
from longarm_comp.devices.stop_latch import Stop, StopLatch, kept_stops
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator

pytestmark = pytest.mark.usefixtures("nobody_there")


@pytest.fixture(params=MODELS)
def emulator(request: pytest.FixtureRequest) -> Iterator[FaultyBus]:
    with bus(request.param) as made:
        yield made


# ---- scan ---------------------------------------------------------------------------------------


def test_scan_finds_protocol_ids_models_and_two_servos_with_one_id(
    shell: Shell, emulator: FaultyBus
) -> None:
    patient = ("--timeout", 0.05)  # also on a busy machine
    found = shell.json("servo", "scan", "--port", emulator.port, "--ids", "1-4", *patient)
    assert (found["protocol"], [s["servo_id"] for s in found["servos"]]) == (
        emulator.protocol, [1, 2, 3],
    )  # fmt: skip
    assert {s["model"] for s in found["servos"]} == {MODELS[emulator.protocol]}
    assert {s["firmware"] for s in found["servos"]} <= {"3.10", "45"}
    assert not any(s["clash"] for s in found["servos"])
    emulator.add_twin(2, 700.0)
    words = ("--port", emulator.port, "--protocol", emulator.protocol, "--baud", 1000000)
    said = shell.refused("servo", "scan", *words, "--ids", "1-3", *patient, code=3)
    assert "id" in said and "[2]" in said
    assert "two servos with this id" in shell.out


def test_answers_that_come_too_late_are_not_taken_for_a_second_servo() -> None:
    with bus("feetech") as emulator:
        emulator.faults.delays_s[1] = 0.5  # with time-outs that a busy machine keeps
        found = scan_line(emulator.port, "feetech", 1000000, [1, 2, 3], 0.2, lambda *_: None)
    assert found is not None
    assert [(s.servo_id, s.clash) for s in found.servos][-2:] == [(2, False), (3, False)]


class EverySecond(dict[int, float]):
    """Delays (s) of every second answer of the servos."""

    turns = cycle((False, True))

    def get(self, servo_id: int, default: float = 0.0) -> float:  # type: ignore[override]
        return self[servo_id] if next(self.turns) else default


def test_a_servo_whose_answers_come_late_now_and_then_is_no_second_servo() -> None:
    """On a busy computer: two of six too late were "damaged or doubled"."""
    with bus("feetech") as emulator:
        emulator.faults.delays_s = EverySecond({2: 0.12})
        found = scan_line(emulator.port, "feetech", 1000000, [2], 0.05, lambda *_: None)
    assert found is not None
    assert [(s.servo_id, s.clash) for s in found.servos] == [(2, False)]


def test_scan_says_what_is_missing(shell: Shell, tmp_path: Path) -> None:
    with bus("feetech") as emulator:
        words = ("--port", emulator.port, "--protocol", "feetech", "--baud", 1000000)
        assert "powered" in shell.refused("servo", "scan", *words, "--ids", "7", code=3)
        assert "--ids" in shell.refused("servo", "scan", *words, "--ids", "5-2")
        assert "protocol" in shell.refused("servo", "scan", *words[:2], "--protocol", "can")
    assert "--port" in shell.refused("servo", "scan")
    assert "not usable" in shell.refused("servo", "scan", "--port", tmp_path / "no", code=3)


# ---- setup by flags -----------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", MODELS)
def test_setup_finds_the_true_zeros(shell: Shell, protocol: str) -> None:
    mine = folder(shell, MODELS[protocol])
    with bus(protocol) as emulator:
        turns = KeptTurns(state_folder(), str(mine / "arm.yaml"), emulator.port, TRUE)
        turns.keep(frozenset(TRUE), within_s=None)  # before this setup
        found = shell.json("servo", "setup", mine, "--port", emulator.port, *RIGHT, *POSE_FLAGS)
        turns = KeptTurns(state_folder(), str(mine / "arm.yaml"), emulator.port, TRUE)
        at = emulator.positions()
        assert turns.away == {
            name for name, true in TRUE.items() if not 0 <= at[true.servo_id] < 4096
        }
        off = off_by(mine / "servo_driver.yaml", emulator)
        assert not any(emulator.torques_on().values())
    assert max(map(abs, off.values())) <= 1.0, off
    for name, value in POSE.items():
        assert found["joints"][name]["now"] == pytest.approx(value, abs=TRUE[name].si_per_tick)
    text = (mine / "servo_driver.yaml").read_text()
    assert "# cycles a second" in text and f"port: {emulator.port}" in text
    file = mine / "servo_driver.yaml"
    assert [f.level for f in check_record(mine) if file.name in f.where] == ["measured"]
    assert read_measured(mine)["servo_driver.yaml"].facts["zero"] == "pose"


def test_setup_is_patient_with_the_servos_of_its_file(shell: Shell) -> None:
    """A scan asks 253 ids and cannot wait long for each."""
    mine = folder(shell, "sts3215")
    with bus("feetech") as emulator:
        emulator.faults.delays_s = {3: 0.06}
        line = ("--port", emulator.port)
        assert shell("servo", "setup", mine, *line, *RIGHT, *POSE_FLAGS) == 0, shell.err


def untouched(mine: Path, shell: Shell, *words: object, code: int = 3) -> str:
    """The error line of a setup that must leave the file as it was."""
    before = (mine / "servo_driver.yaml").read_bytes()
    said = shell.refused("servo", "setup", mine, *words, code=code)
    assert (mine / "servo_driver.yaml").read_bytes() == before
    assert sorted(p.name for p in mine.iterdir() if "measured" in p.name) == []
    return said


def test_a_turn_that_ends_within_the_limits_is_refused(
    shell: Shell, emulator: ServoEmulator
) -> None:
    mine = folder(shell, MODELS[emulator.protocol])
    file = mine / "servo_driver.yaml"
    line = "joint2: {servo_id: 2, model: MODEL, type: revolute, zero_ticks: 2048.0, lower: -0.5, "
    line = line.replace("MODEL", MODELS[emulator.protocol]) + "upper: 0.8, max_velocity: 1.0}"
    file.write_text(re.sub(r"joint2: {.*}", line, file.read_text()))
    emulator.push(2, 4000.0)  # directly driven: 0.8 rad are 522 ticks, over the end of the turn
    pose = ("--pose", "joint1=-60", "--pose", "joint3=20")
    said = untouched(mine, shell, "--port", emulator.port, *RIGHT, *pose, code=2)
    assert "joint2.upper" in said and "multi_turn" in said
    assert not any(emulator.torques_on().values())


def test_an_arm_that_moves_and_torque_that_stays_on_are_told(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = folder(shell, "sts3215")
    original = ServoSetup.rest
    with bus("feetech") as emulator:
        words = ("--port", emulator.port, *RIGHT)

        def shaken(setup: ServoSetup) -> object:
            read = setup._bus.read

            def moved(ids: list[int]) -> object:
                emulator.push(2, emulator.positions()[2] + 2.0)
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
        words = ["--port", emulator.port, *RIGHT, *POSE_FLAGS]
        for flag, count in (("--port", 2), ("--direction", 2), ("--yes", 1)):
            at = words.index(flag)
            left = [*words[:at], *words[at + count :]]
            assert f"{flag}: 'missing'" in untouched(mine, shell, *left, code=2)
        for name, value in (("--direction", "joint1=up"), ("--pose", "elbow=3"),
                            ("--pose", "joint1=nan")):  # fmt: skip
            assert f"{name}: " in untouched(mine, shell, *words, name, value, code=2)
        assert not any(emulator.torques_on().values())
        file = mine / "servo_driver.yaml"
        text = file.read_text()
        file.write_text(text.replace("servo_id: 2", "servo_id: 9"))
        assert "servo 9 of joint2 is not on the bus" in untouched(mine, shell, *words)
        file.write_text(text)
        assert shell("servo", "setup", mine, *words) == 0
        assert "now" in shell.out
    for words in (("setup", shell.folder), ("set-id", 5, "--arm", shell.folder)):
        assert "servo file" in shell.refused("servo", *words)


@pytest.mark.parametrize("by", ["port", "file", "folder"])
def test_nothing_moves_under_a_stop(shell: Shell, by: str, tmp_path: Path) -> None:
    """A driver was killed under a stop or a hold: its servos stay as they are."""
    mine = folder(shell, "sts3215")
    file, state = mine / "servo_driver.yaml", state_folder()
    if by == "folder":
        state = tmp_path / "stops"
        text, given = file.read_text(), f"state: {state}"
        file.write_text(text.replace('state: ""', given))
        assert given in file.read_text()
    with bus("feetech") as emulator:
        port = emulator.port if by != "file" else "/dev/elsewhere"
        latch = StopLatch(state, "/left", "" if by == "port" else str(mine / "arm.yaml"), port)
        latch.ask(Stop.HOLD)
        latch.keep()
        servos = dict.fromkeys((1, 2, 3), models()["sts3215"])
        with closing(open_bus("feetech", emulator.port, 1000000, servos, 0.2)) as line:
            line.torque([1, 2, 3], on=True)
        bus_there = ("--port", emulator.port, "--timeout", 0.2)  # also on a busy machine
        words = (*bus_there, *RIGHT, *POSE_FLAGS)
        assert "held since" in untouched(mine, shell, *words)
        only = (*bus_there, "--ids", "1", *(("--arm", mine) if by != "port" else ()))
        assert "held since" in shell.refused("servo", "set-id", 5, *only, code=3)
        assert 5 not in emulator.torques_on()
        assert all(emulator.torques_on().values())
        with latch.lift_stops(Stop.HOLD):
            pass
        assert shell("servo", "setup", mine, *words) == 0, shell.err


def test_stops_without_a_driver_are_shown_and_ended_one_by_one(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    for port in ("/dev/a", "/dev/b"):
        latch = StopLatch(state_folder(), "/", "", port)
        latch.ask(Stop.ESTOP)
        latch.keep()
    assert shell("reset", "--kept") == 3 and "no answer" in shell.err
    assert len(kept_stops(state_folder())) == 2
    assert shell("reset", "--kept", "--yes") == 0
    assert "port /dev/a" in shell.err and "port /dev/b" in shell.err
    assert not kept_stops(state_folder())
    assert shell("reset", "--kept") == 0 and "nothing to reset" in shell.err


@pytest.mark.parametrize("protocol", MODELS)
@pytest.mark.parametrize("turns", [-1, 1])
def test_turns_counted_from_another_turn_are_refused_where_nobody_can_cut_the_power(
    shell: Shell, protocol: str, turns: int
) -> None:
    mine = folder(shell, MODELS[protocol])
    with bus(protocol) as emulator:
        emulator.push(2, emulator.positions()[2] + 4096 * turns)
        said = untouched(mine, shell, "--port", emulator.port, *RIGHT, *POSE_FLAGS)
        assert "give it back with joint2 at 0.0 deg, less than 18.0 deg off (" in said
        assert "cut the servos' power" in said and "without --yes" in said
        assert not any(emulator.torques_on().values())


@pytest.mark.parametrize("shifts", [True, False])
@pytest.mark.parametrize("turns", [-1, 0, 1])
def test_zero_with_a_stored_offset_is_not_a_turn_off_after_power_on(
    shell: Shell, shifts: bool, turns: int
) -> None:
    """A Feetech servo may count from 0 to 4095 with the offset in it, or without."""
    mine, offset = folder(shell, "sts3215"), 300

    def turn_on(emulator: FaultyBus, encoder: float) -> None:
        emulator.power_cycle(2)
        emulator.push(2, encoder % 4096 if shifts else offset + (encoder - offset) % 4096)

    with bus("feetech") as emulator:
        store(emulator, 2, 31, 2, offset)
        for encoder in (100.0, 1000.0, 4000.0):  # of joint2 at 0
            turn_on(emulator, encoder)
            emulator.push(2, emulator.positions()[2] + 4096 * turns)
            pose = ("--pose", "joint1=-60", "--pose", "joint3=20")
            if shell("servo", "setup", mine, "--port", emulator.port, *RIGHT, *pose) == 0:
                joint = ServoConfig.load(mine / "servo_driver.yaml").joints["joint2"]
                turn_on(emulator, encoder)
                assert joint.to_si(emulator.positions()[2] - offset) == pytest.approx(0.0, abs=1e-3)
            else:
                assert turns or encoder != 1000.0, shell.err
                assert "homing_offset or reversal has to be set to 0" in shell.err


# ---- setup in a dialogue ------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", MODELS)
def test_a_zero_measured_in_a_held_pose_is_true_after_every_power_on(
    shell: Shell, protocol: str
) -> None:
    """Powered at 30 degrees, which is more than a turn of a geared servo from 0."""
    mine, true = folder(shell, MODELS[protocol]), TRUE["joint2"]

    def turn_on(emulator: FaultyBus, degrees: float) -> None:
        """Give the power back with the joint there: the servo counts from one turn."""
        emulator.power_cycle(2)
        emulator.push(2, true.ticks(math.radians(degrees)) % 4096)

    with bus(protocol) as emulator:
        turn_on(emulator, 30.0)
        pose = ("--pose", "joint1=-60", "--pose", "joint2=30", "--pose", "joint3=20")
        signs = ("--direction", "joint1=-", "--direction", "joint2=+", "--direction", "joint3=-")
        talk = Terminal("servo", "setup", mine, "--ids", "1-3", *pose, *signs,
                        "--port", emulator.port)  # fmt: skip
        talk.until("hold or support")
        talk.say("y")
        for again in (True, False):
            talk.until("joint2 30.0 deg")
            talk.say("y")
            if again:
                talk.until("joint2 at 0.0 deg, less than 18.0 deg off")
                turn_on(emulator, 0.0)
                emulator.push(2, true.ticks(math.radians(30.0)))
                talk.say("y")
        talk.until("will be written")
        talk.say("y")
        assert talk.end() == 0
        joint = ServoConfig.load(mine / "servo_driver.yaml").joints["joint2"]
        for degrees in (-15.0, 0.0, 15.0):
            turn_on(emulator, degrees)
            reads = math.degrees(joint.to_si(emulator.positions()[2]))
            assert reads == pytest.approx(degrees, abs=0.02)  # two ticks


def test_a_dialogue_finds_directions_and_a_broken_off_one_leaves_nothing(shell: Shell) -> None:
    mine = folder(shell, "sts3215")
    before = (mine / "servo_driver.yaml").read_bytes()
    with bus("feetech") as emulator:
        words = ("servo", "setup", mine, "--ids", "1-3")
        broken = Terminal(*words, "--port", emulator.port, "--yes")
        broken.until("joint1: which way")
        assert all(emulator.torques_on().values())
        assert broken.stop() == 130
        assert not any(emulator.torques_on().values())
        assert (mine / "servo_driver.yaml").read_bytes() == before
        for name, true in TRUE.items():
            emulator.push(true.servo_id, true.ticks(POSE[name]))

        talk = Terminal(*words, *POSE_FLAGS)
        talk.until("serial port")
        talk.say(emulator.port)
        talk.until("hold or support")
        talk.say("y")
        talk.until("hold it still")
        talk.say("")
        talk.until("Stand clear")
        talk.say("")
        rest = emulator.positions()
        for name, true in TRUE.items():
            talk.until(f"{name}: which way")
            grew = (emulator.positions()[true.servo_id] - rest[true.servo_id]) * true.direction > 0
            if name == "joint1":
                talk.say("again")
                talk.until(f"{name}: which way")
            talk.say("+" if grew else "-")
        talk.until("goes off again")
        talk.say("")
        talk.until("will be written")
        talk.say("y")
        talk.until("zero_ticks")
        assert talk.end() == 0
        off = off_by(mine / "servo_driver.yaml", emulator)
        assert not any(emulator.torques_on().values())
    assert max(map(abs, off.values())) <= 1.0, off
    config = ServoConfig.load(mine / "servo_driver.yaml")
    assert {n: j.direction for n, j in config.joints.items()} == {
        n: true.direction for n, true in TRUE.items()
    }
