"""One record of circumstances: every field reaches every engine, every file and every command."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import pytest
from column_arm import arm as column_arm
from cylinder_boom import boom
from every_circumstance import ENGINES, KINDS, N, circumstances, forms, models, valued
from small_arm import ARM, measured
from wind_up import Sliders, there_and_back

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import LEGS, PER_JOINT, Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import Scalar, Twist
from longarm_comp.core.compensation.arrive import compensate_move
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.online import Readings
from longarm_comp.core.compensation.result import CompensationOptions, Method, Status
from longarm_comp.core.compensation.unknown import unknown_history
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.plays import Backlash, FrictionHysteresis, ServoDeadband
from longarm_comp.core.effects.slow_changes import ThermalGrowth
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik.solver import Engine, solve_many
from longarm_comp.core.learn.inputs import INPUT_KINDS
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.targets import Targets


@pytest.mark.parametrize(
    "engine",
    [pytest.param(e, marks=[pytest.mark.long] * (e != Engine.MODEL)) for e in ENGINES],
)
def test_every_engine_reaches_the_plain_model_in_every_form(demo: Arm, engine: Engine) -> None:
    covered = set()
    for arm in (demo, column_arm(), boom()):
        q, context = circumstances(arm)
        for model in models(arm):
            target = model.tip(q, context)
            seed = np.clip(q + 0.02, arm.lower, arm.upper)
            found = solve_many(model, target, seed=seed, context=context, engine=engine)
            assert found.ok.all()
            np.testing.assert_allclose(model.tip(found.q, context), target, rtol=0, atol=1e-8)
            covered |= {effect.name for effect in model.effects}
    assert covered == {kind.name for kind in KINDS if kind.continuous}


FIELDS = [f.name for f in dataclasses.fields(Context)]


@dataclasses.dataclass(frozen=True)
class Probe(Effect):
    """The first joint moves with every field of the record, with each by another share."""

    name = "probe"

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """Hundredths of what the fields hold: one of the first, two of the next, and so on."""
        read = (k * self.read(posture.context, field) for k, field in enumerate(FIELDS, 1))
        return {posture.bearing(1): (0.0, 0.0, 0.0, 0.0, 0.0, 0.01 * sum(read))}

    def read(self, context: Context, field: str) -> Scalar:
        if field in PER_JOINT:
            return sum(context.of_joint(field, context_joint(field)))
        if field == "columns":
            return context.column("probe")
        assert field == "labels", f"no probe for a new kind of field: {field}"
        return context.is_label("group", "a")


def context_joint(field: str) -> int:
    """Another joint for every field, so that none is taken for another."""
    return PER_JOINT.index(field) + 1


@pytest.mark.parametrize("engine", ENGINES)
def test_every_field_of_the_record_reaches_every_engine(engine: Engine) -> None:
    q, context = circumstances(ARM)
    model = Model(ARM, (Probe(),))
    target = model.tip(q, context)
    assert np.abs(target - Model(ARM).tip(q)).max() > 1e-4
    found = solve_many(model, target, seed=q + 0.01, context=context, engine=engine)
    assert found.ok.all()
    np.testing.assert_allclose(model.tip(found.q, context), target, rtol=0, atol=1e-8)


def test_taking_rows_keeps_every_field() -> None:
    _, context = circumstances(ARM)
    whole, one = context.layout, context.take(2)
    assert one.layout == whole
    np.testing.assert_array_equal(whole.pack(one, 1)[0], whole.pack(context, N)[2])
    assert [each == context.take(k) for k, each in enumerate(context.each(N))] == [True] * N
    back = whole.unpack(list(whole.pack(context, N).T))
    np.testing.assert_array_equal(whole.pack(back, N), whole.pack(context, N))
    for f in dataclasses.fields(Context):
        assert getattr(one, f.name), f"{f.name} was lost"
        assert getattr(back, f.name), f"{f.name} was lost"


def test_history_is_the_same_list_of_fields_everywhere(rng: np.random.Generator) -> None:
    assert {f.name for f in dataclasses.fields(History)} == set(PER_JOINT)
    assert set(History.unknown(3).fields()) == set(PER_JOINT)
    session = measured(12, rng, approach=rng.choice([-1.0, 1.0], (12, ARM.n)))
    context = session.context()
    for name in PER_JOINT:
        rows = getattr(session, name).reshape(12, -1)
        np.testing.assert_array_equal(np.stack(getattr(context, name), -1), rows)
        taken = session.take(slice(3, 7)).context()
        np.testing.assert_array_equal(np.stack(getattr(taken, name), -1), rows[3:7])
    moved = Context(**History.unknown(ARM.n).after(ARM.upper[None], ARM.lower).fields())
    for name in PER_JOINT:
        for joint in range(ARM.n):
            assert moved.of_joint(name, joint)[0] > 0


class Watched(Context):
    """Notes what is read."""

    def of_joint(self, name: str, joint: int) -> tuple[Scalar, ...]:
        self.__dict__.setdefault("seen", set()).add(name)
        return super().of_joint(name, joint)

    def column(self, name: str, default: float | None = None) -> Scalar:
        self.__dict__.setdefault("seen", set()).add(name)
        return super().column(name, default)


def test_every_instance_says_what_it_reads(demo: Arm) -> None:
    q, context = circumstances(demo)
    rng = np.random.default_rng(6)
    read_history = set()
    for terms in forms(demo):
        for term in (valued(t, rng) for t in terms):
            held = {f.name: getattr(context, f.name) for f in dataclasses.fields(Context)}
            watched = Watched(**held)
            term.twists(Model(demo).posture(tuple(q.T), watched))
            read = watched.__dict__.get("seen", set()) - {"payload_kg"}  # the arm's own load
            assert read <= set(term.inputs), f"{term}: reads {read}, says {term.inputs}"
            read_history |= read & set(PER_JOINT)
    assert read_history == set(PER_JOINT)


def test_targets_of_a_file_carry_what_they_were_given() -> None:
    targets = Targets(
        np.arange(2), np.zeros((2, 3)), np.full((2, 4), np.nan), np.array([1.0, -1.0]),
        {"temperature_c": np.array([20.0, 30.0])}, {"group": np.array(["a", "b"])},
    )  # fmt: skip
    context = targets.context(3)
    assert [side.tolist() for side in context.approach] == [[1.0, -1.0]] * 3
    assert context.columns["temperature_c"].tolist() == [20.0, 30.0]
    assert context.labels["group"].tolist() == ["a", "b"]


def test_a_question_to_the_predictor_carries_every_learned_input() -> None:
    srv = pytest.importorskip("longarm_interfaces.srv")
    fields = set(srv.PredictError.Request.get_fields_and_field_types())
    assert set(INPUT_KINDS["context"]) <= fields


# ------------------------------------------------------------------ commands


def play(arm: Arm) -> Model:
    """Play that friction gates, droop with a gate, and friction that remembers."""
    first, second = arm.commanded[:2]
    return Model(
        arm,
        (
            Backlash(joint=first, gate=0.3, width=0.01),
            ServoDeadband(joint=second, gate=0.3, width=0.012),
            FrictionHysteresis(second, near=0.02, far=0.1, width=0.012, inner=0.003, outer=0.006),
        ),
    )


def test_commands_one_after_another_land_where_the_sliders_are(rng: np.random.Generator) -> None:
    """The history is followed here by the simulator's sliders, dragged along the whole way."""
    model = play(ARM)
    friction = model.effects[-1]
    assert isinstance(friction, FrictionHysteresis)
    still = Model(ARM, model.effects[:-1])
    parts = friction.width - friction.inner - friction.outer, friction.inner, friction.outer
    half = np.zeros((3, ARM.n))
    half[:, 1] = 0.5 * np.array(parts)
    at = ARM.mid
    sliders = Sliders(np.array([1e-9, friction.near, friction.far]), half, at)
    history = History.unknown(ARM.n)
    commands = [*there_and_back(ARM, at)]
    for point in commands:
        sliders.drive(point)
        history, at = history.after(point[None], at), point
    span = ARM.upper - ARM.lower
    misses = []
    for goal in ARM.mid + 0.6 * span * (rng.random((25, ARM.n)) - 0.5):
        target = Model(ARM).tip(goal)
        arrival = compensate_move(
            model, None, target, start=at, history=history,
            context_after=partial(Readings().context, model, 1.0, 1.0),
        )  # fmt: skip
        points = arrival.move.points
        sliders.drive(points)
        history = history.after(points, at)
        at = arrival.outcome.command
        truly = still.tip(at - sliders.behind, Context(tuple(history.approach)))
        if "not known" not in arrival.outcome.reason:
            misses.append(np.linalg.norm(truly - target))
    assert len(misses) >= 20
    assert max(misses) < 5e-6


