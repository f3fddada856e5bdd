"""The paper's method against a plant whose error is known."""

import numpy as np
import pytest

import longarm_comp as la
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.result import Method, Prediction, Status
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.plays import Backlash
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from studies.many import compensate_arrays


def smooth_error(q: np.ndarray) -> np.ndarray:
    """A residual of several millimetres that varies over the box, (N, 3) m."""
    a = np.sin(2 * q[:, 1] + q[:, 3]) + 4 * q[:, 2]
    return 1e-3 * np.stack([3 + a, 2 * np.cos(3 * q[:, 0]), -8 - 3 * a], axis=1)


class Known:
    """A predictor that knows the plant's residual, and optionally refuses."""

    def __init__(self, error=smooth_error, inside=lambda q: np.ones(len(q), bool)) -> None:
        self.error, self.inside, self.seen = error, inside, []

    def predict(self, q, context=None):
        self.seen.append(context)
        return Prediction(self.error(q), np.full((len(q), 3), 1e-4), self.inside(q))


@pytest.fixture
def plant(twin):
    """(model, targets, q -> measured): the sagging arm with a residual on top."""
    model = Model(twin, (LinkDeflection(),))
    rng = np.random.default_rng(5)
    box = twin.upper - twin.lower
    q = rng.uniform(twin.lower + 0.15 * box, twin.upper - 0.15 * box, (30, twin.n))
    return model, model.tip(q), lambda q: model.tip(q) + smooth_error(q)


def miss(measured: np.ndarray, targets: np.ndarray) -> float:
    return float(np.linalg.norm(measured - targets, axis=1).max())


def test_sign_and_settling(plant):
    """Corrected, the real tip is on target; with the other sign it would miss by twice as much."""
    model, targets, measure = plant
    made = compensate_arrays(model, Known(), targets)
    assert (made.status == Status.SUCCESS).all()
    assert miss(measure(made.command), targets) < 1.2e-5
    assert miss(measure(made.ideal), targets) > 5e-3
    # without position_only=True the targets are positions anyway
    assert np.allclose(made.pseudo_target, targets - made.predicted_error)
    assert ((made.passes >= 1) & (made.passes <= 5)).all()
    opposite = compensate_arrays(model, Known(lambda q: -smooth_error(q)), targets)
    assert miss(measure(opposite.command), targets) > 1.8 * miss(measure(made.ideal), targets)


def test_a_pose_is_corrected_in_position_and_kept_in_orientation(plant):
    """The arm is really commanded; with the other sign its tip would miss by twice the error."""
    model, _, measure = plant
    arm = model.arm
    rng = np.random.default_rng(8)
    q = arm.mid + 0.4 * (arm.upper - arm.lower) * (rng.random((12, arm.n)) - 0.5)
    poses = model.pose(q)
    made = compensate_arrays(model, Known(), poses, seed=q)
    good = made.status == Status.SUCCESS
    assert good.sum() >= 8
    reached = model.pose(made.command[good])
    real = measure(made.command[good])
    assert miss(real, poses[good, :3, 3]) < 1.2e-5
    np.testing.assert_allclose(reached[:, :3, :3], poses[good, :3, :3], atol=1e-7)
    np.testing.assert_allclose(
        made.pseudo_target[good, :3, 3], poses[good, :3, 3] - made.predicted_error[good]
    )
    assert miss(measure(q), poses[:, :3, 3]) > 2e-3  # what it would be uncorrected


def test_single_pass_leaves_the_second_order(plant):
    model, targets, measure = plant
    once = compensate_arrays(model, Known(), targets, single_pass=True)
    assert (once.passes == 1).all()
    many = compensate_arrays(model, Known(), targets, tol_m=1e-7)
    left = miss(measure(once.command), targets)
    assert 1e-5 < left < 2e-3
    assert miss(measure(many.command), targets) < 2e-7 < left


