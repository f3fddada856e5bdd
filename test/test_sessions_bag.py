"""Sessions as bags: exact round trips, bags as a robot records them, broken bags."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg
from small_arm import ARM, measured

from longarm_comp.core.arm import Arm
from longarm_comp.core.dataset import Session
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.bag import read_bag
from longarm_comp.sessions.bag_info import bag_info
from longarm_comp.sessions.bag_write import write_bag
from longarm_comp.sessions.csv import read_csv
from longarm_comp.sessions.message_types import message_types
from longarm_comp.sessions.read import read_session

STORAGES = ("mcap", "sqlite3")


@contextmanager
def robot(path: Path, namespace: str = "") -> Iterator[Any]:
    """Write a bag as a recorder does: `put(topic, type, seconds, message)`."""
    types = message_types()
    connections: dict[str, Any] = {}
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:

        def put(topic: str, kind: str, t: float, **fields: Any) -> None:
            name = f"{namespace}/{topic}"
            if name not in connections:
                connections[name] = writer.add_connection(name, kind, typestore=types)
            message = types.types[kind](**fields)
            stamp = round((1000 + t) * 1e9)
            writer.write(connections[name], stamp, types.serialize_cdr(message, kind))

        yield put


def header(t: float = 0.0, frame: str = "base") -> Any:
    types = message_types().types
    nanos = round((1000 + t) * 1e9) if t else 0
    stamp = types["builtin_interfaces/msg/Time"](sec=nanos // 10**9, nanosec=nanos % 10**9)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def command(put: Any, t: float, *points: list[float], names: tuple[str, ...] | None = None) -> None:
    types = message_types().types
    none = np.array([])
    made = [
        types["trajectory_msgs/msg/JointTrajectoryPoint"](
            positions=np.array(p, dtype=float),
            velocities=none,
            accelerations=none,
            effort=none,
            time_from_start=types["builtin_interfaces/msg/Duration"](sec=k, nanosec=0),
        )
        for k, p in enumerate(points)
    ]
    names = ARM.joint_names if names is None else names
    kind = "trajectory_msgs/msg/JointTrajectory"
    put("joint_trajectory", kind, t, header=header(), joint_names=list(names), points=made)


def state(put: Any, t: float, q: list[float]) -> None:
    none = np.array([])
    names = [*reversed(ARM.joint_names), "gripper"]
    position = np.array([*reversed(q), 0.3])
    kind = "sensor_msgs/msg/JointState"
    put(
        "joint_states", kind, t, header=header(t), name=names, position=position,
        velocity=none, effort=none,
    )  # fmt: skip


def sighting(put: Any, t: float, xyz: list[float], sd: float = 0.0, frame: str = "base") -> None:
    types = message_types().types
    x, y, z = map(float, xyz)
    covariance = np.zeros(36)
    covariance[[0, 7, 14]] = sd**2
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=x, y=y, z=z),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    whole = types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=covariance)
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    put("tip_measured", kind, t, header=header(t, frame), pose=whole)


def refusal(path: Path, **how: Any) -> str:
    with pytest.raises(InputError) as caught:
        read_bag(path, ARM, **how)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


# ------------------------------------------------------------------ round trips


@pytest.mark.parametrize("storage", STORAGES)
def test_the_twin_survives_a_bag(storage: Any, data_dir: Path, tmp_path: Path) -> None:
    arm = Arm.load(data_dir / "twin" / "arm.yaml")
    session = read_csv(data_dir / "twin" / "paper_twin_300" / "samples.csv", arm)
    write_bag(session, tmp_path / "bag", arm, storage)
    back = read_session(tmp_path / "bag", arm)
    assert (back.approach == session.approach).all()
    assert back.hash == session.hash


@pytest.mark.parametrize("storage", STORAGES)
def test_everything_recorded_survives(
    storage: Any, tmp_path: Path, rng: np.random.Generator
) -> None:
    base = measured(30, rng)
    xyz = base.xyz.copy()
    xyz[[4, 5, 20]] = np.nan
    session = Session.record(
        base.q,
        xyz,
        index=np.cumsum(rng.integers(1, 3, 30)),
        approach=rng.integers(-1, 2, 30),
        repeat_id=rng.integers(-1, 4, 30),
        sigma=rng.random((30, 3)) * 1e-3 + 1e-4,
        columns={"temperature_c": rng.random(30), "humidity": rng.random(30)},
        labels={"group": rng.choice(["left", "right"], 30)},
    )
    write_bag(session, tmp_path / "bag", ARM, storage, namespace="cell/arm_2")
    back = read_session(tmp_path / "bag", ARM)
    assert (back.index == session.index).all()
    assert (back.q == session.q).all()
    assert np.array_equal(back.xyz, session.xyz, equal_nan=True)
    assert (back.approach == session.approach).all()
    assert (back.repeat_id == session.repeat_id).all()
    assert back.sigma is not None
    assert session.sigma is not None
    assert np.allclose(back.sigma, session.sigma, rtol=1e-12)
    assert (back.columns["humidity"] == session.columns["humidity"]).all()
    assert (back.labels["group"] == session.labels["group"]).all()


def test_one_row_without_anything_else(tmp_path: Path) -> None:
    session = Session.record(ARM.mid[None], np.array([[0.4, 0.1, 0.3]]))
    write_bag(session, tmp_path / "bag", ARM)
    back = read_session(tmp_path / "bag", ARM)
    assert (back.q == session.q).all()
    assert (back.xyz == session.xyz).all()
    assert not back.approach.any()


# ------------------------------------------------------------------ as a robot records


def test_the_settled_sightings_are_averaged(tmp_path: Path, rng: np.random.Generator) -> None:
    first, second = [0.1, 0.5, 0.05, 0.2], [0.2, 0.4, 0.05, 0.2]
    with robot(tmp_path / "bag", "/left_arm") as put:
        sighting(put, 0.0, [9, 9, 9])  # before any command
        command(put, 1.0, first)
        for k in range(10):  # on the way, then at rest for seven sightings
            reached = min(1.0, (k + 1) / 4)
            state(put, 1.1 + k / 10, [reached * v for v in first])
            sighting(put, 1.15 + k / 10, [0.4 * reached, 0.1, 0.3 + 1e-4 * (k % 2)], sd=1e-3)
        command(put, 3.0, second)
        for k in range(4):
            state(put, 3.1 + k / 10, second)
            sighting(put, 3.15 + k / 10, [0.5, 0.1, 0.3 + 1e-4 * (k % 2)], sd=1e-3)
    session = read_bag(tmp_path / "bag", ARM)
    assert session.q.tolist() == [first, second]
    # At rest from the first state at the end, k = 3, to the last, k = 9.
    expected = 0.3 + 1e-4 * np.mean([k % 2 for k in range(3, 10)])
    assert np.allclose(session.xyz[0], [0.4, 0.1, expected], atol=1e-12)
    assert np.allclose(session.xyz[1], [0.5, 0.1, 0.30005], atol=1e-12)
    assert session.sigma is not None
    assert np.allclose(session.sigma[:, 0], [1e-3 / np.sqrt(7), 1e-3 / np.sqrt(4)])
    assert session.approach.tolist() == [[0, 0, 0, 0], [1, -1, 0, 0]]
    assert session.index.tolist() == [0, 1]


def test_directions_come_from_commands_that_only_pass(tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        command(put, 0.0, [0.3, 0.3, 0.05, 0.0])  # an approach pose: no sighting
        command(put, 1.0, [0.2, 0.5, 0.05, 0.0])
        sighting(put, 2.0, [0.4, 0.1, 0.3])
        command(put, 3.0, [0.0, 0.0, 0.02, 0.1], [0.2, 0.5, 0.05, 0.0])  # one with a via point
        sighting(put, 4.0, [0.4, 0.1, 0.3])
    session = read_bag(tmp_path / "bag", ARM)
    assert session.approach.tolist() == [[-1, 1, 0, 0], [1, 1, 1, -1]]


def test_a_command_sent_again_is_one_row(tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        for k in range(6):
            command(put, k * 0.5, [0.1 * (k // 3), 0.5, 0.05, 0.0])
            sighting(put, k * 0.5 + 0.2, [0.4 + 0.1 * (k // 3), 0.1, 0.3 + 1e-4 * k])
    session = read_bag(tmp_path / "bag", ARM)
    assert session.q[:, 0].tolist() == [0.0, 0.1]
    assert np.allclose(session.xyz[:, 2], [0.3001, 0.3004], atol=1e-12)


def test_points_of_a_streamed_path_are_no_rows(tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        for k in range(20):  # a controller that streams its path, 20 points a second
            q = [0.02 * k, 0.5, 0.05, 0.0]
            command(put, k * 0.05, q)
            state(put, k * 0.05 + 0.02, [0.02 * (k - 1), *q[1:]])
            state(put, k * 0.05 + 0.04, q)
            sighting(put, k * 0.05 + 0.045, [0.4 + 0.01 * k, 0.1, 0.3])
        for k in range(10):
            state(put, 1.0 + k * 0.05, [0.38, 0.5, 0.05, 0.0])
            sighting(put, 1.02 + k * 0.05, [0.59, 0.1, 0.3])
    session = read_bag(tmp_path / "bag", ARM)
    assert session.q.tolist() == [[0.38, 0.5, 0.05, 0.0]]
    assert session.approach.tolist() == [[1, 0, 0, 0]]


def test_context_holds_until_the_next_message(tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        for k, temperature in enumerate((20.0, None, 22.5)):
            if temperature is not None:
                kind = "sensor_msgs/msg/Temperature"
                put("temperature", kind, k, header=header(), temperature=temperature, variance=0.0)
            command(put, k + 0.1, [0.1 * k, 0.5, 0.05, 0.2])
            sighting(put, k + 0.5, [0.4, 0.1 * k, 0.3])
        put("payload", "std_msgs/msg/Float64", 1.2, data=0.4)
    session = read_bag(tmp_path / "bag", ARM)
    assert session.temperature_c is not None
    assert session.temperature_c.tolist() == [20.0, 20.0, 22.5]
    assert session.payload_kg is not None
    assert session.payload_kg.tolist() == [0.4, 0.4, 0.4]
    assert session.t_s is not None
    assert np.allclose(session.t_s, [0.5, 1.5, 2.5])


def test_unknown_types_and_topics_are_passed_over(tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        types = message_types()
        if "my_robot/msg/Mood" not in types.types:
            types.register(get_types_from_msg("float64 level\n", "my_robot/msg/Mood"))
        put("mood", "my_robot/msg/Mood", 0.1, level=1.0)
        put("tip_measured_raw", "std_msgs/msg/Float64", 0.1, data=1.0)
        put("payload", "std_msgs/msg/Int32", 0.1, data=5)  # the name, but another type
        command(put, 0.2, [0.1, 0.5, 0.05, 0.2])
        sighting(put, 0.5, [0.4, 0.1, 0.3])
    session = read_bag(tmp_path / "bag", ARM)
    assert len(session) == 1
    assert session.payload_kg is None
    read = {t.topic: t.read for t in bag_info(tmp_path / "bag").topics}
    assert read == {
        "/joint_trajectory": True,
        "/mood": False,
        "/payload": False,
        "/tip_measured": True,
        "/tip_measured_raw": False,
    }


def test_two_arms_in_one_bag_need_a_choice(tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        for side, x in (("left", 0.4), ("right", 0.5)):

            def mine(topic: str, *rest: Any, side: str = side, **fields: Any) -> None:
                put(f"{side}/{topic}", *rest, **fields)

            command(mine, 0.2, [0.1, 0.5, 0.05, 0.2])
            sighting(mine, 0.5, [x, 0.1, 0.3])
    assert "namespaces: '/left, /right'" in refusal(tmp_path / "bag")
    assert read_bag(tmp_path / "bag", ARM, namespace="right").xyz[0, 0] == 0.5


# ------------------------------------------------------------------ what is refused


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
