"""One path is computed in the circumstances of one moment."""

import time
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_arm import ARM as SMALL

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.online import Readings
from longarm_comp.core.compensation.planned_path import PathLimits
from longarm_comp.core.compensation.result import Method
from longarm_comp.core.model.model import Model
from longarm_comp.nodes import trajectory_compensator
from longarm_comp.nodes.arm_state import ArmState


def test_a_path_is_computed_in_the_circumstances_of_one_moment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A payload that is published meanwhile counts for the next path."""
    kind, still, seen = trajectory_compensator._TrajectoryCompensator, np.zeros(SMALL.n), []

    def compute(model: Model, context_at: Any, history: History, **rest: Any) -> Any:
        for _ in range(2):
            seen.append(context_at(history).columns)
            state.readings = state.readings.with_reading("payload", {"payload_kg": 2.0}, 1e9)
        return SimpleNamespace(notes=())

    monkeypatch.setattr(trajectory_compensator, "compensate_path", compute)
    stands = SimpleNamespace(promising=lambda model: model, motion=None)
    predictor = SimpleNamespace(compensate_with=lambda method, compensate: (compensate(),))
    state: Any = SimpleNamespace(
        files=SimpleNamespace(loaded=SimpleNamespace(model=Model(SMALL), stands=stands)),
        readings=Readings().with_reading("payload", {"payload_kg": 1.0}, time.monotonic()),
        driver=SimpleNamespace(rests_at=still, history=History.unknown(SMALL.n)),
        p={"context_max_age_s": 60.0, "max_correction_m": 0.0},
        predictor=predictor,
    )
    state.circumstances = partial(ArmState.circumstances, state)
    state.context = partial(ArmState.context, state)
    node: Any = SimpleNamespace(
        _state=state, _arm=SMALL, _driver=state.driver, _files=state.files, p=state.p,
        _method=Method.DEFLECTION, _following=0, _limits=PathLimits(),
        _longest_share=lambda request: 0.0,
        _plan_of=lambda asked, start: SimpleNamespace(seen_from=lambda motion: None),
    )  # fmt: skip
    for _ in range(2):
        _, why = kind._compensate_request(node, SimpleNamespace(trajectory=None), still)
        assert not why
    assert [columns["payload_kg"] for columns in seen] == [1.0, 1.0, 2.0, 2.0]