def test_passes_on_a_soft_arm(plant):
    """All of the sag left to the predictor (rigid kinematics): the passes contract to nothing.

    kinematics.md: 42.5 mm -> 1.97 after one pass -> 0.26 -> 0.012 on a 43 mm arm.
    """
    model, targets, _ = plant
    stiff = Model(model.arm)
    sag = Known(lambda q: model.tip(q) - stiff.tip(q))
    single = compensate_arrays(model, sag, targets, method=Method.NETWORK, single_pass=True)
    none = compensate_arrays(model, None, targets, method=Method.NONE)
    raw = miss(model.tip(none.command), targets)
    settled = compensate_arrays(model, sag, targets, method=Method.NETWORK)
    assert miss(model.tip(single.command), targets) < 0.2 * raw
    assert miss(model.tip(settled.command), targets) < 1.2e-5
    physics = compensate_arrays(model, None, targets, method=Method.DEFLECTION)
    assert miss(model.tip(physics.command), targets) < 1e-8


def test_methods_use_the_physics_they_name(plant):
    model, targets, _ = plant
    stiff = Model(model.arm)
    for method, reached in ((Method.NONE, stiff), (Method.DEFLECTION, model)):
        made = compensate_arrays(model, Known(), targets, method=method)
        assert (made.status == Status.SUCCESS).all()
        assert (made.passes == 0).all()
        assert not made.predicted_error.any()
        assert miss(reached.tip(made.command), targets) < 1e-8


def test_no_predictor_and_out_of_domain_fall_back_and_say_so(plant):
    model, targets, _ = plant
    plain = compensate_arrays(model, None, targets)
    assert (plain.status == Status.NO_PREDICTOR).all()
    assert plain.success.all()
    assert "physics only" in plain.reason[0]
    refusing = compensate_arrays(model, Known(inside=lambda q: q[:, 0] > 0), targets)
    out = refusing.status == Status.OUT_OF_DOMAIN
    assert out.any()
    assert (refusing.status == Status.SUCCESS).any()
    assert np.allclose(refusing.command[out], plain.command[out])
    assert not refusing.predicted_error[out].any()
    assert "training data" in refusing.reason[int(np.flatnonzero(out)[0])]


def test_correction_is_bounded(plant):
    """One bound for the sag and the learned error together; each alone stays below it."""
    model, targets, _ = plant
    made = compensate_arrays(model, Known(), targets, max_correction_m=1e-3)
    assert (made.status == Status.CORRECTION_TOO_LARGE).all()
    assert not made.success.any()
    assert "permitted 1 mm" in made.reason[0]
    one = compensate(model, Known(), targets[0], max_correction_m=1e-3)[0]
    assert one.status is Status.CORRECTION_TOO_LARGE
    np.testing.assert_array_equal(one.command, one.ideal)
    free, rigid = compensate_arrays(model, Known(), targets), Model(model.arm)
    learned = np.linalg.norm(smooth_error(free.command), axis=1)
    sag = np.linalg.norm(rigid.tip(free.ideal) - targets, axis=1)
    both = np.linalg.norm(rigid.tip(free.command) - targets, axis=1)
    most = 0.5 * (both.max() + max(learned.max(), sag.max()))
    assert both.max() > max(learned.max(), sag.max()) + 1e-3
    bounded = compensate_arrays(model, Known(), targets, max_correction_m=most)
    np.testing.assert_array_equal(bounded.status == Status.CORRECTION_TOO_LARGE, both > most)
    np.testing.assert_array_equal(bounded.success, both <= most)
    refused = compensate_arrays(model, None, targets, max_correction_m=0.9 * sag.max())
    np.testing.assert_array_equal(refused.success, sag <= 0.9 * sag.max())  # without a predictor


def test_what_does_not_settle_is_said(plant):
    model, targets, _ = plant
    flips = Known(lambda q: np.where(np.arange(3) == 2, 0.004 * np.sin(4e3 * q[:, :1]), 0.0))
    made = compensate_arrays(model, flips, targets, tol_m=1e-9, max_passes=3)
    assert (made.status == Status.NOT_CONVERGED).any()
    assert not made.success[(made.status == Status.NOT_CONVERGED).argmax()]


