"""What a setup of servos that was broken off leaves: written back to its arm, and to no other."""

import json
import os
from contextlib import closing
from pathlib import Path

import pytest
from cli_shell import Shell
from servo_bench import MODELS, configured, direct, folder, limit, stored, two
from servo_bench import bus as geared_bus
from servo_terminal import RIGHT, Terminal

from longarm_comp.core.errors import JobError
from longarm_comp.devices import setup_journal
from longarm_comp.devices.servo_arm import ServoArm
from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.registry import models, open_bus
from longarm_comp.devices.servo_config import BusConfig, ServoConfig
from longarm_comp.devices.servo_setup import ServoSetup
from longarm_comp.devices.setup_journal import SetupJournal
from longarm_comp.devices.state_folder import state_folder

THERE = {name: BusConfig(protocol=name, port="/dev/elsewhere") for name in MODELS}


pytestmark = pytest.mark.usefixtures("nobody_there")


class Broken(Exception):  # noqa: N818
    """Ends a setup before its end."""


def breaks_off(bus: SerialServoBus, config: ServoConfig, journal: SetupJournal) -> list[str]:
    """Break a setup off after it set the servos; what it said."""
    setup = ServoSetup(bus, config.joints, journal)
    with pytest.raises(Broken), setup.safely():
        raise Broken
    return setup.said


def drives(config: ServoConfig, journal: SetupJournal) -> list[str]:
    """What a driver says when it opens the port."""
    with closing(ServoArm(config, journal=journal)) as arm:
        return arm.said


@pytest.mark.parametrize("protocol", MODELS)
def test_what_a_setup_set_is_written_back_after_ctrl_c_and_after_a_kill(
    shell: Shell, protocol: str
) -> None:
    mine = folder(shell, MODELS[protocol])
    with geared_bus(protocol) as emulator:
        before, config = stored(emulator), configured(mine, emulator)
        words = ("servo", "setup", mine, "--ids", "1-3", "--port", emulator.port, "--yes")
        broken = Terminal(*words)
        broken.until("joint1: which way")
        assert stored(emulator) != before
        assert broken.stop() == 130
        assert stored(emulator) == before

        killed = Terminal(*words)
        killed.until("joint1: which way")
        killed.kill()
        changed = stored(emulator)
        assert changed != before
        scan = ("servo", "scan", "--port", emulator.port, "--ids", "1-3")
        assert shell(*scan) == 0
        assert f"a setup of {mine / 'arm.yaml'} was broken off: servos [1, 2, 3]" in shell.err
        assert stored(emulator) == changed
        journal = SetupJournal("", mine / "arm.yaml", config.bus)
        with closing(config.open_bus()) as bus:
            breaks_off(bus, config, journal)
        assert stored(emulator) == before
        assert shell(*scan) == 0 and "broken off" not in shell.err

        again = Terminal(*words)
        again.until("joint1: which way")
        again.kill()
        for servo_id in (1, 2, 3):
            emulator._devices[servo_id].motor.switch(False)
        assert drives(config, journal) == [
            "a setup of servos [1, 2, 3] was broken off; they are set as configured"
        ]
        assert shell(*scan) == 0 and "broken off" not in shell.err


@pytest.mark.parametrize("protocol", MODELS)
def test_another_arm_at_the_port_says_what_was_left_there_and_leaves_it(
    shell: Shell, protocol: str
) -> None:
    """Its servo is rightly set for many turns: written back, it would lose count of them."""
    mine = folder(shell, MODELS[protocol])
    with geared_bus(protocol) as emulator:
        config = configured(mine, emulator)
        with closing(config.open_bus()) as bus:
            had, many = bus.turns([2])[2], {1: True, 2: True, 3: True}
            changes: dict[int, tuple[bytes, bytes]] = {}
            bus.set_turns(many, changes.update)
            first = SetupJournal("", "first/arm.yaml", bus)
            first.begin({2: (had, bus.turns([2])[2])})
            file, set_now = first.path.read_bytes(), stored(emulator)
            other = SetupJournal("", mine / "arm.yaml", bus)
            told = [breaks_off(bus, config, other)]
        told += [drives(config, other), drives(config, SetupJournal("", "", config.bus))]
        for said in told:
            (sentence,) = said
            assert f"a setup of {os.path.realpath('first/arm.yaml')} was broken off" in sentence
            assert "servos [2] have not stored again" in sentence and str(first.path) in sentence
        assert stored(emulator) == set_now and first.path.read_bytes() == file
        # The arm's adapter got another name
        away = SetupJournal("", "first/arm.yaml", THERE[protocol])
        with closing(config.open_bus()) as bus:
            assert away.write_back(bus) == [] and bus.turns([2])[2] == had
        assert not first.path.exists()


