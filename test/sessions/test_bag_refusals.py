"""Broken bags, and what a session as a bag refuses to read or to write over."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_robot import STORAGES, command, refusal, robot, row_said, sighting, state
from session_bag import write_bag
from small_arm import ARM, measured

from longarm_comp.core.data.rest import is_of_two_arms
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


def told_of_three(path: Path, *rows: dict[str, Any]) -> Path:
    """A bag of three poses, with what is said after each."""
    with robot(path) as put:
        for k, row in enumerate(rows):
            command(put, 2 * k + 0.2, [0.1 * k, 0.5, 0.05, 0.2])
            sighting(put, 2 * k + 0.5, [0.4, 0.1, 0.3])
            row_said(put, 2 * k + 1.0, **row)
    return path


def test_a_label_that_a_row_lacks_is_blank_and_a_number_that_it_lacks_is_missed(
    tmp_path: Path,
) -> None:
    elbow, wind = {"labels": {"marker": "elbow"}}, {"columns": {"wind": 3.0}}
    session = read_bag(told_of_three(tmp_path / "a", {}, elbow, {}), ARM)
    assert session.labels["marker"].tolist() == ["", "elbow", ""]
    session = read_bag(told_of_three(tmp_path / "b", wind, wind, wind), ARM)
    assert session.columns["wind"].tolist() == [3.0, 3.0, 3.0]
    told_of_three(tmp_path / "c", {"index": 7, **wind}, {"index": 8}, {"index": 9, **wind})
    assert "session_row columns wind: 'none at index 8'" in refusal(tmp_path / "c")
    tilt = {"columns": {"incl_base_x": 0.1}}
    columns = read_bag(told_of_three(tmp_path / "d", {}, tilt, {}), ARM).columns
    np.testing.assert_array_equal(columns["incl_base_x"], [np.nan, 0.1, np.nan])


def test_two_rows_of_one_command(tmp_path: Path) -> None:
    for k, second in enumerate(({"index": 4}, {"index": 5})):
        with robot(tmp_path / str(k)) as put:
            command(put, 0.2, [0.1, 0.5, 0.05, 0.2])
            sighting(put, 0.5, [0.4, 0.1, 0.3])
            row_said(put, 0.6, index=4)
            row_said(put, 0.7, **second)
    assert read_bag(tmp_path / "0", ARM).index.tolist() == [4]
    assert "session_row at 0.500 s: 'another of one command'" in refusal(tmp_path / "1")


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


def moved(put: Any, k: int, of: Callable[[float], list[float]], rate: float = 50.0) -> None:
    """A command, the joints of the 1.5 s after it as this function of the time, and the tip."""
    command(put, 2.0 * k, of(9.0), stamp=2.0 * k)
    for i in range(int(1.5 * rate)):
        state(put, 2.0 * k + 0.01 + i / rate, of(i / rate))
        if i % 5 == 0 and i / rate > 1:
            sighting(put, 2.0 * k + 0.015 + i / rate, [0.4 + 0.01 * k, 0.1, 0.3])


def poses(rng: np.random.Generator) -> list[list[float]]:
    return [list(q) for q in ARM.lower + (ARM.upper - ARM.lower) * rng.uniform(0.3, 0.7, (6, 4))]


@pytest.mark.parametrize("rate", [(50.0, 20.0), (20.0, 50.0), (50.0, 50.0)])
def test_two_publishers_of_joint_states(
    rate: tuple[float, float], tmp_path: Path, rng: np.random.Generator
) -> None:
    """The second tells where another arm stands."""
    with robot(tmp_path / "bag") as put:
        for k, q in enumerate(poses(rng)):
            moved(put, k, lambda t, q=q: q, rate[0])  # type: ignore[misc]
            for i in range(int(1.5 * rate[1])):
                state(put, 2.0 * k + 0.013 + i / rate[1], [0.0, 0.2, 0.0, 0.0])
    said = refusal(tmp_path / "bag")
    assert "joint_states: 'two publishers in turn, after 6 of 6 commands'; allowed: one" in said


def test_joints_that_never_rest(tmp_path: Path, rng: np.random.Generator) -> None:
    """One swings, as a badly tuned servo does; it is one publisher's, however it is read."""
    for rate in (50.0, 16.0, 12.0):
        with robot(tmp_path / f"{rate}") as put:
            for k, q in enumerate(poses(rng)):
                swing = lambda t, q=q: [q[0], q[1] + 0.1 * np.sin(25.0 * t + 0.4), *q[2:]]  # noqa: E731
                moved(put, k, swing, rate)
        said = refusal(tmp_path / f"{rate}")
        assert f"{ARM.joint_names[1]} still moved at the end of 6 of 6 commands" in said
        assert "did not rest for 0.1 s" in said and "publisher" not in said


def test_leaps_of_a_single_command_lose_only_that(tmp_path: Path, rng: np.random.Generator) -> None:
    with robot(tmp_path / "bag") as put:
        for k, q in enumerate(poses(rng)):
            leap = 0.2 * (k == 2)
            moved(put, k, lambda t, q=q, d=leap: [q[0] + d * (int(50 * t) % 2), *q[1:]])  # type: ignore[misc]
    assert read_bag(tmp_path / "bag", ARM).index.tolist() == [0, 1, 2, 3, 4]


def test_an_endless_joint_at_half_a_turn_is_one_arm_and_so_is_one_that_swings() -> None:
    """Readings of the former flicker between pi and -pi."""
    flicker = np.where(np.arange(40) % 2, np.pi - 1e-3, 1e-3 - np.pi)
    assert not is_of_two_arms(np.stack([flicker, np.zeros(40)], axis=1))
    assert is_of_two_arms(np.stack([np.where(np.arange(40) % 2, 0.5, 0.0), np.zeros(40)], axis=1))
    swing = 0.2 * np.sin(np.pi / 3 * np.arange(60))  # two steps of six change its direction
    assert not is_of_two_arms(np.stack([swing, np.zeros(60)], axis=1))
    assert not is_of_two_arms(np.zeros((1, 2))) and not is_of_two_arms(np.zeros((0, 2)))
