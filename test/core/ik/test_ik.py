"""Inverse kinematics: the paper's grid, limits, locks, tracking, failures, engines."""

import copy
import itertools
import pickle

import numpy as np
import pytest
from scipy.optimize import minimize
from small_arm import ARM as SMALL

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.geometry_errors import DhError
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.placements import BasePose
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik import newton
from longarm_comp.core.ik.kernel import kernel_of
from longarm_comp.core.ik.solver import Engine, Reason, compile_at_once, solve, solve_many
from longarm_comp.core.model.model import Model

FAST = Engine.COMPILED
EXACT = 1e-6  # m and rad, the acceptance of issue 2


@pytest.fixture(scope="module")
def model(demo_arm_path) -> Model:
    return Model(Arm.load(demo_arm_path), (LinkDeflection(),))


def paper_grid() -> np.ndarray:
    """The paper's III.B: 3^5 rotations by 6 prismatic combinations, on limits and singularities."""
    deg = [(-15, 0, 15), (0, 15, 30), (0, 30, 60), (-45, -25, 0), (-30, 0, 30)]
    slides = [(0, 0), (0, 0.063), (0.06, 0.01), (0.053, 0.063), (0.104, 0.018), (0.105, 0.063)]
    return np.array(
        [
            [a, b, s, c, d, e, t]
            for (a, b, c, d, e), (s, t) in itertools.product(
                itertools.product(*map(np.radians, deg)), slides
            )
        ]
    )


def misses(model: Model, q: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (m) and angle (rad) errors at q, by the model's own code."""
    got = model.pose(q)
    R = np.swapaxes(got[:, :3, :3], 1, 2) @ targets[:, :3, :3]
    skew = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]])
    trace = np.trace(R, axis1=1, axis2=2)
    angle = np.arctan2(0.5 * np.linalg.norm(skew, axis=0), 0.5 * (trace - 1))
    return np.linalg.norm(got[:, :3, 3] - targets[:, :3, 3], axis=1), angle


def inside(model: Model, q: np.ndarray) -> bool:
    return bool(((q >= model.arm.lower) & (q <= model.arm.upper)).all())


@pytest.mark.parametrize("position_only", [False, True])
def test_the_whole_paper_grid(model, position_only):
    """All 1458 poses of the training grid from mid-range, as poses and as positions."""
    targets = model.pose(paper_grid())
    made = solve_many(model, targets, position_only=position_only, engine=FAST)
    position, angle = misses(model, made.q, targets)
    assert len(made) == 1458
    assert made.ok.all()
    assert inside(model, made.q)
    assert position.max() < EXACT
    assert position_only or angle.max() < EXACT
    assert (made.starts == 1).mean() > 0.97
    assert np.allclose(made.position_residual_m, position, rtol=0, atol=1e-12)


@pytest.mark.parametrize("engine", [Engine.COMPILED, Engine.MODEL])
def test_an_orientation_that_no_joints_hold_is_held_as_near_as_they_allow(engine, rng):
    """Four joints: of the angles at a position, the least that another search finds."""
    bent = Model(SMALL, (DhError(row=2, alpha=0.2), DhError(row=4, alpha=0.3, beta=0.1)))
    q = SMALL.lower + (0.2 + 0.6 * rng.random((8, 4))) * (SMALL.upper - SMALL.lower)
    targets = Model(SMALL).pose(q)
    assert not solve_many(bent, targets, seed=q, max_starts=1, engine=engine).ok.any()
    made = solve_many(bent, targets, seed=q, max_starts=1, near=True, engine=engine)
    position, angle = misses(bent, made.q, targets)
    assert made.ok.all() and inside(bent, made.q)
    assert position.max() < 1e-9 and angle.min() > 0.1
    np.testing.assert_allclose(made.angle_residual_rad, angle, atol=1e-9)

    def gap(x: np.ndarray, k: int) -> np.ndarray:
        return 100.0 * (bent.pose(x)[:3, 3] - targets[k, :3, 3])

    for k in range(len(q)):
        other = minimize(
            lambda x, k=k: misses(bent, x[None], targets[k : k + 1])[1][0] ** 2, q[k],
            method="SLSQP", bounds=list(zip(*SMALL.bounds, strict=True)),
            constraints=[{"type": "eq", "fun": gap, "args": (k,)}], options={"ftol": 1e-13},
        )  # fmt: skip
        assert angle[k] == pytest.approx(np.sqrt(other.fun), rel=1e-6)
    loose = solve_many(bent, targets, seed=q, max_starts=1, position_only=True, engine=engine)
    assert (misses(bent, loose.q, targets)[1] > 1.02 * angle).any()


