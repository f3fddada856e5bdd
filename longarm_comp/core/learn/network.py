"""The BP network: one tanh layer, linear outputs, the paper's section II.C.

``y = tanh([x, 1] V) W + b`` with ``V (d+1, H)``, ``W (H, k)``, ``b (k,)``. One flat vector
``[V, W, b]`` of length ``D = (d+1) H + H k + k`` holds all weights: the position of a sparrow.

``squared_error`` gives the mean squared error of a whole population at once: that is the fitness
of the sparrow search. ``forward`` and ``normal_equations`` serve back-propagation; the Jacobian is
never formed, because each of its rows is a product of the columns ``B = [x s, z, 1]`` with ``W``,
so that one Gram matrix ``B'UB`` gives ``J'UJ`` for all outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.learn.sparrow import Fitness, SparrowSearch

Array = NDArray[np.float64]
Weights = NDArray[Any]  # float32 in the sparrow's fitness, float64 elsewhere

_GRAM_ROWS = 4096  # rows of B held at once
SPARROW_BOUND = 1.0  # weights of standardised inputs and outputs


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

    def split(self, weights: Weights) -> tuple[Weights, Weights, Weights]:
        """Views ``V (..., d+1, H)``, ``W (..., H, k)``, ``b (..., k)`` of weights (..., D)."""
        lead = weights.shape[:-1]
        first = (self.inputs + 1) * self.hidden
        second = first + self.hidden * self.outputs
        return (
            weights[..., :first].reshape(*lead, self.inputs + 1, self.hidden),
            weights[..., first:second].reshape(*lead, self.hidden, self.outputs),
            weights[..., second:],
        )

    def groups(self) -> NDArray[np.intp]:
        """(D,) index of the prior of each weight: one per input (ARD), one for the hidden
        biases, one for ``W``, one for ``b``."""
        d, h, k = self.inputs, self.hidden, self.outputs
        return np.repeat(np.arange(d + 3), [h] * (d + 1) + [h * k, k])


def with_ones(x: Array) -> Array:
    """(N, d) -> (N, d+1), the bias input last."""
    return np.concatenate((x, np.ones((len(x), 1))), axis=1)


def forward(shape: NetworkShape, weights: Array, x1: Array) -> Array:
    """Outputs (..., N, k) of networks with weights (..., D) for inputs with ones (N, d+1)."""
    v, w, b = shape.split(weights)
    return np.tanh(x1 @ v) @ w + b[..., None, :]


def output_jacobian(shape: NetworkShape, weights: Array, x1: Array) -> Array:
    """``dy/dweights`` (N, k, D) of inputs with ones (N, d+1)."""
    v, w, _ = shape.split(weights)
    n, k = len(x1), shape.outputs
    z = np.tanh(x1 @ v)
    slope = (1.0 - z * z)[:, None, :] * w.T  # (N, k, H)
    jacobian = np.zeros((n, k, shape.size))
    first = v.size
    jacobian[:, :, :first] = (x1[:, None, :, None] * slope[:, :, None, :]).reshape(n, k, first)
    by_output = jacobian[:, :, first : first + w.size].reshape(n, k, shape.hidden, k)
    for output in range(k):
        by_output[:, output, :, output] = z
        jacobian[:, output, first + w.size + output] = 1.0
    jacobian[:, :, first : first + w.size] = by_output.reshape(n, k, w.size)
    return jacobian


def normal_equations(
    shape: NetworkShape, weights: Array, x1: Array, y: Array, row_weights: Array
) -> tuple[Array, Array, Array]:
    """Gauss-Newton matrix ``J'UJ`` (D, D), ``J'U r`` (D,) and residual ``r = y - f`` (N, k)."""
    v, w, b = shape.split(weights)
    p, h, k = shape.inputs + 1, shape.hidden, shape.outputs
    columns = p * h + h + 1
    gram = np.zeros((columns, columns))
    grad_v, grad_w, grad_b = np.zeros((p, h)), np.zeros((h, k)), np.zeros(k)
    residual = np.empty_like(y)
    for start in range(0, len(x1), _GRAM_ROWS):
        rows = slice(start, start + _GRAM_ROWS)
        xs = x1[rows]
        z = np.tanh(xs @ v)
        slope = 1.0 - z * z
        residual[rows] = y[rows] - (z @ w + b)
        basis = np.empty((len(xs), columns))
        np.multiply(xs[:, :, None], slope[:, None, :], out=basis[:, : p * h].reshape(len(xs), p, h))
        basis[:, p * h : -1] = z
        basis[:, -1] = 1.0
        weighted = residual[rows] * row_weights[rows, None]
        basis *= np.sqrt(row_weights[rows])[:, None]
        gram += basis.T @ basis
        grad_v += xs.T @ ((weighted @ w.T) * slope)
        grad_w += z.T @ weighted
        grad_b += weighted.sum(axis=0)
    gradient = np.concatenate((grad_v.ravel(), grad_w.ravel(), grad_b))
    return _expand(shape, w, gram), gradient, residual


def _expand(shape: NetworkShape, w: Array, gram: Array) -> Array:
    """``B'UB`` of the shared columns -> ``J'UJ`` of all weights."""
    p, h, k = shape.inputs + 1, shape.hidden, shape.outputs
    first, second = p * h, p * h + h * k
    matrix = np.zeros((shape.size, shape.size))
    matrix[:first, :first] = gram[:first, :first] * np.tile(w @ w.T, (p, p))
    shared = np.tile(w, (p, 1))  # (p h, k), W of the hidden unit that a column belongs to
    cross = gram[:first, first:-1, None] * shared[:, None, :]  # (p h, h, k)
    matrix[:first, first:second] = cross.reshape(first, h * k)
    matrix[:first, second:] = gram[:first, -1:] * shared
    eye = np.eye(k)
    matrix[first:second, first:second] = np.kron(gram[first:-1, first:-1], eye)
    matrix[first:second, second:] = np.kron(gram[first:-1, -1:], eye)
    matrix[second:, second:] = gram[-1, -1] * eye
    return np.asarray(np.triu(matrix) + np.triu(matrix, 1).T)


def squared_error(
    shape: NetworkShape, x: Array, y: Array
) -> Callable[[Weights], NDArray[np.float32]]:
    """The sparrow's fitness: weights (P, D) -> mean squared error per output (P,), float32.

    All sparrows go through one matrix product, in blocks that fit the cache. With
    ``tanh a = 1 - 2 s`` and ``s = 1 / (1 + exp 2a)`` one exponential serves and the rest folds into
    the output layer, ``y = -2 s W + (sum W + b)``. Measured against mealpy's one-by-one evaluation
    in ``bench/ssa.py``.
    """
    n, k, h = len(x), shape.outputs, shape.hidden
    x1t = np.ascontiguousarray(2.0 * with_ones(x).T, dtype=np.float32)  # (d+1, N)
    yt = np.ascontiguousarray(np.asarray(y).T, dtype=np.float32)  # (k, N)
    # hidden activations held at once: they should stay in the L2 cache
    block = max(1, 512 * 1024 // (4 * n * h))
    hidden = np.empty((block * h, n), dtype=np.float32)
    output = np.empty((block, k, n), dtype=np.float32)

    @np.errstate(over="ignore")  # exp 2a = inf is s = 0, as it should be
    def fitness(population: Weights) -> NDArray[np.float32]:
        v, w, b = shape.split(np.asarray(population, dtype=np.float32))
        vt = v.transpose(0, 2, 1).reshape(-1, shape.inputs + 1)
        wt = -2.0 * w.transpose(0, 2, 1)
        shift = (w.sum(axis=1) + b)[:, :, None]
        error = np.empty(len(population), dtype=np.float32)
        for start in range(0, len(population), block):
            stop = min(start + block, len(population))
            s = hidden[: (stop - start) * h]
            np.matmul(vt[start * h : stop * h], x1t, out=s)
            np.exp(s, out=s)
            s += 1.0
            np.reciprocal(s, out=s)
            out = output[: stop - start]
            np.matmul(wt[start:stop], s.reshape(stop - start, h, n), out=out)
            out += shift[start:stop] - yt
            flat = out.reshape(stop - start, k * n)
            error[start:stop] = np.einsum("ij,ij->i", flat, flat)
        error /= n * k
        return error

    return fitness


def xavier_start(shape: NetworkShape, rng: np.random.Generator) -> Array:
    """Start weights (D,) of Glorot and Bengio (2010): the control to the sparrow start."""
    weights = np.zeros(shape.size)
    v, w, _ = shape.split(weights)
    v[:] = rng.standard_normal(v.shape) * np.sqrt(2.0 / (shape.inputs + shape.hidden))
    w[:] = rng.standard_normal(w.shape) * np.sqrt(2.0 / (shape.hidden + shape.outputs))
    return weights


def sparrow_start(
    shape: NetworkShape, fitness: Fitness, rng: np.random.Generator, search: SparrowSearch
) -> Array:
    """Start weights (D,) found by sparrow search, with hidden units that differ."""
    bound = np.full(shape.size, SPARROW_BOUND)
    found = search.minimise(fitness, -bound, bound, rng)
    return separate(shape, found.position, rng)


def hidden_alike(shape: NetworkShape, weights: Array) -> NDArray[np.bool_]:
    """(H,) hidden units whose incoming weights repeat those of an earlier unit up to sign.

    Such units have the same gradient, so back-propagation can never separate them.
    """
    v, _, _ = shape.split(weights)
    columns = v.T
    norm = np.linalg.norm(columns, axis=1)
    scale = np.maximum(norm[:, None], norm[None, :]) + 1e-12
    apart = np.linalg.norm(columns[:, None] - columns[None], axis=2) / scale
    mirrored = np.linalg.norm(columns[:, None] + columns[None], axis=2) / scale
    # relative distance of hidden units below which they count as collapsed
    near = np.minimum(apart, mirrored) < 0.05
    return np.tril(near, -1).any(axis=1) | (norm < 1e-6)


def separate(shape: NetworkShape, weights: Array, rng: np.random.Generator) -> Array:
    """Weights (D,) with every collapsed hidden unit redrawn (Xavier); the others unchanged."""
    weights = weights.copy()
    v, w, _ = shape.split(weights)
    for _ in range(10):
        alike = hidden_alike(shape, weights)
        if not alike.any():
            break
        fresh_v, fresh_w, _ = shape.split(xavier_start(shape, rng))
        v[:, alike], w[alike] = fresh_v[:, alike], fresh_w[alike]
    return weights
