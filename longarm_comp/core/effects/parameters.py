"""One fitted number of an effect, as it is declared."""

from __future__ import annotations

import math
from dataclasses import dataclass

_FLAT = 1000.0
"""Width of a prior that knows nothing, in ordinary sizes: 50 m and 50 rad for a base."""

ALIKE = 0.95
"""Correlation, beforehand, of parameters that are like each other: they differ by a third of their
size. Of seven seats of first joints that were fitted to real arms, five are as soft along as across
within a factor of 1.6."""


@dataclass(frozen=True)
class Parameter:
    """One number of an effect: unit, meaning, prior standard deviation and physical bounds.

    Attributes:
        unit: SI.
        meaning: description in a few words.
        prior: standard deviation of plausible values; 0 means fixed at its value.
        lower, upper: physical bounds.
        unknown: nothing is known beforehand: the fit's prior is too wide to pull.
        like: shared by parameters of one effect that are nearly equal beforehand (`ALIKE`). It
            counts where explanations are compared; a fit takes each by itself.
        usual: standard deviation of what every arm has of it: no finding, and never fitted.
    """

    name: str
    unit: str
    meaning: str
    prior: float
    lower: float = -math.inf
    upper: float = math.inf
    unknown: bool = False
    like: str = ""
    usual: float = 0.0

    @property
    def width(self) -> float:
        """Standard deviation of the fit's prior."""
        return _FLAT * self.prior if self.unknown else self.prior
