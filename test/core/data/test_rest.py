"""When an arm is at rest, so that a sighting is of its command."""

import numpy as np

from longarm_comp.core.arm.history import History
from longarm_comp.core.data.rest import RestWatch


def test_servos_that_give_way_rest_where_the_driver_says_so() -> None:
    """They never come within a tick of their goals; until then it is a passage."""
    watch = RestWatch(settle_s=0.5, sightings=1)
    goal, hangs, tip = np.zeros(2), np.array([0.0, -0.02]), np.array([0.4, 0.1, 0.3])
    for told in (False, True):
        watch.on_command(goal, History.unknown(2))
        if told:
            watch.on_arrival(1.0)
        watch.joints(hangs, 1.0)
        rest = watch.on_sighting(tip, np.zeros(3), 2.0)
        assert (rest is not None) == told
    watch.on_command(goal, History.unknown(2))
    watch.joints(hangs, 3.0)
    assert watch.on_sighting(tip, np.zeros(3), 4.0) is None


def test_a_reading_of_the_way_that_comes_after_the_arrival_is_no_rest() -> None:
    """Messages of different topics overtake each other on a busy machine."""
    watch = RestWatch(settle_s=0.5, sightings=1)
    goal, tip = np.zeros(2), np.array([0.4, 0.1, 0.3])
    watch.on_command(goal, History.unknown(2))
    watch.on_arrival(3.0)
    for q, at_s in ((goal + 0.2, 2.0), (goal, 3.0)):
        watch.joints(q, at_s)
    assert watch.on_sighting(tip, np.zeros(3), 2.9) is None
    assert watch.on_sighting(tip, np.zeros(3), 3.5) is not None


def test_an_arm_that_leaves_its_rest_without_a_command_is_at_no_rest() -> None:
    """By hand, or without torque: its sightings are not of the command."""
    watch = RestWatch(settle_s=0.5, sightings=2)
    goal, tip = np.zeros(2), np.array([0.4, 0.1, 0.3])
    for moved, rests in ((1e-3, True), (3e-2, False)):
        watch.on_command(goal, History.unknown(2))
        watch.on_arrival(1.0)
        watch.joints(goal, 1.0)
        assert watch.on_sighting(tip, np.zeros(3), 2.0) is None
        watch.joints(goal + moved, 2.1)
        found = [watch.on_sighting(tip, np.zeros(3), 3.0)]
        watch.joints(goal, 3.1)  # it comes back
        found.append(watch.on_sighting(tip, np.zeros(3), 4.0))
        assert any(rest is not None for rest in found) == rests
