"""Functions where the geometry is exact: the model has no free parameter."""

import dataclasses

import pytest
from hidden_arm import at, session
from small_arm import ARM as SMALL

from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.identify.posterior.explained import ExplainedSession
from longarm_comp.core.identify.posterior.resampled import SAMPLES
from longarm_comp.core.model.model import Model
from longarm_comp.sim.hidden import drives


@pytest.fixture(scope="module")
def exact() -> ExplainedSession:
    """Explained by a model that has no free parameter."""
    return explain_session(Model(SMALL), session([drives.JointGain(at(2, 0.02))]), ())


def test_a_half_of_the_rows_that_finds_nothing_there_leaves_doubt(exact: ExplainedSession) -> None:
    assert exact.resampling is not None and exact.found[0].presence > 0.99
    (doubted,) = dataclasses.replace(exact.resampling, of_halves=((), ())).average_samples(0)
    assert doubted.presence == pytest.approx(SAMPLES / (SAMPLES + 2), rel=1e-3)
    (both,) = dataclasses.replace(exact.resampling, of_halves=(exact.found,) * 2).average_samples(0)
    assert both.presence > 0.99 and both.name == doubted.name


def test_a_function_is_found_where_the_geometry_is_exact(exact: ExplainedSession) -> None:
    """The slide above turns about the same axis."""
    (effect,) = exact.found
    (term,) = effect.terms
    assert term.function == "linear(q2)"
    assert term.where in ("joint 2, turn z", "joint 3, turn y")
    assert abs(term.amount) == pytest.approx(0.02, rel=0.02)
