"""Another network for ``longarm train --network``: two tanh layers (docs/your_own_network.md)."""

from __future__ import annotations

import torch


def network(inputs: int, outputs: int) -> torch.nn.Module:
    """A module of (N, inputs) -> (N, outputs), both standardised, with numbers to begin from."""
    return torch.nn.Sequential(
        torch.nn.Linear(inputs, 12),
        torch.nn.Tanh(),
        torch.nn.Linear(12, 8),
        torch.nn.Tanh(),
        torch.nn.Linear(8, outputs),
    )
