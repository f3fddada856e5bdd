"""Alternative learners to SSA-BP, with the same train and predict signatures.

Both are scikit-learn, which only the studies need.
"""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.result import Prediction
from longarm_comp.core.learn.inputs import Encoding, check_rows, fit_encoding
from studies.extra import extra

with extra():
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    from sklearn.model_selection import GridSearchCV
    from sklearn.neural_network import MLPRegressor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PeerPredictor:
    """A fitted scikit-learn regressor on the inputs of SSA-BP."""

    encoding: Encoding
    regressor: Any
    offset: Array  # (3,) m
    scale: float  # m
    sigma: Array | None  # (3,) m where the regressor gives none of its own

    def predict(self, q: Array, context: Context | None = None) -> Prediction:
        """Return the expected residual. Peers have no domain, so every row counts as inside."""
        q, known = check_rows("predict", q, context)
        _, x = self.encoding.encode(q, known)
        if self.sigma is None:
            mean, sd = self.regressor.predict(x, return_std=True)
            sigma = self.scale * np.asarray(sd).reshape(len(x), -1) * np.ones(3)
        else:
            mean, sigma = self.regressor.predict(x), np.broadcast_to(self.sigma, (len(x), 3))
        error = self.offset + self.scale * mean
        return Prediction(error, sigma, np.ones(len(q), bool), [""] * len(q), np.zeros(len(q)))


def train_gaussian_process(
    q: Array, residual: Array, context: Context | None = None, *, seed: int = 0
) -> PeerPredictor:
    """Train a Gaussian process: squared-exponential kernel, a length per input, white noise.

    Arguments are as of ``learn.ensemble.train``.
    """

    def build(width: int) -> Any:
        lengths = RBF(np.full(width, 3.0), (0.1, 1e3))
        return GaussianProcessRegressor(
            ConstantKernel(10.0, (1e-3, 1e5)) * lengths + WhiteKernel(1e-2, (1e-8, 1e2)),
            random_state=seed,
        )

    return _fit(build, q, residual, context, own_sigma=True)


def train_mlp(q: Array, residual: Array, *, seed: int, hidden: int) -> PeerPredictor:
    """Train ``MLPRegressor`` of the same size by L-BFGS, its penalty by five-fold validation."""

    def build(width: int) -> Any:
        network = MLPRegressor(
            hidden_layer_sizes=(hidden,), activation="tanh", solver="lbfgs", max_iter=2000,
            random_state=seed,
        )  # fmt: skip
        return GridSearchCV(network, {"alpha": [1e-3, 1e-2, 1e-1, 1.0, 10.0]}, cv=5)

    return _fit(build, q, residual, None, own_sigma=False)


def _fit(
    build: Any, q: Array, residual: Array, context: Context | None, own_sigma: bool
) -> PeerPredictor:
    q, known = check_rows("train", q, context)
    encoding = fit_encoding(q, known, "context")
    x = encoding.encode(q, known)[1]
    y = np.asarray(residual, float)
    offset, scale = y.mean(axis=0), float(y.std())
    regressor = build(x.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        regressor.fit(x, (y - offset) / scale)
    left = y - offset - scale * regressor.predict(x)
    sigma = None if own_sigma else left.std(axis=0)
    return PeerPredictor(encoding, regressor, offset, scale, sigma)
