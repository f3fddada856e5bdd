"""The inputs of the workflows: an admitted session, the model, the predictor for that model."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.admission import FEW_POSES, admit
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import file_hash
from longarm_comp.core.identify.run_ups import with_fitted_run_ups
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, store
from longarm_comp.sessions.csv import read_csv
from longarm_comp.sessions.read import read_session

if TYPE_CHECKING:
    from longarm_comp.core.learn.others import NetworkKind
    from longarm_comp.core.learn.predictor import Predictor

FilePath = str | Path
SessionLike = Session | FilePath
"""A session, or the CSV or bag that it is read from."""
ModelLike = Model | FilePath
"""A model, or the model.yaml that it is read from."""
Note = Callable[[str], None]

MODEL, PREDICTOR = "model.yaml", "predictor.npz"
"""Names of a diagnosis's files, and of the files in use."""
MODEL_BEFORE, SESSION = "model_before", "session"
"""Keys in the provenance of a diagnosis's model: SHA-256 of the model that was diagnosed, empty for
the declared arm; path of the session relative to the diagnosis, empty for a session in memory."""
DIGEST = "model_digest"
"""Key in a predictor's settings: digest of the model in memory with which it was trained."""

log_note: Note = logging.getLogger("longarm_comp").info
"""Default for notes: the log of the package, level INFO."""


Telling = bool | Callable[..., None]
"""True: print a line for each step on standard error; False: nothing; or a function to call."""


def make_teller(progress: Telling) -> Callable[..., None]:
    """Return a function to call with each step and, if known, the share done, 0 to 1."""
    if callable(progress):
        return progress
    if not progress:
        return lambda *_: None
    begun, last = time.monotonic(), ""

    def tell(step: str, share: float | None = None) -> None:
        nonlocal last
        if step != last:
            done = "" if share is None else f"{100 * share:3.0f} % "
            sys.stderr.write(f"{time.monotonic() - begun:5.0f} s {done}{step}\n")
            sys.stderr.flush()
        last = step

    return tell


def admit_session(
    given: SessionLike,
    arm: Arm,
    model: Model | None = None,
    min_poses: int = FEW_POSES,
    note: Note = log_note,
    *,
    judge: bool = False,
) -> Session:
    """Read a session, check it and return the admitted rows.

    Args:
        model: known model. Run-ups of unknown length get the length with which it was fitted.
        min_poses: smallest number of poses.
        note: called with each finding of the check.
        judge: the rows are to judge the model: rows that do not fit it are noted, not refused.
    """
    session = given if isinstance(given, Session) else read_session(given, arm)
    if model is not None:
        session = with_fitted_run_ups(session, model)
    admission = admit(session, arm, model, min_poses, judge=judge)
    where = session.source if isinstance(given, Session) else given
    for finding in admission.findings:
        note(f"{where}: {finding}")
    return admission.session


def import_table(
    files: FilePath | Sequence[FilePath],
    arm: Arm,
    *,
    units: Sequence[str] = (),
    names: Mapping[str, str] | None = None,
    like: FilePath | None = None,
    columns: Sequence[str] = (),
    **told: str | None,
) -> Session:
    """Read CSV, TXT or XLSX of another program; several files make one session.

    Args:
        units: units of columns whose names have none, such as ``("mm", "deg")``.
        names: name in a session by name in the file, ``{"A": "q1", "B": "q2:mm"}``.
        like: mapping of an earlier file of the same kind, instead of the other arguments.
        columns: names of the columns, if no line of the file has them.
        told: ``rotation``, ``sheet``, ``decimal``, ``join`` and ``sort``: the options of
            `longarm import-data` with these names.
    """
    from longarm_comp.sessions.foreign import convert

    options = convert.Options(
        tuple(units), dict(names or {}), arm=arm, columns=tuple(columns), **told
    )
    found = convert.import_table(files, options if like is None else options.like(Path(like)))
    with tempfile.TemporaryDirectory() as folder:
        csv = Path(folder) / "samples.csv"
        found.save(csv)
        session = read_csv(csv, arm)
    return dataclasses.replace(session, source=", ".join(file.name for file in found.files))


def choose_physics(arm: Arm, given: ModelLike | None, deflection: bool = True) -> Model:
    """Return the given model, else the declared arm's; without sag if ``deflection`` is False.

    Terms that belong to one session only, such as the place of a touched point, are left out.
    Raises InputError for the model of another arm.
    """
    if given is None:
        return declared_model(arm, deflection=deflection)
    model = given if isinstance(given, Model) else load_model(given, arm)
    if model.arm.hash != arm.hash:
        found = f"of arm {model.arm.name} {model.arm.hash[:12]}"
        raise InputError("model", "arm", found, f"a model of {arm.name} {arm.hash[:12]}")
    model = model.lasting()
    return model if deflection else model.rigid


def physics_mark(given: ModelLike | None, deflection: bool = True) -> dict[str, object]:
    """Return the settings of a predictor that identify the physics with which it was trained."""
    if isinstance(given, Model):
        return {DIGEST: _digest_model(given), "deflection": deflection}
    digest = "" if given is None else file_hash(given)
    return {"model_hash": digest, "deflection": deflection}


def network_kind(given: NetworkKind | FilePath | None) -> NetworkKind | None:
    """Return another network than the paper's, from its file or its name; None: the paper's."""
    if not isinstance(given, (str, Path)):
        return given
    from longarm_comp.core.learn.others import choose_network

    return choose_network(given)


def load_predictor(
    path: FilePath,
    arm: Arm,
    model: ModelLike | None = None,
    network: NetworkKind | FilePath | None = None,
) -> Predictor:
    """Load a predictor that belongs to the arm and the model.

    Args:
        path: file that `train` or a diagnosis wrote.
        arm: the declared arm.
        model: the model to use it with: a model, its file, or the declared arm (None). A
            predictor that was trained with a file is identified by the hash of that file.
        network: its network, if it is not the paper's: the file or name that it was trained with.

    Raises:
        InputError: the file is corrupt, or its predictor was trained for another arm or on top of
            another model.
    """
    from longarm_comp.core.learn.predictor_file import load

    network_kind(network)
    predictor = load(
        path,
        arm_hash=arm.hash,
        joint_names=arm.joint_names,
        model_hash=None if isinstance(model, Model) else str(physics_mark(model)["model_hash"]),
        model=f"the model that it was trained with, not {model or 'none'}",
    )
    check_predictor(predictor, choose_physics(arm, model), path)
    return predictor


def check_predictor(predictor: Predictor, model: Model, where: object) -> None:
    """Raise InputError if a predictor was not trained on the residual of this model."""
    origin = predictor.provenance
    if origin.arm_hash and origin.arm_hash != model.arm.hash:
        allowed = f"{model.arm.hash[:12]} (arm {model.arm.name}, in use)"
        raise InputError(where, "predictor.arm_hash", origin.arm_hash[:12], allowed)
    trained_with = origin.settings.get(DIGEST)
    if trained_with is not None and trained_with != _digest_model(model):
        found = str(trained_with)[:12]
        raise InputError(where, f"predictor.{DIGEST}", found, "the model that it was trained with")


def _digest_model(model: Model) -> str:
    bare = dataclasses.replace(model, uncertainty=None)
    return hashlib.sha256(store(bare).model_dump_json().encode()).hexdigest()
