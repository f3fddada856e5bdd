"""The whole catalogue against central differences: Eq. (5) is every parameter's column."""

import numpy as np
import pytest
from places import DEMO_ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.catalogue import BUILT_IN
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.geometry_errors import DhError
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.placements import BasePose
from longarm_comp.core.model.model import Model, unstack

N = 25


def situation(arm: Arm) -> tuple[np.ndarray, Context]:
    rng = np.random.default_rng(4)
    q = arm.lower + (arm.upper - arm.lower) * rng.random((N, arm.n))
    columns = {
        "temperature_c": rng.uniform(15, 40, N),
        "payload_kg": np.full(N, 0.3),
        "t_s": np.linspace(0, 7200, N),
    }
    for frame in range(len(arm.joints) + 1):
        for axis in "xy":
            columns[f"incl_{frame}_{axis}"] = rng.normal(0, 0.01, N)
    approach = tuple(rng.choice([-1.0, 0.0, 1.0], N) for _ in range(arm.n))
    ways = tuple(np.random.default_rng(5).uniform(-0.5, 0.5, (arm.n, N)))
    return q, Context(approach, columns, last_way=ways)


def instances(arm: Arm) -> list[Effect | Bias]:
    return [term for kind in BUILT_IN.values() for term in kind.for_arm(arm)]


@pytest.mark.parametrize("name", sorted(BUILT_IN))
def test_column_is_the_derivative_at_zero(arm, name):
    """At zero effect Eq. (5) is exact but for the load feedback of a rigid-model step.

    The reference is a central difference of the whole model with a single load pass, in
    which the feedback of a parameter on the other effects' loads is switched off; the
    remaining tolerance is the cubic term of the difference.
    """
    q, context = situation(arm)
    for term in BUILT_IN[name].for_arm(arm):
        base = Model(arm, (), ()).plus(term)
        for slot in base.slots:
            got = base.columns(base.posture(unstack(q), context), [slot])[1][..., 0]
            h = 1e-3 * slot.parameter.prior
            ends = []
            for by in (h, -h):
                moved = term.with_values(
                    {slot.parameter.name: getattr(term, slot.parameter.name) + by}
                )
                ends.append(Model(arm, (), (), passes=1).plus(moved).measured(q, context))
            want = (ends[0] - ends[1]) / (2 * h)
            scale = np.abs(want).max()
            np.testing.assert_allclose(got, want, atol=2e-6 * scale + 1e-12, err_msg=slot.label)


def test_load_effects_act_through_the_elastic_ones(arm):
    """Payload and gravity have columns only with something elastic, and then the right ones."""
    q, context = situation(arm)
    model = Model(arm, (LinkDeflection(),))
    posture = model.posture(unstack(q), context)
    for name in ("tip_payload", "gravity_direction"):
        (term,) = BUILT_IN[name].for_arm(arm)
        with_it = model.plus(term)
        for slot in with_it.slots:
            got = with_it.columns(posture, [slot])[1][..., 0]
            h = 1e-2 * slot.parameter.prior
            up, down = (
                model.plus(term.with_values({slot.parameter.name: by})).tip(q, context)
                for by in (h, -h)
            )
            want = (up - down) / (2 * h)
            assert np.abs(want).max() > 0
            # the frames are held in a column: a few percent at this sag
            assert np.abs(got - want).max() < 0.06 * np.abs(want).max(), slot.label


def test_every_effect_moves_the_tip_or_a_reading(arm):
    """A parameter that moves nothing anywhere is a mistake (or a joint whose axis is vertical)."""
    q, context = situation(arm)
    model = Model(arm, (LinkDeflection(),))
    posture = model.posture(unstack(q), context)
    still = []
    for term in instances(arm):
        if not term.parameters(arm):
            continue
        slots = model.plus(term).slots
        motion = model.plus(term).motion(posture, slots, turns=True)
        read = [motion.read(k)[1] for k in range(arm.n)]
        columns = np.concatenate([motion.point()[1], motion.axes()[1], *read], axis=1)
        if not np.abs(columns).max(axis=(0, 1)).any():
            still.append(f"{term.name} {term.where}")
    assert set(still) <= {"joint_compliance joint 1", "servo_droop joint 1", "backlash joint 1"}


@pytest.mark.parametrize("name", ["tip_payload", "gravity_direction", "joint_compliance"])
def test_a_known_posture_leads_to_that_of_a_similar_model(arm, name):
    """Also where what changed acts through the loads alone, in the one pass of a small step."""
    q, context = situation(arm)
    model = Model(arm, (LinkDeflection(),)).plus(*BUILT_IN[name].for_arm(arm))
    known = model.posture(unstack(q), context)
    priors = np.array([slot.parameter.prior for slot in model.slots])
    moved = model.with_values(model.values + 0.1 * priors)
    want = moved.tip(q, context)
    change = np.abs(want - model.tip(q, context)).max()
    assert change > 1e-5
    for close, share in ((True, 0.03), (False, 1e-3)):
        left = np.abs(moved.measured_at(moved.posture_near(known, close)) - want).max()
        assert left < share * change


def test_a_known_posture_of_an_arm_of_light_beams_leads_to_that_of_heavy_ones(arm: Arm) -> None:
    q, context = situation(arm)
    data = arm.model_dump(mode="json", exclude_defaults=True)
    for beam in data["links"]:
        beam["mass_kg"] *= 2.0
    heavy = Model(Arm.parse(data, "heavy"), (LinkDeflection(),))
    known = Model(arm, heavy.effects).posture(unstack(q), context)
    want = heavy.tip(q, context)
    assert np.abs(want - Model(arm, heavy.effects).tip(q, context)).max() > 1e-3
    near = heavy.measured_at(heavy.posture_near(known))
    np.testing.assert_allclose(near, want, atol=1e-4)


def test_a_column_is_taken_about_the_twists_that_placed_the_arm() -> None:
    """Exact for a rigid arm whose base is turned far and whose seats are: by differences."""
    arm = Arm.load(DEMO_ARM)
    model = Model(arm).plus(*BasePose.for_arm(arm), *DhError.for_arm(arm))
    values = 0.3 * np.random.default_rng(0).standard_normal(len(model.values))
    model = model.with_values(values)
    q = np.random.default_rng(1).uniform(arm.lower, arm.upper, (5, arm.n))
    columns = model.columns(model.posture(tuple(q.T)))[1]
    for k, step in enumerate(1e-5 * np.eye(len(values))):
        ends = [model.with_values(values + by).tip(q) for by in (step, -step)]
        np.testing.assert_allclose(columns[..., k], (ends[0] - ends[1]) / 2e-5, atol=1e-5)
