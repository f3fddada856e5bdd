"""Joints that hardly moved in the session, or arrived from one side: said, and in the promise.

The true arm is the simulated one, which computes by other physics than the model.
"""

import dataclasses
from functools import cache, partial

import numpy as np
import pytest
from places import DEMO_ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.compensation.arrive import compensate_move
from longarm_comp.core.compensation.compensate import compensate, judge
from longarm_comp.core.compensation.result import CompensationOptions, Method
from longarm_comp.core.compensation.sighting import error_of_sighting
from longarm_comp.core.compensation.unknown import history_joints
from longarm_comp.core.compensation.unshown import describe_unshown, structure_left, unshown_effects
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import searched_effects
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.slow_changes import BaseSettling
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model, slots_of, unstack
from longarm_comp.core.model.model_file import restore, store
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden import drives
from longarm_comp.sim.rods import QUICK_STEPS
from longarm_comp.workflows.compensate import compensate as compensate_targets
from longarm_comp.workflows.compensate import complete_after_move

ARM = Arm.load(DEMO_ARM)
ONE = np.eye(ARM.n)
HELD = 3  # the joint, counted from 0, that hides something


def gain(joint: int) -> TrueArm:
    return TrueArm(ARM, [drives.JointGain(0.03 * ONE[joint])], steps=QUICK_STEPS)


def friction(joint: int) -> TrueArm:
    return TrueArm(ARM, [drives.FrictionHysteresis(4e-3 * ONE[joint])], steps=QUICK_STEPS)


@cache
def session(
    true: TrueArm, still: int | None = None, one_sided: int | None = None, moved: float = 0.0
) -> Session:
    """Rows of an arm; its joint `still` moves by a share of its range only."""
    rng = np.random.default_rng(0)
    q = rng.uniform(ARM.lower, ARM.upper, (60, ARM.n))
    sides = rng.choice([-1.0, 1.0], q.shape)
    if still is not None:
        share = 0.3 + moved * rng.random(60)
        q[:, still] = ARM.lower[still] + share * (ARM.upper - ARM.lower)[still]
        sides[:, still] *= moved > 0.0
    if one_sided is not None:
        sides[:, one_sided] = 1.0
    seen = true.tip(q, TrueContext(approach=sides)) + 2e-4 * rng.standard_normal((60, 3))
    return Session.record(q, seen, approach=sides, index=2 * np.arange(60))


@cache
def learned(rows: Session) -> Model:
    *_, (_, fitted) = fit_stages(declared_model(ARM), rows)
    return with_uncertainty(fitted)


def commands(rows: Session) -> tuple[np.ndarray, np.ndarray]:
    """Random joints amid the rows, and sides of arrival."""
    rng = np.random.default_rng(1)
    low, high = rows.q.min(axis=0), rows.q.max(axis=0)
    q = low + rng.uniform(0.05, 0.95, (40, ARM.n)) * (high - low)
    return q, rng.choice([-1.0, 1.0], q.shape)


def promised(model: Model, q: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, list[str]]:
    context = Context(approach=tuple(sides.T))
    tip = model.tip(q, context)
    miss, _, why = judge(model, Method.DEFLECTION, q, context, tip, None)
    return miss.sizes[1], why


def missed(true: TrueArm, model: Model, q: np.ndarray, sides: np.ndarray) -> np.ndarray:
    off = true.tip(q, TrueContext(approach=sides)) - model.tip(q, Context())
    return np.asarray(np.linalg.norm(off, axis=1))


@pytest.mark.parametrize(("moved", "range_"), [(0.0, "0.3142: "), (0.08, "0.31")])
def test_a_joint_that_hardly_moved_widens_the_promise_of_commands_that_move_it(
    moved: float, range_: str
) -> None:
    true = gain(HELD)
    rows = session(true, still=HELD, moved=moved)
    model, (q, sides) = learned(rows), commands(rows)
    sides[:, HELD] = 0.0
    as_in_rows, quiet = promised(model, q, sides)
    assert (missed(true, model, q, sides) < as_in_rows).mean() > 0.9 and not any(quiet)
    away = q.copy()
    away[:, HELD] = ARM.upper[HELD]
    p90, why = promised(model, away, sides)
    off = missed(true, model, away, sides)
    assert (off < p90).mean() > 0.9 > (off < 1.5 * as_in_rows).mean()
    assert all(
        each.startswith(f"joint4 {ARM.upper[HELD]:.4g} is beyond the session's {range_}")
        and ": its play, " in each
        and each.count("(sigma ") == 1
        for each in why
    )
    (one,) = compensate(model, None, model.tip(away[:1]), seed=away[:1], locked=range(ARM.n))
    assert "joint4" in one.reason and one.p90_m > 2.0 * as_in_rows.max()


