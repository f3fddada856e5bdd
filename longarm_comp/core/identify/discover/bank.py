"""Searches all products of a component and a function for those that explain most of a residual.

A candidate's column is the motion of the channels by a unit of a component, multiplied at each row
by a function of the inputs.  Its products with the geometry's columns and with the residual are
therefore matrix products, and some hundred thousand candidates are tried in a second, on a part
of the rows.  The best of every kind are then judged on all rows.
"""

import math
import os
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.linear import Marginal
from longarm_comp.core.calibration.model_fit import ModelFit, choose_evenly
from longarm_comp.core.data.measurement import make_equations
from longarm_comp.core.effects.discovered import (
    CAMERA,
    Discovered,
    DiscoveredView,
    components,
    stations,
    views,
)
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.quantities import AXES, SeenCoordinate
from longarm_comp.core.effects.shapes import Function
from longarm_comp.core.identify.discover.functions import FunctionFamily, FunctionGroup, Functions
from longarm_comp.core.identify.discover.inputs import read_arm_inputs, read_camera_inputs
from longarm_comp.core.identify.posterior.found import NONE
from longarm_comp.core.identify.posterior.offers import AMPLITUDES
from longarm_comp.core.model.model import slots_of

MOST_ROWS = 350
"""Largest number of rows in the first selection: about a thousand equations. The time grows with
it, and the best candidates are judged on all rows anyway."""
SHORTLIST = 60
"""Number of candidates of each kind that are judged on all rows. The first selection is rough: it
takes the columns of a group for orthogonal."""
_WEAK = float(np.sqrt(np.finfo(np.float32).eps))
"""Smallest share of a column's square that must remain when the geometry is projected out: half of
the digits of single precision, in which the first selection is computed."""


@dataclass(frozen=True)
class Spot:
    """A place and a component there: of a twist or load on the arm, or of the camera's view."""

    at: str
    component: str


@dataclass(frozen=True)
class FunctionCandidate:
    """Functions at places that are fitted together.

    Attributes:
        members: spot and function of each column.
        decay: prior standard deviation of each column, relative to the first.
        log_prior: log prior of the choice among all candidates.
    """

    members: tuple[tuple[Spot, Function], ...]
    decay: tuple[float, ...]
    log_prior: float


