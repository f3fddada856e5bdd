"""Conversion of a session's rows to the training and test data of a predictor."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.data.measurement import errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.predictor import Prediction, Predictor
from longarm_comp.core.model.model import Model


def training_rows(model: Model, session: Session) -> tuple[np.ndarray, np.ndarray, Context]:
    """Joints (M, n), residual of a model (M, 3) in m, and circumstances of the M located rows."""
    seen = session.take(session.located)
    if not len(seen):
        allowed = "rows with all three, to learn from"
        raise InputError(session.source, "x, y, z", "not measured together in any row", allowed)
    return seen.q, errors(model, seen), seen.context()


def expected(predictor: Predictor, session: Session) -> Prediction:
    """The error that a predictor expects at the M rows that say where the tip is."""
    seen = session.take(session.placed)
    return predictor.predict(seen.q, seen.context())
