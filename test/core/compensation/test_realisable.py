"""Realisable joints: against every combination of steps, by linear models and by the arm's own."""

from __future__ import annotations

import dataclasses
import itertools
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.realisable import Lattice, Search, choose
from longarm_comp.core.errors import InputError
from studies.many import choose_arrays

STEP = 2 * math.pi / 1000
SLIDE = 1e-4
LENGTH = 0.3
PRICE = math.degrees(1e-4)


def every(ranges: list[np.ndarray]) -> np.ndarray:
    """All combinations, (K, n)."""
    return np.array(list(itertools.product(*ranges)), float)


# ------------------------------------------------------------------ linear models


def arm_of(limits: list[tuple[float, float]], slides: list[int] | None = None) -> Arm:
    """An arm of which only the limits (rad, m) and kinds of joint matter: the tip is given."""
    joints = []
    for i, (low, high) in enumerate(limits):
        slide = i in (slides or [])
        between = [low, high] if slide else [math.degrees(low), math.degrees(high)]
        joints.append(
            {
                "id": i + 1,
                "type": "prismatic" if slide else "revolute",
                "limits_m" if slide else "limits_deg": between,
            }
        )
    data = {"name": "any", "convention": "mdh_craig", "tip": {"frame": 1}, "joints": joints}
    return Arm.parse(data, "test")


@dataclasses.dataclass
class Linear:
    """A tip that is linear in the joints, with targets for it and the truth by brute force."""

    arm: Arm
    lattice: Lattice
    J: np.ndarray
    tip0: np.ndarray
    ideal: np.ndarray
    targets: np.ndarray

    @classmethod
    def draw(cls, rng: np.random.Generator, *, count: int = 12, slide: bool = True) -> Linear:
        """Four joints, of which the last may slide; ranges below, above and across zero."""
        step = np.array([STEP, 1.3 * STEP, STEP, SLIDE if slide else 0.8 * STEP])
        offset = np.array([0.31, -0.44, 0.07, 0.23]) * step
        middle = np.array([-0.4, 0.3, 0.0, -0.02 if slide else 0.1])
        # seven steps a joint: k within +-3 of the one nearest to the middle
        whole = np.rint((middle - offset) / step)
        low, high = (offset + step * (whole + by) for by in (-3.4, 3.4))
        arm = arm_of(list(zip(low, high, strict=True)), [3] if slide else [])
        J = rng.normal(size=(3, 4)) * [0.5, 0.5, 0.5, 1.0 if slide else 0.5]
        ideal = rng.uniform(arm.lower, arm.upper, (count, 4))
        tip0 = rng.normal(size=3)
        # the ideal joints miss too, as they do where a pseudo-target has not settled
        targets = tip0 + ideal @ J.T + rng.normal(size=(count, 3)) * 2e-3
        return cls(arm, Lattice(step, offset, np.zeros(4)), J, tip0, ideal, targets)

    def predict(self, q: np.ndarray) -> np.ndarray:
        assert (q >= self.arm.lower).all() and (q <= self.arm.upper).all()
        return self.at(q)

    def at(self, q: np.ndarray) -> np.ndarray:
        """The tip at joints."""
        return self.tip0 + q @ self.J.T

    def choose(
        self, price: float = PRICE, kept: int = 16, rounds: int = 2, **more: Any
    ) -> SimpleNamespace:
        search = Search(LENGTH, price_m=price, kept=kept, rounds=rounds, max_nodes=200_000)
        return choose_arrays(
            self.arm, self.lattice, self.predict, self.targets, self.ideal, search, **more
        )

    def cost(self, q: np.ndarray, i: int, price: float = PRICE) -> np.ndarray:
        slides = np.array([j.type == "prismatic" for j in self.arm.joints])
        moved = (q - self.ideal[i]) * np.where(slides, price / LENGTH, price)
        miss = self.at(q) - self.targets[i]
        made: np.ndarray = (miss**2).sum(axis=-1) + (moved**2).sum(axis=-1)
        return made

    def brute(self) -> np.ndarray:
        """All realisable joints."""
        step, offset = self.lattice.step, self.lattice.offset
        ranges = [
            offset[j]
            + step[j]
            * np.arange(
                math.ceil((self.arm.lower[j] - offset[j]) / step[j]),
                math.floor((self.arm.upper[j] - offset[j]) / step[j]) + 1,
            )
            for j in range(4)
        ]
        return every(ranges)


