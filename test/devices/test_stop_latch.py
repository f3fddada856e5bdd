"""Files of stops: whose they are, damaged ones, and folders that cannot be read or written."""

import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from unprivileged import unprivileged

from longarm_comp.core.errors import InputError, JobError, LongarmError
from longarm_comp.devices.state_folder import state_folder
from longarm_comp.devices.stop_latch import Stop, StopLatch, kept_stops, refuse_under_stop

PORT = "/dev/ttyUSB0"
KILLED = """
import os, sys, threading
from pathlib import Path
from longarm_comp.devices.stop_latch import Stop, StopLatch
latch = StopLatch(Path(sys.argv[1]), "/", "", sys.argv[2])
os.fsync = lambda file: threading.Event().wait()
latch.ask(Stop[sys.argv[3]])
latch.keep(0.005)
while not list(Path(sys.argv[1]).glob(f"*.{sys.argv[3].lower()}")):
    latch.keep(0.1)
os.kill(os.getpid(), 9)
"""


def latch(folder: Path, namespace: str = "/", arm: str = "", port: str = PORT) -> StopLatch:
    return StopLatch(folder / "state", namespace, arm, port)


def stopped(folder: Path, stop: Stop = Stop.ESTOP, **arm: str) -> list[Path]:
    """The files of a stop that is kept there."""
    made = latch(folder, **arm)
    made.ask(stop)
    made.keep()
    assert not made.trouble
    return sorted((folder / "state").glob(f"*.{stop.name.lower()}"))


@pytest.mark.parametrize("stop", Stop)
def test_a_stop_outlasts_a_process_that_is_killed_while_the_disk_writes(
    tmp_path: Path, stop: Stop
) -> None:
    command = [sys.executable, "-c", KILLED, str(tmp_path / "state"), PORT, stop.name]
    assert subprocess.run(command, timeout=60.0).returncode == -9
    assert list(latch(tmp_path).standing) == [stop]


@pytest.mark.parametrize("stop", Stop)
def test_a_stop_stands_for_every_successor_until_it_is_lifted(tmp_path: Path, stop: Stop) -> None:
    assert not latch(tmp_path).standing and not latch(tmp_path).words
    stopped(tmp_path, stop)
    others = set(Stop) - {stop}
    for _ in range(2):
        successor = latch(tmp_path)
        assert list(successor.standing) == [stop]
        assert f"~/{'reset' if stop is Stop.FAULT else stop.name.lower()}" in successor.words
        with successor.lift_stops(*others):
            pass
    with successor.lift_stops(stop):
        assert not successor.standing
    assert not latch(tmp_path).standing


def test_why_an_arm_is_stopped_outlasts_the_process_too(tmp_path: Path) -> None:
    made = latch(tmp_path)
    made.ask(Stop.FAULT, "joint2 stalled")
    made.keep()
    assert latch(tmp_path).words == made.words and "joint2 stalled" in made.words
    assert "joint2 stalled" in str(kept_stops(tmp_path)[0])


def test_a_stop_that_somebody_deleted_is_written_again_while_its_driver_runs(
    tmp_path: Path,
) -> None:
    (file,) = stopped(tmp_path)
    running = latch(tmp_path)
    file.unlink()
    running.keep()
    assert list(latch(tmp_path).standing) == [Stop.ESTOP]
    with running.lift_stops(Stop.ESTOP):
        pass
    running.keep()
    assert not file.exists()


def test_an_arm_is_known_by_its_port_and_by_its_file_in_its_namespace(tmp_path: Path) -> None:
    file, elsewhere = str(tmp_path / "arm.yaml"), str(tmp_path / "other.yaml")
    stopped(tmp_path, namespace="/left", arm=file)
    for same in (
        {"port": PORT}, {"port": PORT, "arm": elsewhere, "namespace": "/right"},
        {"port": "/dev/ttyUSB1", "arm": file, "namespace": "/left"},
    ):  # fmt: skip
        assert latch(tmp_path, **same).standing, same
    for another in (
        {"port": "/dev/ttyUSB1"},
        {"port": "/dev/ttyUSB1", "arm": file, "namespace": "/right"},
        {"port": "/dev/ttyUSB1", "arm": elsewhere, "namespace": "/left"},
    ):
        assert not latch(tmp_path, **another).standing, another
        with latch(tmp_path, **another).lift_stops(*Stop):
            pass
    renumbered = latch(tmp_path, port="/dev/ttyUSB1", arm=file, namespace="/left")
    assert renumbered.standing


def test_a_port_is_known_by_where_its_name_leads(tmp_path: Path) -> None:
    device, link = tmp_path / "ttyUSB0", tmp_path / "by-id"
    device.touch()
    link.symlink_to(device)
    stopped(tmp_path, port=str(link))
    assert latch(tmp_path, port=str(device)).standing
    with latch(tmp_path, port=str(link)).lift_stops(*Stop):
        pass
    assert not latch(tmp_path, port=str(device)).standing
    stopped(tmp_path, port=str(device))
    assert latch(tmp_path, port=str(link)).standing


