"""The zeros of several joints change at once, as where an arm is referenced anew."""

import numpy as np
import pytest
from hidden_arm import SIGMA
from known_arm import RIGID, ZEROS, calibrated, judged
from read_arm import ARM

from longarm_comp.core.arm.context import Context
from longarm_comp.core.at_work.changes import TOGETHER, Parameters
from longarm_comp.core.at_work.explanations import Branch, Explanations, _PastChange
from longarm_comp.core.at_work.learner import Learner
from longarm_comp.core.at_work.posterior import RecursivePosterior
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.geometry import JointZero


@pytest.mark.parametrize("changes", [(2e-3, -3e-3, 2e-3, 0.0), (-4e-3, 0.0, -1.2e-3, 2.1e-3)])
def test_zeros_that_change_at_once_are_named_together(changes: tuple[float, ...]) -> None:
    """One joint at a time, the first was a knock of the base and nothing was learned; of the second
    one joint was named, and half of the tips were inside the promise."""
    rng = np.random.default_rng(0)
    changed = TrueArm(ARM, [JointZero(ZEROS.offset + changes)])
    learner = Learner.of(calibrated(RIGID, "wide"))
    for k in range(50):
        truth = RIGID if k < 10 else changed
        q = ARM.lower + rng.random(ARM.n) * (ARM.upper - ARM.lower)
        tip = truth.tip(q[None])[0] + SIGMA * rng.standard_normal(3)
        learner = learner.learn(q, Context(), tip, np.full(3, SIGMA**2), 60.0 * k)
        if k >= 27:
            assert judged(learner.model, changed)[0] >= 0.95
    assert judged(learner.model, changed)[1] < SIGMA
    (named,) = learner.now
    assert (named.effect, named.where) == ("joint_zero", TOGETHER)
    moved = {name: value for name, _, value in named.by}
    for joint, change in enumerate(changes, start=1):
        assert moved[f"joint {joint} offset"] == pytest.approx(change, abs=1e-3)


def test_places_come_in_the_order_of_the_changes() -> None:
    """Two changes that become certain at once are reported in the same order by every run."""
    model = calibrated(RIGID, "wide")
    space = Parameters.of(model, Context())
    known = RecursivePosterior.begin(space, space.values(model), np.arange(2), np.eye(2))
    names = [f"joint {k}" for k in (5, 2, 7, 1, 6, 3, 4)]
    changes = tuple(_PastChange(("joint_zero", n), n, 0.0, 2, (0.0,)) for n in names)
    assert list(Explanations((Branch(1.0, known, changes),)).places) == names
