"""Chooses the poses after which the tip is known best: linear Bayesian design.

Geometry and effects have priors, or the posterior of the rows measured so far.  I-optimal poses
leave the least variance of the seen tip, averaged over the joint box; D-optimal poses leave the
least volume of all parameters (Chaloner and Verdinelli 1995).  Poses are chosen one by one from a
pool and then exchanged while that helps (Fedorov 1972).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.parts import Vec3
from longarm_comp.core.calibration.calibrate import geometry_terms
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.placement import place_sensors
from longarm_comp.core.data.measurement import compute_posture, make_equations
from longarm_comp.core.data.plan import Plan, at_levels, random_joints, uniform
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik.solver import solve_many
from longarm_comp.core.model.model import Model

Criterion = Literal["i-optimal", "d-optimal"]
Measure = Literal["position", "pose", "distance", "touch"]
POOL, REFERENCE = 1024, 256
"""Smallest number of poses to choose from, and number of poses over which the tip's error counts.
"""
AHEAD = 20
"""Number of further poses that are chosen, only to say what they would bring."""
WIDEST = 1.0
"""Largest prior standard deviation of a parameter (m, rad): any pose determines it better."""
ANEW = 1e-3
"""Share of its start to which the largest `own` of the poses may fall before everything is computed
anew: the differences that update it lose as many digits."""
PASSES = 2
"""Largest number of rounds in which every pose is exchanged: each costs as much as the first
choice."""


@dataclass(frozen=True, eq=False)
class OptimalPlan(Plan):
    """A plan of poses, the most informative first."""

    expected_m: float = float("nan")  # expected rms error of the tip over the joint box, m
    ahead_m: float = float("nan")  # the same once `AHEAD` more poses are measured

    @property
    def stop_rule(self) -> str:
        """A sentence about what more poses would bring."""
        gain = 1e3 * (self.expected_m - self.ahead_m)
        return (
            f"expected error of the tip {1e3 * self.expected_m:.2f} mm; "
            f"{AHEAD} more poses would bring {gain:.2f} mm"
        )


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """The uncertain parameters of an arm, and the noise with which its poses are measured."""

    model: Model  # with every uncertain term; derivatives are taken at its values
    scale: np.ndarray  # (p,) units of its parameters: their prior standard deviations
    information: np.ndarray  # (p, p) inverse covariance in these units
    sigma: tuple[float, float]  # noise of a length (m) and of an angle (rad)
    framed: bool = True  # whether the measurements show where the base stands
    read: Mapping[str, float] = field(default_factory=dict)
    """Noise of joint readings that are taken at each pose too, rad or m, by name."""

    @classmethod
    def of(
        cls,
        model: Model,
        measured: Session | None,
        measure: Measure,
        *,
        known: bool,
        sigma: tuple[float, float],
        pool: Plan | None = None,
    ) -> Uncertainty:
        """Return the uncertainty before any measurement, or after a session.

        Effects of circumstances that a plan does not state, such as a recorded column, count as
        known. It raises what `fit_model` raises.

        Args:
            measured: rows that were measured so far. They also give the noise; joints that were
                read are expected to be read again.
            known: the model holds every effect that the arm has. Otherwise every effect of the
                library may be there too.
            sigma: noise of a length (m) and of an angle (rad), where `measured` gives none.
            pool: the poses to choose from, if they are known already.
        """
        middle = Plan(model.arm.mid[None], np.ones((1, model.arm.n)))
        asked = _rows(model.arm, pool or middle, measure)
        whole = model
        for rows in asked if measured is None else (*asked, measured):
            whole = whole.with_missing(geometry_terms(model.arm, rows))
        fitted, read = None, dict[str, float]()
        if measured is not None:
            solved = model.with_missing(geometry_terms(model.arm, measured))
            fitted = fit_model(place_sensors(solved, measured), measured)
            whole = fitted.model.with_missing(whole.terms)
            noise = dict(zip(measured.channels, fitted.sigma.tolist(), strict=True))
            names = [f"read_q{k + 1}" for k in measured.read_joints]
            read = {name: noise.pop(name) for name in names}
            length = {c for c, u in zip(measured.channels, measured.units, strict=True) if u == "m"}
            held = [s for c, s in noise.items() if c in length and np.isfinite(s)]
            sigma = (float(np.median(held)) if held else sigma[0], sigma[1])
        whole = whole.told_by(asked[0].context())
        if not known:
            both = np.tile(model.arm.mid, (2, 1))
            at = Session.record(both, np.zeros((2, 3)), approach=alternate_sides(2))
            tried = list_candidates(model.arm, at.context(), None, whole.terms).testable
            whole = whole.with_missing(term for each in tried for term in each.terms)
        scale = np.array([min(s.parameter.width, WIDEST) for s in whole.slots])
        information = np.eye(len(scale))
        if fitted is not None:
            seen = fitted.session
            columns = make_equations(whole, seen).columns * scale
            white = fitted.whiten_columns(columns)
            information = information + white.T @ white
        framed = any(rows.has_own_frame(model.arm) for rows in (*asked, measured) if rows)
        return cls(whole, scale, information, sigma, framed, read)

    def measures(self, plan: Plan, measure: Measure) -> np.ndarray:
        """Return the derivatives (M, d, p), by every parameter, of the measurements at M poses.

        Measurements are in units of their noise, parameters in units of `scale`.
        """
        made = []
        for rows in _rows(self.model.arm, plan, measure, self.read):
            found = make_equations(self.model, rows).columns
            known = zip(rows.channels, rows.units, strict=True)
            noise = np.array([self.read.get(c, self.sigma[unit == "rad"]) for c, unit in known])
            made.append(found * self.scale / noise[:, None])
        return np.concatenate(made, axis=1)

    def tips(self, q: np.ndarray) -> np.ndarray:
        """Return the matrix (p, p), m^2, that weighs parameter errors by their effect on the tip.

        The trace of its product with a covariance of the parameters is the mean square error of the
        seen tip over poses q (N, n). If no measurement shows where the base stands, errors that
        move all tips as one rigid body are left out.
        """
        rows = Session.record(q, np.zeros((len(q), 3)), approach=alternate_sides(len(q)))
        seen, columns = self.model.columns(compute_posture(self.model, rows))
        columns = columns * self.scale
        if not self.framed:
            local = seen - seen.mean(axis=0)
            turned = np.cross(np.eye(3)[None], local[:, None])
            body = np.concatenate([turned, np.tile(np.eye(3), (len(q), 1, 1))], axis=1)
            moved = np.swapaxes(body, 1, 2).reshape(3 * len(q), 6)
            flat = columns.reshape(3 * len(q), -1)
            columns = flat - moved @ np.linalg.lstsq(moved, flat, rcond=None)[0]
            columns = columns.reshape(len(q), 3, -1)
        return np.asarray(np.einsum("nip,niq->pq", columns, columns) / len(q))


def choose_optimal_poses(
    uncertain: Uncertainty,
    n: int,
    *,
    criterion: Criterion = "i-optimal",
    measure: Measure = "position",
    allowed: Callable[[Plan], np.ndarray] | None = None,
    rng: np.random.Generator | int = 0,
    pool: Plan | None = None,
) -> OptimalPlan:
    """Choose n poses of a pool within the limits, each joint with room for its run-up.

    Args:
        allowed: returns a mask (M,) of the poses of a plan that may be driven and are seen; by
            default all are.
        pool: the poses to choose from; by default half of them fill the joint box, half have every
            joint at a limit or in its middle, where the same errors move the tip farthest.

    Raises:
        InputError: n is below 1, or fewer than n + `AHEAD` poses are allowed.
    """
    arm = uncertain.model.arm
    rng = np.random.default_rng(rng)
    if pool is None:
        halves = [draw(arm, max(POOL, 4 * n) // 2, rng) for draw in (uniform, at_levels)]
        pool = Plan(*(np.concatenate([getattr(h, k) for h in halves]) for k in ("q", "approach")))
    kept = np.arange(len(pool)) if allowed is None else np.flatnonzero(allowed(pool))
    if not 1 <= n <= len(kept) - AHEAD:
        most = f"1 to {max(len(kept) - AHEAD, 0)} ({len(kept)} of {len(pool)} poses are allowed)"
        raise InputError("plan", "n", n, most)
    pool = pool.take(kept)
    x = uncertain.measures(pool, measure)
    tips = uncertain.tips(random_joints(arm, REFERENCE, rng))
    choice = Choice(x, uncertain.information, tips if criterion == "i-optimal" else None)
    begun: list[int] = []
    if pool.touch is not None:  # the first touch of a point tells nothing, only further ones do
        begun = np.unique(pool.touch, return_index=True)[1].tolist()[: n // 2]
    chosen = choice.exchange_worse(choice.add_best(begun, n - len(begun)))
    more = choice.add_best(chosen, AHEAD)
    ends = [np.sqrt(np.trace(tips @ choice.covariance(rows))) for rows in (chosen, more)]
    best = pool.take(np.array(chosen))
    expected, ahead = map(float, ends)
    return OptimalPlan(best.q, best.approach, None, best.touch, expected, ahead)


@dataclass(frozen=True, eq=False)
class Choice:
    """The choice of some of M poses: I-optimal, or D-optimal without `tips`.

    Minimised is the trace of the product of `tips` and the covariance, or the covariance's
    determinant.
    """

    x: np.ndarray  # (M, d, p) derivatives of what each measures (`Uncertainty.measures`)
    information: np.ndarray  # (p, p) inverse covariance before any is measured
    tips: np.ndarray | None  # (p, p)

    def covariance(self, chosen: Sequence[int]) -> np.ndarray:
        """Return the covariance (p, p) of the parameters once the chosen poses are measured."""
        rows = self.x[list(chosen)].reshape(-1, self.x.shape[2])
        return np.asarray(np.linalg.inv(self.information + rows.T @ rows))

    def after(self, chosen: Sequence[int]) -> _Known:
        """Return what is known once the chosen poses are measured."""
        covariance = self.covariance(chosen)
        turned = self.x.swapaxes(1, 2)
        own = _times(self.x, covariance) @ turned + np.eye(self.x.shape[1])
        if self.tips is None:
            return _Known(self, covariance, own)
        error = covariance @ self.tips @ covariance
        return _Known(self, covariance, own, error, _times(self.x, error) @ turned)

    def add_best(self, chosen: Sequence[int], n: int) -> list[int]:
        """Return the chosen poses and n more, each the best one after those before it."""
        made, known = list(chosen), self.after(chosen)
        most = known.own.max()
        for _ in range(n):
            made.append(int(np.argmax(known.gains(made))))
            known = known.with_pose(made[-1])
            if known.own.max() < ANEW * most:
                known = self.after(made)
                most = known.own.max()
        return made

    def exchange_worse(self, chosen: list[int]) -> list[int]:
        """Return the chosen poses, each replaced if another improves the criterion more."""
        made = chosen.copy()
        for _ in range(PASSES):
            before, known = made.copy(), self.after(made)
            for k, old in enumerate(before):
                without = known.with_pose(old, -1.0)
                made[k] = int(np.argmax(without.gains(made[:k] + made[k + 1 :])))
                known = known if made[k] == old else without.with_pose(made[k])
            if made == before:
                break
        return made


@dataclass(frozen=True, eq=False)
class _Known:
    """The uncertainty that is left after some poses; one pose more is an update of rank d."""

    choice: Choice  # the poses
    covariance: np.ndarray  # (p, p) C
    own: np.ndarray  # (M, d, d) I + x C x' of every pose
    error: np.ndarray | None = None  # (p, p) C tips C; None if D-optimal
    left: np.ndarray | None = None  # (M, d, d) x C tips C x' of every pose; None if D-optimal

    def with_pose(self, k: int, sign: float = 1.0) -> _Known:
        """Return what is known with pose k added (`sign` 1) or taken away (-1)."""
        x, poses = self.choice.x[k], self.choice.x
        a = self.covariance @ x.T
        core = np.linalg.inv(x @ a + sign * np.eye(len(x)))
        if self.error is None or self.left is None:
            seen = _times(poses, a)
            covariance = self.covariance - a @ core @ a.T
            return _Known(self.choice, covariance, self.own - seen @ core @ seen.swapaxes(1, 2))
        b = self.error @ x.T
        b = b - a @ (core @ (x @ b)) / 2  # half: each cross term takes its share of the last one
        seen, weighed = np.split(_times(poses, np.concatenate([a, b], axis=1)), 2, axis=2)
        seen_core, a_core = seen @ core, a @ core
        cross, error = seen_core @ weighed.swapaxes(1, 2), a_core @ b.T
        return _Known(
            self.choice,
            self.covariance - a_core @ a.T,
            self.own - seen_core @ seen.swapaxes(1, 2),
            self.error - error - error.T,
            self.left - cross - cross.swapaxes(1, 2),
        )

    def gains(self, taken: Sequence[int]) -> np.ndarray:
        """Return (M,) by how much each pose would improve the criterion; -inf for `taken` ones."""
        if self.left is None:
            gain = np.linalg.slogdet(self.own)[1]
        else:
            gain = np.einsum("mij,mji->m", np.linalg.inv(self.own), self.left)
        gain[list(taken)] = -np.inf
        return np.asarray(gain)


def _times(blocks: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Multiply (M, d, p) by (p, k), as one product."""
    return (blocks.reshape(-1, len(right)) @ right).reshape(*blocks.shape[:2], -1)