def test_the_farther_it_moves_the_less_is_promised() -> None:
    model = learned(rows := session(gain(HELD), still=HELD))
    q, _ = commands(rows)
    grown = []
    for share in (0.3, 0.4, 0.6, 1.0):
        q[:, HELD] = ARM.lower[HELD] + share * (ARM.upper - ARM.lower)[HELD]
        covariance, _ = unshown_effects(model, q, Context())
        grown.append(float(np.einsum("kii->", covariance)))
    assert grown[0] == 0.0 and grown == sorted(grown) and grown[3] > 2.0 * grown[1]


def test_a_side_from_which_a_joint_never_arrived_widens_the_promise() -> None:
    true = friction(HELD)
    rows = session(true, one_sided=HELD)
    model, (q, sides) = learned(rows), commands(rows)
    sides[:, HELD] = 1.0
    as_in_rows, quiet = promised(model, q, sides)
    assert (missed(true, model, q, sides) < as_in_rows).mean() > 0.9 and not any(quiet)
    sides[:, HELD] = -1.0
    p90, why = promised(model, q, sides)
    off = missed(true, model, q, sides)
    assert (off < p90).mean() > 0.9 > (off < as_in_rows).mean()
    assert all(each.startswith("joint4 arrived from below in every row") for each in why)
    sides[:, HELD] = 0.0  # either may be
    assert (promised(model, q, sides)[0] > 1.5 * as_in_rows).all()


def sizes_at_joint(model: Model, q: np.ndarray, sides: np.ndarray, joint: int = HELD) -> np.ndarray:
    """What is added, as standard deviations of a joint's position, rad."""
    covariance, _ = unshown_effects(model, q, Context(approach=tuple(sides.T)))
    (zero,) = (t for t in JointZero.for_arm(ARM) if t.joint == ARM.commanded[joint])
    columns = model.columns(model.posture(unstack(q)), slots_of(ARM, [zero]))[1]
    return np.asarray(np.sqrt(np.einsum("kii->k", covariance) / (columns**2).sum(axis=(1, 2))))


def test_a_command_arrives_from_the_only_side_that_the_rows_had() -> None:
    """The model holds no effect that depends on it, and the direct way comes from above."""
    true = friction(HELD)
    model = learned(rows := session(true, one_sided=HELD))
    assert not history_joints(model)
    for q in commands(rows)[0][:6]:
        start, unknown = q + 0.2 * (ARM.upper - q), History.unknown(ARM.n)
        found, direct = (
            compensate_move(
                model, None, model.tip(q, Context()), start=start, history=unknown, seed=q,
                context_after=partial(complete_after_move, Context()), position_only=True,
                options=CompensationOptions(Method.DEFLECTION, run_up=run_up),
            )
            for run_up in (True, False)
        )  # fmt: skip
        assert found.outcome.success and found.move.side[HELD] == 1.0 and not found.outcome.reason
        assert direct.move.side[HELD] == -1.0 and "in every row" in direct.outcome.reason
        assert direct.outcome.p90_m > 1.5 * found.outcome.p90_m
        (listed,) = compensate_targets(
            model, model.tip(q[None], Context()), method="deflection", frame="base"
        ).arrivals
        assert listed.move.side[HELD] == 1.0 and not listed.outcome.reason


def test_what_is_added_has_the_size_that_such_effects_have() -> None:
    """The other side: play of 20 mrad and friction of 11; a little away: half of these squares."""
    upright = 0  # no load decides on which side of its play it rests
    model = learned(rows := session(TrueArm(ARM, steps=QUICK_STEPS), one_sided=upright))
    q, sides = commands(rows)
    sides[:, upright] = -1.0
    other = sizes_at_joint(model, q, sides, upright)
    assert np.median(other) > 5e-3 and (other < 25e-3).all()
    model = learned(rows := session(TrueArm(ARM, steps=QUICK_STEPS), still=HELD))
    q, sides = commands(rows)
    q[:, HELD] += 0.01 * (ARM.upper - ARM.lower)[HELD]
    sides[:, HELD] = 0.0
    assert np.median(sizes_at_joint(model, q, sides)) > 3e-3
    still = dataclasses.replace(model, arrivals=tuple((0, 60) for _ in range(ARM.n)))
    q[:, HELD] = rows.q[0, HELD]
    sides = np.ones_like(q)
    sides[:, HELD] = 0.0
    assert not sizes_at_joint(still, q, sides).any()  # it stays as it came


def test_a_zero_that_the_drawing_does_not_expect_makes_such_effects_larger() -> None:
    """It may be the friction of a joint that arrived from one side."""
    added = []
    for lag in (0.0, 15e-3):
        true = TrueArm(ARM, [drives.FrictionHysteresis(lag * ONE[HELD])], steps=QUICK_STEPS)
        model = learned(rows := session(true, one_sided=HELD))
        q, sides = commands(rows)
        sides[:, HELD] = -1.0
        added.append(sizes_at_joint(model, q, sides).mean())
    assert added[1] > 1.3 * added[0]


