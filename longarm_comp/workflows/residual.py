"""Conversion of a session's rows to the training and test data of a predictor."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.calibrate import errors
from longarm_comp.core.learn.predictor import Prediction, Predictor
from longarm_comp.core.model.model import Model


def training_rows(model: Model, session: Session) -> tuple[np.ndarray, np.ndarray, Context]:
    """Joints (M, n), residual of a model (M, 3) in m, and circumstances of the M seen rows."""
    seen = session.take(session.seen)
    return seen.q, errors(model, seen), seen.context()


def expected(predictor: Predictor, session: Session) -> Prediction:
    """The error that a predictor expects at the M seen rows."""
    seen = session.take(session.seen)
    return predictor.predict(seen.q, seen.context())
