"""What a residual may depend on: displacements of the tip, and of each joint, by every input."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.fit import Fit


@dataclass(frozen=True)
class Group:
    """Displacements that some inputs may cause.

    Attributes:
        inputs: names of what drives them.
        at: the joint that moves (``joint 2``), or empty where it is the tip, along each axis.
        columns: (N, 3, k) m, each about as large as the noise.
    """

    inputs: tuple[str, ...]
    at: str
    columns: np.ndarray

    @property
    def label(self) -> str:
        """For people: ``q1 x q3 at joint 2``."""
        return " x ".join(self.inputs) + (f" at {self.at}" if self.at else "")


def groups(fit: Fit) -> list[Group]:
    """Everything that is tried: functions of each input, products of joints, seen or at a joint."""
    session = fit.session
    curves = [_curve(session.q[:, j]) for j in range(session.n)]
    made = [
        Group(inputs, "", _three_axes(features, fit.sigma))
        for inputs, features in _of_the_tip(session, curves)
        if features.shape[1]
    ]
    for slot, column in zip(fit.slots, np.moveaxis(fit.columns, -1, 0), strict=True):
        if slot.owner.name == "joint_zero":
            for inputs, features in _of_a_joint(curves):
                moved = column[..., None] * features[:, None, :]
                size = np.sqrt(((moved / fit.sigma[:, None]) ** 2).mean(axis=(0, 1)))
                if features.shape[1] and size.all():
                    made.append(Group(inputs, slot.owner.where, moved / size))
    return made


Features = Iterator[tuple[tuple[str, ...], np.ndarray]]


def _of_the_tip(session: Session, curves: list[np.ndarray]) -> Features:
    """Functions of each joint, of pairs, of direction, way, temperature, time and payload."""
    for j, curve in enumerate(curves):
        yield (f"q{j + 1}",), curve
    yield from _products(curves)
    for j, curve in enumerate(curves):
        side = session.approach[:, j].astype(float)[:, None]
        bent = np.concatenate([side, side * curve[:, :2]], axis=1)
        yield ("approach", f"q{j + 1}"), _standard(bent)
        if session.travel is not None:
            way = np.sign(session.travel[:, j])[:, None]
            yield ("order", f"q{j + 1}"), _standard(way)
    for name, values in session.columns.items():
        yield (name,), _curve(values)[:, :3]


def _of_a_joint(curves: list[np.ndarray]) -> Features:
    """Functions of each joint, and products of two."""
    for j, curve in enumerate(curves):
        yield (f"q{j + 1}",), curve
    yield from _products(curves)


def _products(curves: list[np.ndarray]) -> Features:
    for k, j in combinations(range(len(curves)), 2):
        yield (f"q{k + 1}", f"q{j + 1}"), _standard(curves[j][:, :1] * curves[k][:, :1])


def _curve(values: np.ndarray) -> np.ndarray:
    """Up to six orthogonal functions of one input; as many as its distinct levels allow."""
    span = np.ptp(values)
    levels = len(np.unique(np.round(values / (span or 1.0), 3)))
    if span == 0 or levels < 2:
        return np.zeros((len(values), 0))
    x = 2 * (values - values.min()) / span - 1
    basis = np.polynomial.legendre.legvander(x, min(6, levels - 1))[:, 1:]
    return _standard(basis)


def _standard(features: np.ndarray) -> np.ndarray:
    """Centred, unit size, dependent columns dropped."""
    centred = features - features.mean(0)
    size = np.sqrt((centred**2).mean(0))
    centred = centred[:, size > 1e-9] / size[size > 1e-9]
    if not centred.shape[1]:
        return centred
    u, s, _ = np.linalg.svd(centred, full_matrices=False)
    return u[:, s > 1e-6 * s[0]] * np.sqrt(len(features))


def _three_axes(features: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """(N, m) features -> (N, 3, 3m) displacements of one noise standard deviation each axis."""
    n, m = features.shape
    made = np.zeros((n, 3, 3 * m))
    for axis in range(3):
        made[:, axis, axis * m : (axis + 1) * m] = features * sigma[axis]
    return made