@pytest.mark.parametrize("price", [0.3 * PRICE, PRICE, 20 * PRICE])
def test_the_choice_is_the_best_of_all_combinations(price: float, rng: np.random.Generator) -> None:
    for _ in range(2):
        case = Linear.draw(rng)
        grid = case.brute()
        assert len(grid) == 7**4
        got = case.choose(price)
        # the first of the list is it already (or too far off in a corner of the limits)
        one = case.choose(price, kept=1, rounds=1)
        listed = np.array([not reason for reason in one.reason])
        assert listed.sum() >= 6 or price > PRICE
        np.testing.assert_array_equal(one.joints[listed], got.joints[listed])
        for i in range(len(case.ideal)):
            best = grid[np.argmin(case.cost(grid, i, price))]
            np.testing.assert_allclose(got.joints[i], best, atol=1e-12)
            miss = np.linalg.norm(case.at(best) - case.targets[i])
            assert got.error[i] == pytest.approx([miss, 0.0], abs=1e-12)


def test_a_second_look_mends_what_the_first_took_for_linear(rng: np.random.Generator) -> None:
    case = Linear.draw(rng, count=40)

    def bent(q: np.ndarray) -> np.ndarray:
        off = q - case.arm.mid
        return case.predict(q) + 8.0 * off[:, :1] * off[:, 1:2] * [1.0, -1.0, 0.5]

    targets = bent(case.ideal)
    left = [
        choose_arrays(
            case.arm, case.lattice, bent, targets, case.ideal, Search(LENGTH, kept=1, rounds=r)
        ).error[:, 0]
        for r in (1, 2)
    ]
    grid = case.brute()
    best = [np.linalg.norm(bent(grid) - target, axis=1).min() for target in targets]
    excess = [np.mean(e - best) for e in left]
    assert excess[1] < 0.6 * excess[0]


def test_a_dear_move_is_rounding_and_a_cheap_one_goes_further(rng: np.random.Generator) -> None:
    case = Linear.draw(rng)
    dear, plain, cheap = (case.choose(p) for p in (1e3, PRICE, 0.3 * PRICE))
    np.testing.assert_array_equal(dear.joints, dear.rounded)
    assert set(dear.reason) == {"no choice was better than rounding"}
    assert cheap.error[:, 0].mean() <= plain.error[:, 0].mean() < 0.7 * dear.error[:, 0].mean()
    grid = case.brute()
    for i, rounded in enumerate(dear.rounded):  # each joint by itself, inside the limits
        apart = np.abs(grid - case.ideal[i]) / case.lattice.step
        np.testing.assert_array_equal(rounded, grid[np.argmin(apart.sum(axis=1))])


def test_continuous_joints_are_solved_for_inside_their_limits(rng: np.random.Generator) -> None:
    """Every combination of steps with the other joints by SciPy's bounded least squares."""
    at_limit = 0
    for one_more in (0, 1):
        case = Linear.draw(rng, count=3)
        step = np.where([0, 0, one_more, 1], 0.0, case.lattice.step)  # slide, or slide and joint
        low, high = case.arm.lower.copy(), case.arm.upper.copy()
        middle = case.ideal[:, 3].mean()
        low[3], high[3] = middle - 0.6 * SLIDE, middle + 0.6 * SLIDE
        case.arm = arm_of(list(zip(low, high, strict=True)), [3])
        case.ideal = np.clip(case.ideal, low, high)
        case.lattice = Lattice(step, case.lattice.offset, np.zeros(4))
        got = case.choose(kept=64)
        stepped = np.flatnonzero(step > 0)
        free = np.flatnonzero(step == 0)
        price = np.array([PRICE, PRICE, PRICE, PRICE / LENGTH])
        ranges = [
            case.lattice.offset[j]
            + step[j]
            * np.arange(
                math.ceil((low[j] - case.lattice.offset[j]) / step[j]),
                math.floor((high[j] - case.lattice.offset[j]) / step[j]) + 1,
            )
            for j in stepped
        ]
        for i, ideal in enumerate(case.ideal):
            best, cost = ideal, math.inf
            for point in every(ranges):
                q = ideal.copy()
                q[stepped] = point
                A = np.concatenate([case.J[:, free], np.diag(price[free])])
                b = np.r_[case.targets[i] - case.at(q), np.zeros(free.size)]
                x = lsq_linear(A, b, (low[free] - ideal[free], high[free] - ideal[free])).x
                q[free] += x
                if case.cost(q, i) < cost:
                    best, cost = q, case.cost(q, i)
            assert case.cost(got.joints[i], i) <= cost * (1 + 1e-6)
            np.testing.assert_allclose(got.joints[i], best, atol=1e-5)
            at_limit += best[3] in (low[3], high[3]) or abs(best[3] - middle) > 0.59 * SLIDE
    assert at_limit > 0


