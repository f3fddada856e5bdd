"""Encoding of joints and circumstances as the standardised inputs of the network.

The columns, in this order, constant ones left out:

* ``q1..qn`` commanded joints (rad, m): all that the paper uses (``inputs="joints"``);
* ``approach``: mean over the joints of the direction they arrive from, -1 (from above) to +1;
** ``approach_q1..qn``: difference of each joint's direction from that mean. They vary only if the
  joints arrive from different sides;
* ``temperature_c`` (degC), ``payload_kg`` (kg).

They are read from the record of circumstances, `Context`. A quantity that it does not hold is NaN;
so is an unknown side of arrival (0). Time ``t_s`` is not an input: online it is always outside the
training range, and warm-up is better described by the temperature. Travel is modelled by the
physics only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.arm.context import PER_JOINT, Context
from longarm_comp.core.errors import InputError

Array = NDArray[np.float64]

INPUT_KINDS = {"context": ("approach", "temperature_c", "payload_kg"), "joints": ()}


@dataclass(frozen=True)
class Encoding:
    """Map of raw columns to network inputs, fitted once to the training set."""

    joints: int
    context: tuple[str, ...]  # context names in use, in the order of the columns
    kept: NDArray[np.intp]  # (d,) raw columns that are not constant
    mean: Array  # (d,)
    scale: Array  # (d,)

    @property
    def names(self) -> tuple[str, ...]:
        raw = raw_names(self.joints, self.context)
        return tuple(raw[i] for i in self.kept)

    def raw(self, q: Array, context: Context) -> Array:
        """(N, columns) raw inputs in SI units; NaN where the context is unknown."""
        return _raw_columns(q, context, self.context)

    def standardise(self, raw: Array) -> Array:
        """Inputs (N, d) from raw columns. NaN is replaced by the training mean."""
        x: Array = (raw[:, self.kept] - self.mean) / self.scale
        if self.context:
            x[np.isnan(x)] = 0.0
        return x


def raw_names(joints: int, context: tuple[str, ...]) -> list[str]:
    """Names of the raw columns, before constant ones are dropped."""
    names = [f"q{i + 1}" for i in range(joints)]
    for name in context:
        names.append(name)
        if name in PER_JOINT:
            names += [f"{name}_q{i + 1}" for i in range(joints)]
    return names


def _raw_columns(q: Array, context: Context, used: tuple[str, ...]) -> Array:
    n, joints = q.shape
    raw = np.full((n, len(raw_names(joints, used))), np.nan)
    raw[:, :joints] = q
    at = joints
    for name in used:
        columns = raw[:, at : at + (1 + joints if name in PER_JOINT else 1)]
        at += columns.shape[1]
        if not context.has(name):
            continue
        if name in PER_JOINT:
            _spread(getattr(context, name), columns)
        else:
            columns[:, 0] = context.columns[name]
    return raw


def _spread(values: tuple[object, ...], columns: Array) -> None:
    """Mean over the joints whose value is known (not 0), and the difference of each from it."""
    each = columns[:, 1:]
    each[:] = np.asarray(values, float).T
    each[~(np.abs(each) > 0.0)] = np.nan
    count = (~np.isnan(each)).sum(axis=1)
    some = count > 0
    columns[some, 0] = np.nansum(each[some], axis=1) / count[some]
    each -= columns[:, :1]


def fit_encoding(q: Array, context: Context, kind: str) -> Encoding:
    if kind not in INPUT_KINDS:
        raise InputError("train", "inputs", kind, f"one of {sorted(INPUT_KINDS)}")
    used = tuple(name for name in INPUT_KINDS[kind] if context.has(name))
    raw = _raw_columns(q, context, used)
    raw = np.where(np.isnan(raw).all(axis=0), 0.0, raw)
    mean, scale = np.nanmean(raw, axis=0), np.nanstd(raw, axis=0)
    # a column whose sd is below this (relative to its size) carries nothing
    varies = scale > 1e-6 * (1.0 + np.abs(mean))
    if not varies[: q.shape[1]].any():
        raise InputError("train", "q", "all rows one pose", "poses that differ")
    kept = np.flatnonzero(varies)
    return Encoding(q.shape[1], used, kept, mean[kept], scale[kept])


def check_rows(where: str, q: Array, context: Context | None) -> tuple[Array, Context]:
    """Checked joints, a finite (N, n) array, and circumstances of matching shape."""
    q = np.asarray(q, float)
    if q.ndim != 2 or q.shape[1] == 0:
        raise InputError(where, "q", f"shape {q.shape}", "(N, n) joint values")
    if not np.isfinite(q).all():
        row, joint = np.argwhere(~np.isfinite(q))[0]
        raise InputError(where, f"q{joint + 1} of row {row}", q[row, joint], "a finite number")
    context = context or Context()
    for name in filter(context.has, INPUT_KINDS["context"]):
        per_joint = name in PER_JOINT
        value = np.asarray(getattr(context, name) if per_joint else context.columns[name], float)
        lead = q.shape[1:] if per_joint else ()
        if value.shape not in (lead, (*lead, len(q))):
            raise InputError(where, name, f"shape {value.shape}", f"{lead} or {(*lead, len(q))}")
        if np.isinf(value).any():
            raise InputError(where, name, "infinite", "finite, or NaN where not known")
        if name == "approach" and (np.abs(value) > 1.0).any():
            raise InputError(where, name, float(np.nanmax(np.abs(value))), "-1, 0 or +1")
    return q, context
