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
