"""Networks as torch modules, many at once: their weights are one tensor (M, D), as they train.

`Stack` takes any module. `TanhStack` is the paper's network, whose Gauss-Newton matrices need no
Jacobian: each column of it is a column of ``B`` times a number of each output (`network`), so one
Gram matrix ``B U B'`` serves all outputs. Rows are last: inputs (M, d, N), outputs (M, k, N).
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor
from torch.func import functional_call, jacrev, vmap

from longarm_comp.core.learn.network import NetworkShape
from longarm_comp.core.learn.sparrow import Fitness, SparrowSearch

_STRIPS = 4
"""Of a symmetric product: the blocks below its diagonal are left out."""


def _block(columns: int, device: torch.device) -> int:
    """Rows of so many columns held at once: within the cache of a CPU, the memory of a GPU."""
    return max(1, (2**18 if device.type == "cpu" else 2**27) // columns)


class Stack:
    """Networks of one module (N, d) -> (N, k); a flat row of weights for each."""

    def __init__(self, module: torch.nn.Module) -> None:
        self.module = module
        self._shapes = {name: p.shape for name, p in module.named_parameters()}
        sizes = torch.tensor([shape.numel() for shape in self._shapes.values()])
        self._sizes, self.size = sizes.tolist(), int(sizes.sum())
        self.groups = torch.repeat_interleave(sizes)
        """(D,) index of the prior of each weight: one a parameter."""

    def parts(self, weights: Tensor) -> dict[str, Tensor]:
        """Parameters (..., *shape) by name of weights (..., D)."""
        parts = weights.split(self._sizes, dim=-1)
        lead, named = weights.shape[:-1], zip(self._shapes.items(), parts, strict=True)
        return {name: part.reshape(*lead, *shape) for (name, shape), part in named}

    def outputs(self, weights: Tensor, x: Tensor) -> Tensor:
        """(M, k, N) of networks (M, D) at inputs (M, d, N)."""

        def one(weights: Tensor, x: Tensor) -> Tensor:
            return functional_call(self.module, self.parts(weights), (x.mT,)).mT

        return vmap(one)(weights, x)

    def jacobian(self, weights: Tensor, x: Tensor) -> Tensor:
        """``dy / dweights`` (M, N, k, D)."""

        def at(weights: Tensor, x: Tensor) -> Tensor:
            return functional_call(self.module, self.parts(weights), (x[None],))[0]

        return vmap(vmap(jacrev(at), in_dims=(None, 1)))(weights, x)

    def normal_equations(
        self, weights: Tensor, x: Tensor, y: Tensor, row: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gauss-Newton matrix ``J'UJ`` (M, D, D), ``J'U r`` (M, D), residual ``r`` (M, k, N).

        ``row`` (M, N) are the weights ``U`` of the rows.
        """
        residual = y - self.outputs(weights, x)
        matrix = weights.new_zeros(*weights.shape, self.size)
        gradient = torch.zeros_like(weights)
        step = _block(len(weights) * y.shape[1] * self.size, x.device)
        for rows in (slice(a, a + step) for a in range(0, x.shape[2], step)):
            root = row[:, rows, None].sqrt()
            slope = self.jacobian(weights, x[..., rows]) * root[..., None]
            slope = slope.flatten(1, 2)
            matrix += slope.mT @ slope
            weighted = (residual[..., rows].mT * root).flatten(1, 2)
            gradient += (slope.mT @ weighted[..., None])[..., 0]
        return matrix, gradient, residual


