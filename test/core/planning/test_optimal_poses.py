"""Optimal poses: the algebra against brute force, what may be driven, what rows bring, commands."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from few_effects import few_effects, names_alone
from sensed_arm import ANCHORS, SIGMA, ZEROS, declared, miss, read, sensed
from small_arm import ARM

import longarm_comp as la
from longarm_comp.cli.plan import command
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.calibration.calibrate import geometry_terms
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.data.plan import Plan, outside_boxes, random_joints, sobol
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.model import Model
from longarm_comp.core.planning.optimal_poses import Choice, Uncertainty, choose_optimal_poses
from longarm_comp.sessions.csv import write_csv
from longarm_comp.sessions.poses import read_poses
from longarm_comp.sim.arm_truth import TrueArm

NOISE = (SIGMA, 1e-3)


@pytest.fixture(scope="module")
def unknown() -> Uncertainty:
    return Uncertainty.of(Model(ARM), None, "position", known=True, sigma=NOISE)


def expected(uncertain: Uncertainty, plan: Plan, measure: str = "position") -> float:
    """Rms error of the tip, m, from the inverse of all information."""
    x = uncertain.measures(plan, measure).reshape(-1, len(uncertain.scale))  # type: ignore[arg-type]
    cover = np.linalg.inv(uncertain.information + x.T @ x)
    return float(np.sqrt(np.trace(uncertain.tips(random_joints(ARM, 200, 3)) @ cover)))


def test_a_gain_is_what_the_criterion_loses(unknown: Uncertainty) -> None:
    x = unknown.measures(sobol(ARM, 20, 1), "position")
    tips = unknown.tips(random_joints(ARM, 50, 2))
    for weight in (tips, None):
        choice = Choice(x, unknown.information, weight)

        def criterion(rows: list[int], choice: Choice = choice) -> float:
            cover = choice.covariance(rows)
            if choice.tips is None:
                return float(np.linalg.slogdet(cover)[1])
            return float(np.trace(choice.tips @ cover))

        taken = [0, 3, 4, 9]
        known = choice.after([0, 3, 7]).with_pose(4).with_pose(9).with_pose(7, -1.0)
        gains = known.gains(taken)
        for k in (1, 7, 19):
            lost = criterion(taken) - criterion([*taken, k])
            assert gains[k] == pytest.approx(lost, rel=1e-5)
        assert (gains[taken] == -np.inf).all()
        grown = choice.add_best([], 8)
        assert criterion(choice.exchange_worse(grown)) <= criterion(grown) + 1e-12
        assert len(set(choice.exchange_worse(grown))) == 8


def test_no_digits_are_lost_while_everything_is_unknown() -> None:
    """The poses are those that a new inverse each time would choose."""
    wide = Uncertainty.of(Model(ARM), None, "position", known=False, sigma=NOISE)
    tips = wide.tips(random_joints(ARM, 50, 2))
    choice = Choice(wide.measures(sobol(ARM, 64, 1), "position"), wide.information, tips)
    anew: list[int] = []
    for _ in range(20):
        anew.append(int(np.argmax(choice.after(anew).gains(anew))))
    assert choice.add_best([], 20) == anew


@pytest.mark.parametrize("measure", ["position", "pose", "distance"])
def test_chosen_poses_leave_less_than_others(measure: str) -> None:
    arm = declared(anchors={name: {"xyz_m": place} for name, place in ANCHORS.items()})
    uncertain = Uncertainty.of(Model(arm), None, measure, known=True, sigma=NOISE)  # type: ignore[arg-type]
    plan = choose_optimal_poses(uncertain, 15, measure=measure, rng=0)  # type: ignore[arg-type]
    others = [expected(uncertain, sobol(ARM, 15, seed), measure) for seed in range(8)]
    mine = expected(uncertain, plan, measure)
    assert mine < 0.95 * min(others)
    assert plan.expected_m == pytest.approx(mine, rel=0.1)
    assert plan.ahead_m < plan.expected_m
    start = plan.q - plan.approach * run_up_lengths(ARM)
    assert ((start >= ARM.lower) & (start <= ARM.upper)).all()


def test_chosen_poses_calibrate_the_true_arm_better(unknown: Uncertainty) -> None:
    true, left = TrueArm(ARM, ZEROS), {"sobol": [], "i-optimal": []}
    for seed in range(12):
        plans = {
            "sobol": sobol(ARM, 10, seed),
            "i-optimal": choose_optimal_poses(unknown, 10, rng=seed),
        }
        for way, plan in plans.items():
            noise = 1e-3 * np.random.default_rng(seed).standard_normal((10, 3))
            rows = Session.record(plan.q, true.tip(plan.q) + noise, approach=plan.approach)
            fitted = fit_model(Model(ARM).with_missing(geometry_terms(ARM, rows)), rows)
            left[way].append(miss(fitted.model))
    assert np.mean(left["i-optimal"]) < 0.95 * np.mean(left["sobol"])


def test_rows_measured_so_far_count(unknown: Uncertainty) -> None:
    session = read(sensed(n=40))
    after = Uncertainty.of(Model(ARM), session, "position", known=True, sigma=(1.0, 1.0))
    assert after.sigma[0] == pytest.approx(SIGMA, rel=0.3)  # the rows' own
    first, next_ = choose_optimal_poses(unknown, 10, rng=0), choose_optimal_poses(after, 10, rng=0)
    assert next_.expected_m < 0.7 * first.expected_m
    wide = Uncertainty.of(Model(ARM), session, "position", known=False, sigma=NOISE)
    assert len(wide.model.slots) > len(after.model.slots) + 5
    assert choose_optimal_poses(wide, 10, rng=0).expected_m > next_.expected_m


def boxed(low: np.ndarray, high: np.ndarray) -> Model:
    return Model(declared(keep_out={"lamp": {"min_m": low.tolist(), "max_m": high.tolist()}}))


def test_boxes_keep_the_whole_arm_and_its_run_up_out() -> None:
    model, q = Model(ARM), ARM.mid[None]
    tip = model.tip(q)[0]
    elbow = model.posture(list(ARM.mid)).frames[3].matrix()[:3, 3]
    ahead = Plan(q, np.ones((1, ARM.n)))
    for place in (
        tip,
        elbow,
        0.5 * (tip + model.posture(list(ARM.mid)).frames[-1].matrix()[:3, 3]),
    ):
        assert not outside_boxes(boxed(place - 5e-3, place + 5e-3), ahead)[0]
    assert outside_boxes(boxed(tip + 5.0, tip + 6.0), ahead)[0]
    begun = model.tip(ARM.mid - run_up_lengths(ARM))
    there = boxed(begun - 5e-3, begun + 5e-3)
    assert not outside_boxes(there, ahead)[0]
    assert outside_boxes(there, Plan(q, -np.ones((1, ARM.n))))[0]


def test_a_floor_and_what_is_seen_hold_for_every_kind_of_plan() -> None:
    tips = Model(ARM).tip(random_joints(ARM, 500, 1))
    height = float(np.quantile(tips[:, 2], 0.3))
    aside = float(np.median(tips[:, 1]))
    standing = declared(base={"xyz_m": [0.0, 0.0, 0.0], "rpy_deg": [0, 0, 0]})
    low = min(height, standing.base.xyz_m[2] - 0.01)

    def seen(poses: np.ndarray) -> np.ndarray:
        return np.asarray(poses[:, 1, 3] > aside)

    for kind in ("sobol", "grid", "i-optimal"):
        known = {"model": Model(standing)} if kind == "i-optimal" else {}
        poses = la.plan(standing, 12, kind=kind, floor=low, seen=seen, **known).q  # type: ignore[arg-type]
        there = Model(standing).tip(poses)
        assert len(poses) == 12 and (there[:, 2] > low).all() and (there[:, 1] > aside).all()
    free = la.plan(standing, 12)
    assert (la.plan(standing, 12, floor=-9.0).q == free.q).all()
    with pytest.raises(JobError, match="only 0 of"):  # its shoulder lies at that height
        la.plan(standing, 12, floor=0.0)
    with pytest.raises(JobError, match="only 0 of"):
        la.plan(standing, 12, seen=lambda poses: np.zeros(len(poses), dtype=bool))


def test_the_command_plans_says_when_to_stop_and_respects_a_box(tmp_path: Path) -> None:
    file, out = tmp_path / "arm.yaml", tmp_path / "p.csv"
    tips = Model(ARM).tip(random_joints(ARM, 200, 0))
    low, high = np.median(tips, axis=0) - np.eye(3)[2], tips.max(axis=0) + 1.0
    arm = boxed(low, high).arm
    file.write_text(yaml.safe_dump(arm.model_dump(mode="json", exclude_defaults=True)))
    write_csv(read(sensed(n=40)), tmp_path / "rows.csv")
    la.calibrate(arm, tmp_path / "rows.csv").save(tmp_path / "model.yaml")
    run = CliRunner().invoke
    known = ["--model", str(tmp_path / "model.yaml"), "--measured", str(tmp_path / "rows.csv")]
    words = [str(file), "--kind", "i-optimal", "-n", "12", "-o", str(out)]
    done = run(command, [*words, *known])
    assert done.exit_code == 0, done.output
    assert "20 more poses would bring" in done.stderr
    there = Model(ARM).tip(read_poses(out, ARM).q)
    assert len(there) == 12 and not ((there > low) & (there < high)).all(axis=1).any()
    told = json.loads(run(command, [*words, "--json", *known]).stdout)
    assert 0 < told["expected_with_20_more_mm"] < told["expected_mm"] < 0.5


def test_what_cannot_be_planned_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="anchors with their places"):
        la.plan(ARM, 5, kind="d-optimal", model=Model(ARM), measure="distance")
    with pytest.raises(InputError, match=r"poses are allowed"):
        everywhere = boxed(np.full(3, -9.0), np.full(3, 9.0))
        la.plan(everywhere.arm, 5, kind="i-optimal", model=everywhere)
    with pytest.raises(InputError, match=r"sobol.*i-optimal or d-optimal"):
        la.plan(ARM, 5, model=Model(ARM))


def test_a_diagnosis_is_what_is_known(tmp_path: Path) -> None:
    write_csv(read(sensed(n=60)), tmp_path / "rows.csv")
    with few_effects(()), names_alone():
        la.diagnose(ARM, tmp_path / "rows.csv", network=False).save(tmp_path / "found")
    after = la.plan(ARM, 10, kind="i-optimal", report=tmp_path / "found")
    before = la.plan(ARM, 10, kind="i-optimal", model=Model(ARM))
    assert after.expected_m < 0.7 * before.expected_m  # type: ignore[attr-defined]
    (tmp_path / "rows.csv").unlink()
    alone = la.plan(ARM, 10, kind="i-optimal", report=tmp_path / "found")
    assert alone.expected_m > after.expected_m  # type: ignore[attr-defined]