def test_what_a_command_cannot_know_is_said_in_millimetres() -> None:
    model = play(ARM)
    target = Model(ARM).tip(ARM.mid)
    blind = compensate(model, None, target, method=Method.DEFLECTION)[0]
    assert blind.status is Status.SUCCESS
    first, second = (ARM.joint_names[k] for k in (0, 1))
    for part in (f"approach of {first}", f"approach of {second}", f"earlier moves of {second}"):
        assert part in blind.reason
    assert f"earlier moves of {first}" not in blind.reason
    sides = [
        Context((a, b, 1.0, 1.0), legs=one_leg(w))
        for a in (-1.0, 1.0) for b in (-1.0, 1.0) for w in (-0.5, 0.5)
    ]  # fmt: skip
    misses = [np.linalg.norm(model.tip(blind.command, s) - target) for s in sides]
    told = compensate(model, None, target, context=sides[0], method=Method.DEFLECTION)[0]
    assert told.reason == ""
    spread = np.sqrt((blind.sigma**2 - told.sigma**2).sum())  # beside what nobody has calibrated
    assert 0.5 * max(misses) < spread < 1.5 * max(misses)


def one_leg(way: float) -> tuple[float, ...]:
    """Legs of the small arm's joints: the second made one, the others none."""
    legs = np.zeros((ARM.n, LEGS))
    legs[1, 0] = way
    return tuple(legs.ravel().tolist())