class TanhNetwork(torch.nn.Module):
    """``y = tanh([x, 1] V) W + b``, the paper's network; parameters as in `NetworkShape`."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        self.v = torch.nn.Parameter(torch.zeros(shape.inputs + 1, shape.hidden))
        self.w = torch.nn.Parameter(torch.zeros(shape.hidden, shape.outputs))
        self.b = torch.nn.Parameter(torch.zeros(shape.outputs))

    def forward(self, x: Tensor) -> Tensor:
        """(N, d) -> (N, k)"""
        return (self.w.mT @ self.units(self.v.mT, _with_ones(x.mT)) + self.b[:, None]).mT

    @staticmethod
    def units(v: Tensor, x1: Tensor) -> Tensor:
        """``tanh(v x1)`` (..., H, N); as ``2 / (1 + exp(-2a)) - 1`` torch takes a tenth as long."""
        return (v @ x1).mul_(2.0).sigmoid_().mul(2.0).sub_(1.0)


class TanhStack(Stack):
    """Paper's networks; those with fewer hidden units have idle ones, whose weights are 0."""

    def __init__(self, shape: NetworkShape, device: torch.device) -> None:
        super().__init__(TanhNetwork(shape))
        self.shape = shape
        self.groups = torch.as_tensor(shape.groups, device=device)
        self._column = torch.as_tensor(shape.column, device=device)
        self._lift = torch.eye(shape.outputs, device=device).repeat(1, 1 + shape.hidden)

    def outputs(self, weights: Tensor, x: Tensor) -> Tensor:
        v, w, b = self.shape.split(weights)
        return torch.baddbmm(b[..., None], w.mT, TanhNetwork.units(v.mT, _with_ones(x)))

    def normal_equations(
        self, weights: Tensor, x: Tensor, y: Tensor, row: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        v, w, b = self.shape.split(weights)
        (many, d, n), h, k = x.shape, self.shape.hidden, y.shape[1]
        first = (d + 1) * h
        columns = first + h + 1 + k  # the residual as the last: its products are the gradient
        gram = weights.new_zeros(many, columns, columns)
        residual = torch.empty_like(y)
        step = _block(many * columns, x.device)
        for rows in (slice(a, a + step) for a in range(0, n, step)):
            xs, root = x[..., rows], row[:, None, rows].sqrt()
            z = TanhNetwork.units(v.mT, _with_ones(xs))
            residual[..., rows] = y[..., rows] - torch.baddbmm(b[..., None], w.mT, z)
            basis = x.new_empty(many, columns, xs.shape[2])
            slope = (1.0 - z * z) * root
            inputs = basis[:, : d * h].view(many, d, h, -1)
            torch.mul(xs[:, :, None], slope[:, None], out=inputs)
            basis[:, d * h : first] = slope
            basis[:, first : first + h] = z.mul_(root)
            basis[:, first + h : first + h + 1] = root
            basis[:, first + h + 1 :] = residual[..., rows] * root
            _add_gram(gram, basis)
        lift = w.mT.repeat(1, 1, d + 1)
        lift = torch.cat((lift, self._lift.to(w).expand(many, -1, -1)), dim=2)  # (M, k, D)
        by_weight = gram.index_select(1, self._column)
        matrix = by_weight.index_select(2, self._column).mul_(lift.mT @ lift)
        return matrix, (by_weight[..., -k:].mT * lift).sum(1), residual

    def squared_error(self, x: Tensor, y: Tensor, used: Tensor) -> Fitness:
        """The sparrow's fitness: weights (M, P, D) -> mean squared error per output (M, P).

        The sparrows of all networks go through one product, in single precision.
        """
        x1, y, used = _with_ones(x).float(), y.float(), used.float()[..., None]
        share = 1.0 / (y.shape[1] * used.sum(dim=1))
        step = _block(len(x) * self.shape.hidden * x.shape[2], x.device)

        def fitness(position: Tensor) -> Tensor:
            parts = [one(p) for p in position.float().split(step, dim=1)]
            return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)

        def one(position: Tensor) -> Tensor:
            v, w, b = self.shape.split(position)
            many, sparrows = position.shape[:2]
            z = TanhNetwork.units(v.mT.flatten(1, 2), x1)
            z = z.view(many * sparrows, self.shape.hidden, -1)
            out = torch.baddbmm(b.reshape(-1, b.shape[-1], 1), w.flatten(0, 1).mT, z)
            error = out.view(many, sparrows, *y.shape[1:]).sub_(y[:, None])
            square = error.square_().view(many, -1, x1.shape[2]) @ used
            return square.view(many, sparrows, -1).sum(2) * share

        return fitness

    def starts(
        self, init: str, busy: Tensor, fitness: Fitness, rng: torch.Generator, search: SparrowSearch
    ) -> Tensor:
        """Initial weights (M, D), 0 where not ``busy`` (M, D): by sparrow search, or Xavier's."""
        xavier = self._xavier(busy, rng)
        if init == "xavier":
            return xavier
        bound = busy.float()
        found = search.minimise(fitness, -bound, bound, rng).position.double()
        for _ in range(10):
            v, w, _ = self.shape.split(found)
            alike = hidden_alike(v) & (self.shape.split(busy)[1][..., 0])
            if not alike.any():
                break
            new_v, new_w, _ = self.shape.split(self._xavier(busy, rng))
            v.copy_(torch.where(alike[:, None], new_v, v))
            w.copy_(torch.where(alike[..., None], new_w, w))
        return found

    def _xavier(self, busy: Tensor, rng: torch.Generator) -> Tensor:
        """Start weights of Glorot and Bengio (2010): the control to the sparrow start."""
        weights = torch.zeros(busy.shape, dtype=torch.float64, device=busy.device)
        v, w, _ = self.shape.split(weights)
        hidden = self.shape.split(busy)[1][..., 0].sum(dim=1)[:, None, None]
        for part, ends in ((v, self.shape.inputs), (w, self.shape.outputs)):
            spread = (2.0 / (ends + hidden)).sqrt()
            part.copy_(torch.randn(part.shape, generator=rng, dtype=part.dtype, device=part.device))
            part *= spread
        return weights * busy


def hidden_alike(v: Tensor) -> Tensor:
    """(M, H) hidden units whose incoming weights repeat those of an earlier unit up to sign.

    Such units have the same gradient, so back-propagation can never separate them.
    """
    units = v.mT  # (M, H, d+1)
    norm = units.norm(dim=2)
    one, other = units[:, :, None], units[:, None]
    scale = torch.maximum(norm[:, :, None], norm[:, None]) + 1e-12
    apart = torch.minimum((one - other).norm(dim=3), (one + other).norm(dim=3))
    # relative distance of hidden units below which they count as collapsed
    return (apart < 0.05 * scale).tril(-1).any(dim=2) | (norm < 1e-6)


def _with_ones(x: Tensor) -> Tensor:
    """(..., d, N) -> (..., d+1, N), the bias input last."""
    return torch.nn.functional.pad(x, (0, 0, 0, 1), value=1.0)


def _add_gram(gram: Tensor, basis: Tensor) -> None:
    """Add ``B B'`` (M, C, C) of ``B`` (M, C, N)."""
    edges = [gram.shape[1] * i // _STRIPS for i in range(_STRIPS + 1)]
    for low, high in pairwise(edges):
        product = basis[:, low:high] @ basis[:, low:].mT
        gram[:, low:high, low:] += product
        if high > low:
            gram[:, high:, low:high] += product[:, :, high - low :].mT
