"""The BP network of the paper's section II.C, without torch: one tanh layer, linear outputs.

``y = [tanh([x, 1] V), 1] W`` with ``V (d+1, H)`` and ``W (H+1, k)``. One flat vector ``[V, W]`` of
length ``D = (d+1) H + (H+1) k`` holds all weights: the position of a sparrow, and a row of
predictor.npz. `stack.TanhStack` trains it.
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
        """The number D of weights of both layers, biases included."""
        return (self.inputs + 1) * self.hidden + (self.hidden + 1) * self.outputs

    def split(self, weights: Any) -> tuple[Any, Any]:
        """Return views ``V (..., d+1, H)`` and ``W (..., H+1, k)`` of weights (..., D)."""
        lead, first = weights.shape[:-1], (self.inputs + 1) * self.hidden
        return (
            weights[..., :first].reshape(*lead, self.inputs + 1, self.hidden),
            weights[..., first:].reshape(*lead, self.hidden + 1, self.outputs),
        )

    def within(self, larger: NetworkShape) -> NDArray[np.intp]:
        """Return the indices (D,) of these weights in a network with more hidden units."""
        v, w = larger.split(np.arange(larger.size))
        kept = np.r_[: self.hidden, larger.hidden]  # the last row of W belongs to no unit
        return np.concatenate((v[:, : self.hidden].ravel(), w[kept].ravel()))


@dataclass(frozen=True)
class TanhMembers:
    """Trained networks, in standardised units; `others.TorchMembers` has the same methods."""

    shape: NetworkShape
    weights: Array  # (M, D)

    @cached_property
    def _mean(self) -> tuple[Array, Array]:
        """The mean of all members as one network: V (d+1, M H), and W without its bias (M H, k)."""
        v, w = self.shape.split(self.weights)
        return np.concatenate(v, axis=1), np.concatenate(w[:, :-1]) / len(w)

    def outputs(self, x: Array) -> Array:
        """Return outputs (M, N, k) of inputs (N, d)."""
        v, w = self.shape.split(self.weights)
        made: Array = np.tanh(_with_ones(x) @ v) @ w[:, :-1] + w[:, -1:]
        return made

    def jacobian(self, x: Array) -> Array:
        """Return the derivatives (N, k, D) of the first member's outputs by its weights."""
        v, w = self.shape.split(self.weights[0])
        x1, k = _with_ones(x), self.shape.outputs
        z = np.tanh(x1 @ v)
        back = (1.0 - z * z)[:, None] * w[:-1].T  # (N, k, H)
        made = np.zeros((len(x), k, self.shape.size))
        by_v, by_w = self.shape.split(made)
        np.multiply(x1[:, None, :, None], back[:, :, None], out=by_v)
        each = np.arange(k)  # a weight of W moves its own output alone
        by_w[:, each, :-1, each], by_w[:, each, -1, each] = z, 1.0
        return made

    def slope(self, x: Array, moved: NDArray[np.bool_], error: float) -> tuple[Array, float]:
        """Return the slope of the members' mean at one input, and how far it is valid.

        Args:
            x: (d,) inputs.
            moved: (d,) mask of the m inputs that move.
            error: allowed error of a linear step.

        Returns:
            The slope (k, m), and a step: a linear change is accurate to `error` while no moved
            input changes by more. `others.TorchMembers` does not know the step and returns 0.
        """
        hidden, output = self._mean
        z = np.tanh(x @ hidden[:-1] + hidden[-1])
        bend, rates = 1.0 - z * z, hidden[:-1][moved]
        # |tanh''| bounds the error of a step of at most 1 in every column, without cancelling
        bent = np.minimum(2.0 * np.abs(z) * bend, 0.77) * np.abs(rates).sum(axis=0) ** 2
        curvature = float((bent @ np.abs(output)).max())
        return ((rates * bend) @ output).T, (2.0 * error / max(curvature, 1e-12)) ** 0.5


def _with_ones(x: Array) -> Array:
    """Add the bias input last: (N, d) -> (N, d+1)."""
    return np.concatenate((x, np.ones((len(x), 1))), axis=1)
