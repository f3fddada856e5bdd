"""Long bags: read in bounded memory, sightings that come late, joint states of several senders."""

import tracemalloc
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_robot import command, header, robot, sighting, state
from small_arm import ARM

from bench.synthetic_bag import PERIOD_S, recording, write_raw
from longarm_comp.sessions.bag import read_bag
from longarm_comp.sessions.message_types import message_types

KIND = "sensor_msgs/msg/JointState"


def peak_of_reading(path: Path) -> tuple[int, int]:
    """Rows and the most bytes that were held while a bag was read."""
    tracemalloc.start()
    try:
        session = read_bag(path, ARM)
        return len(session), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_the_length_of_the_bag(tmp_path: Path) -> None:
    for name, count in (("warm", 500), ("short", 10_000), ("long", 30_000)):
        write_raw(tmp_path / name, recording(ARM), count)
    read_bag(tmp_path / "warm", ARM)
    short_rows, short = peak_of_reading(tmp_path / "short")
    long_rows, long = peak_of_reading(tmp_path / "long")
    assert long_rows > 2.5 * short_rows
    assert long < 1.3 * short


def test_a_recording_gives_the_poses_that_were_commanded(tmp_path: Path) -> None:
    write_raw(tmp_path / "bag", recording(ARM, seed=3), 3000)
    session = read_bag(tmp_path / "bag", ARM)
    truth = next(iter(np.random.default_rng(3).uniform(ARM.lower, ARM.upper, (256, 1, ARM.n))))
    assert np.allclose(session.q[0], truth[0])
    assert session.t_s is not None
    assert np.allclose(np.diff(session.t_s[:-1]), PERIOD_S, atol=0.1)
    assert (np.abs(session.approach[1:]) == 1).all()


def test_a_sighting_that_was_recorded_late_goes_where_it_was_taken(tmp_path: Path) -> None:
    types = message_types()
    with robot(tmp_path / "bag") as put:

        def late(t: float, taken: float, x: float) -> None:
            sighting(lambda topic, kind, _, **f: made.update(f, kind=kind), taken, [x, 0.1, 0.3])
            put("tip_measured", made.pop("kind"), t, **made)

        made: dict[str, Any] = {}
        for k in range(40):
            command(put, 5.0 * k, [0.01 * k, 0.5, 0.05, 0.2])
            if k >= 11:  # 55 s after the next command was sent
                late(5.0 * k + 1.0, 5.0 * (k - 11) + 2.0, 0.4 + 0.01 * (k - 11))
    assert types is message_types()
    session = read_bag(tmp_path / "bag", ARM)
    assert np.allclose(session.q[:, 0], 0.01 * np.arange(29))
    assert np.allclose(session.xyz[:, 0], 0.4 + 0.01 * np.arange(29))


def test_context_told_late_holds_for_the_rows_before(tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        for k in range(60):
            command(put, 5.0 * k, [0.01 * k, 0.5, 0.05, 0.2])
            if k >= 40:
                kind = "sensor_msgs/msg/Temperature"
                put("temperature", kind, 5.0 * k + 1.0, header=header(), temperature=float(k),
                    variance=0.0)  # fmt: skip
            sighting(put, 5.0 * k + 2.0, [0.4, 0.1, 0.3])
    session = read_bag(tmp_path / "bag", ARM)
    assert session.columns["temperature_c"].tolist() == [float(max(k, 40)) for k in range(60)]


def test_states_of_several_senders_are_told_apart(tmp_path: Path) -> None:
    """The joints move until 1 s; a gripper reports on the same topic all the while."""
    none = np.array([])
    with robot(tmp_path / "bag") as put:
        command(put, 0.0, [0.4, 0.5, 0.05, 0.2])
        for k in range(1, 31):
            t = 0.1 * k
            state(put, t, [min(0.4 * t, 0.4), 0.5, 0.05, 0.2])
            put("joint_states", KIND, t + 0.01, header=header(), name=["gripper"],
                position=np.array([float(k)]), velocity=none, effort=none)  # fmt: skip
            sighting(put, t + 0.02, [0.3 + 1e-3 * min(t, 1.0), 0.1, 0.3])
    session = read_bag(tmp_path / "bag", ARM)
    # Still from the state at 1.0 s on: the sighting at 0.92 s, nearly at rest, is out.
    assert session.xyz[0, 0] == pytest.approx(0.301, abs=1e-9)


def test_joints_are_read_by_their_names(tmp_path: Path) -> None:
    q = [0.4, 0.5, 0.05, 0.2]
    with robot(tmp_path / "bag") as put:
        command(put, 0.0, q)
        for k in range(1, 31):
            state(put, 0.1 * k, q)  # in another order, and with a joint that is not the arm's
            sighting(put, 0.1 * k + 0.02, [0.3, 0.1, 0.3])
    session = read_bag(tmp_path / "bag", ARM)
    assert [session.readings[f"read_q{j}"][0, 0] for j in range(1, 5)] == pytest.approx(q)


def test_a_recording_is_endless_and_in_the_order_of_time() -> None:
    stamps = [raw.stamp_ns for raw in islice(recording(ARM), 2000)]
    assert all(a <= b for a, b in pairwise(stamps))
