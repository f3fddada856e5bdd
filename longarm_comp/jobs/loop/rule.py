"""Whether another round is expected to pay."""

from __future__ import annotations

import math
from dataclasses import dataclass

NEAR_NOISE = 2.0
"""A mean error below so many times what the noise alone shows is as good as measured."""

RULE = (
    "another round follows where the last one brought the tip nearer beyond chance and the mean "
    f"error is still more than {NEAR_NOISE:g} times what the noise of the measurement alone shows"
)


@dataclass(frozen=True)
class Decision:
    """Whether to go on, and why."""

    again: bool
    why: str


def another_round(
    gain_ci95_m: tuple[float, float], mean_m: float, sigma_m: tuple[float, float, float]
) -> Decision:
    """The rule.

    Args:
        gain_ci95_m: 95 % interval of what the round took off the mean error at the tip.
        mean_m: mean 3-D error at the tip after it.
        sigma_m: noise of a measurement along each axis.
    """
    rms = math.sqrt(sum(s * s for s in sigma_m) / 3.0)
    alone = math.sqrt(8.0 / math.pi) * rms  # mean length of a normal vector in three dimensions
    shown = f"the mean error is {1e3 * mean_m:.3f} mm, noise alone shows {1e3 * alone:.3f} mm"
    if gain_ci95_m[0] <= 0.0:
        return Decision(False, f"this round did not bring the tip nearer beyond chance; {shown}")
    if mean_m <= NEAR_NOISE * alone:
        return Decision(False, f"what is left is near the noise: {shown}")
    return Decision(True, f"more is left than noise: {shown}")
