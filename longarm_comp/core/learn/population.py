"""The fitness of the sparrow search on an accelerator, as one batched torch product.

On a CPU the numpy form in ``network.squared_error`` is faster.  torch is imported only here, when a
device is requested.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.network import Shape, Weights, squared_error, with_ones

_DEVICE_BYTES = 256 * 1024 * 1024  # hidden activations held at once on a device

PopulationFitness = Callable[[Weights], NDArray[np.float32]]


def fitness_on(device: str | None, shape: Shape, x: Weights, y: Weights) -> PopulationFitness:
    """Fitness (P, D) -> (P,): numpy where ``device`` is None, else torch on ``device``.

    Raises
    ------
    InputError: torch is not installed or does not know or have the device.
    """
    return squared_error(shape, x, y) if device is None else torch_error(device, shape, x, y)


def torch_error(device: str, shape: Shape, x: Weights, y: Weights) -> PopulationFitness:
    """As ``network.squared_error``, float32 on a torch device (``cpu``, ``cuda``, ``cuda:1``)."""
    torch = _torch()
    try:
        place = torch.device(device)
        x1 = torch.as_tensor(with_ones(np.asarray(x)).T.copy(), dtype=torch.float32, device=place)
        target = torch.as_tensor(np.asarray(y).T.copy(), dtype=torch.float32, device=place)
    except (RuntimeError, AssertionError) as error:
        raise InputError("train", "device", device, "a device that torch has here") from error
    k, n = target.shape
    block = max(1, _DEVICE_BYTES // (4 * n * shape.hidden))

    def fitness(population: Weights) -> NDArray[np.float32]:
        errors = []
        with torch.inference_mode():
            for start in range(0, len(population), block):
                part = np.asarray(population[start : start + block], dtype=np.float32)
                v, w, b = shape.split(torch.as_tensor(part, device=place))
                z = torch.tanh(v.transpose(1, 2) @ x1)  # (p, H, N)
                out = torch.baddbmm(b[:, :, None] - target, w.transpose(1, 2), z)
                errors.append(out.square().sum(dim=(1, 2)))
            mean: NDArray[np.float32] = (torch.cat(errors) / (n * k)).cpu().numpy()
        return mean

    return fitness


def _torch() -> Any:
    try:
        import torch
    except ImportError as error:
        allowed = "no device; pip install 'longarm_comp[device]' brings torch"
        raise InputError("train", "device", "torch is not installed", allowed) from error
    return torch