def test_near_changes_nothing_where_the_orientation_can_be_held(model, rng):
    q = model.arm.mid + 0.2 * rng.standard_normal((5, 7)) * (model.arm.upper - model.arm.mid)
    targets = model.pose(q)
    targets[4, :3, 3] += 10.0  # out of reach either way
    held, near = (solve_many(model, targets, near=near, max_starts=1) for near in (False, True))
    np.testing.assert_array_equal(held.q[:4], near.q[:4])
    assert held.ok.tolist() == near.ok.tolist() == [True] * 4 + [False]
    assert near[4].reason is held[4].reason


@pytest.mark.parametrize("engine", [Engine.COMPILED, Engine.MODEL])
def test_a_target_missed_by_less_than_a_micrometre_is_reached(engine, demo_arm_path):
    """On the boundary of the reach the rounding of a target can put it outside: 0.5 um, 2 um."""
    model = Model(Arm.load(demo_arm_path))
    corners = np.round(model.tip(paper_grid()[[515, 695, 749, 803]]), 9)
    made = solve_many(model, corners, engine=engine)
    assert made.ok.all()
    assert made.position_residual_m.max() > 1e-9  # no search gets closer
    assert all(solve(model, corner, engine=engine).ok for corner in corners)
    lever = Arm.parse({
        "name": "lever", "convention": "mdh_craig", "tip": {"frame": 1, "position_m": [0.5, 0, 0]},
        "joints": [{"id": 1, "type": "revolute", "limits_deg": [-90, 90]}],
    }, "test")  # fmt: skip
    for out, ok in ((0.5e-6, True), (2e-6, False)):
        target = (0.5 + out) * np.array([np.cos(0.3), np.sin(0.3), 0.0])
        found = solve(Model(lever), target, engine=engine)
        assert found.ok is ok
        assert found.position_residual_m == pytest.approx(out, rel=1e-3)
        assert found.starts == (1 if ok else 16)
    assert solve(Model(lever), target, tol=3e-6, engine=engine).ok
    for tilt, ok in ((0.5e-6, True), (2e-6, False)):
        pose = Model(lever).pose(np.array([0.3]))
        pose[:3, :3] = pose[:3, :3] @ np.array([[1, 0, 0], [0, 1, -tilt], [0, tilt, 1]])
        found = solve(Model(lever), pose, engine=engine)
        assert found.ok is ok
        assert found.angle_residual_rad == pytest.approx(tilt, rel=1e-3)


@pytest.mark.parametrize("position_only", [False, True])
@pytest.mark.parametrize("count", [4, 20])  # on floats, on arrays
@pytest.mark.parametrize("base", [(), (BasePose(x=2.0, y=-1.0, rz=1.1),)])
def test_engines_run_one_search(model, base, count, position_only, rng):
    """Also where a calibration found the base metres away."""
    model = Model(model.arm, (*model.effects, *base))
    arm = model.arm
    q = rng.uniform(arm.lower, arm.upper, (count, arm.n))
    q[0] = arm.lower  # a corner of the box
    targets = model.pose(q)
    made, reference = (
        solve_many(model, targets, position_only=position_only, engine=engine)
        for engine in (Engine.MODEL, FAST)
    )
    assert made.ok.all()
    assert (made.starts == reference.starts).all()
    assert (made.iterations == reference.iterations).all()
    assert np.allclose(made.q, reference.q, rtol=0, atol=1e-12)


def test_a_model_is_compiled_when_its_targets_are_worth_it(demo_arm_path):
    model = Model(Arm.load(demo_arm_path), (LinkDeflection(), JointCompliance(2, 1.1e-3)))
    target = model.pose(model.arm.mid + 0.01)
    first = solve(model, target)
    kernel = kernel_of(model, Context().layout)
    assert not kernel.is_compiled
    kernel.workload = 100.0
    assert np.allclose(solve(model, target).q, first.q, rtol=0, atol=1e-12)
    assert kernel.is_compiled
    other = model.plus(JointCompliance(3, 1.1e-3))
    with compile_at_once():
        solve(other, target)
    assert kernel_of(other, Context().layout).is_compiled


