"""What the page of `longarm view` says of what it has heard."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from longarm_comp.view import words
from longarm_comp.view.words import (
    CollectProgress,
    LastAnswer,
    NodeHealth,
    PageState,
    Part,
    Picture,
)

DECLARED = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [1.0, 0.0, 0.5]])
HANGING = DECLARED - np.array([[0.0], [0.0], [0.01]]) * np.array([0.0, 0.0, 1.0])
TARGET = np.array([1.0, 0.0, 0.488])
SEEN = np.array([1.0, 0.003, 0.484])
"""3 mm and 4 mm beside the target; 3 mm and 6 mm beside the prediction."""
JOINTS = {"a": 0.1, "b": -0.2}


def at_rest() -> PageState:
    """An arm that rests at its target since 10 s, seen a moment ago; it is 20 s now."""
    return (
        PageState(
            heard=19.9,
            picture=Picture(DECLARED, HANGING, TARGET, None, 19.8),
            tip=SEEN,
            tip_at=19.9,
            answer=LastAnswer("SUCCESS", "", JOINTS),
        )
        .with_joints(JOINTS, 10.0)
        .with_joints(JOINTS, 19.9)
    )


def test_errors_of_an_arm_at_rest() -> None:
    state = at_rest()
    np.testing.assert_allclose(state.miss_at_target(20.0), [0.0, 0.003, -0.004])
    np.testing.assert_allclose(state.miss_of_prediction(20.0), [0.0, 0.003, -0.006])
    at_target, as_predicted, *_ = words.list_lines(state, 20.0, "/", "")["tip"]
    assert at_target == "tip − target: 5.00 mm (x +0.00, y +3.00, z -4.00)"
    assert as_predicted.startswith("tip − predicted: 6.71 mm (x ")


def test_there_is_no_error_without_a_sighting_of_now() -> None:
    state = at_rest()
    lost = replace(state, tip=np.full(3, math.nan))
    for blind, now in ((replace(state, tip=None), 20.0), (lost, 20.0), (state, 24.0)):
        assert (
            blind.miss_at_target(now) == blind.miss_of_prediction(now) == "no camera sees the tip"
        )
        assert words.list_lines(blind, now, "/", "")["tip"][0].endswith(": no camera sees the tip")


@pytest.mark.parametrize("old", ["picture", "tip"])
def test_there_is_no_error_while_the_arm_moves(old: str) -> None:
    """Picture and sighting must both be later than the last movement, and a little more."""
    moved = at_rest().with_joints({"a": 0.11, "b": -0.2}, 19.5)
    assert moved.miss_at_target(20.0) == moved.miss_of_prediction(20.0) == "the arm moves"
    assert moved.picture is not None
    for late, rests in ((21.0, True), (20.0, False)):
        at = {"picture": 21.0, "tip": 21.0, old: late}
        picture = replace(moved.picture, at=at["picture"])
        assert replace(moved, picture=picture, tip_at=at["tip"]).resting == rests


def test_a_servo_that_trembles_does_not_move_and_one_that_creeps_does() -> None:
    state = at_rest()
    for k, shake in enumerate((0.001, -0.001, 0.0015)):
        state = state.with_joints({"a": 0.1 + shake, "b": -0.2}, 11.0 + k)
    assert state.moved == 10.0
    for k in range(4):
        state = state.with_joints({"a": 0.1 + 0.0011 * k, "b": -0.2}, 15.0 + k)
    assert state.moved == 17.0


def test_the_miss_is_of_the_target_that_the_joints_were_sent_to() -> None:
    state = at_rest()
    assert state.answer is not None
    elsewhere = replace(state, answer=LastAnswer("SUCCESS", "", {"a": 0.1, "b": -0.3}))
    unsent = replace(state, answer=LastAnswer("UNREACHABLE", "3 mm missing", {}))
    foreign = replace(state, answer=LastAnswer("SUCCESS", "", {"c": 0.1}))
    for other in (elsewhere, unsent, foreign, replace(state, answer=None)):
        assert isinstance(other.miss_at_target(20.0), str)
        assert not isinstance(other.miss_of_prediction(20.0), str)
    assert elsewhere.miss_at_target(20.0) == "the arm is not at the last target"
    _, target = words.list_lines(unsent, 20.0, "/", "")["state"]
    assert target == "Last target: UNREACHABLE, nothing sent: 3 mm missing."


def test_silence_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    assert "Nothing received yet in namespace /left of ROS domain 7" in words.say_headline(
        PageState(), 5.0, "/left"
    )
    state = replace(at_rest(), driver=("in fault", "joint2 stalled"))
    assert not state.is_old(22.0) and state.is_old(23.0)
    assert words.say_headline(replace(state, heard=25.0), 25.0, "/") == "No joint_states for 5 s."
    assert words.say_headline(PageState(heard=25.0), 25.0, "/") == "No joint_states."
    assert words.say_headline(state, 22.0, "/") == "The driver is in fault (joint2 stalled)."
    assert words.say_headline(state, 30.0, "/").startswith("The graph is silent for 10 s.")
    assert words.say_headline(state, 500.0, "/").startswith("The graph is silent for 8 min.")


def test_a_node_is_as_well_as_its_worst_part_and_silent_by_its_own_pace() -> None:
    parts = (Part("bus", 0, "fine"), Part("heat", 1, "60 degrees"), Part("load", 2, "stalled"))
    state = PageState().with_report("driver", parts, 1.0).with_report("driver", parts, 2.0)
    node = state.nodes["driver"]
    said = ["✖ driver: error", "▲ heat: 60 degrees", "✖ load: stalled"]
    assert words.describe_health(node, 6.0) == said
    assert words.describe_health(node, 9.0) == ["■ driver: silent for 7 s"]
    slow = state.with_report("driver", parts, 12.0).nodes["driver"]
    assert words.describe_health(slow, 40.0) == said
    assert words.describe_health(slow, 43.0) == ["■ driver: silent for 31 s"]
    assert words.describe_health(NodeHealth("n", (Part("p", 3, "?"),), 1.0), 1.0)[0] == "■ n: stale"


def test_exaggeration_in_words() -> None:
    assert "10 times larger than it is, error arrows to scale" in words.describe_scale(10.0, 1.0)
    assert "drawn to scale, error arrows 50 times longer" in words.describe_scale(1.0, 50.0)


def test_drift_and_progress_in_words() -> None:
    def lines(place: str, now: float = 5.0, **changes: Any) -> list[str]:
        return words.list_lines(PageState(**changes), now, "/", "")[place]

    assert lines("tip")[-1] == "Drift: nothing judged yet."
    assert lines("tip", evidence=0.5)[-1].endswith("does not warn.")
    assert lines("tip", evidence=1.0)[-1].endswith("the test warns.")
    job = CollectProgress(0.3, "7 of 24 poses driven", 10.0)
    assert lines("job", 12.0, progress=job) == ["collect: 7 of 24 poses driven"]
    assert lines("job", 22.0, progress=job) == ["collect: 7 of 24 poses driven; heard 12 s ago"]
    assert lines("job") == []
