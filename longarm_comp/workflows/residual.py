"""A session as a predictor takes it: the one place where rows become training and test data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.calibrate import errors
from longarm_comp.core.learn.inputs import CONTEXT_NAMES
from longarm_comp.core.learn.predictor import Prediction, Predictor
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.residual_inputs import predictor_context


def training_rows(
    model: Model, session: Session
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Joints (M, n), what a model leaves (M, 3) in m, and circumstances, of the M seen rows."""
    seen = session.take(session.seen)
    return seen.q, errors(model, seen), predictor_context(seen)


def expected(predictor: Predictor, session: Session) -> Prediction:
    """The error that a predictor expects at the M seen rows."""
    seen = session.take(session.seen)
    return predictor.predict(seen.q, predictor_context(seen))


@dataclass(frozen=True, eq=False)
class Learned:
    """A predictor behind the context that models take."""

    predictor: Predictor

    def predict(self, q: np.ndarray, context: Context | None = None) -> Prediction:
        """Expected residual at joints (N, n)."""
        given: dict[str, np.ndarray] = {}
        if context is not None:
            given = {k: np.asarray(v) for k, v in context.columns.items() if k in CONTEXT_NAMES}
            if context.approach:
                given["approach"] = np.stack(context.approach, axis=-1)
        return self.predictor.predict(q, given)
