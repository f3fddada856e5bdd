"""What measures may have drifted, also where no drift was found: the promise knows it."""

import dataclasses

import numpy as np
import pytest
from hidden_arm import SIGMA, at, calibrated, session, tip
from small_arm import ARM

from longarm_comp.core.arm.context import ORDER, Context
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.data.commanded import moved_with_time
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.camera_errors import CameraDrift
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.sim.hidden.geometry import JointZero

HIDDEN = (JointZero(at(3, 2e-3)),)
DRIFT = np.array([3e-4, 3e-4, 9e-4])
"""From the first row to the last, m."""


def drifted(joint: int | None, drift: np.ndarray = DRIFT, **columns: np.ndarray) -> Session:
    """100 poses in the order of a joint's position, or as drawn, while the tracker drifts."""
    rows = session(HIDDEN, n=100)
    rows = rows if joint is None else rows.take(np.argsort(rows.q[:, joint]))
    time = np.linspace(0.0, 1.0, 100)[:, None]
    return Session.record(rows.q, rows.xyz + time * drift, columns=columns)


def judged(model: Model) -> tuple[float, float]:
    """Share of true tips inside the promised radius, in the frame of the session's start, and the
    radius, m."""
    q = ARM.lower + np.random.default_rng(8).random((100, ARM.n)) * (ARM.upper - ARM.lower)
    predicted = model.tip(q, Context())
    off = np.linalg.norm(tip(HIDDEN, q, np.ones(100)) - predicted, axis=1)
    radius = expected_miss(model, q, Context(), predicted).sizes[1]
    return float((off <= radius).mean()), float(np.median(radius))


@pytest.mark.parametrize("joint", [None, 0, 1, 3])
def test_a_drift_that_no_model_holds_is_in_the_promise(joint: int | None) -> None:
    """In rows along one joint it looks like a fault of this joint."""
    rows = drifted(joint)
    model = with_uncertainty(calibrated(rows))
    assert judged(model)[0] >= 0.9
    at_rows = expected_miss(model, rows.q, Context(), model.tip(rows.q)).sizes[0]
    assert model.uncertainty is not None
    assert at_rows.max() == pytest.approx(model.uncertainty.largest_m, rel=0.02)


def test_without_a_drift_rows_in_any_order_but_a_joint_s_promise_what_they_did() -> None:
    still = judged(with_uncertainty(calibrated(drifted(None, 0.0 * DRIFT))))
    assert still[0] >= 0.9 and still[1] < 1.7 * SIGMA
    along = judged(with_uncertainty(calibrated(drifted(0, 0.0 * DRIFT))))
    assert along[1] > 1.2 * still[1]


def test_in_a_quick_session_little_can_drift() -> None:
    hour, minute = (
        judged(with_uncertainty(calibrated(drifted(0, 0.0 * DRIFT, t_s=np.linspace(0.0, s, 100)))))
        for s in (3600.0, 60.0)
    )
    assert minute[1] < 0.9 * hour[1]


def test_a_drift_that_the_model_holds_counts_once() -> None:
    rows = drifted(0, t_s=np.linspace(0.0, 3600.0, 100))
    *_, (_, fit) = fit_stages(declared_model(ARM).plus(CameraDrift()), rows)
    held = judged(with_uncertainty(fit))
    assert held[0] >= 0.9 and held[1] < judged(with_uncertainty(calibrated(rows)))[1]


@pytest.mark.parametrize(
    ("place", "direction", "as_frame"),
    [("joint 1", "move z", 1.0), ("joint 1", "turn z", 1.0), ("joint 3", "move z", 0.0)],
)
def test_a_part_that_moves_as_a_frame_would_may_have_been_the_frame(
    place: str, direction: str, as_frame: float
) -> None:
    rows = drifted(None, **{ORDER: np.arange(100.0)})
    moves = Discovered(place, direction, f"linear({ORDER})", f"{ORDER} 0..99")
    moves = dataclasses.replace(moves, amount=1e-5)
    moved = moved_with_time(Model(ARM, (moves,)), rows, SIGMA**2)
    own = Model(ARM, (moves,)).tip(rows.q, rows.context()) - Model(ARM).tip(rows.q)
    np.testing.assert_allclose(moved, as_frame * (own - own[-1]), atol=1e-6)
