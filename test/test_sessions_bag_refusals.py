"""Broken bags, and what a session as a bag refuses to read or to write over."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_robot import STORAGES, command, refusal, robot, sighting
from rosbags.rosbag2 import Writer
from small_arm import ARM, measured

from bench.bag_write import write_bag
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.bag import read_bag


def test_joints_of_another_arm(tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        command(put, 0.2, [0.1, 0.5], names=("shoulder", "elbow"))
        sighting(put, 0.5, [0.4, 0.1, 0.3])
    assert "shoulder, elbow" in refusal(tmp_path / "bag")
    assert "joint1, joint2, joint3, joint4 of arm small" in refusal(tmp_path / "bag")


@pytest.mark.parametrize(
    ("xyz", "q", "words"),
    [
        ([0.4, np.nan, 0.3], [0.1, 0.5, 0.05, 0.2], "tip_measured at"),
        ([0.4, np.inf, 0.3], [0.1, 0.5, 0.05, 0.2], "tip_measured at"),
        ([0.4, 0.1, 0.3], [0.1, np.nan, 0.05, 0.2], "joint_trajectory points at"),
        ([0.4, 0.1, 0.3], [0.1, 0.5, 0.05], "joint_trajectory points at"),
    ],
)
def test_numbers_that_cannot_be(
    xyz: list[float], q: list[float], words: str, tmp_path: Path
) -> None:
    with robot(tmp_path / "bag") as put:
        command(put, 0.2, q)
        sighting(put, 0.5, xyz)
    assert words in refusal(tmp_path / "bag")


@pytest.mark.parametrize(
    "text", ["", "5", '{"index": "x"}', '{"columns": 3}', '{"rows": 1}', '{"columns": {"a": "b"}}']
)
def test_a_row_that_tells_nonsense(text: str, tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        command(put, 0.2, [0.1, 0.5, 0.05, 0.2])
        sighting(put, 0.5, [0.4, 0.1, 0.3])
        put("session_row", "std_msgs/msg/String", 0.6, data=text)
    assert "session_row at 0.400 s" in refusal(tmp_path / "bag")


def test_a_bag_without_commands_or_sightings(tmp_path: Path) -> None:
    with robot(tmp_path / "a") as put:
        command(put, 0.2, [0.1, 0.5, 0.05, 0.2])
    assert "tip_measured: 'no message'" in refusal(tmp_path / "a")
    with robot(tmp_path / "b") as put:
        sighting(put, 0.2, [0.4, 0.1, 0.3])
    assert "joint_trajectory: 'no message'" in refusal(tmp_path / "b")
    with robot(tmp_path / "c") as put:
        put("mood", "std_msgs/msg/Float64", 0.1, data=1.0)
    assert "topics: '/mood'" in refusal(tmp_path / "c")
    with robot(tmp_path / "d") as put:
        sighting(put, 0.2, [0.4, 0.1, 0.3])
        command(put, 0.4, [0.1, 0.5, 0.05, 0.2])
    assert "none after a command" in refusal(tmp_path / "d")


def test_two_frames(tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        command(put, 0.2, [0.1, 0.5, 0.05, 0.2])
        sighting(put, 0.5, [0.4, 0.1, 0.3])
        sighting(put, 0.6, [0.4, 0.1, 0.3], frame="camera")
    assert "one frame" in refusal(tmp_path / "bag")


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_cut_anywhere_is_refused_or_read_whole(
    storage: Any, tmp_path: Path, rng: np.random.Generator
) -> None:
    session = measured(12, rng)
    write_bag(session, tmp_path / "bag", ARM, storage)
    whole = read_bag(tmp_path / "bag", ARM).hash
    suffix = ".mcap" if storage == "mcap" else ".db3"
    (file,) = (p for p in (tmp_path / "bag").iterdir() if p.suffix == suffix)
    size = file.stat().st_size
    refused = 0
    for length in [*range(0, 64, 9), *np.linspace(64, size - 1, 25).astype(int)]:
        cut = tmp_path / "cut"
        shutil.copytree(tmp_path / "bag", cut)
        with (cut / file.name).open("rb+") as handle:
            handle.truncate(int(length))
        try:
            assert read_bag(cut, ARM).hash == whole
        except InputError:
            refused += 1
            assert "complete rosbag2" in refusal(cut)
        shutil.rmtree(cut)
    assert refused >= 25


def test_a_killed_recording_has_no_metadata(tmp_path: Path, rng: np.random.Generator) -> None:
    write_bag(measured(5, rng), tmp_path / "bag", ARM)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert "a recording that was killed has none" in refusal(tmp_path / "bag")


@pytest.mark.parametrize("content", ["", "rosbag2_bagfile_information: 5\n", "{", "a: [1\n"])
def test_broken_metadata(content: str, tmp_path: Path, rng: np.random.Generator) -> None:
    write_bag(measured(5, rng), tmp_path / "bag", ARM)
    (tmp_path / "bag" / "metadata.yaml").write_text(content)
    refusal(tmp_path / "bag")


def test_no_bag_at_all(tmp_path: Path) -> None:
    refusal(tmp_path / "none")
    (tmp_path / "folder").mkdir()
    refusal(tmp_path / "folder")
    (tmp_path / "file.mcap").write_bytes(b"")
    refusal(tmp_path / "file.mcap")


def test_writing_refuses_what_it_must_not_replace(tmp_path: Path, rng: np.random.Generator) -> None:
    session = measured(3, rng)
    (tmp_path / "bag").mkdir()
    with pytest.raises(InputError, match="does not exist yet"):
        write_bag(session, tmp_path / "bag", ARM)
    with pytest.raises(InputError, match="output folder"):
        write_bag(session, Path("/proc/longarm/bag"), ARM)
    with pytest.raises(InputError, match="mcap or sqlite3"):
        write_bag(session, tmp_path / "new", ARM, "hdf5")  # type: ignore[arg-type]


def test_an_interrupted_write_leaves_nothing(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Writer, "close", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_bag(measured(3, rng), tmp_path / "bag", ARM)
    assert list(tmp_path.iterdir()) == []
