"""The error of a sighting: what a command promises there, and the noise of the sensor."""

import dataclasses

import numpy as np
import pytest
from told_payloads import ARM, loaded

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.compensate import judge
from longarm_comp.core.compensation.result import Method
from longarm_comp.core.compensation.sighting import VISITED, error_of_sighting, visit
from longarm_comp.core.compensation.weighing import SD
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.effects.plays import FrictionHysteresis
from longarm_comp.core.model.uncertainty import Alternative

VARIANCE = np.array([1e-8, 4e-6, 9e-6])
GROWN = Discovered("joint 3", "turn z", "linear(q2)", "q2 -0.1..0.1", 0.01, 0.2)
CIRCUMSTANCES = {
    "nothing": {},
    "a heavier payload": {"payload_kg": 1.0},
    "a payload that is not sure": {"payload_kg": 0.3, SD: 0.05},
    "warmth and a tilt": {"temperature_c": 60.0, "incl_0_x": 0.05},
}


@pytest.mark.parametrize("told", CIRCUMSTANCES.values(), ids=CIRCUMSTANCES)
@pytest.mark.parametrize("share", [0.5, 1.0], ids=["amid the rows", "beyond them"])
def test_it_is_the_promise_and_the_noise(told: dict[str, float], share: float) -> None:
    """Of the joints' history nothing is known, and a function without a name is extrapolated."""
    given = loaded()
    assert given.uncertainty is not None
    slots = tuple(slot.identity for slot in given.uncertain_slots(given.uncertainty)[:2])
    record = dataclasses.replace(
        given.uncertainty,
        frame=np.diag([1e-6, 2e-6, 3e-6]),
        noise=2e-6 * np.eye(3),
        alternatives=(Alternative(0.3, slots, np.array([[4e-3, -3e-3], [0.0, 1e-3]])),),
    )
    model = dataclasses.replace(
        given.plus(FrictionHysteresis(2, far=0.01, width=0.01), GROWN), uncertainty=record
    )
    q, context = ARM.lower + share * (ARM.upper - ARM.lower), Context(columns=told)
    promised = judge(model, Method.DEFLECTION, q, context, model.tip(q, context), None)[0]
    error = error_of_sighting(model, record, q, context, VARIANCE)
    slots = model.uncertain_slots(record)
    columns = model.columns(model.posture(tuple(q.tolist()), context), slots)[1].reshape(1, 3, -1)
    (by_parameters,) = record.carry_to_tip(columns, [slot.identity for slot in slots])
    whole = np.diag(error.covariance + by_parameters)
    noise = np.maximum(VARIANCE, 2e-6)
    np.testing.assert_allclose(whole - noise, promised.sigma**2, rtol=1e-6)
    assert (np.diag(error.noise) > noise).any()  # what depends on the history is new each time


def test_a_predictor_takes_the_place_of_what_no_parameter_explains() -> None:
    given, sigma = loaded(), np.array([1e-3, 2e-3, 1e-6])
    record = given.uncertainty
    assert record is not None
    error = error_of_sighting(given, record, ARM.mid, Context(), VARIANCE, sigma)
    left = np.maximum(sigma**2 - np.diag(record.noise), 0.0)
    np.testing.assert_allclose(error.structure, np.diag(left))
    assert left[2] == 0.0


def test_the_poses_visited_last_are_followed_and_near_ones_count_as_one() -> None:
    place, is_new, visited = visit((), np.full(4, 0.5))
    assert (place, is_new) == (0, True)
    assert visit(visited, np.full(4, 0.54))[:2] == (0, False)
    assert visit(visited, np.array([0.5, 0.5, 0.5, 0.56]))[:2] == (1, True)
    for k in range(1, VISITED):
        place, is_new, visited = visit(visited, np.full(4, 1.0 + k))
        assert (place, is_new) == (k, True)
    _, _, visited = visit(visited, np.full(4, 0.5))  # pose 1 is now the one of longest ago
    assert visit(visited, np.full(4, 99.0))[:2] == (1, True)
    assert len(visit(visited, np.full(4, 99.0))[2]) == VISITED
