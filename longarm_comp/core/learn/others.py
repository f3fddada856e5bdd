"""Networks from outside this package: factories of torch modules, from files or entry points.

A factory is a function ``network(inputs, outputs)`` that returns a `torch.nn.Module` of (N, inputs)
-> (N, outputs), all of whose numbers are parameters. Each parameter tensor has one prior precision,
so weights of different typical size should be in different tensors. A saved predictor holds the
name and the origin of its network, never its code. To load it, the same file must be given or the
same package installed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from longarm_comp.core.entry_points import execute_file, of_other_packages
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import file_hash
from longarm_comp.core.learn.network import Array
from longarm_comp.core.learn.stack import Stack

GROUP = "longarm_comp.networks"
"""Group of the entry points of networks from other packages."""

Factory = Callable[[int, int], torch.nn.Module]
_loaded: dict[str, NetworkKind] = {}


@dataclass(frozen=True)
class NetworkKind:
    """A factory with its name and its origin: a package, or the SHA-256 of its file."""

    name: str
    origin: str
    factory: Factory = field(compare=False, repr=False)

    def stack(self, inputs: int, outputs: int, device: str | torch.device = "cpu") -> Stack:
        """Return a stack that evaluates and trains many of its modules at once."""
        return Stack(self._module(inputs, outputs).to(device))

    def starts(self, inputs: int, outputs: int, many: int, seed: int) -> torch.Tensor:
        """Return the initial weights (M, D) of `many` new modules, M."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            modules = [self._module(inputs, outputs) for _ in range(many)]
        return torch.stack([torch.nn.utils.parameters_to_vector(m.parameters()) for m in modules])

    def members(self, inputs: int, outputs: int, weights: Array) -> TorchMembers:
        """Return the trained networks that have the weights (M, D)."""
        return TorchMembers(self.stack(inputs, outputs), torch.as_tensor(weights))

    def _module(self, inputs: int, outputs: int) -> torch.nn.Module:
        where, wanted = f"network {self.name}", f"a torch.nn.Module (N, {inputs}) -> (N, {outputs})"
        try:
            module = self.factory(inputs, outputs).double().eval()
            made = module(torch.zeros(3, inputs, dtype=torch.float64))
            module(torch.zeros(0, inputs, dtype=torch.float64))
        except Exception as error:
            said = f"{type(error).__name__}: {error}"
            raise InputError(where, "factory", said, wanted) from error
        if made.shape != (3, outputs) or not list(module.parameters()):
            raise InputError(where, "factory", f"an output of shape {tuple(made.shape)}", wanted)
        if buffers := [name for name, _ in module.named_buffers()]:
            raise InputError(where, "buffers", buffers, "none: all its numbers are parameters")
        return module.requires_grad_(False)


@dataclass(frozen=True)
class TorchMembers:
    """Trained networks of one module, evaluated on the CPU."""

    stack: Stack
    weights: torch.Tensor  # (M, D)

    def outputs(self, x: Array) -> Array:
        rows = torch.as_tensor(x).expand(len(self.weights), -1, -1)
        return self.stack.outputs(self.weights, rows).numpy()

    def jacobian(self, x: Array) -> Array:
        return self.stack.jacobian(self.weights[:1], torch.as_tensor(x)[None])[0].numpy()

    def slope(self, x: Array, moved: NDArray[np.bool_], error: float) -> tuple[Array, float]:
        def mean(x: torch.Tensor) -> torch.Tensor:
            return self.stack.outputs(self.weights, x.expand(len(self.weights), 1, -1)).mean(0)[0]

        slope = torch.func.jacrev(mean)(torch.as_tensor(x)).numpy()
        return slope[:, moved], 0.0  # how far it holds is not known


def load_file(path: str | Path) -> NetworkKind:
    """Execute a Python file that defines ``network(inputs, outputs)``; return its network.

    The network has the name of the file without ``.py``. Raises InputError for another file.
    """
    path = Path(path)
    module = execute_file(path, "network")
    factory = getattr(module, "network", None)
    if not callable(factory):
        raise InputError(path, "network", "none", "a function network(inputs, outputs)")
    said = f"file of SHA-256 {file_hash(path)}"
    kind = _loaded[path.stem] = NetworkKind(path.stem, said, factory)
    return kind


def choose_network(given: str | Path) -> NetworkKind:
    """Return the network of an installed package by its name, or that of a Python file."""
    if found := _of_packages().get(str(given)):
        return found
    if Path(given).suffix != ".py":
        known = ", ".join((*_of_packages(), "a Python file, .py"))
        raise InputError("--network", "name", given, known)
    return load_file(given)


def load_saved(name: str, origin: str, where: object) -> NetworkKind:
    """Return the network that a predictor's file (`where`) names, by its name and origin.

    Raises InputError if neither was it loaded nor has a package it.
    """
    found = _loaded.get(name) or _of_packages().get(name)
    if found is None or found.origin != origin:
        is_now = "not known" if found is None else f"now of another {found.origin.split()[0]}"
        raise InputError(where, f"network {name}", is_now, f"the {origin}: give it with --network")
    return found


@cache
def _of_packages() -> dict[str, NetworkKind]:
    return {
        name: NetworkKind(name, source, factory)
        for name, factory, source in of_other_packages(GROUP)
    }
