"""Readings of the joints that may not be believed, and messages that a full queue has lost."""

import numpy as np
import pytest
from walking import Walk

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.online import JointTrust, check_inside
from longarm_comp.core.errors import InputError
from longarm_comp.nodes.worker import SequenceWatch

DT = 0.02


def test_joints_that_move_as_joints_do_are_believed(arm: Arm) -> None:
    trust, range_ = JointTrust(arm, rate=1.0), arm.upper - arm.lower
    for k in range(40):
        assert trust.read(arm.lower + (k / 40) * range_, k * DT)
    assert trust.read(arm.lower - 0.019 * range_, 100.0)  # beside a limit, after a long time
    assert not trust.doubt


def test_an_arm_of_a_tests_own_is_believed_however_late_it_is_heard(arm: Arm) -> None:
    trust, walk = JointTrust(arm, rate=1.0), Walk(arm)
    walk.go([arm.upper, arm.lower, arm.mid])
    trust.read(walk.q, 0.0)
    assert all(trust.read(walk.q, 0.0) for _ in iter(walk.step, False))
    np.testing.assert_array_equal(walk.q, arm.mid)


@pytest.mark.parametrize("share", [0.03, -1.03])
def test_joints_outside_their_limits_are_named(arm: Arm, share: float) -> None:
    q = arm.upper.copy()
    q[3] += share * (arm.upper - arm.lower)[3]
    with pytest.raises(InputError, match="joint4"):
        check_inside(q, arm, "seed")
    q[3] = np.nan
    with pytest.raises(InputError, match="joint4"):
        check_inside(q, arm, "seed")
    trust = JointTrust(arm, rate=1.0)
    assert not trust.read(np.where(np.arange(arm.n) == 3, 50.0, arm.mid), 0.0)
    assert "joint4: 50" in trust.doubt
    assert [trust.read(arm.mid, k * DT) for k in (1, 2, 3)] == [False, False, True]


def test_two_arms_on_one_topic_are_never_believed(arm: Arm) -> None:
    trust, other = JointTrust(arm, rate=1.0), arm.mid.copy()
    other[1] += 0.13 * (arm.upper - arm.lower)[1]  # just above what joints can do in 0.02 s
    assert trust.read(arm.mid, 0.0)
    assert not any(trust.read((arm.mid, other)[k % 2], k * DT) for k in range(1, 50))
    assert "joint2 jumped" in trust.doubt
    slower = JointTrust(arm, rate=2.0)
    slower.read(arm.mid, 0.0)
    assert slower.read(other, DT)


def test_a_doubt_from_elsewhere_ends_as_the_others_do(arm: Arm) -> None:
    trust = JointTrust(arm, rate=1.0)
    trust.distrust("too old")
    assert trust.doubt == "too old"
    assert [trust.read(arm.mid, k * DT) for k in range(3)] == [False, False, True]


def test_a_full_queue_tells_what_it_has_dropped() -> None:
    watch = SequenceWatch()
    watch.count([1, 2, 3], full=False)
    watch.count([7, 8], full=False)  # not full: so this is somebody else's
    assert watch.lost == 0
    watch.count([12, 13, 14], full=True)
    assert watch.lost == 3
    two = SequenceWatch()
    two.count([100, 1, 101, 2], full=False)
    two.count([112, 8, 113, 9], full=True)  # 10 of one and 5 of the other
    assert two.lost == 15
