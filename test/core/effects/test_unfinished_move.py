"""Joints that are measured before they have arrived: the effect, its name, its commands."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest
from few_effects import names_alone
from hidden_arm import white
from small_arm import ARM

import longarm_comp as la
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.compensation.arrive import compensate_move
from longarm_comp.core.compensation.online import Readings
from longarm_comp.core.compensation.unknown import unknown_history
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import LIBRARY, searched_effects
from longarm_comp.core.effects.compliances import ServoDroop
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.effects.drive_errors import JointCoupling, JointGain, UnfinishedMove
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.plays import Backlash, FrictionHysteresis
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.discover.inputs import read_arm_inputs
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden import drives

SPAN = ARM.upper - ARM.lower
SHARE = 0.004
SHORT = Model(ARM, tuple(UnfinishedMove(row, share=SHARE) for row in ARM.commanded))
AT_ONE_JOINT = (FrictionHysteresis, Backlash, ServoDroop, JointGain, JointCoupling, UnfinishedMove)


def session(n: int, seed: int, run_up: bool = False) -> tuple[Session, np.ndarray]:
    """Random poses one after the other, or each by a run-up of one length, and true tips (n, 3).

    A share of every joint's last way is left when the tip is measured. Run-ups pass their pose, so
    that the joints turn.
    """
    rng = np.random.default_rng(seed)
    q = ARM.lower + SPAN * (0.1 + 0.8 * rng.random((n, ARM.n)))
    before = np.vstack([q[:1], q[:-1]])
    begun = q + 0.8 * SPAN * np.where(q > before, 1.0, -1.0)
    before = begun if run_up else before
    lag = drives.ServoLag(np.full(ARM.n, SHARE))
    tip = TrueArm(ARM, [lag]).tip(q, TrueContext(way=q - before))
    return Session.record(q, tip + white(rng, n), run_up=begun if run_up else None), tip


def diagnosed(kinds: Sequence[type[Effect]], run_up: bool = False) -> Diagnosis:
    """Proved by rows of its own."""
    rows, held = (session(n, seed, run_up)[0] for n, seed in ((150, 1), (60, 3)))
    return diagnose(ARM, rows, test=held, kinds=kinds)


@pytest.fixture(scope="module")
def late() -> Diagnosis:
    return diagnosed((*LIBRARY, UnfinishedMove))


def test_a_joint_stands_short_of_its_command_by_a_share_of_its_last_way() -> None:
    """The first joint turns by so much about the vertical axis; the slide is so much shorter."""
    start, way = ARM.mid - 0.2 * SPAN, np.array([0.5, 0.0, 0.03, 0.0])
    path = start + np.outer([0.3, 0.6, 0.4], way)  # up, up again, and back
    history = History.unknown(ARM.n).after(path[:1], start)
    for before, here, share in ((path[0], path[1], 0.3), (path[1], path[2], -0.2)):
        history = history.after(here[None], before)
        np.testing.assert_allclose(history.last_way, share * way, atol=1e-12)
        tip = SHORT.tip(here, Context(**history.fields()))
        np.testing.assert_allclose(tip, Model(ARM).tip(here - SHARE * share * way), atol=1e-9)


def test_what_is_left_of_a_known_way_is_less_known_the_longer_it_is() -> None:
    start = ARM.mid - 0.3 * SPAN

    def doubt(way: float) -> float:
        came = History.unknown(ARM.n).after((start + way * SPAN)[None], start)
        sd, (why,) = unknown_history(SHORT, ARM.mid[None], Context(**came.fields()))
        assert why.startswith("the tip depends") and "time since the last move of" in why
        return float(np.linalg.norm(sd))

    unknown = np.linalg.norm(unknown_history(SHORT, ARM.mid[None], Context())[0])
    assert doubt(0.25) == pytest.approx(0.5 * unknown, rel=1e-3)
    assert doubt(0.05) == pytest.approx(0.1 * unknown, rel=1e-3)


def test_a_command_makes_up_for_what_its_own_move_leaves() -> None:
    start, target = ARM.mid - 0.3 * SPAN, Model(ARM).tip(ARM.mid)
    arrival = compensate_move(
        SHORT, None, target, start=start, history=History.unknown(ARM.n),
        context_after=partial(Readings().context, SHORT, 1.0, 1.0),
    )  # fmt: skip
    path = np.vstack([start, arrival.move.points])
    short = path[-1] - SHARE * (path[-1] - path[-2])
    np.testing.assert_allclose(Model(ARM).tip(short), target, atol=1e-6)
    assert np.linalg.norm(Model(ARM).tip(path[-1]) - target) > 5e-5
    missed_settled = np.linalg.norm(Model(ARM).tip(path[-1]) - target)
    assert missed_settled < 2.0 * np.linalg.norm(arrival.outcome.sigma)


def test_joints_that_are_measured_too_early_are_named_with_their_share(late: Diagnosis) -> None:
    assert late.verdict == "named"
    assert [f.names for f in late.findings] == [("unfinished_move",)]
    terms = [t for t in late.model.effects if isinstance(t, UnfinishedMove)]
    assert {t.joint for t in terms} >= {1, 2}
    for term in terms[:2]:
        assert term.share == pytest.approx(SHARE, rel=0.1)


def test_it_is_tried_only_where_it_is_asked_for() -> None:
    assert UnfinishedMove not in searched_effects()


def test_where_it_is_not_tried_its_rows_are_not_taken_for_friction() -> None:
    """A side explains two thirds of what ways do: functions of the ways are tried in its place."""
    kinds = tuple(kind for kind in AT_ONE_JOINT if kind is not UnfinishedMove)
    found = diagnosed(kinds)
    assert found.verdict in ("partly", "unknown")
    assert {name for f in found.findings for name in f.names} <= {"joint_coupling", "joint_gain"}
    assert "behaves like rows that were measured before the arm stood" in found.summary
    ways = {t.function for t in found.model.effects if isinstance(t, Discovered)}
    assert any("way_" in function for function in ways)


def test_a_way_counts_only_at_joints_whose_history_tells_already() -> None:
    rows = session(60, 1)[0]
    at = Model(ARM).posture([rows.q[:, k] for k in range(ARM.n)], rows.context())
    held = read_arm_inputs(ARM, at, rows, remembering={1}).by_name
    assert [name for name in held if name.startswith("way_")] == ["way_2"]
    np.testing.assert_allclose(held["way_2"].values, rows.last_way[:, 1])
    assert not any(name.startswith("way_") for name in read_arm_inputs(ARM, at, rows).by_name)


def test_rows_that_nobody_fitted_are_predicted(late: Diagnosis) -> None:
    fresh, tip = session(100, 2)
    off = np.linalg.norm(late.model.tip(fresh.q, fresh.context()) - tip, axis=1)[1:]
    without = np.linalg.norm(Model(ARM).tip(fresh.q) - tip, axis=1)[1:]
    assert np.sqrt((off**2).mean()) < 0.1 * np.sqrt((without**2).mean())


def test_a_command_keeps_its_promise_as_soon_as_the_rows_were_measured_and_later(
    late: Diagnosis,
) -> None:
    q = ARM.lower + SPAN * np.random.default_rng(5).uniform(0.2, 0.8, (40, ARM.n))
    targets = Model(ARM).tip(q)
    found = la.compensate(with_uncertainty(late.fit), targets, frame="measured")
    assert found.success.all()
    promised = np.array([each.p90_m for each in found])
    last = np.array([arrival.history.last_way for arrival in found.arrivals])
    for share in (SHARE, 0.0):
        missed = np.linalg.norm(Model(ARM).tip(found.command - share * last) - targets, axis=1)
        assert (missed <= promised).mean() >= 0.9


def test_after_run_ups_of_one_length_nothing_tells_it_from_friction() -> None:
    with names_alone():
        found = diagnosed(AT_ONE_JOINT, run_up=True)
    assert [set(f.names) for f in found.findings] == [{"unfinished_move", "friction_hysteresis"}]
