"""The BP network of the paper's section II.C, served without torch: one tanh layer, linear outputs.

``y = tanh([x, 1] V) W + b`` with ``V (d+1, H)``, ``W (H, k)``, ``b (k,)``. One flat vector
``[V, W, b]`` of length ``D = (d+1) H + H k + k`` holds all weights: the position of a sparrow, and
a row of predictor.npz. `stack.TanhStack` trains it.

Each weight's column of the Jacobian is one of the columns ``B = [x s, s, z, 1]`` (``z = tanh``,
``s = 1 - z^2``) times a number of each output: ``J[n, o, a] = B[n, column(a)] lift[o, a]``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NetworkShape:
    """Sizes of the network: d inputs, H hidden units, k outputs."""

    inputs: int
    hidden: int
    outputs: int

    @property
    def size(self) -> int:
        """D, the number of weights."""
        return (self.inputs + 1) * self.hidden + self.hidden * self.outputs + self.outputs

    def split(self, weights: Any) -> tuple[Any, Any, Any]:
        """Views ``V (..., d+1, H)``, ``W (..., H, k)``, ``b (..., k)`` of weights (..., D)."""
        lead = weights.shape[:-1]
        first = (self.inputs + 1) * self.hidden
        second = first + self.hidden * self.outputs
        return (
            weights[..., :first].reshape(*lead, self.inputs + 1, self.hidden),
            weights[..., first:second].reshape(*lead, self.hidden, self.outputs),
            weights[..., second:],
        )

    @cached_property
    def groups(self) -> NDArray[np.intp]:
        """(D,) index of the prior of each weight: one per input (ARD), one for the hidden
        biases, one for ``W``, one for ``b``."""
        d, h, k = self.inputs, self.hidden, self.outputs
        return np.repeat(np.arange(d + 3), [h] * (d + 1) + [h * k, k])

    @cached_property
    def column(self) -> NDArray[np.intp]:
        """(D,) index of each weight's column of ``B``."""
        first, h, k = (self.inputs + 1) * self.hidden, self.hidden, self.outputs
        unit = np.repeat(np.arange(first, first + h), k)
        return np.concatenate((np.arange(first), unit, np.full(k, first + h)))

    def within(self, larger: NetworkShape) -> NDArray[np.intp]:
        """(D,) places of these weights among those of a network with more hidden units."""
        v, w, b = larger.split(np.arange(larger.size))
        return np.concatenate((v[:, : self.hidden].ravel(), w[: self.hidden].ravel(), b))


@dataclass(frozen=True)
class TanhMembers:
    """Trained networks, in standardised units; `others.TorchMembers` does the same."""

    shape: NetworkShape
    weights: Array  # (M, D)

    @cached_property
    def _products(self) -> tuple[Array, Array]:
        """All members in one product: V (d+1, M H), and W of the mean (M H, k)."""
        v, w, _ = self.shape.split(self.weights)
        return np.concatenate(v, axis=1), np.concatenate(w) / len(w)

    def outputs(self, x: Array) -> Array:
        """(M, N, k) of inputs (N, d)."""
        v, w, b = self.shape.split(self.weights)
        made: Array = np.tanh(_with_ones(x) @ v) @ w + b[:, None, :]
        return made

    def jacobian(self, x: Array) -> Array:
        """(N, k, D): of the first member's outputs by its weights."""
        v, w, _ = self.shape.split(self.weights[0])
        x1, k = _with_ones(x), self.shape.outputs
        z = np.tanh(x1 @ v)
        slope = x1[:, :, None] * (1.0 - z * z)[:, None, :]
        basis = np.concatenate((slope.reshape(len(x), -1), z, x1[:, -1:]), axis=1)
        lift = np.tile(np.eye(k), 1 + self.shape.hidden)
        lift = np.concatenate((np.tile(w.T, len(v)), lift), axis=1)
        made: Array = basis[:, None, self.shape.column] * lift
        return made

    def slope(self, x: Array, moved: NDArray[np.bool_], error: float) -> tuple[Array, float]:
        """Slope (k, m) of the mean at inputs (d,), by the m moved ones, and the step of all of them
        within which it is accurate to ``error``; 0 where that is not known."""
        hidden, output = self._products
        z = np.tanh(x @ hidden[:-1] + hidden[-1])
        bend, rates = 1.0 - z * z, hidden[:-1][moved]
        # |tanh''| bounds the error of a step of at most 1 in every column, without cancelling
        bent = np.minimum(2.0 * np.abs(z) * bend, 0.77) * np.abs(rates).sum(axis=0) ** 2
        curvature = float((bent @ np.abs(output)).max())
        return ((rates * bend) @ output).T, (2.0 * error / max(curvature, 1e-12)) ** 0.5


def _with_ones(x: Array) -> Array:
    """(N, d) -> (N, d+1), the bias input last."""
    return np.concatenate((x, np.ones((len(x), 1))), axis=1)