def test_where_every_joint_moved_from_both_sides_nothing_is_added() -> None:
    model = learned(rows := session(friction(HELD)))
    q, sides = commands(rows)
    for given in (sides, 0.0 * sides):
        covariance, why = unshown_effects(model, q, Context(approach=tuple(given.T)))
        assert not covariance.any() and not any(why)
    assert model.uncertainty is not None
    unknown = dataclasses.replace(model, arrivals=())
    assert not unshown_effects(unknown, q, Context())[0].any()
    before = dataclasses.replace(model.uncertainty, domain=None)
    old = dataclasses.replace(model, uncertainty=before)
    assert not unshown_effects(old, 2.0 * q, Context())[0].any()


def test_what_is_worth_a_word_depends_on_what_is_expected_anyway() -> None:
    """A large arm and a small one say the same."""
    model = learned(rows := session(friction(HELD), one_sided=HELD))
    q, _ = commands(rows)
    context, known = Context(approach=tuple(-np.ones((ARM.n, len(q))))), model.uncertainty
    assert known is not None
    for largest_m, said in ((1e-6, True), (known.largest_m, True), (1.0, False)):
        other = dataclasses.replace(known, largest_m=largest_m)
        covariance, why = unshown_effects(dataclasses.replace(model, uncertainty=other), q, context)
        assert covariance.any() and any(why) is said


def test_what_the_rows_show_does_not_depend_on_a_command() -> None:
    """The rows had their loads: a first command with another one may not change what they show."""
    kg, (q, sides) = np.linspace(0.0, 4.0, 60), commands(rows := session(gain(HELD), still=HELD))
    loaded = dataclasses.replace(rows, columns={"payload_kg": kg})
    leaning = BaseSettling(about_x=0.1)
    model = dataclasses.replace(learned(loaded).with_missing([leaning]), ended_s=600.0)
    assert model.uncertainty is not None
    ranges = model.uncertainty.circumstances
    away, beyond = q.copy(), 2.0 * q
    away[:, HELD], beyond[:, HELD] = ARM.upper[HELD], q[:, HELD]

    def added(model: Model, kg: float) -> np.ndarray:
        assert model.uncertainty is not None
        columns = {"payload_kg": kg, "t_s": 600.0}
        context = Context(approach=tuple(sides.T), columns=columns)
        left = structure_left(model, model.uncertainty, beyond, context)
        return np.concatenate([unshown_effects(model, away, context)[0], left])

    def with_loads(low: float, high: float) -> Model:
        known = dataclasses.replace(
            model.uncertainty, circumstances={**ranges, "payload_kg": (low, high)}
        )
        return dataclasses.replace(model, uncertainty=known)

    first, after = added(model, 0.0), with_loads(0.0, 4.0)
    added(after, 50.0)
    np.testing.assert_array_equal(added(after, 0.0), first)
    np.testing.assert_array_equal(added(with_loads(2.0, 2.0), 0.0), first)
    for other in (with_loads(4.0, 4.0), dataclasses.replace(model, ended_s=36e3)):
        assert np.abs(added(other, 0.0) - first).max() > 1e-3 * np.abs(first).max()


def test_nothing_is_said_of_effects_that_the_model_holds() -> None:
    model = learned(rows := session(friction(HELD), one_sided=HELD))
    q, sides = commands(rows)
    sides[:, HELD] = -1.0
    context = Context(approach=tuple(sides.T))
    kinds = [kind for kind in searched_effects() if issubclass(kind, Effect)]
    every = [e for k in kinds for e in k.for_arm(ARM) if ARM.commanded[HELD] in e.joints]
    by_side = {e.key: e for e in every if "approach" in e.inputs or "legs" in e.inputs}
    for held in (by_side, {e.key: e for e in every}):
        _, why = unshown_effects(model.with_missing(held.values()), q, context)
        assert why == [""] * len(q)


def test_the_model_of_a_file_promises_the_same() -> None:
    model = learned(rows := session(gain(HELD), still=HELD))
    again = restore(store(model), ARM, "model.yaml")
    q, sides = commands(rows)
    q[:, HELD] = ARM.upper[HELD]
    np.testing.assert_allclose(
        promised(again, q, sides)[0], promised(model, q, sides)[0], rtol=1e-3
    )


def test_a_sighting_is_expected_as_the_promise_says() -> None:
    model = learned(rows := session(gain(HELD), still=HELD))
    assert model.uncertainty is not None
    q, _ = commands(rows)
    near, far = (
        np.trace(error_of_sighting(model, model.uncertainty, at, Context(), np.zeros(3)).structure)
        for at in (q[0], np.where(np.arange(ARM.n) == HELD, ARM.upper, q[0]))
    )
    assert far > 10.0 * near


@pytest.mark.parametrize(
    ("still", "one_sided", "said"),
    [
        (HELD, None, "joint4 hardly moved: "),
        (None, 1, "joint2 arrived from one side only: "),
        (HELD, 1, "joint4 hardly moved and joint2 arrived from one side only: "),
        (None, None, ""),
    ],
)
def test_the_report_says_what_the_rows_cannot_show(
    still: int | None, one_sided: int | None, said: str
) -> None:
    text = describe_unshown(ARM, session(gain(HELD), still, one_sided))
    assert text.startswith(said) and bool(text) == bool(said)
