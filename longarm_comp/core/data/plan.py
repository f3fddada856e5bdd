"""Plans of poses to measure: the paper's grid, space-filling points, random poses.

A plan holds commanded joints (N, n) inside the joint limits (the joint box), and the side from
which each joint shall arrive.  It may be filtered, for instance by keep-out boxes.  Poses that
separate two effects are planned by the diagnosis.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.arm.parts import Box
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.link_frames import boxes_entered
from longarm_comp.core.model.model import Model

_PAPER_STROKES = np.array([(0, 0), (0, 63), (60, 10), (53, 63), (104, 18), (105, 63)]) / (105, 63)
"""Section III.B of the paper: the six pairs of prismatic strokes, as fractions of each stroke."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Poses to measure, in the order to drive them."""

    q: np.ndarray  # (N, n) commanded joints, rad and m
    approach: np.ndarray
    """(N, n) side from which each joint arrives: +1 from below, -1 from above, 0 from either.

    It may be given as (N,), with one side for all joints.
    """
    payload_kg: np.ndarray | None = None  # (N,) mass to carry; None: the present payload
    touch: np.ndarray | None = None
    """(N,) name of the point that the tip touches; None if the plan is not one of touches."""

    def __post_init__(self) -> None:
        sides = np.asarray(self.approach, dtype=np.int8)
        sides = np.broadcast_to(sides[:, None] if sides.ndim == 1 else sides, self.q.shape)
        object.__setattr__(self, "approach", sides)

    def __len__(self) -> int:
        return len(self.q)

    def take(self, rows: np.ndarray) -> Plan:
        """Return some of the poses, by index."""
        arrays = (self.q, self.approach, self.payload_kg, self.touch)
        return Plan(*(None if each is None else each[rows] for each in arrays))  # type: ignore[arg-type]


def paper_grid(arm: Arm) -> np.ndarray:
    """Return the paper's training grid (Section III.B) for any arm, (N, n).

    Each revolute joint takes its lower limit, its middle and its upper limit.  Two prismatic
    joints take the paper's six pairs of strokes, scaled to their limits; any other number of
    them takes three levels each like a revolute joint.  (The paper uses -25 deg for joint 5,
    whose middle is -22.5 deg.)  The paper's arm gives 3^5 * 6 = 1458 poses.

    Raises:
        InputError: the grid has more than a million poses.
    """
    sliding = int(arm.slides.sum())
    pairs = _PAPER_STROKES if sliding == 2 else _levels(sliding)
    count = 3 ** (arm.n - sliding) * len(pairs)
    if count > 1_000_000:
        allowed = f"sobol: a grid of {arm.n} joints is {count} poses"
        raise InputError("plan", "kind", "grid", allowed)
    levels = _levels(arm.n - sliding)
    shares = np.empty((len(levels), len(pairs), arm.n))
    shares[:, :, ~arm.slides] = levels[:, None, :]
    shares[:, :, arm.slides] = pairs[None, :, :]
    return _in_box(arm, shares.reshape(-1, arm.n))


def _levels(joints: int) -> np.ndarray:
    return np.array(list(itertools.product((0.0, 0.5, 1.0), repeat=joints)))


def grid(arm: Arm, n: int, rng: np.random.Generator | int = 0) -> Plan:
    """Draw n poses of the paper's grid in random order, none twice; InputError if it has fewer."""
    rng, poses = np.random.default_rng(rng), paper_grid(arm)
    if not 1 <= n <= len(poses):
        raise InputError("plan", "n", n, f"1 to {len(poses)} (the grid of {arm.name})")
    return _with_sides(arm, poses[rng.permutation(len(poses))[:n]], rng)


def sobol(arm: Arm, n: int, rng: np.random.Generator | int = 0) -> Plan:
    """Draw n scrambled Sobol points, which fill the joint box evenly; InputError beyond 2^20."""
    if not 1 <= n <= 2**20:
        raise InputError("plan", "n", n, f"1 to {2**20}")
    rng = np.random.default_rng(rng)
    from scipy.stats import qmc  # takes a quarter of a second

    engine = qmc.Sobol(d=arm.n, scramble=True, seed=int(rng.integers(2**31)))
    shares = engine.random_base2(max(0, (n - 1).bit_length()))[:n]
    return _with_sides(arm, _in_box(arm, shares), rng)


def uniform(arm: Arm, n: int, rng: np.random.Generator | int = 0) -> Plan:
    """Draw n uniformly random poses in the joint box."""
    rng = np.random.default_rng(rng)
    return _with_sides(arm, random_joints(arm, n, rng), rng)


def at_levels(arm: Arm, n: int, rng: np.random.Generator | int = 0) -> Plan:
    """Draw n random poses with every joint at its lower limit, its middle or its upper limit."""
    rng = np.random.default_rng(rng)
    return _with_sides(arm, _in_box(arm, rng.integers(0, 3, (n, arm.n)) / 2.0), rng)


