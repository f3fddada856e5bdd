"""From a posture and its context to the standardised inputs of the network.

The columns, in this order, constant ones left out:

* ``q1..qn`` commanded joints (rad, m): all that the paper uses (``inputs="joints"``);
* ``approach``: mean over the joints of the direction they arrive from, -1 (from above) to +1;
* ``approach_q1..qn``: how far each joint's direction differs from that mean. Nearly zero where all
  joints arrive from one side, so they vary only where the directions are mixed;
* ``temperature_c`` (degC), ``payload_kg`` (kg).

Time ``t_s`` is accepted and left out: online it always lies outside the training range, and what
depends on it (warm-up) is better told by the temperature.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.errors import InputError

Array = NDArray[np.float64]
Context = Mapping[str, Array | float]

INPUT_KINDS = {"context": ("approach", "temperature_c", "payload_kg"), "joints": ()}
CONTEXT_NAMES = ("approach", "temperature_c", "payload_kg", "t_s")
_CONSTANT = 1e-6  # a column whose sd is below this (relative to its size) carries nothing


@dataclass(frozen=True)
class Encoding:
    """How raw columns become network inputs; fitted once on the training set."""

    joints: int
    context: tuple[str, ...]  # context names in use, in the order of the columns
    kept: NDArray[np.intp]  # (d,) raw columns that are not constant
    mean: Array  # (d,)
    scale: Array  # (d,)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the d inputs."""
        raw = raw_names(self.joints, self.context)
        return tuple(raw[i] for i in self.kept)

    def raw(self, q: Array, context: Context) -> Array:
        """(N, columns) raw inputs in SI units; NaN where the context is not known."""
        return raw_columns(q, context, self.context)

    def standardise(self, raw: Array) -> Array:
        """Inputs (N, d) of raw columns; what is not known is taken at its training mean."""
        x: Array = (raw[:, self.kept] - self.mean) / self.scale
        if self.context:
            x[np.isnan(x)] = 0.0
        return x


def raw_names(joints: int, context: tuple[str, ...]) -> list[str]:
    """Names of the raw columns, before constant ones are dropped."""
    names = [f"q{i + 1}" for i in range(joints)]
    for name in context:
        names.append(name)
        if name == "approach":
            names += [f"approach_q{i + 1}" for i in range(joints)]
    return names


def raw_columns(q: Array, context: Context, used: tuple[str, ...]) -> Array:
    """(N, columns) raw inputs in SI units; NaN where the context is not known."""
    n, joints = q.shape
    raw = np.empty((n, joints + sum(_width(name, joints) for name in used)))
    raw[:, :joints] = q
    at = joints
    for name in used:
        width, value = _width(name, joints), context.get(name)
        columns = raw[:, at : at + width]
        at += width
        if value is None:
            columns[:] = np.nan
        elif name == "approach":
            direction = columns[:, 1:]
            direction[:] = value if np.ndim(value) == 2 else np.reshape(value, (-1, 1))
            columns[:, 0] = direction.sum(axis=1) / joints
            direction -= columns[:, :1]
        else:
            columns[:, 0] = value
    return raw


def _width(name: str, joints: int) -> int:
    return joints + 1 if name == "approach" else 1


def fit_encoding(q: Array, context: Context, kind: str) -> Encoding:
    """Encoding of a training set.

    Raises
    ------
    InputError: unknown ``kind``, or no column varies (all rows one pose).
    """
    if kind not in INPUT_KINDS:
        raise InputError("train", "inputs", kind, f"one of {sorted(INPUT_KINDS)}")
    used = tuple(name for name in INPUT_KINDS[kind] if name in context)
    raw = raw_columns(q, context, used)
    raw = np.where(np.isnan(raw).all(axis=0), 0.0, raw)
    mean, scale = np.nanmean(raw, axis=0), np.nanstd(raw, axis=0)
    varies = scale > _CONSTANT * (1.0 + np.abs(mean))
    if not varies[: q.shape[1]].any():
        raise InputError("train", "q", "all rows one pose", "poses that differ")
    kept = np.flatnonzero(varies)
    return Encoding(q.shape[1], used, kept, mean[kept], scale[kept])


def check_rows(where: str, q: Array, context: Context) -> tuple[Array, dict[str, Array]]:
    """Joints as a finite (N, n) array and the context as arrays that fit it.

    Raises
    ------
    InputError: wrong shape, not finite, unknown context name, approach outside [-1, 1].
    """
    q = np.asarray(q, float)
    if q.ndim != 2 or q.shape[1] == 0:
        raise InputError(where, "q", f"shape {q.shape}", "(N, n) joint values")
    if not np.isfinite(q).all():
        row, joint = np.argwhere(~np.isfinite(q))[0]
        raise InputError(where, f"q{joint + 1} of row {row}", q[row, joint], "a finite number")
    checked: dict[str, Array] = {}
    for name, given in context.items():
        if name not in CONTEXT_NAMES:
            raise InputError(where, "context", name, f"one of {list(CONTEXT_NAMES)}")
        value = np.asarray(given, float)
        shapes = [(), (len(q),)] + ([q.shape] if name == "approach" else [])
        if value.shape not in shapes:
            raise InputError(where, name, f"shape {value.shape}", f"one of {shapes}")
        if np.isinf(value).any():
            raise InputError(where, name, "infinite", "finite, or NaN where not known")
        if name == "approach" and (np.abs(value) > 1.0).any():
            raise InputError(where, name, float(np.nanmax(np.abs(value))), "-1, 0 or +1")
        checked[name] = value
    return q, checked