def test_without_a_driver_what_is_stopped_is_not_moved(tmp_path: Path) -> None:
    """By its ports, or by its file in whatever namespace; a simulated arm is another."""
    state, file, other = tmp_path / "state", tmp_path / "arm.yaml", tmp_path / "other.yaml"
    refuse_under_stop(state, [PORT], file)
    kept = stopped(tmp_path, Stop.HOLD, namespace="/left", arm=str(file))
    for ports, arm in (([PORT], None), (["/dev/x", PORT], other), (["/dev/x"], file)):
        with pytest.raises(JobError, match=r"(?s)held since .*longarm reset --kept"):
            refuse_under_stop(state, ports, arm)
    refuse_under_stop(state, ["/dev/x"], other)
    refuse_under_stop(tmp_path, [PORT], file)  # they are of the arms of a folder below
    assert {stop.of for stop in kept_stops(tmp_path)} == {f"port {PORT}", f"/left {file}"}
    for stop in kept:
        garbled(stop)
    assert {stop.of for stop in kept_stops(tmp_path)} == {stop.stem for stop in kept}
    with pytest.raises(JobError, match="held since"):
        refuse_under_stop(state, [PORT])


def test_stops_that_cannot_be_read_are_not_taken_for_none() -> None:
    with unprivileged(), tempfile.TemporaryDirectory() as place:
        (Path(place) / "state").mkdir(0o000)
        with pytest.raises(JobError, match="cannot be read"):
            refuse_under_stop(Path(place) / "state", [PORT])


def emptied(file: Path) -> None:
    file.write_bytes(b"")


def garbled(file: Path) -> None:
    file.write_bytes(bytes(range(256)) * 100)


def dangling(file: Path) -> None:
    file.unlink()
    file.symlink_to("/nowhere/at/all")


def locked(file: Path) -> None:
    file.chmod(0)


@pytest.mark.parametrize("damage", [emptied, garbled, dangling, locked])
def test_a_damaged_file_stops_the_arm_and_can_be_reset(
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    (file,) = stopped(tmp_path)
    damage(file)
    made = latch(tmp_path)
    assert list(made.standing) == [Stop.ESTOP]
    with made.lift_stops(*Stop):
        pass
    assert not latch(tmp_path).standing


def test_a_folder_in_place_of_a_file_stops_the_arm_until_somebody_removes_it(
    tmp_path: Path,
) -> None:
    (file,) = stopped(tmp_path)
    file.unlink()
    file.mkdir()
    made = latch(tmp_path)
    with pytest.raises(JobError, match="the stop stays"), made.lift_stops(*Stop):
        pass
    assert list(made.standing) == [Stop.ESTOP]
    file.rmdir()
    with made.lift_stops(*Stop):
        pass
    assert not made.standing


@pytest.mark.parametrize("mode", [0o000, 0o500])
def test_a_folder_that_is_not_readable_or_writable_holds_the_arm(mode: int) -> None:
    """Held, not let go: a heavy arm must not drop because of its computer's disk."""
    with unprivileged(), tempfile.TemporaryDirectory() as place:  # one that anybody can reach
        assert not latch(Path(place)).standing
        folder = Path(place) / "state"
        folder.chmod(mode)
        made = latch(Path(place))
        assert list(made.standing) == [Stop.HOLD]
        assert "cannot be kept" in made.words and str(folder) in made.words
        with pytest.raises(LongarmError, match=str(folder)), made.lift_stops(*Stop):
            pass
        made.ask(Stop.ESTOP)
        made.keep()
        assert list(made.standing) == [Stop.HOLD, Stop.ESTOP] and str(folder) in made.trouble
        folder.chmod(0o700)
        made.keep()
        assert not made.trouble and "ends with" not in made.words
        assert set(latch(Path(place)).standing) == {Stop.HOLD, Stop.ESTOP}


def test_a_stop_that_could_not_be_kept_is_not_kept_while_it_is_written_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder, goes_on = tmp_path / "state", threading.Event()
    folder.write_text("a file where the folder should be")
    made = latch(tmp_path)
    before = made.trouble
    folder.unlink()
    written = os.fsync
    monkeypatch.setattr(os, "fsync", lambda file: goes_on.wait() and written(file))
    made.keep(0.0)
    assert made.writing and before and made.trouble == before and "ends with" in made.words
    goes_on.set()
    made.keep()
    assert not made.trouble and list(latch(tmp_path).standing) == [Stop.HOLD]


def test_a_reset_that_breaks_off_leaves_the_stop(tmp_path: Path) -> None:
    stopped(tmp_path)
    made = latch(tmp_path)
    with pytest.raises(JobError), made.lift_stops(*Stop):
        assert not made.standing
        raise JobError("a servo is silent")
    assert list(made.standing) == [Stop.ESTOP] == list(latch(tmp_path).standing)


def test_the_folder_is_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for given in ("", "not/absolute"):
        monkeypatch.setenv("XDG_STATE_HOME", given)
        assert state_folder() == tmp_path / ".local" / "state" / "longarm_comp"
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "xdg"))
    assert state_folder() == tmp_path / "xdg" / "longarm_comp"


def test_a_user_without_a_home_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    with pytest.raises(InputError, match="XDG_STATE_HOME"):
        state_folder()
