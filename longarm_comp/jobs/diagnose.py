"""A diagnosis from files to files: report, model with the effect added, predictor, poses."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp import __version__
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.admission import FEW_POSES, admit
from longarm_comp.core.data.plan import Plan
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import atomic_path
from longarm_comp.core.identify.calibrate import errors
from longarm_comp.core.identify.diagnosis import Diagnosis, diagnose
from longarm_comp.core.identify.evidence import key
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.predictor import Predictor, Provenance
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import (
    StoredModel,
    load_model,
    read_stored,
    save_model,
    store,
)
from longarm_comp.report.assemble import assemble, refused
from longarm_comp.report.drawing import SPLITS
from longarm_comp.report.write import write_report
from longarm_comp.sessions.next_poses import FILE
from longarm_comp.sessions.poses import write_poses
from longarm_comp.sessions.read import read_session

Say = Callable[[str], None]

MODEL, PREDICTOR = "model.yaml", "predictor.npz"


@dataclass(frozen=True)
class Request:
    """What to diagnose.

    Attributes:
        arm: as declared.
        session: CSV or bag.
        test: hold-out, CSV or bag; blocks of the session are locked away when None.
        model: model.yaml of what is known already.
        seed: of everything random.
        network: whether to train on what is left.
    """

    arm: Arm
    session: Path
    test: Path | None = None
    model: Path | None = None
    seed: int = 0
    network: bool = True


def run(request: Request, folder: Path, say: Say = lambda _: None) -> dict[str, Any]:
    """Diagnose and write everything to a folder; returns report.json's contents.

    Raises:
        InputError: the data were refused (the report says so too, verdict ``bad_data``), or a
            file of the request cannot be used at all.
        JobError: a fit did not stay finite.
    """
    for path in (request.session, request.test, request.model):
        if path is not None and not path.exists():
            raise InputError(path, "file", "missing", "a file or a bag that exists")
    known = None if request.model is None else load_model(request.model, request.arm)
    try:
        session = _admitted(request.session, request.arm, known, FEW_POSES)
        test = request.test and _admitted(request.test, request.arm, known, 1)
        found = diagnose(
            request.arm,
            session,
            test=test or None,
            model=known,
            train_network=_train(request.seed) if request.network else None,
            seed=request.seed,
            progress=say,
        )
    except InputError as error:
        digest = _file_hash(request.session)
        write_report(*refused(error, request.seed, request.session.name, digest), folder)
        raise
    say("report")
    report, detail = assemble(found, session.hash, _facts(request, session, test or None))
    write_report(report, detail, folder)
    before = None if request.model is None else read_stored(request.model)
    stored = stored_model(found, session.hash, before)
    _save(stored, request.model, folder / MODEL)
    _write_predictor(found, session.hash, folder)
    _write_next(found, folder)
    return report


def stored_model(
    found: Diagnosis, session_hash: str, before: StoredModel | None = None
) -> StoredModel:
    """The model to use from now on, as it is written.

    Args:
        found: the diagnosis.
        session_hash: where it came from.
        before: the version that it replaces.
    """
    model = found.model
    intervals: dict[tuple[int, str], tuple[float, float]] = {}
    spread = None
    if found.rolled_back:
        weights = found.fit.weights
        spread = fit(
            model, found.train, sigma=found.fit.sigma, rho=found.fit.rho, weights=weights
        ).standard_errors
    else:
        for k, slot in enumerate(model.slots):
            interval = found.confirmed.intervals[k]
            intervals[slot.term, slot.parameter.name] = (interval.low, interval.high)
    added = {key(t) for f in found.findings for t in f.terms}
    held = {} if before is None else _origins(before)
    origins = {}
    for number, term in enumerate(model.terms):
        new = f"{found.verdict}, session {session_hash[:16]}, seed {found.seed}"
        origins[number] = new if key(term) in added else held.get(key(term), "")
    return store(
        model,
        spread,
        version=1 if before is None else before.version + 1,
        provenance={
            "session_hash": session_hash,
            "rows": len(found.train),
            "verdict": found.verdict,
            "seed": found.seed,
            "longarm_comp": __version__,
        },
        origins=origins,
        intervals=intervals,
    )


def _origins(stored: StoredModel) -> dict[tuple[str, str], str]:
    terms = (*stored.geometry, *stored.effects, *stored.camera)
    return {(t.effect, t.where): t.origin for t in terms}


def _save(stored: StoredModel, before: Path | None, path: Path) -> None:
    """Write the model; the version before, if one was given, is what `undo` puts back."""
    if before is not None and before.resolve() != path.resolve():
        with atomic_path(path) as partial:
            partial.write_bytes(before.read_bytes())
    save_model(path, stored)


def _admitted(path: Path, arm: Arm, model: Model | None, min_poses: int) -> Session:
    return admit(read_session(path, arm), arm, model, min_poses).session


def _train(seed: int) -> Callable[[Model, Session], Predictor]:
    def made(model: Model, session: Session) -> Predictor:
        return train(
            session.q,
            errors(model, session),
            session.context(),
            seed=seed,
            provenance=Provenance(
                model.arm.hash, session.hash, model.arm.joint_names, {"deflection": True}
            ),
        )

    return made


def _write_predictor(found: Diagnosis, session_hash: str, folder: Path) -> None:
    """The network where it helped, bound to the model beside it; else none."""
    path = folder / PREDICTOR
    if not isinstance(found.network, Predictor):
        path.unlink(missing_ok=True)
        return
    predictor = found.network
    origin = predictor.provenance
    mark = {"model_hash": _file_hash(folder / MODEL), "deflection": True}
    bound = dataclasses.replace(
        origin, session_hash=session_hash, settings={**origin.settings, **mark}
    )
    dataclasses.replace(predictor, provenance=bound).save(path)


def _write_next(found: Diagnosis, folder: Path) -> None:
    """Every splitting pose with its side, for ``longarm collect``; no file where there is none."""
    splits = [s for s in found.split_by if s.log_bayes_factor >= SPLITS]
    path = folder / FILE
    if not splits:
        path.unlink(missing_ok=True)
        return
    q = np.concatenate([s.q for s in splits])
    side = np.concatenate([s.approach for s in splits])
    loads = [s.payload_kg for s in splits if s.payload_kg is not None]
    write_poses(Plan(q, side.astype(int), np.concatenate(loads) if loads else None), path)


def _file_hash(path: Path) -> str:
    """SHA-256 of a file; of a folder's files in the order of their names."""
    digest = hashlib.sha256()
    for part in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if part.is_file():
            digest.update(part.read_bytes())
    return digest.hexdigest()


def _facts(request: Request, session: Session, test: Session | None) -> Mapping[str, str]:
    made = {"session": request.session.name, "arm": request.arm.hash, "rows": str(len(session))}
    if request.test is not None and test is not None:
        made |= {"hold-out": request.test.name, "hold-out sha256": test.hash}
    if request.model is not None:
        made["model before"] = _file_hash(request.model)
    return made