def random_joints(arm: Arm, n: int, rng: np.random.Generator | int = 0) -> np.ndarray:
    """Draw n uniformly random joint vectors in the box, (n, arm.n)."""
    return _in_box(arm, np.random.default_rng(rng).random((n, arm.n)))


def random_targets(model: Model, n: int, rng: np.random.Generator | int = 0) -> np.ndarray:
    """Draw n random reachable points (n, 3), m: the tips of a model at random joints."""
    return model.tip(random_joints(model.arm, n, rng))


def _in_box(arm: Arm, shares: np.ndarray) -> np.ndarray:
    """Return the joints at fractions 0..1 of the joint box; 0 and 1 give exactly the limits."""
    return np.where(shares == 1.0, arm.upper, arm.lower + shares * (arm.upper - arm.lower))


def with_room(arm: Arm, q: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return the sides of arrival (N, n), reversed where a limit leaves no room for a run-up.

    Args:
        q: (N, n) commanded joints, rad and m.
        sides: (N, n) wanted sides, +-1; 0 stays 0.
    """
    start, (lower, upper) = q - sides * run_up_lengths(arm), arm.bounds
    return np.where((start < lower) | (start > upper), -sides, sides)


def with_random_sides(arm: Arm, plan: Plan, rng: np.random.Generator | int = 0) -> Plan:
    """Return the same poses with random sides of arrival; where one has no room, the other one."""
    drawn = np.random.default_rng(rng).choice(np.array([-1, 1]), size=plan.q.shape)
    return dataclasses.replace(plan, approach=with_room(arm, plan.q, drawn))


def from_both_sides(arm: Arm, plan: Plan, rng: np.random.Generator | int = 0) -> Plan:
    """Return every pose twice, the second time with all joints from the opposite sides.

    Sides that the plan leaves open are drawn. A joint at a limit arrives both times from the side
    that has room.
    """
    drawn = with_random_sides(arm, plan, rng).approach
    first = np.where(plan.approach == 0, drawn, plan.approach)
    sides = np.stack([with_room(arm, plan.q, first), with_room(arm, plan.q, -first)], axis=1)
    twice = plan.take(np.repeat(np.arange(len(plan)), 2))
    return dataclasses.replace(twice, approach=sides.reshape(-1, arm.n))


def _with_sides(arm: Arm, q: np.ndarray, rng: np.random.Generator) -> Plan:
    """Return a plan of poses q (N, n) with a random side of arrival for every joint.

    A spawned generator draws them, so later draws of `rng` do not depend on the number of joints.
    """
    common = Plan(q, rng.choice(np.array([-1, 1]), size=len(q)))
    return with_random_sides(arm, common, rng.spawn(1)[0])


FLOOR = "floor"
"""Name of the keep-out box of everything below a height."""
_FAR = 1e3


def with_floor(arm: Arm, height_m: float) -> Arm:
    """Return the arm with a floor at a height (m, base frame) among its keep-out boxes.

    A floor above the arm's foot is a safety height: the arm rises above it once and stays there.

    Raises:
        InputError: the height is not within +-1 km.
    """
    if not -_FAR < height_m < _FAR:
        raise InputError("floor", "--floor", height_m, f"a height, {-_FAR:g} to {_FAR:g} m")
    floor = Box(min_m=(-_FAR, -_FAR, -_FAR), max_m=(_FAR, _FAR, height_m))
    return arm.model_copy(update={"keep_out": {**arm.keep_out, FLOOR: floor}})


def outside_boxes(model: Model, plan: Plan) -> np.ndarray:
    """Return (M,) True for poses at which, and at whose run-up, the arm is outside all boxes."""
    if not model.arm.keep_out:
        return np.ones(len(plan), dtype=bool)
    start = plan.q - plan.approach * run_up_lengths(model.arm)
    begun = np.clip(start, *model.arm.bounds)
    pairs = zip(boxes_entered(model, plan.q), boxes_entered(model, begun), strict=True)
    return np.array([not any(pair) for pair in pairs])


def fill_plan(
    make: Callable[[Arm, int, int], Plan],
    arm: Arm,
    n: int,
    seed: int,
    allowed: Callable[[Plan], np.ndarray],
    most: int,
) -> Plan:
    """Return a plan of the first n allowed poses; at most 64 poses are drawn for each.

    Args:
        make: makes a plan of a number of poses from the arm, this number and a seed.
        allowed: returns (M,) True for the allowed ones of a plan's M poses.
        most: largest number of poses to draw, if this is more than n.

    Raises:
        JobError: fewer than n of the drawn poses are allowed.
    """
    free, tried = np.zeros(0, dtype=int), 0
    for count in sorted({n, *(min(times * n, most) for times in (4, 16, 64))}):
        plan = make(arm, count, seed)
        free, tried = np.flatnonzero(allowed(plan))[:n], count
        if len(free) == n:
            return plan if count == n else plan.take(free)
    why = "keep-out boxes, floor and cameras allow no more"
    raise JobError(f"only {len(free)} of {tried} poses are allowed: {why}", asked=n)
