"""The file of joints whose servos stand outside the turn from which they count after power-on."""

import os
import threading
from pathlib import Path

import pytest
from faulty_bus import wait_until

from longarm_comp.devices.kept_turns import TURNS, KeptTurns

NONE = frozenset[str]()
A, B = frozenset("a"), frozenset("b")


def kept(folder: Path, arm: str = "", port: str = "/dev/ttyUSB0") -> KeptTurns:
    return KeptTurns(folder, arm, port, ("a", "b"))


def kept_as(folder: Path, *states: frozenset[str], **of: str) -> None:
    """Keep one state after another; each is what a successor finds."""
    made = kept(folder, **of)
    for away in states:
        assert wait_until(
            lambda away=away: made.keep(away, 60.0) or kept(folder, **of).away == away
        )


def test_a_successor_finds_what_was_kept_last(tmp_path: Path) -> None:
    assert kept(tmp_path).away == NONE
    kept_as(tmp_path, A, A | B, NONE, B)


def test_an_arm_is_known_by_its_file_then_by_its_port_then_by_the_device(tmp_path: Path) -> None:
    arm, other, port = str(tmp_path / "arm.yaml"), str(tmp_path / "other.yaml"), tmp_path / "port"
    port.symlink_to(tmp_path / "device")
    kept_as(tmp_path, A, arm=arm, port=str(port))
    assert kept(tmp_path, other, str(port)).away == A  # its file was moved
    assert kept(tmp_path, other, str(tmp_path / "device")).away == A
    assert kept(tmp_path, other).away == NONE
    kept_as(tmp_path, NONE, arm=other, port=str(port))  # another arm at this port
    assert kept(tmp_path, arm, str(port)).away == A
    kept_as(tmp_path, B, arm=other, port=str(port))
    assert kept(tmp_path, arm, str(port)).away == A
    assert kept(tmp_path, port=str(port)).away == B
    assert kept(tmp_path, port="/dev/ttyUSB1").away == NONE


def test_every_joint_is_away_where_the_file_cannot_be_read(tmp_path: Path) -> None:
    kept_as(tmp_path, A)
    (file,) = (tmp_path / TURNS).iterdir()  # there is no link at its port
    file.write_bytes(b"\xff\xfe")
    assert kept(tmp_path).away == A | B
    file.unlink()
    file.mkdir()
    assert kept(tmp_path).away == A | B


def test_every_joint_is_away_where_the_file_names_one_that_has_another_name_since(
    tmp_path: Path,
) -> None:
    kept_as(tmp_path, A)
    renamed = KeptTurns(tmp_path, "", "/dev/ttyUSB0", ("b", "c"))
    assert renamed.away == {"b", "c"}
    assert wait_until(lambda: renamed.keep(B) or kept(tmp_path).away == B)


def test_the_last_reading_counts_while_the_disk_still_writes_an_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The driver is then configured again, by what it knows."""
    made, goes_on, own = kept(tmp_path), threading.Event(), os.fsync
    monkeypatch.setattr(os, "fsync", lambda file: (goes_on.wait(600.0), own(file)))
    try:
        made.keep(A)
        made.keep(A | B)
        assert made.away == A | B
    finally:
        goes_on.set()
    assert wait_until(lambda: made.keep(A | B) or kept(tmp_path).away == A | B)


def test_what_could_not_be_written_is_written_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, tried = kept(tmp_path), list[object]()

    def fails(file: object) -> None:
        tried.append(file)
        raise OSError(28, "full")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fails)
        assert wait_until(lambda: made.keep(A) or len(tried) > 1)
        assert kept(tmp_path).away == NONE
    assert wait_until(lambda: made.keep(A) or kept(tmp_path).away == A)
