"""Sessions as bags: exact round trips, and bags as a robot records them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_robot import STORAGES, command, header, refusal, robot, row_said, sighting, state
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation
from sensed_arm import only, read, sensed
from session_bag import write_bag
from small_arm import ARM, measured

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.rest import Sighting, mean_at_rest
from longarm_comp.core.data.session import Session
from longarm_comp.sessions.bag import NO_LOAD, bag_info, read_bag
from longarm_comp.sessions.csv import read_csv, write_csv
from longarm_comp.sessions.message_types import message_types
from longarm_comp.sessions.read import read_session

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


def test_poses_single_coordinates_and_distances_survive(tmp_path: Path) -> None:
    rows = sensed(n=12)
    xyz = rows.position()
    xyz[3:6, 1] = np.nan
    third = np.arange(12) % 3
    names = np.where(third == 1, "left", "")
    readings = {
        "orientation": only(rows.quaternion(), third == 0),
        "distance": only(rows.distance(np.full(12, "left")), third == 1),
    }
    sigmas = {"orientation": np.where(np.arange(12) % 6 == 0, 2e-3, np.nan)}
    session = read(rows, xyz=xyz, readings=readings, sigmas=sigmas, labels={"anchor": names})
    write_bag(session, tmp_path / "bag", ARM)
    back = read_session(tmp_path / "bag", ARM)
    np.testing.assert_array_equal(back.xyz, session.xyz)
    for name, values in session.readings.items():
        np.testing.assert_allclose(back.readings[name], values, rtol=1e-15)
    np.testing.assert_allclose(back.sigmas["orientation"], sigmas["orientation"], rtol=1e-12)


def test_orientations_are_averaged_as_turns(tmp_path: Path) -> None:
    """Of either sign, as cameras report them; their spread says that they were measured."""
    turns = [Rotation.from_rotvec([0.1 + 1e-3 * k, 0.2, -0.3]).as_quat() for k in (-1, 0, 1)]
    with robot(tmp_path / "bag") as put:
        command(put, 1.0, [0.1, 0.5, 0.05, 0.2])
        for k, turn in enumerate(turns):
            sighting(put, 1.2 + k / 10, [0.4, 0.1, 0.3], turn=(-1) ** k * turn, turn_sd=3e-3)
    session = read_bag(tmp_path / "bag", ARM)
    mean = Rotation.from_quat(session.readings["orientation"][0])
    assert (mean * Rotation.from_quat(turns[1]).inv()).magnitude() < 1e-6
    assert session.sigmas["orientation"][0] == pytest.approx(3e-3 / np.sqrt(3))


# ------------------------------------------------------------------ when the tip is at rest


def _still_from(readings: list[float], sighted: dict[float, float]) -> float:
    """The tip that `mean_at_rest` takes, of readings every 0.05 s and sightings by time."""
    times = 0.05 * np.arange(1, len(readings) + 1)
    seen = [
        Sighting(t, np.array([x, 0.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), 0.0)
        for t, x in sighted.items()
    ]
    found = mean_at_rest(seen, times, np.array(readings)[:, None], 0.0)
    assert found[0] is not None
    return float(found[0].xyz[0])


def test_a_joint_that_still_creeps_to_its_end_is_not_at_rest() -> None:
    """At 0.10 s it is 0.9 mrad off, within the tolerance of rest; at 0.15 s it stands."""
    joint = [0.1, 0.4991, *8 * [0.5]]
    rest = {0.3: 0.7, 0.4: 0.7}
    assert _still_from(joint, {0.12: 0.7009, **rest}) == 0.7
    assert _still_from(joint, {0.17: 0.7001, **rest}) == 0.7  # the encoder stands, the tip swings
    assert _still_from(joint, {0.17: 0.7001}) == 0.7001  # nothing better was seen
    assert _still_from(joint, {0.12: 0.7009}) == 0.7009


def test_an_encoder_that_flickers_is_at_rest() -> None:
    tick = 1.5e-3
    joint = [0.1, *(0.5 + tick * (k % 2) for k in range(9))]
    assert _still_from(joint, {0.2: 0.7, 0.4: 0.701}) == pytest.approx(0.7005)


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


def test_what_a_busy_machine_records_late_is_put_where_it_happened(tmp_path: Path) -> None:
    """The arm stands from 1.3 s on and is seen till 1.8 s; the joints are recorded in a burst."""
    first, second = [0.1, 0.5, 0.05, 0.2], [0.2, 0.4, 0.05, 0.2]
    with robot(tmp_path / "bag") as put:
        command(put, 1.0, first)
        for k in range(5):
            sighting(put, 1.4 + k / 10, [0.4, 0.1, 0.3])
        for k in range(8):
            state(put, 1.1 + k / 10, [min(1.0, (k + 1) / 3) * v for v in first], late=1.0 - k / 11)
        row_said(put, 2.3, index=0)
        command(put, 3.4, second, stamp=2.5)
        for k in range(8):  # on its way before the recorder heard why
            state(put, 2.6 + k / 10, [min(1.0, (k + 1) / 3) * v for v in second])
            sighting(put, 2.65 + k / 10, [0.5 if k > 2 else 0.45, 0.1, 0.3])
        row_said(put, 3.6, index=1)
    session = read_bag(tmp_path / "bag", ARM)
    np.testing.assert_allclose(session.xyz[:, 0], [0.4, 0.5])
    assert not session.lost


def test_a_measurement_that_failed_is_a_row_and_says_why(tmp_path: Path) -> None:
    """Without a word that it was to be measured, the first two would be passages."""
    q = [0.1, 0.5, 0.05, 0.2]
    poses = [[k / 10, *q[1:]] for k in range(5)]
    with robot(tmp_path / "bag") as put:
        command(put, 1.0, poses[0])  # nothing is seen
        command(put, 2.0, poses[1])
        for k in range(8):  # never at rest
            state(put, 2.1 + k / 20, [k / 10, *q[1:]])
            sighting(put, 2.12 + k / 20, [0.4, 0.1, 0.3])
        command(put, 3.0, poses[2])
        sighting(put, 3.2, [np.nan] * 3)
        command(put, 4.0, poses[3])
        sighting(put, 4.1, [0.4, 0.1, 0.3])
        for k in range(4):
            state(put, 4.2 + k / 10, [min(3, k + 2) / 10, *q[1:]])
        command(put, 5.0, poses[4])
        sighting(put, 5.5, [0.4, 0.1, 0.3], sd=1e-3)
        for k in range(5):
            row_said(put, k + 1.9, index=k)
    session = read_bag(tmp_path / "bag", ARM)
    assert session.index.tolist() == [0, 1, 2, 3, 4]
    assert session.q.tolist() == poses
    assert session.seen.tolist() == [False] * 4 + [True]
    assert list(session.lost) == [0, 1, 2, 3]
    said = "no sighting", "did not rest", "marker lost", "on the way"
    assert all(words in why for words, why in zip(said, session.lost.values(), strict=True))
    assert session.sigma is not None  # the blank rows do not cost the others theirs
    assert session.sigma[4] == pytest.approx(1e-3)
    write_csv(session, tmp_path / "rows.csv")
    np.testing.assert_array_equal(read_csv(tmp_path / "rows.csv", ARM).sigma, session.sigma)


@pytest.mark.parametrize("silent", [0.0, np.nan, np.inf])
def test_a_sighting_of_unknown_accuracy_costs_only_its_own_row_the_sigma(
    tmp_path: Path, silent: float
) -> None:
    """Of the second row one of two sightings does not say how accurate it is."""
    with robot(tmp_path / "bag") as put:
        for k in range(3):
            command(put, k + 1.0, [k / 10, 0.5, 0.05, 0.2])
            sighting(put, k + 1.4, [0.4, 0.1, 0.3], sd=1e-3)
            sighting(put, k + 1.5, [0.4, 0.1, 0.3], sd=silent if k == 1 else 1e-3)
    session = read_bag(tmp_path / "bag", ARM)
    assert session.seen.all()
    known, unknown = [1e-3 / np.sqrt(2)] * 3, [np.nan] * 3
    np.testing.assert_allclose(session.sigma, [known, unknown, known])


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
        put("payload", "std_msgs/msg/Float64", 0.2, data=0.4)
    session = read_bag(tmp_path / "bag", ARM)
    assert session.columns["temperature_c"].tolist() == [20.0, 20.0, 22.5]
    assert session.columns["payload_kg"].tolist() == [0.4, 0.4, 0.4]
    assert session.t_s is not None
    assert np.allclose(session.t_s, [0.5, 1.5, 2.5])


def test_rows_before_the_first_word_on_the_payload_are_blank_and_say_why(tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        for k in range(4):
            command(put, k + 0.1, [0.1 * k, 0.5, 0.05, 0.2])
            sighting(put, k + 0.5, [0.4, 0.1 * k, 0.3])
        put("payload", "std_msgs/msg/Float64", 1.8, data=1.5)  # a gripper's node starts
    session = read_bag(tmp_path / "bag", ARM)
    assert session.has_position.tolist() == [False, False, True, True]
    assert session.lost == {0: NO_LOAD, 1: NO_LOAD}
    assert session.columns["payload_kg"].tolist() == [1.5] * 4


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
    assert "payload_kg" not in session.columns
    read = {t["topic"]: t["read"] for t in bag_info(tmp_path / "bag")["topics"]}
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


@pytest.mark.parametrize("lost_told", [True, False])
def test_a_marker_that_is_seen_on_the_way_only_is_lost(lost_told: bool) -> None:
    """The joints rest from 1.0 s on; what was sighted before shows another place."""

    def at(t: float, *xyz: float) -> Sighting:
        return Sighting(t, np.array(xyz), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), 0.0)

    times = np.arange(0.0, 2.0, 0.1)
    joints = np.minimum(times, 1.0)[:, None]
    moving = [at(0.3, 0.1, 0, 0), at(0.8, 0.4, 0, 0)]
    resting = [at(1.4, *[np.nan] * 3), at(1.9, *[np.nan] * 3)] if lost_told else []
    lost, why = mean_at_rest([*moving, *resting], times, joints, 0.0)
    assert lost is not None and "on the way" in why
    assert np.isnan(lost.xyz).all() and np.isnan(lost.quaternion).all()
    found, why = mean_at_rest([*moving, *resting, at(1.95, 0.7, 0, 0)], times, joints, 0.0)
    assert found is not None and not why
    np.testing.assert_allclose(found.xyz, [0.7, 0, 0])