def test_an_arm_keeps_what_it_has_to_write_back_in_its_own_folder(tmp_path: Path) -> None:
    """A simulated arm ends nothing of the real one: it has a folder of its own."""
    own = SetupJournal(str(tmp_path / "own"), "arm.yaml", THERE["feetech"])
    users = SetupJournal("", "arm.yaml", THERE["feetech"])
    users.begin({1: (b"had", b"new")})
    assert own.read() == {} and own.end([1]) == []
    assert users.read() == {1: (b"had", b"new")}
    assert own.path.is_relative_to(tmp_path / "own")
    assert users.describe_others() == []
    (said,) = own.describe_others()
    assert str(users.path) in said


def test_scan_tells_a_setup_that_the_arms_own_folder_keeps(shell: Shell) -> None:
    mine = folder(shell, "sts3215")
    file, own = mine / "servo_driver.yaml", shell.folder / "own"
    file.write_text(file.read_text().replace('state: ""', f'state: "{own}"'))
    with geared_bus("feetech") as emulator:
        killed = Terminal("servo", "setup", mine, "--ids", "1-3", "--port", emulator.port, "--yes")
        killed.until("joint1: which way")
        killed.kill()
        scan = ("servo", "scan", "--port", emulator.port, "--ids", "1-3")
        assert shell(*scan) == 0 and "broken off" not in shell.err
        assert shell(*scan, "--arm", mine) == 0
        assert f"a setup of {mine / 'arm.yaml'} was broken off: servos [1, 2, 3]" in shell.err
        assert str(own) in shell.err


def test_a_file_that_names_no_arm_is_told_at_its_port_and_kept(shell: Shell) -> None:
    """An earlier version wrote it."""
    mine = folder(shell, "sts3215")
    with geared_bus("feetech") as emulator:
        config = configured(mine, emulator)
        with closing(config.open_bus()) as bus:
            had = bus.turns([1])[1]
            bus.set_turns({1: True, 2: True, 3: True})
            new = bus.turns([1])[1]
        port = os.path.realpath(emulator.port).strip("/").replace("/", "-")
        file = state_folder() / "servo_setup" / f"{port}-feetech.json"
        file.parent.mkdir(parents=True)
        text = json.dumps({"turns": {"1": [had.hex(), new.hex()]}})
        for name in (file, file.with_name(f"{port}0-feetech.json")):
            name.write_text(text)
        set_now, journal = stored(emulator), SetupJournal("", mine / "arm.yaml", config.bus)
        with closing(config.open_bus()) as bus:
            told = [breaks_off(bus, config, journal)]
        told += [drives(config, journal)]
        assert shell("servo", "scan", "--port", emulator.port, "--ids", "1-3") == 0
        told += [[line for line in shell.err.splitlines() if "broken off" in line]]
        for said in told:
            (sentence,) = said
            assert "servos [1] have not stored again what they had" in sentence
            assert "of which arm is not known" in sentence and f"delete {file}" in sentence
        assert stored(emulator) == set_now and file.read_text() == text


