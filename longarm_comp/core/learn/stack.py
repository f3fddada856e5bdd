"""Networks as torch modules, many at once: flat weights (M, D), and rows of its own for each.

`Stack` takes any module. `TanhStack` is the paper's network, whose Gauss-Newton matrices need no
Jacobian: each column of it is a column of ``B`` times a number of each output (`network`), so one
Gram matrix ``B U B'`` serves all outputs. Rows are last: inputs (M, d, N), outputs (M, k, N).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import torch
from torch import Tensor
from torch.func import functional_call, jacrev, vmap

from longarm_comp.core.learn.network import NetworkShape
from longarm_comp.core.learn.sparrow import Fitness, SparrowSearch


def _held(device: torch.device) -> int:
    """Numbers held at once: within the cache of a CPU, the memory of a GPU."""
    return 2**18 if device.type == "cpu" else 2**27


def _blocks(x: Tensor, columns: int) -> Iterator[slice]:
    """Rows of so many columns a network that are held at once."""
    step = max(1, _held(x.device) // (len(x) * columns))
    return (slice(a, a + step) for a in range(0, x.shape[2], step))


class Stack:
    """Networks of one module (N, d) -> (N, k); a flat row of weights for each."""

    def __init__(self, module: torch.nn.Module) -> None:
        self._module = module
        self._shapes = {name: p.shape for name, p in module.named_parameters()}
        self._sizes = [shape.numel() for shape in self._shapes.values()]
        self.size = sum(self._sizes)
        device = next(module.parameters()).device
        self.groups = torch.repeat_interleave(torch.tensor(self._sizes, device=device))
        """(D,) index of the prior of each weight: one a parameter."""

    def _at(self, weights: Tensor, x: Tensor) -> Tensor:
        """(..., k, N) of networks (..., D) at inputs (..., d, N)."""
        named = zip(self._shapes.items(), weights.split(self._sizes, dim=-1), strict=True)
        parts = {name: part.reshape(*part.shape[:-1], *shape) for (name, shape), part in named}
        return functional_call(self._module, parts, (x.mT,)).mT

    def outputs(self, weights: Tensor, x: Tensor) -> Tensor:
        """(M, k, N) of networks (M, D)."""
        return vmap(self._at)(weights, x)

    def jacobian(self, weights: Tensor, x: Tensor) -> Tensor:
        """``dy / dweights`` (M, N, k, D)."""
        slope = jacrev(lambda weights, x: self._at(weights, x[:, None])[:, 0])
        return vmap(vmap(slope, in_dims=(None, 1)))(weights, x)

    def normal_equations(
        self, weights: Tensor, x: Tensor, residual: Tensor, row: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Gauss-Newton matrix ``J'UJ`` (M, D, D), its lower triangle, and ``J'U r`` (M, D).

        ``row`` (M, N) are the weights ``U`` of the rows, ``r`` (M, k, N) their residual.
        """
        gram = weights.new_zeros(len(weights), self.size + 1, self.size + 1)
        for rows in _blocks(x, residual.shape[1] * self.size):
            jacobian = self.jacobian(weights, x[..., rows])
            # the residual as the last: its products are the gradient
            basis = torch.cat((jacobian, residual[..., rows].mT[..., None]), dim=3)
            basis = (basis * row[:, rows, None, None].sqrt()).flatten(1, 2)
            gram += basis.mT @ basis
        return gram[:, :-1, :-1], gram[:, :-1, -1]


