"""A prediction that also holds nearby: its slope, and how far slope and domain can be relied on.

A compensation asks for the error at joints a few millirad apart.  With the slope one question is
enough, which matters where each is a round trip to another process.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.learn.network import with_ones
from longarm_comp.core.learn.predictor import Prediction, Predictor

LINEAR_M = 5e-6
"""Within its reach an expansion is true to this."""
_FARTHEST = 0.05  # of a column's training sd; epistemic variance grows by a quarter at the most
_VARIANCE_GROWS = 1.5  # so much is allowed for, before the domain's limit
_CURVATURE = 0.77  # largest |tanh''|, hence of a bound on it that a step may not leave


@dataclass(frozen=True)
class Expansion:
    """Expected residual at joints (n,) and around them.

    Attributes:
        error, sigma: (3,) m; in_domain, reason, doubt: as in `Prediction`.
        jacobian: (3, n), m per rad or m of each joint.
        reach: (n,) rad or m: joints that each move no farther stay inside the training data, and
            ``error + jacobian @ step`` is true to `LINEAR_M`; zero: ask again.
    """

    error: np.ndarray
    sigma: np.ndarray
    in_domain: bool
    reason: str
    jacobian: np.ndarray
    reach: np.ndarray
    doubt: float = 0.0


class Expander:
    """Expansions of one predictor; what its weights alone say is worked out once."""

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
        """Predict at joints (n,) and around them.

        Raises:
            InputError: as `Predictor.predict`.
        """
        predictor, n = self._predictor, len(q)
        context = context or Context.empty()
        found = predictor.predict(q[None], context)
        x = predictor.encoding.standardise(predictor.encoding.raw(q[None], context))
        z = np.tanh(with_ones(x) @ self._hidden)[0]
        bend = 1.0 - z * z
        jacobian, reach = np.zeros((3, n)), np.zeros(n)
        jacobian[:, self._moved] = (((self._rates * bend) @ self._output) / self._width[:, None]).T
        if found.in_domain[0] and found.doubt[0] * _VARIANCE_GROWS <= 1.0:
            bent = np.minimum(2.0 * np.abs(z) * bend, _CURVATURE)
            curvature = float((bent @ self._steep).max())
            step = min(_FARTHEST, math.sqrt(2.0 * LINEAR_M / max(curvature, 1e-12)))
            low, high = predictor.box
            reach = np.minimum(q - low[:n], high[:n] - q)
            reach[self._moved] = np.minimum(reach[self._moved], step * self._width)
        return Expansion(
            found.error[0], found.sigma[0], bool(found.in_domain[0]), found.reason[0],
            jacobian, reach, float(found.doubt[0]),
        )  # fmt: skip


Ask = Callable[[np.ndarray, Context], Expansion]


class Nearby:
    """A predictor for one target: it answers near its last answer without asking again.

    Args:
        ask: the expansion at joints (n,) in a context.
    """

    def __init__(self, ask: Ask) -> None:
        self._ask = ask
        self._held: tuple[np.ndarray, Context, Expansion] | None = None

    def predict(self, q: np.ndarray, context: Context | None = None) -> Prediction:
        """Expected residual at joints (N, n); as `Predictor.predict`.

        Asked near the first of them; the others are extrapolated from there, whatever the reach.
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
