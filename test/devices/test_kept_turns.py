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
        assert wait_until(lambda away=away: made.keep(away) or kept(folder, **of).away == away)


def test_a_successor_finds_what_was_kept_last(tmp_path: Path) -> None:
    assert kept(tmp_path).away == NONE
    kept_as(tmp_path, A, A | B, NONE, B)


def test_an_arm_is_known_by_its_file_and_without_one_by_its_port(tmp_path: Path) -> None:
    arm = str(tmp_path / "arm.yaml")
    kept_as(tmp_path, A, arm=arm)
    kept_as(tmp_path, B)
    assert kept(tmp_path, arm, "/dev/ttyUSB1").away == A
    assert kept(tmp_path, str(tmp_path / "other.yaml")).away == NONE
    assert kept(tmp_path, port="/dev/ttyUSB1").away == NONE


def test_every_joint_is_away_where_the_file_cannot_be_read(tmp_path: Path) -> None:
    kept_as(tmp_path, A)
    (file,) = (tmp_path / TURNS).iterdir()
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