def test_bad_and_unreachable_targets_are_answers(plant):
    model, targets, _ = plant
    some = targets[:4].copy()
    some[0, 1] = np.nan
    some[2] = [9.0, 0.0, 0.0]
    made = compensate_arrays(model, Known(), some)
    assert list(made.status[[0, 2]]) == [Status.BAD_TARGET, Status.UNREACHABLE]
    assert made.success[[1, 3]].all()
    assert "finite" in made.reason[0]
    assert "mm" in made.reason[2]
    assert np.isfinite(made.command).all()
    assert np.isfinite(made.ideal).all()


def test_a_bad_target_is_an_answer_where_the_arm_has_play(twin):
    """One such target among others ended all of them, as `ik.solve_many: target 0`."""
    model = Model(twin, (Backlash(joint=2, width=2e-3),))
    some = [model.tip(twin.mid), [np.nan, 0.0, 0.0], [9.0, 0.0, 0.0]]
    found = la.compensate(model, some, frame="base")
    assert found.status == (Status.SUCCESS, Status.BAD_TARGET, Status.UNREACHABLE)
    assert "not finite" in found[1].reason


def test_many_are_each_by_itself(plant):
    """Of every outcome one at least, each in its own circumstances and from its own start."""
    model, targets, _ = plant
    model = model.plus(JointCompliance(2, 1e-3))
    targets = targets[:12].copy()
    targets[3], targets[5] = np.nan, [9.0, 0.0, 0.0]
    carried = Context((), {"payload_kg": np.linspace(0.0, 2.0, 12)})
    starts = model.arm.mid + 0.1 * np.arange(12)[:, None] * (model.arm.upper - model.arm.mid) / 12

    def error(q):
        return smooth_error(q) * np.where(q[:, :1] > np.median(bend), 1.0, 30.0)

    def inside(q):
        return q[:, 1] > np.quantile(turn, 0.3)

    bend, turn = compensate_arrays(model, None, targets, seed=starts).ideal[:, :2].T
    given = {"tol_m": 1e-4, "max_passes": 4}
    many = compensate(model, Known(error, inside), targets, context=carried, seed=starts, **given)
    assert {each.status for each in many} >= {
        Status.SUCCESS, Status.BAD_TARGET, Status.UNREACHABLE, Status.OUT_OF_DOMAIN,
        Status.CORRECTION_TOO_LARGE,
    }  # fmt: skip
    for k, each in enumerate(many):
        one = compensate(
            model, Known(error, inside), targets[k], context=carried.take(k), seed=starts[k],
            **given,
        )[0]  # fmt: skip
        for name, value in vars(one).items():
            if isinstance(value, np.ndarray | float):
                assert np.allclose(getattr(each, name), value, atol=1e-8, equal_nan=True), name
            else:
                assert getattr(each, name) == value, name


def test_the_predictor_hears_the_context(plant):
    model, targets, _ = plant
    known = Known()
    context = Context((1.0,) * 7, {"temperature_c": 31.0, "payload_kg": np.full(30, 0.4)})
    compensate_arrays(model, known, targets, context=context)
    assert known.seen[0].approach == (1.0,) * 7
    assert known.seen[0].columns["temperature_c"] == 31.0
    assert (known.seen[0].columns["payload_kg"] == 0.4).all()


@pytest.mark.parametrize(
    "options", [{"tol_m": 0.0}, {"max_correction_m": np.nan}, {"max_passes": 0}, {"seed": [1, 2]}]
)
def test_options_are_checked(plant, options):
    model, targets, _ = plant
    with pytest.raises(InputError):
        compensate_arrays(model, Known(), targets[:2], **options)
    with pytest.raises(InputError):
        compensate(model, Known(), np.zeros(4))
