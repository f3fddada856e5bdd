"""Encoding of joints and circumstances as the standardised inputs of the network.

The columns, in this order, constant ones left out:

* ``q1..qn`` commanded joints (rad, m): all that the paper uses (``inputs="joints"``);
* ``approach``: mean over the joints of the direction they arrive from, -1 (from above) to +1;
* ``approach_q1..qn``: difference of each joint's direction from that mean. They vary only if the
  joints arrive from different sides;
* ``temperature_c`` (degC), ``payload_kg`` (kg).

The circumstances are read from a `Context`. A quantity that it lacks is NaN; so is an unknown side
of arrival (0). Time ``t_s`` is not an input: online it is always outside the training range, and
warm-up is better described by the temperature. How far a joint came since its last reversal is no
input either: the physics models that.
"""

from dataclasses import dataclass
from functools import cached_property

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
    lower: Array  # (columns,) training range of every raw column
    upper: Array

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """The names of the raw columns: joints, then circumstances."""
        names = [f"q{i + 1}" for i in range(self.joints)]
        for name in self.context:
            each = range(self.joints) if name in PER_JOINT else ()
            names += [name, *(f"{name}_q{i + 1}" for i in each)]
        return tuple(names)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the d inputs: the raw columns that are not constant."""
        return tuple(self.columns[i] for i in self.kept)

    @cached_property
    def is_joint(self) -> NDArray[np.bool_]:
        """A mask (d,): True for inputs that are joints; the others are circumstances."""
        return self.kept < self.joints

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the training region, (columns,) each, with a margin."""
        # share of a joint's training range; of a context column's, which matters less and drifts
        margin = np.where(np.arange(len(self.lower)) < self.joints, 0.02, 0.5)
        width = margin * (self.upper - self.lower) + 1e-6
        return self.lower - width, self.upper + width

    def encode(self, q: Array, context: Context) -> tuple[Array, Array]:
        """Return the raw inputs (N, columns) of rows, and the standardised ones (N, d).

        Raw inputs are in SI units, NaN where a circumstance is not known. For NaN the standardised
        input is 0, the training mean.
        """
        raw = _raw_columns(q, context, self.context)
        x = (raw[:, self.kept] - self.mean) / self.scale
        return raw, np.where(np.isnan(x), 0.0, x)


def _raw_columns(q: Array, context: Context, used: tuple[str, ...]) -> Array:
    """Return the joints and the `used` circumstances side by side, (N, columns), SI units."""
    made = [q]
    for name in used:
        if name not in PER_JOINT:
            known = np.asarray(context.columns.get(name, np.nan), float)
            made.append(np.broadcast_to(known, len(q))[:, None])
            continue
        each = np.broadcast_to(np.asarray(getattr(context, name) or np.nan, float).T, q.shape)
        each = np.where(np.abs(each) > 0.0, each, np.nan)
        count = (~np.isnan(each)).sum(axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):
            mean = np.nansum(each, axis=1, keepdims=True) / count
        made += [mean, each - mean]
    return np.concatenate(made, axis=1)


def fit_encoding(q: Array, context: Context, kind: str) -> Encoding:
    """Return the encoding of training rows; ``q`` and ``context`` as `check_rows` returns them.

    Raises InputError if `kind` is not known or all rows have one pose.
    """
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
    kept, lower, upper = np.flatnonzero(varies), np.nanmin(raw, axis=0), np.nanmax(raw, axis=0)
    return Encoding(q.shape[1], used, kept, mean[kept], scale[kept], lower, upper)


def check_rows(where: str, q: Array, context: Context | None) -> tuple[Array, Context]:
    """Return joints as a finite (N, n) array, and circumstances of matching shape.

    Raises InputError for a wrong shape or value; ``where`` names the source.
    """
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