def test_what_is_not_known_shrinks_with_the_leg_that_is() -> None:
    """A play of radius R is open by 2 R less the known leg, and closed from there on."""
    radius, width = 0.1, 0.008
    model = Model(ARM, (FrictionHysteresis(2, far=radius, width=width, outer=width),))

    def sigma(leg: float) -> float:
        context = Context((1.0,) * 4, legs=one_leg(leg))
        found, (reason,) = unknown_history(model, ARM.mid[None], context)
        assert ("earlier moves" in reason) == (leg < 2 * radius)
        return float(np.linalg.norm(found))

    whole = sigma(1e-5)
    assert whole > 1e-4
    assert sigma(0.08) == pytest.approx(0.6 * whole, rel=1e-3)
    assert sigma(0.16) == pytest.approx(0.2 * whole, rel=1e-3)
    assert sigma(0.2) == sigma(0.3) == 0.0


def test_history_that_does_not_matter_raises_no_doubt() -> None:
    still = Model(ARM, (Backlash(joint=ARM.commanded[0], gate=0.3, width=0.0),))
    found = compensate(still, None, Model(ARM).tip(ARM.mid), method=Method.DEFLECTION)[0]
    assert found.reason == "" and found.status is Status.SUCCESS


def test_a_quantity_that_the_model_needs_and_nobody_gave_is_no_command() -> None:
    warm = Model(ARM, (ThermalGrowth(8e-5),))
    found = compensate(warm, None, Model(ARM).tip(ARM.mid), method=Method.DEFLECTION)[0]
    assert found.status is Status.STALE_CONTEXT and not found.success
    assert "temperature_c" in found.reason and "thermal_growth" in found.reason
    given = Context(columns={"temperature_c": 25.0})
    target = warm.tip(ARM.mid, given)
    found = compensate(warm, None, target, context=given, method=Method.DEFLECTION)[0]
    assert found.status is Status.SUCCESS


def test_a_joint_that_no_move_brings_from_one_side_counts_as_unknown() -> None:
    """At rest between the two commands, each side's command lies on the other side."""
    model = Model(ARM, (Backlash(joint=ARM.commanded[0], gate=0.3, width=0.02),))
    target = Model(ARM).tip(ARM.mid)
    arrival = compensate_move(
        model, None, target, start=ARM.mid, history=History.unknown(ARM.n),
        context_after=partial(Readings().context, model, 1.0, 1.0),
        options=CompensationOptions(run_up=False),
    )  # fmt: skip
    found, context = arrival.outcome, arrival.context
    step = found.command - ARM.mid
    if np.sign(step[0]) == context.approach[0] != 0.0:
        truly = model.tip(found.command, Context(tuple(np.sign(step))))
        np.testing.assert_allclose(truly, target, atol=2e-6)
    else:
        assert context.approach[0] == 0.0
        assert f"approach of {ARM.joint_names[0]}" in found.reason


def test_a_list_is_a_value_of_each_posture() -> None:
    context = Context(columns={"payload_kg": [0.1, 0.2], "temperature_c": 30.0})
    each = context.each(2)
    assert [one.columns["payload_kg"] for one in each] == [0.1, 0.2]
    assert [one.columns["temperature_c"] for one in each] == [30.0, 30.0]
    assert context.take(1).columns["payload_kg"] == 0.2


@pytest.mark.parametrize("values", [[0.1], [0.1, 0.2, 0.3], np.zeros(3)])
def test_values_of_other_postures_are_refused(values: Sequence[float]) -> None:
    with pytest.raises(InputError, match="number of payload_kg"):
        Context(columns={"payload_kg": values}).each(2)
