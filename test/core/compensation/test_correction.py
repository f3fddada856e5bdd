"""How far a command moves the tip away from its target, and how far it may."""

import numpy as np
import pytest
from small_arm import ARM, AWAY

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.circumstances import allowed_range
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.correction import (
    SHARE_OF_REACH,
    measure_correction,
    permitted_correction,
)
from longarm_comp.core.compensation.result import Status
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import reach
from longarm_comp.core.model.model import Model


@pytest.mark.parametrize(("times_most", "sent"), [(0.1, True), (1.0, True), (3.0, False)])
def test_an_arm_carries_what_it_declares_and_nothing_absurd(
    arm: Arm, times_most: float, sent: bool
) -> None:
    """Without a predictor too, physics is corrected only up to a tenth of the reach."""
    model, rigid = declared_model(arm), Model(arm)
    carried = Context(columns={"payload_kg": times_most * allowed_range(arm, "payload_kg")[1]})
    target = rigid.tip(arm.mid)
    (made,) = compensate(model, None, target, context=carried, realisable=False)
    most = permitted_correction(model, None)
    assert most == SHARE_OF_REACH * reach(rigid)[1]
    assert made.status is (Status.NO_PREDICTOR if sent else Status.CORRECTION_TOO_LARGE)
    size = float(np.linalg.norm(rigid.tip(made.ideal) - target))
    assert (size <= most) is sent
    (wider,) = compensate(
        model, None, target, context=carried, realisable=False, max_correction_m=1.01 * size
    )
    assert wider.success
    found = measure_correction(model, made.ideal[None], target[None], carried)
    np.testing.assert_allclose(found, [size], rtol=1e-9)


def test_where_the_base_stands_is_no_correction() -> None:
    """A tracker's frame is metres away: the arm that stands there is still the declared one."""
    away, q = Model(ARM, (AWAY,)), ARM.mid + 0.1 * np.arange(3.0)[:, None]
    far = np.linalg.norm(away.tip(q) - Model(ARM).tip(q), axis=1)
    assert far.min() > permitted_correction(away, None)
    found = measure_correction(away, q, away.pose(q), Context())
    np.testing.assert_allclose(found, np.zeros(3), atol=1e-9)
