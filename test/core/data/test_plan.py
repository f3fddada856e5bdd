"""Plans: the paper's grid on its arm, other arms, space filling, files."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from small_arm import ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.arm.parts import Payload
from longarm_comp.core.data.plan import (
    Plan,
    from_both_sides,
    grid,
    paper_grid,
    random_targets,
    sobol,
    with_random_sides,
    with_room,
)
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.poses import read_poses, write_poses


def test_the_papers_arm_gives_the_papers_grid(twin: Arm) -> None:
    poses = paper_grid(twin)
    assert poses.shape == (1458, 7)
    assert len(np.unique(poses, axis=0)) == 1458
    for joint, levels in {0: [-15, 0, 15], 1: [0, 15, 30], 3: [0, 30, 60], 5: [-30, 0, 30]}.items():
        assert np.allclose(np.unique(poses[:, joint].round(9)), np.radians(levels))
    strokes = np.unique(poses[:, [2, 6]].round(9), axis=0) * 1e3
    assert np.allclose(strokes, [[0, 0], [0, 63], [53, 63], [60, 10], [104, 18], [105, 63]])


def test_grid_of_another_arm_takes_three_levels_of_every_joint() -> None:
    poses = paper_grid(ARM)
    assert poses.shape == (81, 4)
    assert (poses.min(0) == ARM.lower).all()
    assert (poses.max(0) == ARM.upper).all()


def test_subset_of_the_grid_repeats_nothing_and_follows_the_seed() -> None:
    plan, again, other = grid(ARM, 50, 1), grid(ARM, 50, 1), grid(ARM, 50, 2)
    whole = set(map(tuple, paper_grid(ARM)))
    assert len(set(map(tuple, plan.q))) == 50
    assert set(map(tuple, plan.q)) <= whole
    assert (plan.q == again.q).all()
    assert (plan.q != other.q).any()
    assert set(plan.approach.ravel().tolist()) == {-1, 1}


@pytest.mark.parametrize("n", [1, 7, 64, 100])
def test_sobol_fills_the_box(n: int) -> None:
    plan = sobol(ARM, n, 3)
    assert plan.q.shape == (n, 4)
    assert (plan.q >= ARM.lower).all()
    assert (plan.q <= ARM.upper).all()
    if n >= 64:  # every eighth of every joint's range holds its share of points
        share = (plan.q - ARM.lower) / (ARM.upper - ARM.lower)
        for j in range(4):
            counts = np.histogram(share[:, j], bins=8, range=(0, 1))[0]
            assert counts.min() >= n // 8 - 2


@pytest.mark.parametrize("make", [grid, sobol])
def test_counts_that_cannot_be_are_refused(make) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match="n: 0"):
        make(ARM, 0)


def test_more_than_the_grid_is_refused() -> None:
    with pytest.raises(InputError, match="1 to 81"):
        grid(ARM, 82)


def test_random_targets_are_reachable() -> None:
    model = Model(ARM)
    targets = random_targets(model, 20, 5)
    reach = np.linalg.norm(model.tip(paper_grid(ARM)), axis=1)
    distance = np.linalg.norm(targets, axis=1)
    assert targets.shape == (20, 3)
    assert (distance < reach.max() + 0.05).all()
    assert (distance > reach.min() - 0.05).all()


def joint_by_joint(plan: Plan) -> np.ndarray:
    """(n, n) correlation of the sides of different joints, where both have room for either."""
    return np.corrcoef(plan.approach.T)


def test_every_joint_has_a_side_of_its_own() -> None:
    plan = sobol(ARM, 400, 1)
    assert np.abs(plan.approach.mean(axis=0)).max() < 0.2
    assert np.abs(joint_by_joint(plan) - np.eye(4)).max() < 0.2
    assert (plan.approach == sobol(ARM, 400, 1).approach).all()
    other = with_random_sides(ARM, plan, 7)
    assert (other.q == plan.q).all()
    assert 0.3 < (other.approach == plan.approach).mean() < 0.7


def test_a_side_without_room_to_run_up_is_turned_round() -> None:
    q = np.stack([ARM.lower, ARM.lower + 0.9 * run_up_lengths(ARM), ARM.mid, ARM.upper])
    below = with_room(ARM, q, np.ones(q.shape))
    assert below.tolist() == [[-1] * 4, [-1] * 4, [1] * 4, [1] * 4]
    above = with_room(ARM, q, -np.ones(q.shape))
    assert above.tolist() == [[-1] * 4, [-1] * 4, [-1] * 4, [1] * 4]
    assert (with_room(ARM, q, np.zeros(q.shape)) == 0).all()
    corner = grid(ARM, 81, 1)  # every plan is one that can be driven
    assert (corner.approach == with_room(ARM, corner.q, corner.approach)).all()
    assert (corner.approach[corner.q == ARM.lower] == -1).all()


def test_the_callers_further_draws_do_not_depend_on_the_sides() -> None:
    rng, other = np.random.default_rng(1), np.random.default_rng(1)
    grid(ARM, 9, rng)
    other.permutation(81)
    other.choice([-1, 1], size=9)
    assert rng.random() == other.random()


def test_poses_from_both_sides_keep_their_payload_and_point() -> None:
    poses = sobol(ARM, 3)
    plan = dataclasses.replace(poses, payload_kg=np.arange(3.0), touch=np.array(["a", "b", "c"]))
    twice = from_both_sides(ARM, plan)
    assert twice.touch is not None and twice.payload_kg is not None
    assert twice.touch.tolist() == ["a", "a", "b", "b", "c", "c"]
    assert twice.payload_kg.tolist() == [0, 0, 1, 1, 2, 2]
    assert (twice.q == np.repeat(poses.q, 2, axis=0)).all()


@pytest.mark.parametrize("alike", [False, True])
def test_poses_file_round_trip(tmp_path: Path, alike: bool) -> None:
    carries = ARM.model_copy(update={"payload": Payload(mass_kg=0.2, frame=4)})
    plan = dataclasses.replace(grid(carries, 9, 1), payload_kg=np.linspace(0, 0.4, 9))
    if alike:
        plan = dataclasses.replace(plan, approach=np.repeat([1, 0, -1], 3))
    write_poses(plan, tmp_path / "poses.csv")
    header = (tmp_path / "poses.csv").read_text().splitlines()[0].split(",")
    assert ("approach" in header) == alike
    assert ("approach_q4" in header) != alike
    back = read_poses(tmp_path / "poses.csv", carries)
    assert (back.q == plan.q).all()
    assert (back.approach == plan.approach).all()
    assert back.payload_kg is not None
    assert (back.payload_kg == plan.payload_kg).all()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("q1,q2,q3\n0,0.5,0\n", "column q4: 'missing'"),
        ("q1,q2,q3,q4,speed\n0,0.5,0,0,1\n", "column speed: 'unknown'"),
        ("q1,q2,q3,q4\n0,40,0,0\n", "line 2, q2: '40'"),
        ("q1,q2,q3,q4,approach\n0,0.5,0,0,2\n", "line 2, approach: '2'"),
        ("q1,q2,q3,q4,approach_q1\n0,0.5,0,0,1\n", "column approach_q2: 'missing"),
    ],
)
def test_bad_plans_are_refused(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_poses(path, ARM)
    assert words in str(caught.value)
