"""What no parameter explains goes on outside the range of the rows, and the promise knows it."""

from __future__ import annotations

import numpy as np
import pytest
from hidden_arm import SIGMA, calibrated
from numpy.polynomial.legendre import legval
from small_arm import ARM

from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model_file import restore, store
from longarm_comp.core.model.uncertainty import ModelUncertainty
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.drives import GearEccentricity

WAVE = np.array([0.0, 8e-3, 0.0, 0.0])
TRUTH = TrueArm(ARM, [GearEccentricity(np.array([0.0 * WAVE, WAVE]), np.full((2, ARM.n), 0.7))])


def test_a_parabola_goes_on_outside_its_range() -> None:
    """The third joint stood still: its rows tell nothing of how an error varies with it."""
    square = np.diag([1.0, 2.0, 3.0])
    ranges = {"q1": (-0.5, 1.5), "q2": (0.0, 1.0), "q3": (0.2, 0.2001), "payload_kg": (0.0, 1.0)}
    record = ModelUncertainty((), np.zeros((0, 0)), square, square, 1e-3, 9, circumstances=ranges)
    q = np.array([[0.0, 0.5, 0.9], [-0.5, 1.0, -3.0], [1.9, 0.5, 0.2], [-1.5, 1.3, 0.2]])
    rise = [(legval(1.0 + 2.0 * e, [0.0, 0.0, 1.0]) - 1.0) ** 2 / 0.2 for e in (0.2, 0.5, 0.3)]
    grown = np.array([0.0, 0.0, rise[0], rise[1] + rise[2]]) / 3.0 + 1.0
    found = record.structure_at(q, np.full(3, 0.1))
    np.testing.assert_allclose(found, grown[:, None, None] * square)


@pytest.mark.parametrize("stored", [False, True])
def test_beyond_the_rows_the_promise_holds(stored: bool) -> None:
    """Rows of the lower half of joint 2 hardly show that its gears run out of round.

    All of the error is this joint's, not its share: 0.7 are inside, 0.015 were.
    """
    rng = np.random.default_rng(3)
    upper = np.where(np.arange(ARM.n) == 1, ARM.mid, ARM.upper)
    q = ARM.lower + rng.random((120, ARM.n)) * (upper - ARM.lower)
    rows = Session.record(q, TRUTH.tip(q) + SIGMA * rng.standard_normal((120, 3)))
    model = with_uncertainty(calibrated(rows))
    if stored:
        model = restore(store(model), ARM, "model.yaml")
    fresh = ARM.lower + rng.random((400, ARM.n)) * (ARM.upper - ARM.lower)
    predicted = model.tip(fresh, Context())
    off = np.linalg.norm(TRUTH.tip(fresh) - predicted, axis=1)
    radius = expected_miss(model, fresh, Context(), predicted).sizes[1]
    inside, beyond = off <= radius, fresh[:, 1] > ARM.mid[1]
    assert inside[beyond].mean() >= 0.65 and inside[~beyond].mean() >= 0.85
    assert np.median(radius[beyond]) < 6.0 * np.median(off[beyond])
    assert np.median(radius[~beyond]) < 3.0 * SIGMA