class TanhNetwork(torch.nn.Module):
    """``y = tanh([x, 1] V) W + b``, the paper's network; parameters as in `NetworkShape`."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        self.v = torch.nn.Parameter(torch.zeros(shape.inputs + 1, shape.hidden))
        self.w = torch.nn.Parameter(torch.zeros(shape.hidden, shape.outputs))
        self.b = torch.nn.Parameter(torch.zeros(shape.outputs))

    def forward(self, x: Tensor) -> Tensor:
        """(N, d) -> (N, k), also of stacked parameters and inputs."""
        return _units(self.v, _with_ones(x.mT)).mT @ self.w + self.b[..., None, :]


def _units(v: Tensor, x1: Tensor) -> Tensor:
    """``tanh(V' x1)`` (..., H, N); as ``2 / (1 + exp(-2a)) - 1`` torch takes a fifth as long."""
    return ((2.0 * v).mT @ x1).sigmoid_().mul(2.0).sub_(1.0)


class TanhStack(Stack):
    """Paper's networks."""

    def __init__(self, shape: NetworkShape, device: torch.device) -> None:
        super().__init__(TanhNetwork(shape))
        self.shape = shape
        self.groups = torch.as_tensor(shape.groups, device=device)
        self._column = torch.as_tensor(shape.column, device=device)

    def outputs(self, weights: Tensor, x: Tensor) -> Tensor:
        return self._at(weights, x)  # no `vmap`, which takes longer than the network

    def normal_equations(
        self, weights: Tensor, x: Tensor, residual: Tensor, row: Tensor
    ) -> tuple[Tensor, Tensor]:
        v, w, _ = self.shape.split(weights)
        many, k = residual.shape[:2]
        columns = int(self._column[-1]) + 1 + k
        gram = weights.new_zeros(many, columns, columns)
        for rows in _blocks(x, columns):
            x1, root = _with_ones(x[..., rows]), row[:, None, rows].sqrt()
            z = _units(v, x1)
            slope = x1[:, :, None] * ((1.0 - z * z) * root)[:, None]
            # the residual as the last: its products are the gradient
            last = (z * root, root, residual[..., rows] * root)
            basis = torch.cat((slope.flatten(1, 2), *last), dim=1)
            for a, end in pairwise((*range(0, columns, 64), columns)):  # as far as the diagonal
                gram[:, a:end, :end].baddbmm_(basis[:, a:end], basis[:, :end].mT)
        ends = torch.eye(k, dtype=w.dtype, device=w.device).repeat(1, 1 + self.shape.hidden)
        lift = w.mT.repeat(1, 1, self.shape.inputs + 1)
        lift = torch.cat((lift, ends.expand(many, -1, -1)), dim=2)  # (M, k, D)
        by_weight = gram.index_select(1, self._column)
        matrix = by_weight.index_select(2, self._column).mul_(lift.mT @ lift)
        return matrix, (gram[:, -k:].index_select(2, self._column) * lift).sum(1)

    def squared_error(self, x: Tensor, y: Tensor, used: Tensor) -> Fitness:
        """The sparrow's fitness: weights (M, P, D) -> mean squared error per output (M, P) over the
        rows ``used`` (M, N), in single precision.

        With ``tanh a = 2 s - 1`` and ``s = 1 / (1 + exp(-2a))`` the rest folds into the output
        layer, ``y = 2 s W + (b - sum W)``. All sparrows of a network go through one product.
        """
        x1, y, used = 2.0 * _with_ones(x).float(), y.float(), used.float()[..., None]
        share = 1.0 / (y.shape[1] * used.sum(dim=1))

        def one(position: Tensor) -> Tensor:
            v, w, b = self.shape.split(position)
            s = (v.mT.flatten(1, 2) @ x1).sigmoid_().view(*position.shape[:2], -1, x1.shape[2])
            error = (b - w.sum(dim=2))[..., None] - y[:, None]
            error.flatten(0, 1).baddbmm_(2.0 * w.mT.flatten(0, 1), s.flatten(0, 1))
            square = error.square_().flatten(1, 2) @ used
            return square.view(*position.shape[:2], -1).sum(2) * share

        def fitness(position: Tensor) -> Tensor:
            step = max(1, _held(x.device) // (len(position) * self.shape.hidden * x1.shape[2]))
            return torch.cat([one(p) for p in position.float().split(step, dim=1)], dim=1)

        return fitness

    def sparrow_starts(
        self, fitness: Fitness, many: int, rng: torch.Generator, search: SparrowSearch
    ) -> Tensor:
        """Initial weights (M, D) by sparrow search, with hidden units that differ."""
        xavier = self.xavier_starts(many, rng)
        bound = torch.ones_like(xavier, dtype=torch.float32)
        found = search.minimise(fitness, -bound, bound, rng).position.double()
        v, w, _ = self.shape.split(found)
        new_v, new_w, _ = self.shape.split(xavier)
        alike = hidden_alike(v)
        v.copy_(torch.where(alike[:, None], new_v, v))
        w.copy_(torch.where(alike[..., None], new_w, w))
        return found

    def xavier_starts(self, many: int, rng: torch.Generator) -> Tensor:
        """Initial weights (M, D) of Glorot and Bengio (2010): the control to the sparrow search."""
        shape, device = self.shape, self.groups.device
        weights = torch.randn(many, shape.size, generator=rng, dtype=torch.float64, device=device)
        v, w, b = shape.split(weights)
        v *= (2.0 / (shape.inputs + shape.hidden)) ** 0.5
        w *= (2.0 / (shape.hidden + shape.outputs)) ** 0.5
        b.zero_()
        return weights


def hidden_alike(v: Tensor) -> Tensor:
    """(M, H) hidden units whose incoming weights repeat those of an earlier unit up to sign.

    Such units have the same gradient, so back-propagation can never separate them.
    """
    each = v.mT  # (M, H, d+1)
    norm = each.norm(dim=2)
    one, other = each[:, :, None], each[:, None]
    scale = torch.maximum(norm[:, :, None], norm[:, None]) + 1e-12
    apart = torch.minimum((one - other).norm(dim=3), (one + other).norm(dim=3))
    # relative distance of hidden units below which they count as collapsed
    return (apart < 0.05 * scale).tril(-1).any(dim=2) | (norm < 1e-6)


def _with_ones(x: Tensor) -> Tensor:
    """(..., d, N) -> (..., d+1, N), the bias input last."""
    return torch.nn.functional.pad(x, (0, 0, 0, 1), value=1.0)
