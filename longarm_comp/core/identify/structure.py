"""The test for structure: is more than noise left in the residual?  An F test per group of inputs.

It uses no physics. It finds every cause that moves the tip or a joint as a function of a joint, of
a pair of joints, of the side of arrival, temperature, time or payload, whether the library has a
name for it or not.  Three further tests (`structure_tests.py`) ask whether held-out poses err by
more than the noise, whether the rows that the fit left out have a cause in common, and whether the
scatter is much more than the sensor's.  Structure that one of these shows counts in the same way:
it changes the verdict, and a network is trained.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import expit, fdtrc

from longarm_comp.core.arm.history import compute_play_range
from longarm_comp.core.calibration.linear import Marginal, solve_products
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.reading_steps import mark_exact_readings
from longarm_comp.core.data.registration import median_spread
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.posterior.found import NONE

SIGNIFICANT = 0.005
"""Largest p value at which structure counts: the probability of a false alarm."""
WORTH = 0.25
"""Smallest structure, as a share of the noise, that counts: it makes an error 3 % longer."""
SMALLEST_M = 5e-5
"""Smallest structure at the tip that counts, m: servos and cameras are not more exact."""
OF_SPREAD = 2e-4
"""Smallest structure on a small arm, as a share of the median distance of the sightings from their
middle. It is the smaller limit if that is less than 25 cm."""


@dataclass(frozen=True)
class Structure:
    """The structure that is left in the residual.

    Attributes:
        flag: whether there is more than noise.
        p_value: probability of so large a statistic in any group if there is only noise.
        chance: probability that there is a cause, if `flag` is set.
        inputs: the inputs on which the structure depends, strongest first.
        size_m: RMS of the part that is a function of these inputs, m.
        share_explained: share of the structure after calibration that the named effects explain; 1
            if no structure is left.
        at: the joint that the strongest group moves; empty if it moves the tip.
        sign: the sign of it in words (``shows in the held-out poses``), if another test than the F
            test shows it; else empty.
    """

    flag: bool
    p_value: float
    inputs: tuple[str, ...]
    size_m: float
    share_explained: float
    at: str = ""
    sign: str = ""
    chance: float = 0.0

    def add_test(
        self,
        p_value: float,
        size_m: float,
        least_m: float,
        by: str,
        sign: str,
        chance: float | None = None,
    ) -> Structure:
        """Return the structure with the result of a test other than the F test, which may flag it.

        Args:
            p_value, size_m, sign, chance: as the attributes, by that test; without a chance it is
                that of `cause_probability`.
            least_m: smallest size that counts, m.
            by: name of the test's rows, for `inputs`.
        """
        if self.flag or p_value > SIGNIFICANT or size_m < least_m:
            return self
        chance = cause_probability(p_value) if chance is None else chance
        share = self.share_explained
        return Structure(True, p_value, (by,), size_m, share, sign=sign, chance=chance)


def cause_probability(p_value: float) -> float:
    """Return the largest probability of a cause that a p-value of less than 1/e supports.

    The Bayes factor for a cause is at most ``1 / (-e p ln p)`` (Sellke, Bayarri and Berger 2001).
    The prior is that of a cause that is not in the library.
    """
    if p_value <= 0.0:
        return 1.0
    return float(expit(-NONE - 1.0 - math.log(p_value) - math.log(-math.log(p_value))))


def find_structure(fit: ModelFit, base: ModelFit, tolerated: np.ndarray | None = None) -> Structure:
    """Test whether the residual of a fit is a function of any input.

    Each group of columns is compared with what it leaves of the residual (F test), and the smallest
    p value is multiplied by the number of groups.  Joint readings that the fit reproduces to their
    encoder's step do not count.

    Args:
        fit: the fit with all that was found.
        base: the fit of the geometry alone, to the same rows and with the same noise.
        tolerated: (m, k) whitened columns of the model tolerance, which count as no structure.
    """
    counts = (fit.session.measured & ~mark_exact_readings(fit))[fit.weights > 0].reshape(-1)
    design = fit.design if tolerated is None else np.concatenate([fit.design, tolerated], axis=1)
    marginal = Marginal(design * counts[:, None], fit.data * counts)
    found = _test_groups(fit, marginal, counts)
    if not found:
        return Structure(False, 1.0, (), 0.0, 1.0)
    first = found[0]
    p = min(1.0, len(found) * first.p_value)
    likely = [each for each in found if len(found) * each.p_value < SIGNIFICANT]
    strong = [each for each in likely if each.strength > first.strength / 3]
    if not strong:
        return Structure(False, p, (), 0.0, 1.0)
    b = np.concatenate([each.white for each in strong], axis=1)
    part = marginal.project(b) @ solve_products(*marginal.project_products(b)).u
    sizes, noise = np.sqrt((fit.to_lengths(part) ** 2).mean(0)), fit.noise_m
    size = float(np.linalg.norm(sizes))
    worth = size > WORTH * float(np.linalg.norm(noise))
    worth = worth or bool((sizes > WORTH * np.sqrt(3.0) * noise)[noise > 0].any())
    if not (worth and size > smallest_that_matters(fit)):
        return Structure(False, p, (), 0.0, 1.0)
    inputs = tuple(dict.fromkeys(name for each in strong for name in each.group.inputs))
    residual = fit.whiten_columns(fit.residual[..., None])[:, 0]
    calibrated = fit.whiten_columns(base.residual[..., None])[:, 0]
    before, named, rich = (float(each @ each) for each in (calibrated, residual, residual - part))
    there = before - rich
    share = 1.0 if there <= 0 else float(np.clip((before - named) / there, 0.0, 1.0))
    at = first.group.at
    return Structure(True, p, inputs, size, share, at, chance=cause_probability(p))


def smallest_that_matters(fit: ModelFit) -> float:
    """Return the size (m) below which structure does not count."""
    xyz = fit.session.take(fit.session.has_position).xyz
    return min(SMALLEST_M, OF_SPREAD * median_spread(xyz) if len(xyz) > 1 else SMALLEST_M)


@dataclass(frozen=True)
class Group:
    """A group of displacements that are functions of the same inputs.

    Attributes:
        inputs: names of these inputs.
        at: the joint that moves (``joint 2``); empty if the tip moves.
        columns: (N, d, k) displacements of the channels, m or rad, each about as large as the
            noise.
    """

    inputs: tuple[str, ...]
    at: str
    columns: np.ndarray


class _TestedGroup(NamedTuple):
    """A group with the result of its F test.

    Attributes:
        strength: excess of its statistic over that of noise, in standard deviations.
        white: (m, k) its columns in units of the noise.
    """

    group: Group
    p_value: float
    strength: float
    white: np.ndarray


def _test_groups(fit: ModelFit, marginal: Marginal, counts: np.ndarray) -> list[_TestedGroup]:
    """Compare each group with what it leaves of the residual (F test); the surest comes first.

    Args:
        fit: the fit with all that was found.
        marginal: its data and columns, with those of the model tolerance.
        counts: (m,) True for each equation that counts.
    """
    left = float(marginal.projected_data @ marginal.projected_data)
    free = max(float(counts.sum()) - fit.effective, 2.0)
    tested = []
    for group in list_groups(fit):
        b = fit.whiten_columns(group.columns) * counts[:, None]
        pb = marginal.project(b)
        gram = b.T @ pb
        values, vectors = np.linalg.eigh((gram + gram.T) / 2)
        good = values > 1e-6 * len(b) / fit.width
        if not good.any():
            continue
        along = (vectors[:, good] / np.sqrt(values[good])).T @ (pb.T @ marginal.y)
        score, count = float((along**2).sum()), int(good.sum())
        rest = max(left - score, 1e-9 * left) / max(free - count, 1.0)
        p_value = float(fdtrc(count, max(free - count, 1.0), score / count / rest))
        strength = (score / rest - count) / math.sqrt(2 * count)
        tested.append(_TestedGroup(group, p_value, strength, b))
    return sorted(tested, key=lambda each: (each.p_value, -each.strength))


def list_groups(fit: ModelFit) -> list[Group]:
    """List all groups: functions of each input and products of two joints, at the tip or a joint.

    At the tip, a group moves it along all axes. For each single input there are more groups, which
    move it along one axis each.
    """
    session = fit.session
    curves = [smooth_functions(session.q[:, j]) for j in range(session.n)]
    noise = np.where(np.isfinite(fit.sigma), fit.sigma, 0.0) * session.measured
    made = []
    for inputs, features in _tip_features(session, curves):
        if features.shape[1]:
            # A feature of 1 moves each channel alone by one standard deviation of its noise
            columns = features[:, None, None, :] * (noise[..., None] * np.eye(fit.width))[..., None]
            columns = columns.reshape(len(features), fit.width, -1)
            made.append(Group(inputs, "", columns))
            if len(inputs) == 1 and fit.width > 1:  # a motion along one axis shows less in three
                each = np.split(columns, fit.width, axis=2)
                made += [Group(inputs, "", own) for own in each if own.any()]
    for slot, column in zip(fit.slots, np.moveaxis(fit.columns, -1, 0), strict=True):
        if slot.owner.displaces_joint:
            for inputs, features in _joint_features(curves):
                moved = column[..., None] * features[:, None, :]
                size = np.sqrt(((moved / fit.sigma[:, None]) ** 2).mean(axis=(0, 1)))
                if features.shape[1] and size.all():
                    made.append(Group(inputs, slot.owner.where, moved / size))
    return made


_MEMORY = 0.15
"""Radius of the play that stands for all memory of a joint, as a share of its range in the data."""

Features = Iterator[tuple[tuple[str, ...], np.ndarray]]


def _tip_features(session: Session, curves: list[np.ndarray]) -> Features:
    """Yield inputs and functions (N, k) of these: of joints, their history, recorded columns."""
    yield from _joint_features(curves)
    for j, curve in enumerate(curves):
        side = session.approach[:, j].astype(float)[:, None]
        bent = np.concatenate([side, side * curve[:, :2]], axis=1)
        yield ("approach", f"q{j + 1}"), _standardise(bent)
        radius = _MEMORY * max(float(np.ptp(session.q[:, j])), 1e-9)
        low, high = compute_play_range(tuple(session.legs[:, j].T), radius)
        yield ("order", f"q{j + 1}"), _standardise((low + high)[:, None] / radius)
    for name, values in session.columns.items():
        yield (name,), smooth_functions(values)[:, :3]


def _joint_features(curves: list[np.ndarray]) -> Features:
    """Yield inputs and functions (N, k): of each joint, and products of two joints."""
    for j, curve in enumerate(curves):
        yield (f"q{j + 1}",), curve
    for k, j in combinations(range(len(curves)), 2):
        yield (f"q{k + 1}", f"q{j + 1}"), _standardise(curves[j][:, :1] * curves[k][:, :1])


def smooth_functions(values: np.ndarray) -> np.ndarray:
    """Compute up to six orthogonal functions (N, k) of one input (N,), fewer if it has few levels.

    The k-th is a polynomial of degree k, so the first ones are the smoothest.
    """
    return _standardise(legendre_polynomials(values))


def legendre_polynomials(values: np.ndarray) -> np.ndarray:
    """Compute Legendre polynomials of degree 1 to 6 of one input (N,) over its range, (N, k).

    Each has mean 0 and rms 1 over the rows.  There are fewer if the input has few levels.
    """
    span = np.ptp(values)
    levels = len(np.unique(np.round(values / (span or 1.0), 3)))
    if span == 0 or levels < 2:
        return np.zeros((len(values), 0))
    x = 2 * (values - values.min()) / span - 1
    return _normalise(np.polynomial.legendre.legvander(x, min(6, levels - 1))[:, 1:])


def _standardise(features: np.ndarray) -> np.ndarray:
    """Return features (N, m) centred, orthogonal and of rms 1, without dependent ones."""
    centred = _normalise(features)
    ways, new = np.linalg.qr(centred)
    left = np.diag(new)
    return (ways * np.sign(left))[:, np.abs(left) > 1e-6] * np.sqrt(len(features))


def _normalise(features: np.ndarray) -> np.ndarray:
    """Return features (N, m) with mean 0 and rms 1, without constant ones."""
    centred = features - features.mean(0)
    size = np.sqrt((centred**2).mean(0))
    return centred[:, size > 1e-9] / size[size > 1e-9]