@pytest.mark.parametrize("protocol", MODELS)
def test_the_journal_waits_for_a_silent_servo_and_is_not_guessed_when_damaged(
    shell: Shell, protocol: str
) -> None:
    mine = folder(shell, MODELS[protocol])
    with geared_bus(protocol) as three:
        before = stored(three)
        config = configured(mine, three)
        journal = SetupJournal("", mine / "arm.yaml", config.bus)
        with (
            pytest.raises(JobError, match="torque may be on") as caught,
            closing(config.open_bus()) as bus,
            ServoSetup(bus, config.joints, journal).safely(),
        ):
            three.faults.silent.add(2)
        assert caught.value
        three.faults.silent.clear()
        with closing(config.open_bus()) as bus:
            three.faults.silent.add(2)
            assert journal.write_back(bus) == [2]
            assert sorted(journal.read()) == [2]
            three.faults.silent.clear()
            assert journal.write_back(bus) == [] and stored(three) == before
        journal.path.write_text('{"turns": {"1": 5}}')
        scan = ("servo", "scan", "--port", three.port, "--ids", "1-3")
        assert shell(*scan) == 0 and f"{journal.path} is damaged" in shell.err
        with pytest.raises(JobError, match="is damaged"):
            ServoArm(config, journal=journal)
        words = ("servo", "setup", mine, "--port", three.port, *RIGHT)
        assert "is damaged" in shell.refused(*words, code=3)
        for text in ("[]", '{"turns": {}, "port": 5}'):
            journal.path.write_text(text)
            (said,) = drives(config, SetupJournal("", "another/arm.yaml", config.bus))[-1:]
            assert f"{journal.path} is damaged" in said and journal.path.exists()


def test_entries_are_kept_by_arm_and_by_protocol() -> None:
    journal = SetupJournal("", "arm.yaml", THERE["feetech"])
    journal.begin({1: (b"first", b"a")})
    journal.begin({1: (b"second", b"b"), 2: (b"other", b"c")})
    assert journal.read() == {1: (b"first", b"a"), 2: (b"other", b"c")}
    assert "servos [1]" in journal.end([1, 3])[0]
    for other in (
        SetupJournal("", "another/arm.yaml", THERE["feetech"]),
        SetupJournal("", "arm.yaml", THERE["dynamixel"]),
    ):
        assert other.read() == {}
        other.begin({1: (b"its", b"own")})
        assert journal.read() == {2: (b"other", b"c")}
        other.end([1])


def test_what_somebody_set_meanwhile_is_left(shell: Shell) -> None:
    with two("feetech") as emulator:
        servos = {1: models()["sts3215"]}
        with closing(open_bus("feetech", emulator.port, 1_000_000, servos, 0.2)) as bus:
            journal = SetupJournal("", "arm.yaml", bus)
            journal.begin({1: (b"\0\0\xff\x0f", bytes(4))})
            limit(emulator, 1, 100, 200)
            assert journal.write_back(bus) == []
            assert bus.memory([1])[1].goals == (100, 200)
            assert not os.path.exists(journal.path)


def test_setup_after_a_kill_gives_back_limits_although_the_file_says_one_turn_now(
    shell: Shell,
) -> None:
    mine = direct(shell, "sts3215")
    with two("feetech") as emulator:
        config = configured(mine, emulator)
        limit(emulator, 1, 100, 3900)
        journal = SetupJournal("", mine / "arm.yaml", config.bus)
        with closing(config.open_bus()) as bus:
            bus.set_turns({1: True}, journal.begin)  # killed, when the file said many turns
            breaks_off(bus, config, journal)
            assert bus.memory([1])[1].goals == (100, 3900)


def test_an_entry_of_the_journal_goes_without_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was deleted and the rest written again: killed in between, nothing was written back."""
    journal = SetupJournal("", "arm.yaml", THERE["feetech"])
    changes = {1: (b"had", b"new"), 2: (b"its", b"own")}
    journal.begin(changes)

    def killed(*words: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(setup_journal, "write_text", killed)
        journal.end([1])
    assert journal.read() == changes
    journal.end([1])
    assert journal.read() == {2: changes[2]}
    journal.end([2])
    assert journal.read() == {} and not journal.path.exists()
