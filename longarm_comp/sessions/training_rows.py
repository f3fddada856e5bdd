"""Detects a test session that a model or a predictor was fitted to."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model_file import read_stored

if TYPE_CHECKING:
    from longarm_comp.core.learn.predictor import Predictor


def fitted_to(session: Session, model: Path | None, predictor: Predictor | None) -> list[str]:
    """``model`` and ``predictor``, as far as they were fitted to this session, by its hash.

    Files hold the hash of the whole session. A session that shares only some rows with this one
    is therefore not recognised.
    """
    origins = {}
    if model is not None:
        origins["model"] = read_stored(model).provenance.get("session_hash")
    if predictor is not None:
        origins["predictor"] = predictor.provenance.session_hash
    return [name for name, origin in origins.items() if origin == session.hash]
