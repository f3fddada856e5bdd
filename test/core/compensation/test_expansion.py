"""One answer that holds nearby: slope, reach, and the same commands as asking every time."""

import numpy as np
import pytest
from small_arm import ARM

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.expansion import LINEAR_M, Nearby
from longarm_comp.core.compensation.result import Status
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.model.declared_model import declared_model
from studies.many import compensate_arrays

SPAN = ARM.upper - ARM.lower
FROM_BELOW = Context((1.0,) * ARM.n)


@pytest.fixture(scope="module")
def predictor() -> Predictor:
    """Errors of a few millimetres, bent, with sides; learned in the middle of the joint box."""
    rng = np.random.default_rng(7)
    q = ARM.mid + 0.5 * SPAN * (rng.random((250, ARM.n)) - 0.5)
    side = rng.choice([-1.0, 1.0], (250, ARM.n))
    share = (q - ARM.mid) / SPAN
    error = 3e-3 * np.stack([np.sin(6.0 * share[:, k % ARM.n]) for k in range(3)], -1)
    error += 1e-3 * side[:, :1] + 1e-4 * rng.standard_normal((250, 3))
    sides = Context(tuple(side.T))
    return train(q, error, sides, hidden=8, ensemble=3, iterations=8, population=10)


def postures(count: int, share: float, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return ARM.mid + share * SPAN * (rng.random((count, ARM.n)) - 0.5)


def test_slope_is_that_of_the_prediction(predictor: Predictor) -> None:
    expand = predictor.expand
    h = 1e-6
    for q in postures(10, 0.5):
        steps = np.concatenate([q + h * np.eye(ARM.n), q - h * np.eye(ARM.n)])
        seen = predictor.predict(steps).error
        numeric = (seen[: ARM.n] - seen[ARM.n :]).T / (2.0 * h)
        np.testing.assert_allclose(expand(q).jacobian, numeric, rtol=1e-5, atol=1e-9)


def test_within_reach_the_error_is_true_and_the_domain_the_same(predictor: Predictor) -> None:
    """Also at the corners of the reach, and next to the edge of the training data."""
    expand, rng = predictor.expand, np.random.default_rng(2)
    reached = 0
    for q in postures(60, 0.56):
        found = expand(q, FROM_BELOW)
        if not found.in_domain:
            assert not found.reach.any()
            continue
        corners = np.concatenate(
            [rng.uniform(-1, 1, (20, ARM.n)), rng.choice([-1, 1], (20, ARM.n))]
        )
        steps = corners * found.reach
        asked = predictor.predict(q + steps, FROM_BELOW)
        assert asked.in_domain.all()
        off = found.error + steps @ found.jacobian.T - asked.error
        assert np.abs(off).max() <= LINEAR_M
        reached += bool(found.reach.min() > 1e-4)
    assert reached > 20


def test_commands_and_statuses_are_those_of_asking_every_time(predictor: Predictor) -> None:
    """Targets inside, outside and at the edge of the training data, and out of reach."""
    model, expand = declared_model(ARM), predictor.expand
    targets = model.tip(postures(80, 0.62, seed=4))
    targets[-1] = [9.0, 0.0, 0.0]
    context = Context(approach=(1.0,) * ARM.n)
    many = compensate_arrays(model, predictor, targets, context=context)
    questions = []

    def ask(q, context):
        questions.append(q)
        return expand(q, context)

    for i, target in enumerate(targets):
        one = compensate(model, Nearby(ask), target, context=context)[0]
        assert one.status is Status(int(many.status[i])), (i, one.reason, many.reason[i])
        assert one.reason == many.reason[i] or one.status is Status.OUT_OF_DOMAIN
        np.testing.assert_allclose(model.tip(one.command), model.tip(many.command[i]), atol=2e-5)
    statuses = {Status(int(s)) for s in many.status}
    assert {Status.SUCCESS, Status.OUT_OF_DOMAIN, Status.UNREACHABLE} <= statuses
    assert len(questions) < 1.6 * len(targets)


def test_another_side_is_another_question(predictor: Predictor) -> None:
    asked = []
    expand = predictor.expand

    def ask(q, context):
        asked.append(context)
        return expand(q, context)

    near, q = Nearby(ask), ARM.mid[None]
    up, down = (Context((side,) * ARM.n) for side in (1.0, -1.0))
    one, again, other = (near.predict(q, side) for side in (up, up, down))
    assert len(asked) == 2
    np.testing.assert_array_equal(one.error, again.error)
    assert np.abs(one.error - other.error).max() > 1e-3


def test_several_joints_are_answered_by_the_slope_at_the_first(predictor: Predictor) -> None:
    asked = []
    expand = predictor.expand

    def ask(q, context):
        asked.append(q)
        return expand(q, context)

    near = Nearby(ask)
    q = ARM.mid + SPAN * np.linspace(0, 0.01, 5)[:, None] * [1, -1, 0.5, 1]
    many = near.predict(q, FROM_BELOW)
    assert len(asked) == 1
    np.testing.assert_array_equal(many.error[:1], near.predict(q[:1], FROM_BELOW).error)
    np.testing.assert_allclose(many.error, predictor.predict(q, FROM_BELOW).error, atol=5e-5)
    assert np.abs(many.error[-1] - many.error[0]).max() > 1e-4
    assert many.sigma.shape == (5, 3)
    assert many.in_domain.all()
    assert len(many.reason) == 5
