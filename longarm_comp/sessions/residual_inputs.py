"""The recorded circumstances that a predictor takes, from a session."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.data.session import Session
from longarm_comp.core.learn.inputs import CONTEXT_NAMES


def predictor_context(session: Session) -> dict[str, np.ndarray]:
    """``approach`` (N, n) where any direction is known, and the recorded columns, (N,)."""
    made = {k: session.columns[k] for k in CONTEXT_NAMES if k in session.columns}
    if session.approach.any():
        made["approach"] = session.approach.astype(float)
    return made
