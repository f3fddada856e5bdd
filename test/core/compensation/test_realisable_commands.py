"""Compensation on servos with steps: commands that they can stand at, and the tip on its target."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from cli_shell import Shell

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import LEGS, Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.arrive import compensate_move
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.expansion import Expansion, Nearby
from longarm_comp.core.compensation.realisable import Lattice
from longarm_comp.core.compensation.result import CompensationOptions, Method, Prediction, Status
from longarm_comp.core.compensation.target_frame import find_placement
from longarm_comp.core.effects.drive_errors import ServoQuantisation
from longarm_comp.core.effects.plays import Backlash, FrictionHysteresis
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.workflows.compensate import Commands
from studies.many import compensate_arrays


@pytest.fixture(scope="module")
def model(stepped: Arm) -> Model:
    return declared_model(stepped)


@pytest.fixture
def joints(model: Model, rng: np.random.Generator) -> np.ndarray:
    arm = model.arm
    share = rng.uniform(0.1, 0.9, (6, arm.n))
    return np.array(arm.lower + share * (arm.upper - arm.lower))


def off_steps(model: Model, q: np.ndarray) -> float:
    """Largest distance from a step, in steps."""
    k = q / model.arm.steps
    return float(np.abs(k - np.rint(k)).max())


def residual(q: np.ndarray) -> np.ndarray:
    """A learned error of some millimetres that bends within a few degrees, (N, 3) m."""
    turn = np.sin(8 * q[:, 1] + 5 * q[:, 3])
    return 1e-3 * np.stack([2 + turn, 2 * np.cos(6 * q[:, 0]), -3 + turn], axis=1)


class Known:
    """A predictor that knows the residual; its sigma tells where it was asked."""

    def __init__(self, inside: bool = True) -> None:
        self.inside = inside

    def predict(self, q: np.ndarray, context: Context | None = None) -> Prediction:
        sigma = np.repeat(np.abs(q[:, :1]), 3, axis=1)
        return Prediction(residual(q), sigma, np.full(len(q), self.inside))


def test_commands_stand_on_steps_and_the_tip_on_its_target(
    model: Model, joints: np.ndarray
) -> None:
    targets = model.tip(joints)
    plain = compensate_arrays(model, None, targets, realisable=False, method=Method.DEFLECTION)
    made = compensate_arrays(model, None, targets, method=Method.DEFLECTION)
    assert made.success.all()
    assert off_steps(model, made.command) < 1e-6 < off_steps(model, plain.command)
    np.testing.assert_allclose(made.ideal, plain.ideal, rtol=0, atol=1e-12)
    rounded = model.arm.steps * np.rint(plain.command / model.arm.steps)
    left, was = (np.linalg.norm(model.tip(q) - targets, axis=1) for q in (made.command, rounded))
    assert left.mean() < 0.12e-3 < 1.5e-3 < was.mean()


def test_steps_that_were_found_count_as_declared_ones(
    arm: Arm, model: Model, joints: np.ndarray
) -> None:
    rows = zip(arm.commanded, model.arm.steps, strict=True)
    found = [ServoQuantisation.of_step(arm, row, step) for row, step in rows]
    stands = declared_model(arm).plus(found[0])
    made = compensate_arrays(stands, None, model.tip(joints), method=Method.DEFLECTION)
    k = made.command / model.arm.steps
    assert np.abs(k - np.rint(k))[:, 0].max() < 1e-6 < np.abs(k - np.rint(k))[:, 1:].min()
    for effect in found[1:]:
        stands = stands.plus(effect)
    made = compensate_arrays(stands, None, model.tip(joints), method=Method.DEFLECTION)
    assert off_steps(model, made.command) < 1e-6


def test_the_learned_error_is_that_of_the_chosen_joints(model: Model, joints: np.ndarray) -> None:
    for target in model.tip(joints):
        made = compensate(model, Known(), target)[0]
        assert made.status is Status.SUCCESS
        assert made.reason == ""
        assert off_steps(model, made.command) < 1e-6
        np.testing.assert_allclose(made.predicted_error, residual(made.command[None])[0])
        np.testing.assert_allclose(made.pseudo_target, target - made.predicted_error)
        assert made.sigma[0] == abs(made.command[0])
        chosen = made.realisable
        assert chosen is not None
        np.testing.assert_array_equal(chosen.joints, made.command)
        plain = compensate(model, Known(), target, realisable=False)[0]
        np.testing.assert_allclose(chosen.ideal, plain.command, rtol=0, atol=1e-12)
        assert plain.realisable is None
        real = model.tip(made.command) + residual(made.command[None])[0]
        assert np.linalg.norm(real - target) == pytest.approx(chosen.error[0], abs=1e-9)
        assert chosen.error[0] < 0.4e-3


def test_outside_its_domain_the_learned_error_takes_no_part(
    model: Model, joints: np.ndarray
) -> None:
    target = model.tip(joints[0])
    made = compensate(model, Known(inside=False), target)[0]
    assert made.status is Status.OUT_OF_DOMAIN
    np.testing.assert_array_equal(made.predicted_error, 0)
    assert off_steps(model, made.command) < 1e-6
    assert np.linalg.norm(model.tip(made.command) - target) < 0.3e-3


def test_poses_and_free_orientations(model: Model, joints: np.ndarray) -> None:
    pose = model.pose(joints[1])
    held = compensate(model, None, pose, method=Method.DEFLECTION)[0]
    free = compensate(model, None, pose, method=Method.DEFLECTION, position_only=True)[0]
    errors = []
    for made in (held, free):
        assert off_steps(model, made.command) < 1e-6
        errors.append(np.linalg.norm(model.tip(made.command) - pose[:3, 3]))
    assert held.realisable is not None and free.realisable is not None
    assert held.realisable.error[1] > 0 == free.realisable.error[1]
    assert errors[1] < 0.2e-3 < 3e-3 > errors[0]


def test_locked_joints_keep_their_seed(model: Model, joints: np.ndarray) -> None:
    seed = joints[2] + 1e-3
    made = compensate(
        model, None, model.tip(seed), seed=seed, locked=("joint7", 2), method=Method.DEFLECTION
    )[0]
    np.testing.assert_array_equal(made.command[[2, 6]], seed[[2, 6]])
    others = [0, 1, 3, 4, 5]
    k = made.command[others] / model.arm.steps[others]
    assert np.abs(k - np.rint(k)).max() < 1e-6


@pytest.mark.parametrize("single_pass", [False, True])
def test_off_and_single_passes_are_as_before(
    single_pass: bool, model: Model, joints: np.ndarray, arm: Arm
) -> None:
    bare = declared_model(arm)
    for target in model.tip(joints[:2]):
        want = compensate(bare, Known(), target, single_pass=single_pass)[0]
        got = compensate(model, Known(), target, single_pass=single_pass, realisable=single_pass)[0]
        for field in dataclasses.fields(want):
            one, other = getattr(got, field.name), getattr(want, field.name)
            if np.asarray(other).dtype.kind == "f":
                np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
            else:
                np.testing.assert_array_equal(one, other, field.name)


def test_a_lattice_may_be_given_and_what_is_not_known_is_said(
    model: Model, joints: np.ndarray
) -> None:
    offset = 0.3 * model.arm.steps
    unsure = model.arm.steps * [0.2, 0, 0, 0, 0, 0, 0]
    lattice = Lattice.of(model.arm, offset, unsure)
    target = model.tip(joints[3])
    made = compensate(model, None, target, method=Method.DEFLECTION, realisable=lattice)[0]
    k = (made.command - offset) / model.arm.steps
    assert np.abs(k - np.rint(k))[1:].max() < 1e-6 < np.abs(k - np.rint(k))[0]
    assert made.reason.startswith("joint1 stays at its ideal value: the offset")
    assert np.linalg.norm(model.commandable.tip(made.command) - target) < 0.5e-3


def loose(model: Model, gate: float = 0.0) -> Model:
    """Play in every turning joint, on whatever load; below the gate its side decides."""
    rows = [row for row in model.arm.commanded if model.arm.joints[row - 1].type == "revolute"]
    return model.plus(*(Backlash(row, gate=gate, width=6e-3) for row in rows))


def context_of(history: History) -> Context:
    return Context(**history.fields())


def test_a_chosen_command_arrives_as_it_assumes(model: Model, joints: np.ndarray) -> None:
    played = loose(model)
    start = played.arm.mid
    for q in joints:
        target = model.tip(q)
        arrival = compensate_move(
            played, None, target, start=start, history=History.unknown(played.arm.n),
            context_after=context_of, options=CompensationOptions(Method.DEFLECTION),
        )  # fmt: skip
        assert arrival.outcome.success
        command = arrival.outcome.command
        np.testing.assert_array_equal(arrival.move.q, command)
        # by a history of its own, from the way-points that are sent
        after = History.unknown(played.arm.n).after(arrival.move.points, start)
        np.testing.assert_array_equal(after.approach, arrival.history.approach)
        assert off_steps(model, command) < 1e-6
        assert np.linalg.norm(played.tip(command, context_of(after)) - target) < 0.4e-3


def test_near_its_start_a_joint_may_turn_round_and_is_judged_so(model: Model) -> None:
    """Without run-ups a choice may turn a joint round that was to move by less than a step."""
    played, turned = loose(model, gate=0.3), 0
    options = CompensationOptions(Method.DEFLECTION, run_up=False)
    for k in range(8):
        start = played.arm.mid + 1e-3 * np.cos(np.arange(played.arm.n) + k)
        near = start + 8e-4 * np.sin(3 * np.arange(played.arm.n) + k)
        history = History(
            np.ones(played.arm.n), np.zeros((played.arm.n, LEGS)), np.zeros(played.arm.n)
        )
        target = played.tip(near, context_of(history))
        arrival = compensate_move(
            played, None, target, start=start, history=history,
            context_after=context_of, options=options,
        )  # fmt: skip
        after = history.after(arrival.move.points, start)
        assert off_steps(model, arrival.outcome.command) < 1e-6
        real = played.tip(arrival.outcome.command, context_of(after))
        chosen = arrival.outcome.realisable
        assert chosen is not None
        assert np.linalg.norm(real - target) == pytest.approx(chosen.error[0], abs=1e-9)
        assert chosen.error[0] < 1e-3
        turned += int((after.approach < 0).any())
    assert turned > 0


class Listener:
    """A predictor that expects nothing and keeps the circumstances that it was asked about last."""

    def predict(self, q: np.ndarray, context: Context | None = None) -> Prediction:
        self.last = context
        none = np.zeros((len(q), 3))
        return Prediction(none, none + 1e-4, np.ones(len(q), bool), [""] * len(q), none[:, 0])


def test_each_command_is_judged_after_its_own_move(model: Model, rng: np.random.Generator) -> None:
    """Joints that remember: a choice a degree aside winds them up otherwise."""
    arm, listener = model.arm, Listener()
    rows = [row for row in arm.commanded if arm.joints[row - 1].type == "revolute"]
    sticky = model.plus(
        *(FrictionHysteresis(row, width=8e-3, inner=4e-3, outer=4e-3) for row in rows)
    )
    ends = np.stack([arm.lower, arm.upper, arm.mid])
    q, history = arm.mid, History.unknown(arm.n).after(ends, arm.mid)
    missed = []
    for _ in range(6):
        near = q + 0.1 * (arm.upper - arm.lower) * rng.uniform(-1, 1, arm.n)
        room = 0.1 * (arm.upper - arm.lower)
        target = model.tip(np.clip(near, arm.lower + room, arm.upper - room))
        arrival = compensate_move(
            sticky, listener, target, start=q, history=history, context_after=context_of,
        )  # fmt: skip
        after = history.after(arrival.move.points, q)
        np.testing.assert_array_equal(after.legs, arrival.history.legs)
        assert arrival.context == listener.last == context_of(after)
        real = sticky.tip(arrival.outcome.command, context_of(after))
        assert arrival.outcome.realisable is not None
        missed.append(float(np.linalg.norm(real - target)))
        assert missed[-1] == pytest.approx(arrival.outcome.realisable.error[0], abs=1e-9)
        q, history = arrival.move.q, after
    assert np.mean(missed) < 0.12e-3


def test_a_predictor_of_another_process_answers_for_all_candidates(
    model: Model, joints: np.ndarray
) -> None:
    asked = []

    def ask(q: np.ndarray, context: Context) -> Expansion:
        asked.append(q)
        steps = np.diag(np.full(len(q), 1e-6))
        slope = (residual(q + steps) - residual(q - steps)).T / 2e-6
        return Expansion(
            residual(q[None])[0], np.full(3, 1e-4), True, "", slope, np.full(len(q), 1e-4)
        )

    for target in model.tip(joints[:6]):
        made = compensate(model, Nearby(ask), target)[0]
        assert off_steps(model, made.command) < 1e-6
        real = model.tip(made.command) + residual(made.command[None])[0]
        assert np.linalg.norm(real - target) < 0.6e-3
    assert len(asked) < 6 * 16


def test_commands_csv_holds_the_joints_before_the_choice(
    model: Model, joints: np.ndarray, tmp_path: Path, shell: Shell
) -> None:
    arm = tmp_path / "arm.yaml"
    arm.write_text(model.arm.model_dump_json(exclude_defaults=True))
    targets = tmp_path / "targets.csv"
    lines = [",".join(f"{v:.9f}" for v in p) for p in model.tip(joints[:5])]
    targets.write_text("x,y,z\n" + "\n".join(lines) + "\n")

    def columns(kind: str, *more: str) -> tuple[np.ndarray, np.ndarray]:
        out = tmp_path / f"{kind}.csv"
        shell("compensate", str(arm), "--targets", str(targets), "-o", str(out), *more)
        with out.open() as file:
            rows = list(csv.DictReader(file))
        return tuple(  # type: ignore[return-value]
            np.array([[float(r[f"{name}q{j}"]) for j in range(1, 8)] for r in rows])
            for name in ("", "ideal_")
        )

    q, ideal = columns("chosen")
    plain, _ = columns("plain", "--no-realisable")
    assert off_steps(model, q) < 1e-6
    np.testing.assert_allclose(ideal, plain, atol=1e-9)
    assert np.abs(q - ideal).max() > 1e-4


def test_a_line_of_commands_csv_has_what_was_settled_on(model: Model, joints: np.ndarray) -> None:
    arrival = compensate_move(
        model, Known(), model.tip(joints[0]), start=model.arm.mid,
        history=History.unknown(model.arm.n), context_after=context_of,
    )  # fmt: skip
    chosen = arrival.outcome.realisable
    assert chosen is not None
    names = [f"q{j}" for j in range(1, model.arm.n + 1)]
    where = find_placement(model, "base")
    (line,) = Commands(np.array([4]), (arrival,), (where,)).lines()
    assert list(line) == [
        *("index", "status", "reason", *names, "target_x", "target_y", "target_z"),
        *("predicted_error_x", "predicted_error_y", "predicted_error_z", "sigma_mm", "passes"),
        *("expected_mm", "p90_mm", "frame"),
        *(f"{what}_{name}" for what in ("approach", "run_up", "ideal") for name in names),
    ]
    np.testing.assert_array_equal([line[name] for name in names], arrival.outcome.command)
    np.testing.assert_array_equal([line[f"ideal_{name}"] for name in names], chosen.ideal)
    assert np.abs(chosen.ideal - arrival.outcome.ideal).max() > 1e-4  # learned error is in it
