"""The learned error at one posture and its linear expansion.

With the expansion one request to the predictor is enough for all steps of a solution.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.result import Prediction

LINEAR_M = 5e-6
"""Accuracy of an expansion within its reach, m."""


@dataclass(frozen=True)
class Expansion:
    """The expected residual at joints (n,) and its linear expansion.

    A compensation needs the error at joints that differ by a few millirad. With the slope one
    request is enough, which saves time if the predictor runs in another process.

    Attributes:
        error, sigma: (3,) m.
        in_domain, reason: as in `Prediction`.
        jacobian: (3, n), m per rad or m of each joint.
        reach: (n,) rad or m. If no joint moves farther, the joints stay inside the training data
            and ``error + jacobian @ step`` is accurate to `LINEAR_M`. Zero: valid only at q.
    """

    error: np.ndarray
    sigma: np.ndarray
    in_domain: bool
    reason: str
    jacobian: np.ndarray
    reach: np.ndarray


class Nearby:
    """A predictor for one target: near the joints of its last request it reuses the answer."""

    def __init__(self, ask: Callable[[np.ndarray, Context], Expansion]) -> None:
        self._ask = ask
        self._last: tuple[np.ndarray, Context, Expansion] | None = None

    def predict(self, q: np.ndarray, context: Context | None = None) -> Prediction:
        """Return the expected residual at joints (N, n), in the form of `Predictor.predict`.

        The expansion is made around the first row, or an earlier one near it. Other rows are
        extrapolated from it, also beyond its reach.
        """
        joints, given = q[0], context or Context()
        last = self._last
        if last is None or not (
            (np.abs(joints - last[0]) <= last[2].reach).all() and given == last[1]
        ):
            last = self._last = joints.copy(), given, self._ask(joints, given)
        at, _, found = last
        count = len(q)
        return Prediction(
            found.error + (q - at) @ found.jacobian.T,
            np.repeat(found.sigma[None], count, axis=0),
            np.full(count, found.in_domain),
            [found.reason] * count,
        )
