"""Whether readings still tell where joints stand, by readings alone."""

import pytest
from follower_rig import servo_state

from longarm_comp.core.errors import JobError
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.turn_counts import TurnCounts

HORN = {
    "servo_id": 1, "model": "sts3215", "type": "revolute", "zero_ticks": 2048.0,
    "lower": -0.1, "upper": 0.1, "max_velocity": 0.2,
}  # fmt: skip
RACK = HORN | {"type": "prismatic", "pinion_radius_m": 0.01, "lower": -0.01, "upper": 0.01}
KINDS = {
    "geared": HORN | {"gear_ratio": 10.0}, "rack": RACK | {"max_velocity": 0.01},
    "many turns": HORN | {"multi_turn": True},
}  # fmt: skip
HALF_S = 2048.0 / (50.0 / 60.0 * 4096.0)
"""Time in which a STS3215 may make half a turn."""


def _is_doubtful(joint: dict[str, object], *readings: tuple[float, int]) -> bool:
    """Whether the count of turns is in doubt after readings at these times, s."""
    bus = {"protocol": "feetech", "port": "/dev/null"}
    counts = TurnCounts(ServoConfig.parse({"bus": bus, "joints": {"a": joint}}, "here"))
    for now, ticks in readings:
        counts.follow(now, {1: servo_state(ticks)})
    try:
        counts.check()
    except JobError as error:
        return "a may have lost count" in str(error)
    return False


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("readings", "doubtful"),
    [
        (((0.0, 100), (0.02, 2100), (0.04, 3900)), False),  # it moves on
        (((0.0, 100), (0.02, 4000)), True),  # it passed 0, or lost a turn
        (((0.0, 4000), (0.02, 100)), True),
        (((0.0, 100), (0.02, 4000), (0.04, 100)), False),  # and back, or one false reading
        (((0.0, 100), (0.02, 4000), (0.04, 3900)), True),
        (((0.0, 100), (0.02, 3000), (0.04, 900)), False),
        (((0.0, 1000), (1.02 * HALF_S, 1401)), True),  # it moved unread
        (((0.0, 1000), (1.02 * HALF_S, 599)), True),
        (((0.0, 1000), (1.02 * HALF_S, 1400)), False),
        (((0.0, 1000), (0.98 * HALF_S, 1401)), False),
        (((0.0, 1000), (1.02 * HALF_S, 1401), (1.1 * HALF_S, 1000)), True),
    ],
)
def test_the_count_of_turns_is_in_doubt_after_a_jump_or_an_unread_move(
    kind: str, readings: tuple[tuple[float, int], ...], doubtful: bool
) -> None:
    assert _is_doubtful(KINDS[kind], *readings) is doubtful
    assert not _is_doubtful(HORN, *readings)


@pytest.mark.parametrize(
    ("model", "stored", "readings", "away", "at_power_on"),
    [
        ("sts3215", {}, (2048, 4095), False, (0, 4095)),
        ("sts3215", {}, (2048, 4096), True, (0, 4095)),
        ("sts3215", {}, (2048, -1), True, (0, 4095)),
        ("sts3215", {}, (4096, 4090), True, (0, 4095)),  # it may tremble there
        ("sts3215", {}, (4096, 4055), False, (0, 4095)),
        ("sts3215", {"homing_offset": 500}, (2048, 3700), True, (-500, 4095)),
        ("xl430-w250", {"homing_offset": 500}, (2048, 499), True, (500, 4595)),
    ],
)  # fmt: skip
def test_a_servo_that_left_the_turn_of_power_on_and_reads_in_it_may_have_lost_count(
    model: str, stored: dict[str, int], readings: tuple[int, ...], away: bool,
    at_power_on: tuple[int, int],
) -> None:  # fmt: skip
    bus = {"protocol": "feetech" if model == "sts3215" else "dynamixel", "port": "/dev/null"}
    joint = KINDS["many turns"] | {"model": model, "stored": stored}
    joints = {"a": joint, "b": KINDS["geared"] | {"model": model, "servo_id": 2}}
    config = ServoConfig.parse({"bus": bus, "joints": joints}, "here")

    def begun(at: int, *were_away: str) -> TurnCounts:
        counts = TurnCounts(config, were_away)
        returned = counts.begin(0.0, {1: servo_state(at), 2: servo_state(3000)})
        assert returned == (["a"] if "a" in were_away and low <= at <= high else [])
        return counts

    low, high = at_power_on
    counts = begun(readings[0])
    counts.follow(0.02, {1: servo_state(readings[1])})
    assert counts.away == ({"a"} if away else set())
    counts.follow(0.04, {2: servo_state(-5)})
    assert counts.away == ({"a"} if away else set())
    for at in (low - 1, low, high, high + 1):
        begun(at)
        begun(at, "a", "somebody else")


def test_what_follows_its_goals_has_not_jumped() -> None:
    bus = {"protocol": "feetech", "port": "/dev/null"}
    config = ServoConfig.parse({"bus": bus, "joints": {"a": KINDS["geared"]}}, "here")
    counts = TurnCounts(config)
    counts.follow(0.0, {1: servo_state(100)})
    counts.trust(1.0, {1: servo_state(3900)})
    counts.follow(1.0 + 0.9 * HALF_S, {1: servo_state(3400)})
    counts.check()
    assert counts.stood == {1: 3400}
    counts.lose({1})
    with pytest.raises(JobError, match="lost count"):
        counts.check()
