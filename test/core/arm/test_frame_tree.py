"""Frames told over time: interpolated, carried along the tree, refused in words."""

import math

import numpy as np
import pytest

from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.frame_tree import FrameTree, NotYet, UnknownPlace, carry_place
from longarm_comp.core.errors import InputError

S = 10**9
STRAIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def about_z(angle: float) -> np.ndarray:
    return np.array([0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)])


def tree() -> FrameTree:
    """A table on the floor; a cart that drives along x in 2 s and turns by 90 degrees."""
    made = FrameTree()
    made.hear("floor", "table", np.array([0.0, 2.0, 0.5]), about_z(math.pi / 2), 0, static=True)
    made.hear("floor", "cart", np.zeros(3), STRAIGHT, 10 * S)
    made.hear("floor", "cart", np.array([4.0, 0.0, 0.0]), about_z(math.pi / 2), 12 * S)
    made.hear("cart", "hook", np.array([1.0, 0.0, 0.0]), STRAIGHT, 0, static=True)
    return made


def test_a_place_between_two_that_were_told_is_interpolated() -> None:
    hook = tree().place("hook", "floor", 11 * S)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(hook[:3, 3], [2.0 + half, half, 0.0], atol=1e-12)
    np.testing.assert_allclose(hook[:3, 0], [half, half, 0.0], atol=1e-12)
    quarter = tree().place("cart", "floor", 10 * S + S // 2)
    assert quarter[0, 3] == pytest.approx(1.0)
    np.testing.assert_allclose(
        quarter[:3, 0], [math.cos(math.pi / 8), math.sin(math.pi / 8), 0.0], atol=1e-12
    )


def test_frames_are_carried_across_the_tree_in_both_directions() -> None:
    known = tree()
    there = known.place("table", "hook", 12 * S)
    # The hook is at (4, 1, 0.0), turned by 90 degrees as the table is.
    np.testing.assert_allclose(there[:3, 3], [1.0, 4.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(there[:3, :3], np.eye(3), atol=1e-12)
    back = known.place("hook", "table", 12 * S)
    np.testing.assert_allclose(there @ back, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(carry_place(there, np.array([0.0, 0.0, 1.0])), [1.0, 4.0, 1.5])
    np.testing.assert_allclose(carry_place(there, back), np.eye(4), atol=1e-12)


def test_without_a_time_the_latest_that_all_know_holds() -> None:
    known = tree()
    known.hear("floor", "lamp", np.ones(3), STRAIGHT, 10 * S)
    known.hear("floor", "lamp", np.ones(3), STRAIGHT, 11 * S)
    assert known.place("cart", "floor", 0)[0, 3] == pytest.approx(4.0)
    assert known.place("cart", "lamp", 0)[0, 3] == pytest.approx(1.0)  # both are known at 11 s
    assert known.place("table", "floor", 0)[1, 3] == pytest.approx(2.0)


def test_the_shortest_turn_is_taken() -> None:
    one, two = about_z(0.2), -about_z(0.6)  # the sign of a quaternion says nothing
    np.testing.assert_allclose(quaternion.interpolate(one, two, 0.25), about_z(0.3), atol=1e-12)
    np.testing.assert_allclose(quaternion.interpolate(one, one, 0.5), one, atol=1e-15)


def test_what_is_not_known_is_said() -> None:
    known = tree()
    known.hear("shelf", "book", np.zeros(3), STRAIGHT, 0, static=True)
    with pytest.raises(NotYet, match=r"'cart' was last published 0\.50 s before"):
        known.place("hook", "floor", 12 * S + S // 2)
    with pytest.raises(UnknownPlace, match=r"'cart' is known only from 2\.00 s later on"):
        known.place("cart", "floor", 8 * S)
    with pytest.raises(UnknownPlace, match="'kitchen' is unknown"):
        known.place("kitchen", "floor", 0)
    with pytest.raises(UnknownPlace, match="no tf connects frame 'book' with 'floor'"):
        known.place("book", "floor", 0)


@pytest.mark.parametrize(
    ("parent", "position", "turn", "words"),
    [
        ("floor", [math.nan, 0, 0], [0, 0, 0, 1], "position of cart"),
        ("floor", [0, 0, 0], [0, 0, 0, 2], "rotation of cart"),
        ("cart", [0, 0, 0], [0, 0, 0, 1], "does not depend on 'cart'"),
        ("hook", [0, 0, 0], [0, 0, 0, 1], "does not depend on 'cart'"),
    ],
)
def test_rubbish_is_refused_and_changes_nothing(
    parent: str, position: list[float], turn: list[float], words: str
) -> None:
    known = tree()
    with pytest.raises(InputError, match=words):
        known.hear(parent, "cart", np.array(position, float), np.array(turn, float), 13 * S)
    assert known.place("cart", "floor", 0)[0, 3] == pytest.approx(4.0)


def test_old_places_are_forgotten_and_a_clock_that_jumps_back_starts_anew() -> None:
    known = tree()
    known.hear("floor", "cart", np.zeros(3), STRAIGHT, 21 * S)
    with pytest.raises(UnknownPlace, match="known only from"):
        known.place("cart", "floor", 10 * S)
    known.hear("floor", "cart", np.full(3, 7.0), STRAIGHT, 5 * S)
    assert known.place("cart", "floor", 0)[0, 3] == pytest.approx(7.0)
    known.hear("table", "cart", np.zeros(3), STRAIGHT, 5 * S)  # put on the table
    np.testing.assert_allclose(known.place("cart", "floor", 0)[:3, 3], [0.0, 2.0, 0.5])


def test_what_comes_out_of_order_is_put_in_order() -> None:
    known = tree()
    known.hear("floor", "cart", np.array([0.0, 9.0, 0.0]), STRAIGHT, 11 * S)
    known.hear("floor", "cart", np.array([0.0, 8.0, 0.0]), STRAIGHT, 11 * S)  # told again
    assert known.place("cart", "floor", 10 * S + S // 2)[1, 3] == pytest.approx(4.0)
