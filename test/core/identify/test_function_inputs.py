"""What functions may depend on, their shapes, and the poses that would tell more."""

import dataclasses

import numpy as np
import pytest
from demo_rows import session_of
from discover_rows import DEMO, calibrated, measured
from small_arm import ARM as SMALL

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.admission import admit
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.quantities import Span
from longarm_comp.core.effects.shapes import Function, Legendre, Linear, Square, Switch
from longarm_comp.core.identify.discover.bank import make_banks
from longarm_comp.core.identify.discover.causes import (
    describe_doubts,
    propose_poses,
)
from longarm_comp.core.identify.discover.functions import Functions, list_thresholds, make_switch
from longarm_comp.core.identify.discover.inputs import (
    FunctionInput,
    FunctionInputs,
    count_levels,
    read_arm_inputs,
)
from longarm_comp.core.model.model import Model


def test_positions_near_each_other_are_two_and_those_that_sag_blurs_are_one() -> None:
    assert count_levels(np.array([0.0, 0.013, 0.5, 1.0])) == 4
    assert count_levels(np.array([0.0, 0.005, 0.5, 1.0])) == 3


def test_both_sides_depend_on_what_was_recorded_and_the_camera_on_what_it_sees() -> None:
    """A window, a lens, the warmth: found where they hide in `make long`."""
    rows = measured(DEMO, (), 40, 1)
    ours, axes, views = make_banks(calibrated(DEMO, rows))
    assert {"t_s", "warmth"} < set(ours.functions.inputs.by_name)
    assert "weight" in {spot.component for spot in ours.spots}
    assert {spot.component for spot in axes.spots} == set("xyz")
    seen = {"seen_x", "seen_y", "seen_z", "t_s", "temperature_c"}
    assert set(axes.functions.inputs.by_name) == seen
    assert "distance" in {spot.component for spot in views.spots}


def test_of_three_positions_only_lines_are_tried() -> None:
    three, many = np.tile([0.0, 0.5, 1.0], 20), np.linspace(-1.0, 1.0, 60)
    of = (
        FunctionInput("q1", three, count_levels(three)),
        FunctionInput("q2", many, count_levels(many)),
    )
    made = Functions(FunctionInputs(of, (), 2))
    shapes = {factor for function in made.listed for factor in function.factors}
    assert {type(s) for s in shapes if s.of == "q2"} > {Linear, Legendre, Switch, Square}
    flat = [s for s in shapes if s.of == "q1"]
    assert {type(s) for s in flat} == {Linear, Legendre}
    assert {s.order for s in flat if isinstance(s, Legendre)} == {1}


def test_poses_lie_in_the_gap_of_a_switch() -> None:
    fitted = calibrated(SMALL, measured(SMALL, (), 40, 1))
    flip = Function((Switch("q2", 0.2, 1.2, 0.7, 0.05),))
    guess = Discovered("joint 2", "turn z", flip.text, flip.domain)
    assert describe_doubts(fitted, [guess]) == ("it changes somewhere between q2 0.65 and 0.75",)
    poses = propose_poses(fitted, [guess], 6, seed=1)
    assert len(poses) == 6
    assert (np.abs(poses[:, 1] - 0.7) < 0.05).all()
    smooth = Discovered("joint 2", "turn z")
    assert describe_doubts(fitted, [smooth]) == ()
    assert propose_poses(fitted, [smooth], 6, seed=1).shape == (0, SMALL.n)


def test_a_ramp_fills_the_gap_of_the_data() -> None:
    values = np.array([0.0, 0.1, 0.2, 0.6, 0.7, 1.0])
    made = make_switch(FunctionInput("q1", values, 6), 0.3)
    assert (made.threshold, made.half) == pytest.approx((0.4, 0.2))
    np.testing.assert_allclose(made.at(values), [-1, -1, -1, 1, 1, 1], atol=1e-12)
    assert float(made.at(0.4)) == pytest.approx(0.0)


def test_an_input_that_is_mostly_at_its_least_has_thresholds_too() -> None:
    """A gripper that is empty in four of five rows had none: no load switched anything."""
    rng = np.random.default_rng(0)
    loads = np.concatenate([np.zeros(160), rng.uniform(1.0, 5.0, 40)])
    payloads = np.repeat([0.0, 1.0, 2.0, 3.0], [140, 20, 20, 20])
    for values, tried in ((loads, 1), (payloads, 2), (rng.random(200), 7)):
        levels = count_levels(values)
        thresholds = list_thresholds(FunctionInput("payload_kg", values, levels))
        assert len(thresholds) == tried and min(thresholds) > values.min()


def test_a_distance_that_varies_less_than_its_tolerance_is_no_input(
    arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = session_of(arm, 2)
    model = Model(arm, (LinkDeflection(),))
    at = model.posture([session.q[:, k] for k in range(arm.n)], session.context())
    held = read_arm_inputs(arm, at, session).by_name
    spans = {n: a.high - a.low for n, a in held.items() if n.startswith("distance_")}
    assert spans and min(spans.values()) >= Span.resolution
    monkeypatch.setattr(Span, "resolution", 1.01 * max(spans.values()))
    assert not any(n.startswith("distance_") for n in read_arm_inputs(arm, at, session).by_name)


@pytest.mark.parametrize(("share", "told"), [(0.9, False), (1.1, True)])
def test_a_joint_that_stands_still_is_no_input(arm: Arm, share: float, told: bool) -> None:
    """A run's label in disguise: where a joint came back to, to a few hundred thousandths."""
    session = session_of(arm, 2)
    q = session.q.copy()
    q[:, 6] = arm.lower[6] + np.linspace(0.0, share * arm.telling[6], len(q))
    at = Model(arm).posture([q[:, k] for k in range(arm.n)], session.context())
    held = read_arm_inputs(arm, at, session).by_name
    assert ("q7" in held) == told and ("side_7" in held) <= told
    said = [f.field for f in admit(dataclasses.replace(session, q=q), arm).findings]
    assert ("q7" in said) != told