class FunctionBank:
    """All candidates of one side, the arm's or the camera's: components times functions.

    Args:
        fit: the fit, with its rows, columns and noise, which does not correlate rows (``rho`` 0).
        spots: the K components, with their places.
        units: (N, d, K) motion of the d channels by a unit of each component, m or rad.
        functions: G functions at the N rows.
    """

    def __init__(
        self, fit: ModelFit, spots: Sequence[Spot], units: np.ndarray, functions: Functions
    ) -> None:
        self.fit, self.spots, self.units, self.functions = fit, tuple(spots), units, functions
        self._number = {spot: k for k, spot in enumerate(self.spots)}
        kinds: dict[tuple[str, str], list[int]] = {}
        for k, spot in enumerate(self.spots):
            kind, *_ = spot.component.split(" ")  # without its axis
            kinds.setdefault((spot.at, kind), []).append(k)
        self._vectors = [ks for ks in kinds.values() if len(ks) == 3]
        arm = fit.model.arm
        each = zip(arm.commanded, arm.slides, strict=True)
        own = [Spot(f"joint {row}", "move z" if slides else "turn z") for row, slides in each]
        moving = self._number.keys() >= set(own)  # each joint along its own axis
        self._axes = [self._number[spot] for spot in own] if moving else []
        self._single = [g for g in functions.groups if len(g.functions) == 1]
        self._several = [g for g in functions.groups if len(g.functions) > 1]

    def log_odds_of(self, marginal: Marginal, listed: Sequence[FunctionCandidate]) -> np.ndarray:
        """Return the (C,) log odds of adding each candidate against adding none, with priors.

        The columns that are in the model already are marginalised.
        """
        made = np.array([c.log_prior for c in listed])
        counts = np.array([len(h.members) for h in listed], dtype=int)
        for count in np.unique(counts).tolist():
            alike = np.flatnonzero(counts == count)
            for portion in np.array_split(alike, max(len(alike) * count // SHORTLIST, 1)):
                some = [listed[n] for n in portion.tolist()]
                white = self._white_columns([member for c in some for member in c.members])
                unit = white * (np.concatenate([c.decay for c in some]) / self._rms_shift(white))
                s, t = marginal.project_products(unit)
                every = np.arange(len(some))
                own = s.reshape(len(some), count, len(some), count)[every, :, every]
                values, turned = np.linalg.eigh(own)
                z = np.einsum("cij,ci->cj", turned, t.reshape(len(some), count))
                each = _evidence_by_amplitude(z, np.maximum(values, 0.0)).sum(-1)
                made[portion] += _average_amplitudes(each)
        return made

    def unit_shifts(self, candidate: FunctionCandidate) -> np.ndarray:
        """Return the (r,) rms shift of the rows by a unit of each of r members, in noise units."""
        return self._rms_shift(self._white_columns(candidate.members))

    def _white_columns(self, members: Sequence[tuple[Spot, Function]]) -> np.ndarray:
        """Return the (d M, r) columns of r members at the M inliers, in units of the noise."""
        made = [
            self.units[:, :, self._number[spot]] * self.functions.values_of(f)[:, None]
            for spot, f in members
        ]
        return self.fit.whiten_columns(np.stack(made, axis=-1))

    def _rms_shift(self, white: np.ndarray) -> np.ndarray:
        """Return the (r,) rms over the rows of whitened columns (d M, r), at least 1e-150."""
        rows = max(len(white) // self.fit.width, 1)
        return np.asarray(np.sqrt(np.maximum((white**2).sum(0) / rows, 1e-300)))

    def shortlist_candidates(
        self, kept: np.ndarray, left: Sequence[np.ndarray]
    ) -> list[list[list[FunctionCandidate]]]:
        """Select the best candidates roughly, on a part of the rows.

        Args:
            kept: (p,) mask of the fit's columns, which are projected out of all candidates.
            left: whitened residuals (dM,) of the fit, and of the fit without an effect.

        Returns:
            For each residual, for each kind, its best candidates.
        """
        inliers, width = np.flatnonzero(self.fit.weights > 0), self.fit.width
        rows = choose_evenly(np.arange(len(inliers)), MOST_ROWS)
        white = self.fit.whiten_columns(self.units).reshape(len(inliers), width, -1)
        white = white[rows].astype(np.float32)
        values = self.functions.values[inliers[rows]]
        size = np.sqrt((values**2).mean(axis=0))
        values = (values / np.where(size > 0, size, 1.0)).astype(np.float32)
        raw = np.einsum("nck,nck->kn", white, white) @ values**2
        s = raw - self._squares_taken_by_fit(rows, kept, white, values)
        usable = (raw > 1e-25) & (s > _WEAK * raw)
        unit = np.maximum(raw / len(rows), 1e-30)
        made = []
        for residual in left:
            y = residual.reshape(-1, width)[rows].astype(np.float32)
            t = np.einsum("nc,nck->kn", y, white) @ values
            each = _evidence_by_amplitude(t / np.sqrt(unit), np.maximum(s, _WEAK * raw) / unit)
            made.append(
                list(self._best_of_kinds(np.where(usable, _average_amplitudes(each), -np.inf)))
            )
        return made

    def _squares_taken_by_fit(
        self, rows: np.ndarray, kept: np.ndarray, white: np.ndarray, values: np.ndarray
    ) -> np.ndarray:
        """Return the (K, G) part of each candidate's square that the fit's columns explain.

        Here `white` (m, d, K) are the whitened components, and `values` (m, G) the functions, at
        m rows, whose numbers among the M inliers are `rows`.
        """
        of_rows = (len(self.fit.design) // self.fit.width, self.fit.width, len(kept))
        design = self.fit.design.reshape(of_rows)[rows][..., kept]
        flat = design.reshape(design.shape[0] * design.shape[1], -1)
        factor = cholesky(flat.T @ flat + np.eye(flat.shape[1]), lower=True)
        turned = np.einsum("ncp,nck->pkn", design, white, optimize=True)
        if turned.size:
            flat = turned.reshape(len(turned), -1)
            turned = solve_triangular(factor, flat, lower=True).reshape(turned.shape)
        turned = np.ascontiguousarray(np.moveaxis(turned, 1, 0), dtype=np.float32)

        def squares(of: np.ndarray) -> np.ndarray:
            return np.asarray(((of @ values) ** 2).sum(axis=0))

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            return np.stack(list(pool.map(squares, turned)))

    def _best_of_kinds(self, worth: np.ndarray) -> Iterator[list[FunctionCandidate]]:
        """Yield the best candidates of each kind, one list per kind.

        The log evidence `worth` (K, G) of each component with each function is summed for
        candidates with several columns, as if these were orthogonal.
        """
        alone = [g.functions[0] for g in self._single]
        sharp = {FunctionFamily.SWITCH, FunctionFamily.CONTACT}
        for families in (set(FunctionFamily) - sharp, sharp):
            prior = [self._log_prior(g) if g.family in families else -np.inf for g in self._single]
            best = _largest_entries(worth[:, alone] + np.array(prior))
            yield [self._make_candidate([(k, alone[n])], self._single[n]) for k, n in best]
        several = []
        for family in dict.fromkeys(g.family for g in self._several):
            groups = [g for g in self._several if g.family == family]
            grouped = [_sum_evidence(worth[:, g.functions].T) + self._log_prior(g) for g in groups]
            for n, k in _largest_entries(np.stack(grouped)):
                several.append(
                    self._make_candidate([(k, f) for f in groups[n].functions], groups[n])
                )
        yield several
        prior = [self._log_prior(g) for g in self._single]
        vectors = np.array([_sum_evidence(worth[ks]) for ks in self._vectors]).reshape(
            -1, len(worth.T)
        )
        yield [
            self._make_candidate([(k, alone[n]) for k in self._vectors[v]], self._single[n])
            for v, n in _largest_entries(vectors[:, alone] + np.array(prior))
        ]
        every = self.functions.each_joint if self._axes else []
        at = ([(self._axes[j], f) for j, f in joints] for joints in every)
        seen = ([(k, f) for k, f in joints if np.isfinite(worth[k, f])] for joints in at)
        yield [self._make_candidate(joints, None) for joints in seen if len(joints) > 1]
        own = self.functions.own_joint if self._axes else {}
        yield [
            self._make_candidate([(self._axes[j], f) for f in group.functions], group)
            for j, group in own.items()
            if np.isfinite(worth[self._axes[j], list(group.functions)]).any()
        ]

    def _make_candidate(
        self, members: Sequence[tuple[int, int]], group: FunctionGroup | None
    ) -> FunctionCandidate:
        """Make a candidate from (number of component, number of function) pairs.

        Without a `group` there is one function for each joint.
        """
        named = tuple((self.spots[k], self.functions.listed[f]) for k, f in members)
        if group is None:
            prior = -math.log(len(FunctionFamily) * len(self.functions.each_joint))
            return FunctionCandidate(named, (1.0,) * len(named), prior)
        decay = group.decay if len(group.decay) == len(named) else (1.0,) * len(named)
        return FunctionCandidate(named, decay, self._log_prior(group))

    def _log_prior(self, group: FunctionGroup) -> float:
        """Return the log prior of a group of functions at one component of a twist.

        A family gives half of its probability to single components, half to all three axes.
        """
        if group.family is FunctionFamily.OWN_JOINT:
            return -math.log(len(FunctionFamily) * len(self.functions.own_joint))
        alike = 2.0 * self.functions.counts[group.family] * len(self.spots)
        return -math.log(len(FunctionFamily) * alike) - NONE * group.rare


def _evidence_by_amplitude(t: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Compute the (A, ...) log evidence of columns at each of A amplitudes.

    The projected products of the columns with the data are `t`, with themselves `s`. A unit of each
    column shifts the rows by one standard deviation of the noise, rms.
    """
    square = np.array(AMPLITUDES, dtype=t.dtype).reshape(-1, *(1,) * t.ndim) ** 2
    grown = 1.0 + square * s
    return np.asarray(0.5 * (square * t**2 / grown - np.log(grown)))


def _average_amplitudes(each: np.ndarray) -> np.ndarray:
    """Return the log of the mean evidence over the amplitudes (A, ...)."""
    return np.asarray(np.logaddexp.reduce(each, axis=0) - math.log(len(each)))


def _sum_evidence(each: np.ndarray) -> np.ndarray:
    """Return the sum (...) of the finite log evidence of r columns (r, ...); -inf if none is."""
    seen = np.isfinite(each)
    return np.where(seen.any(axis=0), np.where(seen, each, 0.0).sum(axis=0), -np.inf)


def _largest_entries(table: np.ndarray) -> list[tuple[int, int]]:
    """Return the positions (row, column) of the `SHORTLIST` largest entries that are finite."""
    flat = table.ravel()
    if not flat.size:
        return []
    few = np.argpartition(-flat, min(SHORTLIST, flat.size - 1))[:SHORTLIST]
    return [divmod(int(i), table.shape[1]) for i in np.sort(few) if np.isfinite(flat[i])]


def make_banks(fit: ModelFit, remembering: Collection[int] = ()) -> tuple[FunctionBank, ...]:
    """Make the bank of the arm's side and, if positions are measured, those of the camera's.

    The joints `remembering` are those of `read_arm_inputs`.
    """
    arm, rows = fit.model.arm, fit.session
    spots = [Spot(place, name) for place in _list_places(arm) for name in components(arm)]
    spots, units = _keep_moving(fit, spots)
    inputs = read_arm_inputs(arm, fit.posture, rows, remembering)
    made = [FunctionBank(fit, spots, units, Functions(inputs))]
    if rows.plain:
        points, ways = fit.model.measured_at(fit.posture), views(arm)
        for some, of in ((AXES, SeenCoordinate), ([w for w in ways if w not in AXES], None)):
            if some:
                seen = Functions(read_camera_inputs(points, rows), of)
                made.append(
                    FunctionBank(fit, *_keep_moving(fit, [Spot(CAMERA, way) for way in some]), seen)
                )
    return tuple(made)


def make_term(spot: Spot, function: str, domain: str, scale: float) -> Effect | Bias:
    """Make the term of a model for a component and a function.

    Args:
        function, domain: the function and its domain in words (`Function.text`, `.domain`).
        scale: prior standard deviation of its amount.
    """
    if spot.at == CAMERA:
        return DiscoveredView(spot.component, function, domain, scale)
    return Discovered(spot.at, spot.component, function, domain, scale)


def _list_places(arm: Arm) -> list[str]:
    """List the places on the arm; of places that coincide only one is listed."""
    same = {f"frame {j.id}" for j in arm.joints if j.d_m == 0 and j.type != "prismatic"}
    if arm.tip.frame and not any(arm.tip.position_m):
        same.add(f"frame {arm.tip.frame}")
    return [name for name in stations(arm) if name not in same]


def _keep_moving(fit: ModelFit, spots: list[Spot]) -> tuple[list[Spot], np.ndarray]:
    """Return the K spots that move a channel, and the motion (N, d, K), m or rad, by one unit."""
    slots = slots_of(fit.model.arm, [make_term(spot, "1", "", 1e-3) for spot in spots])
    columns = make_equations(fit.model, fit.session, slots, at=fit.posture).columns
    largest = np.abs(columns).max(axis=(0, 1))
    moving = largest > np.finfo(float).eps * largest.max(initial=0.0)
    return [spot for spot, moves in zip(spots, moving, strict=True) if moves], columns[..., moving]