def test_one_target_alone_is_solved_as_among_many(model, rng):
    q = rng.uniform(model.arm.lower, model.arm.upper, (7, model.arm.n))
    targets = model.pose(q)
    for goals in (targets, targets[:, :3, 3]):
        many = solve_many(model, goals, seed=q[::-1], engine=FAST)
        for k, goal in enumerate(goals):
            alone = solve(model, goal, seed=q[6 - k], engine=FAST)
            assert np.array_equal(alone.q, many.q[k])
            assert alone == (alone.q, *many[k][1:])


def test_a_model_that_was_solved_for_can_be_copied(model):
    target = model.pose(model.arm.mid)
    solved = solve(model, target, engine=FAST)
    twin = copy.deepcopy(model)
    assert twin.effects == model.effects
    assert np.array_equal(solve(twin, target, engine=FAST).q, solved.q)
    assert pickle.dumps(model)  # as it goes to another process


def test_context_and_effects_reach_every_target(model, rng):
    """Payload by target, and compliance: each is solved under its own load."""
    soft = model.plus(JointCompliance(2, 2e-3), JointCompliance(5, 4e-3))
    arm = model.arm
    q = rng.uniform(arm.lower, arm.upper, (20, arm.n))
    context = Context(columns={"payload_kg": np.linspace(0.0, 0.5, 20)})
    targets = soft.pose(q, context)
    made = solve_many(soft, targets, context=context, engine=FAST)
    assert made.ok.all()
    assert np.abs(soft.pose(made.q, context) - targets).max() < EXACT
    wrong = soft.tip(made.q, Context(columns={"payload_kg": 0.25}))
    assert np.linalg.norm(wrong - targets[:, :3, 3], axis=1).max() > 1e-4


def test_tracking_keeps_the_branch(model):
    """A closed path, each target seeded with the joints before: small steps, one start, no drift
    of the tip; a step never exceeds a few times what the path's own joints move."""
    arm = model.arm
    s = np.linspace(0, 2 * np.pi, 240)[:, None]
    phase = np.arange(arm.n)
    path = arm.mid + 0.45 * (arm.upper - arm.lower) * np.sin(s + phase)
    targets = model.pose(path)
    for position_only in (False, True):
        q, steps = path[0], []
        for target in targets[1:]:
            made = solve(model, target, seed=q, position_only=position_only, engine=FAST)
            assert made.ok
            assert made.starts == 1
            steps.append(np.abs(made.q - q) / (arm.upper - arm.lower))
            q = made.q
        assert np.max(steps) < 0.1


def test_the_seed_that_solves_is_the_answer(model, rng):
    q = rng.uniform(model.arm.lower, model.arm.upper)
    made = solve(model, model.pose(q), seed=q, engine=Engine.MODEL)
    assert made.ok
    assert made.iterations == 0
    assert np.array_equal(made.q, q)


def test_smallest_move_in_the_null_space(model):
    """A small step of a position task is the range-weighted pseudo-inverse's, to second order."""
    arm = model.arm
    q, h = arm.mid, 1e-5
    tip = model.tip(q)
    J = np.stack(
        [(model.tip(q + d) - model.tip(q - d)) / 2e-6 for d in 1e-6 * np.eye(arm.n)], axis=1
    )
    D = np.diag(arm.upper - arm.lower)
    move = np.array([1.0, -2.0, 1.5]) * h
    made = solve(model, tip + move, seed=q, engine=FAST)
    want = D @ np.linalg.pinv(J @ D) @ move
    assert np.allclose(made.q - q, want, atol=0.05 * np.abs(want).max())


def test_locked_joints_stay(model, rng):
    arm = model.arm
    q = rng.uniform(arm.lower, arm.upper)
    seed = arm.mid.copy()
    seed[6] = q[6]
    made = solve(model, model.tip(q), seed=seed, locked=(6, arm.joint_names[0]), engine=FAST)
    assert made.q[6] == seed[6]
    assert made.q[0] == seed[0]
    free = solve(model, model.tip(q), seed=seed, engine=FAST)
    assert free.q[6] != seed[6]


