"""The files of a diagnosis: model with the effect added, predictor, poses to measure next."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np

from longarm_comp.core.data.plan import Plan
from longarm_comp.core.files import atomic_path
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.learn import predictor_file
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import StoredModel, read_stored, save_model, store
from longarm_comp.report.detail import SPLITS
from longarm_comp.sessions.poses import FILE, write_poses
from longarm_comp.version import __version__
from longarm_comp.workflows.inputs import file_hash

MODEL, PREDICTOR = "model.yaml", "predictor.npz"
MODEL_BEFORE, SESSION = "model_before", "session"
"""Keys in the model's provenance: SHA-256 of the model that was diagnosed, empty for the declared
arm; path of the session, seen from the diagnosis, empty for a session in memory."""


def write_model(
    found: Diagnosis, model: Model, session_hash: str, before: Path | None, folder: Path,
    session: Path | None,
) -> None:  # fmt: skip
    """Write the model that a diagnosis found. `undo` restores the version before, if one was given.

    ``model``: with the record of how good it is; ``before``: file of the version that it replaces;
    ``session``: file of the session, if it came from one.
    """
    origin = {
        MODEL_BEFORE: "" if before is None else file_hash(before),
        SESSION: "" if session is None else os.path.relpath(session, folder),
    }
    known = None if before is None else read_stored(before)
    stored = _stored(found, model, session_hash, known, origin)
    path = folder / MODEL
    if before is not None and before.resolve() != path.resolve():
        with atomic_path(path) as partial:
            partial.write_bytes(before.read_bytes())
    save_model(path, stored)


def write_predictor(predictor: Predictor | None, session_hash: str, folder: Path) -> None:
    """Write the network if it helped, bound to the written model; else remove an old file."""
    path = folder / PREDICTOR
    if predictor is None:
        path.unlink(missing_ok=True)
        return
    origin = predictor.provenance
    mark = {"model_hash": file_hash(folder / MODEL), "deflection": True}
    bound = dataclasses.replace(
        origin, session_hash=session_hash, settings={**origin.settings, **mark}
    )
    predictor_file.save(dataclasses.replace(predictor, provenance=bound), path)


def write_next(found: Diagnosis, folder: Path) -> None:
    """Write the poses that separate effects, or settle a doubt; no file if there are none."""
    splits = [s for s in found.split_by if s.log_bayes_factor >= SPLITS]
    path = folder / FILE
    more = found.next_q
    if not splits and not len(more):
        path.unlink(missing_ok=True)
        return
    q = np.concatenate([*(s.q for s in splits), more])
    side = np.concatenate(
        [*(s.approach for s in splits), np.where(np.arange(len(more)) % 2, -1, 1)]
    )
    loads = [s.payload_kg for s in splits if s.payload_kg is not None]
    if loads and len(more):
        loads.append(np.full(len(more), float(np.median(np.concatenate(loads)))))
    write_poses(Plan(q, side.astype(int), np.concatenate(loads) if loads else None), path)


def _stored(
    found: Diagnosis, model: Model, session_hash: str, before: StoredModel | None,
    sources: dict[str, str],
) -> StoredModel:  # fmt: skip
    """The resulting model in its stored form."""
    intervals = {
        (slot.term, slot.parameter.name): (found.intervals[k].low, found.intervals[k].high)
        for k, slot in enumerate(model.slots)
    }
    added = {t.key for t in found.search.chosen}
    stored = () if before is None else (*before.geometry, *before.effects, *before.camera)
    held = {(t.effect, t.where): t.origin for t in stored}
    origins = {}
    for number, term in enumerate(model.terms):
        new = f"{found.verdict}, session {session_hash[:16]}, seed {found.seed}"
        origins[number] = new if term.key in added else held.get(term.key, "")
    return store(
        model,
        None,
        version=1 if before is None else before.version + 1,
        provenance={
            "session_hash": session_hash,
            "rows": len(found.train),
            "verdict": found.verdict,
            "seed": found.seed,
            "longarm_comp": __version__,
            **sources,
        },
        origins=origins,
        intervals=intervals,
    )
