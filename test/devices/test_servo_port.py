"""The first evening with servos: which port, who may open it, one id after another."""

import errno
import io
import sys
from pathlib import Path

import pytest
import serial
from cli_shell import Shell
from faulty_bus import FaultyBus
from serial.tools.list_ports_common import ListPortInfo
from servo_bench import bus

from longarm_comp.devices.servo_bus.port import SerialPort
from longarm_comp.devices.servo_bus.state import BusUnplugged
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator

MODELS = ("feetech", "dynamixel")


def test_ids_that_are_none_are_refused_by_the_name_of_the_command(shell: Shell) -> None:
    words = ("servo", "set-id", 3, "--port", "none", "--ids", "5-")
    assert "servo set-id: --ids: '5-'" in shell.refused(*words)


@pytest.mark.parametrize("protocol", MODELS)
def test_ids_are_set_one_servo_at_a_time_and_outlive_the_power(protocol: str, shell: Shell) -> None:
    with ServoEmulator(protocol, {1: 2048.0}) as alone:
        line = ("--port", alone.port, "--protocol", protocol, "--ids", "0-9")
        assert shell("servo", "set-id", 7, *line) == 0, shell.err
        assert "servo 1 is servo 7 now" in shell.err
        alone.power_cycle(7)
        found = shell.json("servo", "scan", *line)
        assert [servo["servo_id"] for servo in found["servos"]] == [7]
        assert "0 to 252" in shell.refused("servo", "set-id", 253, *line)
    with ServoEmulator(protocol, {1: 2048.0, 2: 2048.0}) as two:
        line = ("--port", two.port, "--protocol", protocol, "--ids", "0-9")
        assert "one servo alone" in shell.refused("servo", "set-id", 7, *line, code=3)
        assert set(two.positions()) == {1, 2}


@pytest.mark.parametrize("twin", [False, True])
@pytest.mark.parametrize("protocol", MODELS)
def test_an_id_that_another_servo_has_is_not_given(protocol: str, twin: bool, shell: Shell) -> None:
    """The scan is told to ask id 1 only; two servos of one id answer with damage."""
    with FaultyBus(protocol, {1: 1000.0, 3: 3000.0}) as emulator:
        if twin:
            emulator.add_twin(3, 700.0)
        line = ("--port", emulator.port, "--protocol", protocol, "--ids", "1")
        said = shell.refused("servo", "set-id", 3, *line, code=3)
        assert "another servo has this id" in said and "id=3" in said
        assert [device.servo_id for device in emulator._devices.values()] == [1, 3]


@pytest.mark.parametrize("protocol", MODELS)
def test_an_id_that_two_servos_have_at_the_end_is_an_error(protocol: str, shell: Shell) -> None:
    """The other one is plugged in while the id is being given."""
    with FaultyBus(protocol, {1: 1000.0}) as emulator:
        emulator.add_twin(3, 700.0)
        line = ("--port", emulator.port, "--protocol", protocol, "--ids", "1")
        said = shell.refused("servo", "set-id", 3, *line, code=3)
        assert "two servos have this id now" in said and "before=1" in said


def test_servo_that_did_not_hear_its_new_id_is_locked_again(shell: Shell) -> None:
    with FaultyBus("feetech", {1: 1000.0}) as emulator:
        lost = iter([False, False, True])  # torque off, lock open, the id
        emulator.loses = lambda: next(lost, False)
        line = ("--port", emulator.port, "--protocol", "feetech", "--ids", "1")
        said = shell.refused("servo", "set-id", 3, *line, code=3)
        assert "does not answer to its new id" in said
        device = emulator._devices[1]
        assert (device.servo_id, device.get(55, 1)) == (1, 1)


def test_a_port_that_cannot_be_opened_says_what_to_do(shell: Shell, tmp_path: Path) -> None:
    def said(port: object) -> str:
        return shell.refused("servo", "scan", "--port", port, "--ids", "1", code=3)

    assert "no such port; there are: " in said(tmp_path / "ttyUSB0")
    with bus("feetech") as emulator:
        held = SerialPort(emulator.port, 1_000_000)
        assert "another program holds it" in said(emulator.port)
        held.close()


def test_a_port_without_permission_names_the_group(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the system refuses it; this user may be root."""

    def refused(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port")

    monkeypatch.setattr(serial, "Serial", refused)
    with pytest.raises(BusUnplugged, match=r"usermod -aG \w+ \$USER.*log out"):
        SerialPort("/dev/null", 1_000_000)


def test_the_port_is_the_one_that_goes(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    usb = [ListPortInfo(f"/dev/ttyUSB{k}") for k in range(2)]
    for port in usb:
        port.vid = 0x1A86
    looks = iter([usb, usb[:1]])
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: next(looks))
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\ny\n"))
    assert shell("find-port") == 0, shell.err
    assert shell.out.strip() == "/dev/ttyUSB1"
    assert "longarm servo scan --port /dev/ttyUSB1" in shell.err
    looks = iter([usb, usb])
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    assert shell("find-port") == 3
    assert "no port disappeared" in shell.err
    looks = iter([[]])
    assert "no serial port" in shell.refused("find-port", code=3)