def test_a_slide_at_its_stop_does_not_stall(model):
    arm = model.arm
    goal = arm.mid.copy()
    goal[[2, 6]] = arm.upper[[2, 6]]
    seed = arm.mid.copy()
    seed[[2, 6]] = arm.lower[[2, 6]]
    made = solve(model, model.pose(goal), seed=seed, engine=FAST)
    assert made.ok
    assert made.starts == 1


def test_failure_is_an_answer(model, monkeypatch):
    far = solve(model, [5.0, 0.0, 0.0], engine=FAST)
    assert not far.ok
    assert far.reason in (Reason.AT_LIMITS, Reason.OUT_OF_REACH)
    assert 3.0 < far.position_residual_m < 6.0
    assert np.isfinite(far.q).all()
    assert inside(model, far.q)
    left = np.linalg.norm(model.tip(far.q) - [5.0, 0.0, 0.0])
    assert far.position_residual_m == pytest.approx(left, abs=1e-9)
    monkeypatch.setattr(newton, "MAX_ITERATIONS", 1)
    anew = model.with_terms(model.terms)  # what is prepared once for a model knows the number
    short = solve(anew, model.pose(model.arm.lower), max_starts=1, engine=FAST)
    assert short.reason is Reason.ITERATIONS
    assert short.iterations == 1
    assert short.angle_residual_rad > 0


def test_camera_side_biases_play_no_part(model):
    from longarm_comp.core.effects.camera_errors import CameraScale

    (bias,) = CameraScale.for_arm(model.arm)
    (name,) = [p.name for p in bias.declared()]
    biased = model.plus(bias.with_values({name: 0.05}))
    target = model.pose(model.arm.mid)
    assert np.array_equal(solve(biased, target, engine=FAST).q, solve(model, target, engine=FAST).q)


def test_passive_and_negative_joints():
    """A mimic telescope and a prismatic joint that pulls back, on a rigid arm."""
    arm = Arm.parse(
        {
            "name": "mimic",
            "convention": "mdh_craig",
            "tip": {"frame": 5},
            "joints": [
                {"id": 1, "type": "revolute", "d_m": 0.3, "limits_deg": [-90, 90]},
                {"id": 2, "type": "revolute", "alpha_deg": 90, "limits_deg": [-60, 80]},
                {"id": 3, "type": "prismatic", "alpha_deg": 90, "d_m": 0.5, "limits_m": [0, 0.4]},
                {
                    "id": 4,
                    "type": "prismatic",
                    "d_m": 0.3,
                    "mimic": {"joint": 3, "multiplier": 0.5},
                },
                {
                    "id": 5,
                    "type": "revolute",
                    "alpha_deg": -90,
                    "a_m": 0.1,
                    "limits_deg": [-90, 90],
                },
            ],
        },
        "mimic arm",
    )
    model = Model(arm)
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (40, arm.n))
    for targets in (model.tip(q), model.pose(q)):
        made = solve_many(model, targets, engine=FAST)
        assert made.ok.all()
        assert inside(model, made.q)


def test_restarts_are_repeatable(model):
    targets = model.pose(paper_grid()[::90])
    again = [solve_many(model, targets, engine=FAST).q for _ in range(2)]
    assert np.array_equal(*again)


def test_none_and_one(model):
    assert len(solve_many(model, np.zeros((0, 3)), engine=Engine.MODEL)) == 0
    one = solve(model, model.tip_frame(model.posture(tuple(model.arm.mid.tolist()))))
    assert one.ok


@pytest.mark.parametrize(
    ("target", "options", "field"),
    [
        ([np.nan, 0, 0], {}, "target"),
        ([np.inf, 0, 0], {}, "target"),
        ([1.0, 0.0], {}, "target"),
        (np.eye(4) * 2, {}, "target"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), {}, "target"),
        ([0.5, 0, 0.5], {"seed": [0.0]}, "seed"),
        ([0.5, 0, 0.5], {"seed": [np.nan] * 7}, "seed"),
        ([0.5, 0, 0.5], {"locked": (9,)}, "locked"),
        ([0.5, 0, 0.5], {"locked": ("elbow",)}, "locked"),
        ([0.5, 0, 0.5], {"tol": 0.0}, "tol"),
    ],
)
def test_bad_input_is_one_clear_error(model, target, options, field):
    with pytest.raises(InputError, match=field):
        solve(model, np.array(target), **options)