def _rows(arm: Arm, plan: Plan, measure: Measure, read: Iterable[str] = ()) -> list[Session]:
    """Return sessions in which the poses are measured, for distances one per anchor.

    Their measured values are placeholders. Joint readings of the names in `read` are taken too.
    """
    n = len(plan)
    joints = {f"read_q{k + 1}": plan.q[:, k : k + 1] for k in range(plan.q.shape[1])}
    told = {name: joints[name] for name in read}

    def record(xyz: float, **labels: np.ndarray) -> Session:
        where = np.full((n, 3), xyz)
        return Session.record(plan.q, where, approach=plan.approach, readings=told, labels=labels)

    if measure == "position":
        return [record(0.0)]
    if measure == "pose":
        told["orientation"] = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
        return [record(0.0)]
    if measure == "touch":
        return [record(np.nan, touch=np.full(n, "") if plan.touch is None else plan.touch)]
    places = [name for name, anchor in arm.anchors.items() if anchor.xyz_m is not None]
    if not places:
        raise InputError("plan", "measure", measure, "anchors with their places in arm.yaml")
    told["distance"] = np.ones((n, 1))
    return [record(np.nan, anchor=np.full(n, name)) for name in places]


def alternate_sides(n: int) -> np.ndarray:
    """Return (n,) sides of arrival, alternately from below (+1) and from above (-1)."""
    return np.where(np.arange(n) % 2 == 0, 1.0, -1.0)


def draw_touch_poses(
    model: Model, points: Mapping[str, Vec3], count: int, rng: np.random.Generator
) -> Plan:
    """Return poses at which the model's tip is at one of some points, from random starts.

    Args:
        points: approximate position of each point, m, base frame, by name.
        count: number of starts for all points together; each point has at least two.

    Raises:
        InputError: no point, or one for which fewer than two poses were found.
    """
    if not points:
        raise InputError("plan", "points", "none", "names and places (m) of points to touch")
    model = model.told_by(Context())
    parts, names = [], []
    each = max(count // len(points), 2)
    for name, place in points.items():
        start = random_joints(model.arm, each, rng)
        to = np.tile(place, (each, 1))
        found = solve_many(model, to, seed=start, position_only=True, max_starts=1)
        there = found.q[found.ok]
        if len(there) < 2:
            said = ", ".join(f"{v:g}" for v in place)
            raise InputError("plan", f"point {name}", said, "a place (m) that the arm reaches")
        parts.append(there)
        names += [name] * len(there)
    q = np.concatenate(parts)
    return Plan(q, np.where(rng.random(q.shape) < 0.5, 1.0, -1.0), None, np.array(names))