def test_what_is_not_known_to_a_share_of_the_step_stays(rng: np.random.Generator) -> None:
    case = Linear.draw(rng)
    case.lattice = dataclasses.replace(
        case.lattice, offset_sd=case.lattice.step * [0.149, 0.151, 0.0, 0.149]
    )
    got = case.choose()
    np.testing.assert_array_equal(got.joints[:, 1], case.ideal[:, 1])
    np.testing.assert_array_equal(got.rounded[:, 1], case.ideal[:, 1])
    assert (got.joints[:, 0] != case.ideal[:, 0]).all()
    assert got.note[0] == (
        "joint2 stays at its ideal value: the offset of its steps is not known to 0.15 of a step"
    )
    nothing = dataclasses.replace(case.lattice, offset_sd=case.lattice.step)
    held = choose_arrays(case.arm, nothing, case.predict, case.targets, case.ideal, Search(LENGTH))
    np.testing.assert_array_equal(held.joints, case.ideal)
    assert set(held.reason) == {"no joint's steps are known"}
    assert held.note[0].count("stays at its ideal value") == 4


def test_a_joint_whose_limits_hold_no_step_stays(rng: np.random.Generator) -> None:
    case = Linear.draw(rng)
    low, high = case.arm.lower.copy(), case.arm.upper.copy()
    at = case.lattice.offset[2] + STEP * 0.5
    low[2], high[2] = at - 0.3 * STEP, at + 0.3 * STEP
    case.arm = arm_of(list(zip(low, high, strict=True)), [3])
    case.ideal[:, 2] = at
    got = case.choose()
    np.testing.assert_allclose(got.joints[:, 2], at, atol=1e-15)
    assert got.note[0].startswith("joint3 stays at its ideal value: none of its steps lies inside")
    assert (got.error[:, 0] <= got.rounded_error[:, 0]).all()


def test_locked_joints_stay_and_the_others_make_up_for_them(rng: np.random.Generator) -> None:
    case = Linear.draw(rng)
    got = case.choose(locked=[1, 3])
    np.testing.assert_array_equal(got.joints[:, [1, 3]], case.ideal[:, [1, 3]])
    continuous = dataclasses.replace(case.lattice, step=case.lattice.step * [1, 1, 1, 0])
    search = Search(LENGTH)
    args = (case.arm, continuous, case.predict, case.targets, case.ideal, search)
    assert (choose_arrays(*args, locked=[3]).joints[:, 3] == case.ideal[:, 3]).all()
    assert (choose_arrays(*args).joints[:, 3] != case.ideal[:, 3]).all()
    grid = case.brute()
    for i, ideal in enumerate(case.ideal):
        some = grid.copy()
        some[:, [1, 3]] = ideal[[1, 3]]
        np.testing.assert_allclose(got.joints[i], some[np.argmin(case.cost(some, i))], atol=1e-12)


def test_a_step_where_the_model_says_nothing_is_never_taken(rng: np.random.Generator) -> None:
    case = Linear.draw(rng)
    best = case.choose()
    other = (best.joints != best.rounded).any(axis=1)

    def predict(q: np.ndarray) -> np.ndarray:
        tip = case.predict(q)
        apart = np.abs(q[:, None] - best.joints[other])
        tip[(apart < 1e-9).all(axis=2).any(axis=1)] = math.nan
        return tip

    got = choose_arrays(case.arm, case.lattice, predict, case.targets, case.ideal, Search(LENGTH))
    assert np.isfinite(got.error).all()
    assert other.sum() > 6
    assert (got.joints != best.joints).any(axis=1)[other].all()
    assert (got.error[:, 0] <= got.rounded_error[:, 0]).all()


def test_a_model_that_says_nothing_of_the_ideal_joints_is_an_error(
    rng: np.random.Generator,
) -> None:
    case = Linear.draw(rng)
    given = (case.arm, case.lattice, lambda q: case.predict(q) * math.nan)
    with pytest.raises(InputError, match="finite"):
        choose(*given, case.targets[0], case.ideal[0], Search(LENGTH))


def test_bad_options_are_one_clear_error(rng: np.random.Generator) -> None:
    case = Linear.draw(rng)
    for field, value in (("offset", math.nan), ("offset_sd", -1e-3), ("offset", [0.0, 0.0])):
        with pytest.raises(InputError, match=field):
            Lattice.of(case.arm, **{field: value})


def test_joints_stand_on_steps_inside_the_limits_also_beside_them(
    rng: np.random.Generator,
) -> None:
    """0.6 of a step beside a limit the nearest step lies outside, and is not rounded to."""
    case = Linear.draw(rng)
    beside = 0.2 * case.lattice.step
    limits = zip(case.arm.lower - beside, case.arm.upper + beside, strict=True)
    case.arm = arm_of(list(limits), [3])
    case.ideal[:4] = case.arm.lower
    case.ideal[4:8] = case.arm.upper
    got = case.choose()  # `predict` looks at the limits
    assert (got.error[:, 0] <= got.rounded_error[:, 0]).all()
    for joints in (got.joints, got.rounded):
        k = (joints - case.lattice.offset) / case.lattice.step
        np.testing.assert_allclose(k, np.rint(k), atol=1e-9)
