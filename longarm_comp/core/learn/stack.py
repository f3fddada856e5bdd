"""Many networks of one torch module at once: flat weights (M, D), and rows of its own for each.

`Stack` takes any module (N, d) -> (N, k). `TanhStack` is the paper's network. Its Jacobian is never
formed: each of its columns is one of the columns ``B = [x s, z, 1]`` (``z = tanh``,
``s = 1 - z^2``) times a factor of each output, so one Gram matrix ``B'UB`` is enough for all
outputs.
"""

import torch
from torch import Tensor
from torch.func import functional_call, jacrev, vmap

from longarm_comp.core.learn.network import NetworkShape
from longarm_comp.core.learn.sparrow import Fitness, SparrowSearch


def _numbers_at_once(device: torch.device) -> int:
    """Return how many numbers to hold at once, so that they fit a CPU's cache or a GPU's memory."""
    return 2**18 if device.type == "cpu" else 2**27


class Stack:
    """Networks of one module (N, d) -> (N, k); a flat row of weights for each."""

    def __init__(self, module: torch.nn.Module) -> None:
        self._module = module
        self._shapes = {name: p.shape for name, p in module.named_parameters()}
        self._sizes = [shape.numel() for shape in self._shapes.values()]
        self.size = sum(self._sizes)
        device = next(module.parameters()).device
        self.groups = torch.repeat_interleave(torch.tensor(self._sizes, device=device))
        """(D,) index of the prior of each weight; the weights of a parameter tensor share one."""

    def _at(self, weights: Tensor, x: Tensor) -> Tensor:
        """Return outputs (..., N, k) of networks (..., D) at inputs (..., N, d)."""
        named = zip(self._shapes.items(), weights.split(self._sizes, dim=-1), strict=True)
        parts = {name: part.reshape(*part.shape[:-1], *shape) for (name, shape), part in named}
        made: Tensor = functional_call(self._module, parts, (x,))
        return made

    def outputs(self, weights: Tensor, x: Tensor) -> Tensor:
        """Return outputs (M, N, k) of networks (M, D)."""
        return vmap(self._at)(weights, x)

    def jacobian(self, weights: Tensor, x: Tensor) -> Tensor:
        """Return the derivatives ``dy / dweights`` (M, N, k, D)."""
        slope = jacrev(lambda weights, x: self._at(weights, x[None])[0])
        return vmap(vmap(slope, in_dims=(None, 0)))(weights, x)

    def normal_equations(
        self, weights: Tensor, x: Tensor, residual: Tensor, row: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the lower triangle of the Gauss-Newton matrix ``J'UJ`` (M, D, D), and ``J'U r``.

        The second is (M, D).  ``row`` (M, N) are the weights ``U`` of the rows, ``r`` (M, N, k)
        their residual.
        """
        block = max(1, _numbers_at_once(x.device) // (len(x) * self.size))
        gram = torch.zeros((), dtype=x.dtype, device=x.device)
        for each in zip(*(rows.split(block, dim=1) for rows in (x, residual, row)), strict=True):
            gram = gram + _gram(self._basis(weights, *each))
        return self._of_gram(weights, gram)

    def _basis(self, weights: Tensor, x: Tensor, residual: Tensor, row: Tensor) -> Tensor:
        """Return the Jacobian and residual as columns (M, N k, D+1), times the root of `row`."""
        basis = torch.cat((self.jacobian(weights, x), residual[..., None]), dim=3)
        return (basis * row[..., None, None].sqrt()).flatten(1, 2)

    def _of_gram(self, weights: Tensor, gram: Tensor) -> tuple[Tensor, Tensor]:
        return gram[:, :-1, :-1], gram[:, -1, :-1]


def _gram(basis: Tensor) -> Tensor:
    """Return ``B'B`` (M, C, C) of B (M, N, C); only its lower triangle is complete."""
    gram = basis.new_zeros(len(basis), basis.shape[2], basis.shape[2])
    for a in range(0, basis.shape[2], 64):
        gram[:, a : a + 64, : a + 64] = basis[..., a : a + 64].mT @ basis[..., : a + 64]
    return gram


class TanhNetwork(torch.nn.Module):
    """``y = [tanh([x, 1] V), 1] W``, the paper's network; parameters as in `NetworkShape`."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        self.v = torch.nn.Parameter(torch.zeros(shape.inputs + 1, shape.hidden))
        self.w = torch.nn.Parameter(torch.zeros(shape.hidden + 1, shape.outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, d) to (N, k), also of stacked parameters and inputs."""
        return _with_ones(_units(self.v, _with_ones(x))) @ self.w


class TanhStack(Stack):
    """A stack of the networks of the paper, with the normal equations of their special form."""

    def __init__(self, shape: NetworkShape, device: torch.device) -> None:
        super().__init__(TanhNetwork(shape).to(device))
        d, h, k, self.shape = shape.inputs, shape.hidden, shape.outputs, shape
        priors = torch.tensor([h] * (d + 1) + [h * k, k], device=device)
        self.groups = torch.repeat_interleave(priors)
        """(D,) index of the prior of each weight: one per input (ARD), then one each for the hidden
        biases, for ``W`` and for its bias."""
        ends = torch.arange((d + 1) * h, (d + 1) * h + h + 1, device=device)
        self._column = torch.cat((ends.new_tensor(range((d + 1) * h)), ends.repeat_interleave(k)))
        """(D,) index of the column of ``B`` that belongs to each weight."""

    def outputs(self, weights: Tensor, x: Tensor) -> Tensor:
        return self._at(weights, x)  # no `vmap`, which takes longer than the network

    def _basis(self, weights: Tensor, x: Tensor, residual: Tensor, row: Tensor) -> Tensor:
        """Return the C columns of ``B`` and the residual (M, N, C+k), times the root of `row`."""
        x1, root = _with_ones(x), row[..., None].sqrt()
        z = _units(self.shape.split(weights)[0], x1)
        slope = (x1[..., None] * ((1.0 - z * z) * root)[:, :, None]).flatten(2)
        return torch.cat((slope, z * root, root, residual * root), dim=2)

    def _of_gram(self, weights: Tensor, gram: Tensor) -> tuple[Tensor, Tensor]:
        shape, k = self.shape, self.shape.outputs
        back = self.shape.split(weights)[1][:, :-1].mT.repeat(1, 1, shape.inputs + 1)
        ends = torch.eye(k, dtype=gram.dtype, device=gram.device).repeat(1, 1 + shape.hidden)
        lift = torch.cat((back, ends.expand(len(back), -1, -1)), dim=2)  # (M, k, D)
        by_weight = gram.index_select(2, self._column)
        matrix = by_weight.index_select(1, self._column).mul_(lift.mT @ lift)
        return matrix, (by_weight[:, -k:] * lift).sum(1)

    def squared_error(self, x: Tensor, y: Tensor, used: Tensor) -> Fitness:
        """Return the fitness function of the sparrow search.

        It takes weights (M, P, D) and returns the mean squared error per output (M, P) over the
        rows ``used`` (M, N), in single precision. With ``tanh a = 2 s - 1`` and ``s = 1 / (1 +
        exp(-2a))`` the 2 and the -1 go into the output layer.
        """
        x1, y = 2.0 * _with_ones(x).mT.float(), y.mT[:, None].float()
        share = (used / (y.shape[2] * used.sum(dim=1, keepdim=True))).float()[:, None, None]

        def one(position: Tensor) -> Tensor:
            v, w = self.shape.split(position)
            s = (v.mT.flatten(1, 2) @ x1).sigmoid_().unflatten(1, (-1, self.shape.hidden))
            last = (w[:, :, -1] - w[:, :, :-1].sum(dim=2))[..., None]
            error = (2.0 * w[:, :, :-1].mT) @ s + (last - y)
            return (error.square_() * share).sum(dim=(2, 3))

        def fitness(position: Tensor) -> Tensor:
            each = len(position) * self.shape.hidden * x1.shape[2]
            step = max(1, _numbers_at_once(x.device) // each)
            return torch.cat([one(p) for p in position.float().split(step, dim=1)], dim=1)

        return fitness

    def sparrow_starts(
        self, fitness: Fitness, many: int, rng: torch.Generator, search: SparrowSearch
    ) -> Tensor:
        """Return initial weights (M, D) by sparrow search, with hidden units that differ."""
        xavier = self.xavier_starts(many, rng)
        bound = torch.ones_like(xavier, dtype=torch.float32)
        found = search.minimise(fitness, -bound, bound, rng)[0].double()
        (v, w), (new_v, new_w) = self.shape.split(found), self.shape.split(xavier)
        alike = hidden_alike(v)
        v.copy_(torch.where(alike[:, None], new_v, v))
        w[:, :-1] = torch.where(alike[..., None], new_w[:, :-1], w[:, :-1])
        return found

    def xavier_starts(self, many: int, rng: torch.Generator) -> Tensor:
        """Draw weights (M, D) by Glorot and Bengio (2010): the control to the sparrow search."""
        shape, device = self.shape, self.groups.device
        weights = torch.randn(many, shape.size, generator=rng, dtype=torch.float64, device=device)
        v, w = shape.split(weights)
        v *= (2.0 / (shape.inputs + shape.hidden)) ** 0.5
        w *= (2.0 / (shape.hidden + shape.outputs)) ** 0.5
        w[:, -1] = 0.0
        return weights


def hidden_alike(v: Tensor) -> Tensor:
    """Mark (M, H) the hidden units whose incoming weights are 0, or an earlier unit's up to sign.

    Units with equal weights have equal gradients, so back-propagation can never separate them.
    """
    each = v.mT  # (M, H, d+1)
    norm = each.norm(dim=2)
    scale = torch.maximum(norm[:, :, None], norm[:, None]) + 1e-12
    apart = torch.minimum(torch.cdist(each, each), torch.cdist(each, -each))
    # relative distance of hidden units below which they count as collapsed
    return (apart < 0.05 * scale).tril(-1).any(dim=2) | (norm < 1e-6)


def _units(v: Tensor, x1: Tensor) -> Tensor:
    """Compute ``tanh(x1 V)``, (..., N, H): as ``2 / (1 + exp(-2a)) - 1`` in a fifth of the time."""
    return (x1 @ (2.0 * v)).sigmoid_().mul(2.0).sub_(1.0)


def _with_ones(x: Tensor) -> Tensor:
    """Add the bias input last: (..., N, d) -> (..., N, d+1)."""
    return torch.nn.functional.pad(x, (0, 1), value=1.0)
