"""Linear expansion of a prediction: its slope, and the range in which slope and domain hold.

A compensation needs the error at joints that differ by a few millirad.  With the slope one
request is enough, which matters when a request is a round trip to another process.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.result import Prediction
from longarm_comp.core.learn.network import with_ones
from longarm_comp.core.learn.predictor import Predictor

LINEAR_M = 5e-6
"""Accuracy of an expansion within its reach, m."""


@dataclass(frozen=True)
class Expansion:
    """Expected residual at joints (n,) and its linear expansion.

    Attributes:
        error, sigma: (3,) m.
        in_domain, reason, doubt: as in `Prediction`.
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
    doubt: float = 0.0


class Expander:
    """Computes expansions of one predictor. Terms of the weights alone are computed once."""

    def __init__(self, predictor: Predictor) -> None:
        self._predictor = predictor
        encoding, (v, w, _) = predictor.encoding, predictor.members
        joint = encoding.kept < encoding.joints  # columns that are a joint
        self._moved = encoding.kept[joint]
        self._width = encoding.scale[joint]
        share = predictor.scale / len(w)
        self._hidden = np.concatenate(v, axis=1)  # (d+1, M H): all members in one product
        self._output = share * np.concatenate(w)  # (M H, 3)
        self._rates = self._hidden[:-1][joint]
        # second derivatives along steps of at most 1 in every column, summed without cancelling
        steep = np.abs(self._rates).sum(axis=0) ** 2  # (M H,)
        self._steep = steep[:, None] * np.abs(self._output)

    def __call__(self, q: np.ndarray, context: Context | None = None) -> Expansion:
        """Predict at joints (n,) and around them."""
        predictor, n = self._predictor, len(q)
        context = context or Context.empty()
        found = predictor.predict(q[None], context)
        x = predictor.encoding.standardise(predictor.encoding.raw(q[None], context))
        z = np.tanh(with_ones(x) @ self._hidden)[0]
        bend = 1.0 - z * z
        jacobian, reach = np.zeros((3, n)), np.zeros(n)
        jacobian[:, self._moved] = (((self._rates * bend) @ self._output) / self._width[:, None]).T
        # allowed growth of the variance, up to the limit of the domain
        if found.in_domain[0] and found.doubt[0] * 1.5 <= 1.0:
            # largest |tanh''|, which bounds the error of a step
            bent = np.minimum(2.0 * np.abs(z) * bend, 0.77)
            curvature = float((bent @ self._steep).max())
            # of a column's training sd; epistemic variance grows by a quarter at the most
            step = min(0.05, math.sqrt(2.0 * LINEAR_M / max(curvature, 1e-12)))
            low, high = predictor.box
            reach = np.minimum(q - low[:n], high[:n] - q)
            reach[self._moved] = np.minimum(reach[self._moved], step * self._width)
        return Expansion(
            found.error[0], found.sigma[0], bool(found.in_domain[0]), found.reason[0],
            jacobian, reach, float(found.doubt[0]),
        )  # fmt: skip


Ask = Callable[[np.ndarray, Context], Expansion]


class Nearby:
    """A predictor for one target, which reuses its last expansion within its reach."""

    def __init__(self, ask: Ask) -> None:
        self._ask = ask
        self._held: tuple[np.ndarray, Context, Expansion] | None = None

    def predict(self, q: np.ndarray, context: Context | None = None) -> Prediction:
        """Expected residual at joints (N, n); as `Predictor.predict`.

        The expansion is around the first of them. The others are extrapolated from it, also
        beyond its reach.
        """
        joints, given = q[0], context or Context.empty()
        held = self._held
        if held is None or not (
            (np.abs(joints - held[0]) <= held[2].reach).all() and given == held[1]
        ):
            held = self._held = joints.copy(), given, self._ask(joints, given)
        at, _, found = held
        count = len(q)
        return Prediction(
            found.error + (q - at) @ found.jacobian.T,
            np.repeat(found.sigma[None], count, axis=0),
            np.full(count, found.in_domain),
            [found.reason] * count,
            np.full(count, found.doubt),
        )
