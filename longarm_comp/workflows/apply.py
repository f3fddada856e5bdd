"""Applies a diagnosis: checks that it fits the model in use, trains a predictor, uses both."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias
from longarm_comp.core.effects.units import for_people
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.files import alone_in, follow_link
from longarm_comp.core.learn import predictor_file
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import (
    AS_DECLARED,
    StoredModel,
    read_stored,
    restore,
    save_model,
    store,
)
from longarm_comp.report.record import DiagnosisReport, read_report
from longarm_comp.workflows import inputs
from longarm_comp.workflows.model_in_use import finish_change, put_to_work, undo
from longarm_comp.workflows.train import train

GEOMETRY, CAMERA = "geometry", "camera"


@dataclass(frozen=True)
class ModelChange:
    """One effect of the new model that the old one lacks, or has with other values.

    Attributes:
        what, where: canonical name of the effect, and its place. `geometry` and `camera`, without a
            place, stand for all effects of the geometry and of the measuring side.
        kind: ``added``, ``changed`` or ``removed``.
        values: (parameter, unit, before, after) of each changed parameter; NaN where the effect is
            missing.
        tip_mm: RMS displacement (3-D) of the measured tip by this change, over the given poses.
    """

    what: str
    where: str
    kind: str
    values: tuple[tuple[str, str, float, float], ...]
    tip_mm: float

    def __str__(self) -> str:
        place = f" at {self.where}" if self.where else ""
        shown = []
        for name, unit, *values in self.values:
            times, read = for_people(unit)
            before, after = ("none" if np.isnan(v) else f"{times * v:.4g}" for v in values)
            shown.append(f"{name} {before} -> {after} {read}")
        listed = f" ({', '.join(shown)})" if shown else ""
        return f"{self.what}{place} {self.kind}: {self.tip_mm:.3f} mm at the tip{listed}"


def list_changes(
    before: Model, after: Model, q: np.ndarray, context: Context | None
) -> list[ModelChange]:
    """List the changes from one model to another of the same arm, the largest first.

    The size of a change is the displacement of the tip when it alone is taken back from the new
    model, at joints q (N, n), rad and m. Changes that hardly move the tip are left out.
    """
    old, new = ({(t.name, t.place): t for t in model.terms} for model in (before, after))
    differing: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for key in dict.fromkeys((*new, *old)):
        if old.get(key) != new.get(key):
            term = new.get(key) or old[key]
            together = CAMERA if isinstance(term, Bias) else GEOMETRY if term.geometry else ""
            differing.setdefault((together, "") if together else key, []).append(key)
    seen = after.measured(q, context)
    found = []
    for (name, _), keys in differing.items():
        terms = {key: new[key] for key in new if key not in keys}
        terms |= {key: old[key] for key in keys if key in old}
        moved = after.with_terms(list(terms.values())).measured(q, context) - seen
        tip_mm = 1e3 * float(np.sqrt((moved**2).sum(axis=1).mean()))
        # A change that moves the tip by less than this is not reported
        if tip_mm < 5e-4:
            continue
        if name in (GEOMETRY, CAMERA):
            found.append(ModelChange(name, "", "changed", (), tip_mm))
            continue
        was, now = old.get(keys[0]), new.get(keys[0])
        kind = "added" if was is None else "removed" if now is None else "changed"
        term, values = now or old[keys[0]], []
        for p in term.parameters(after.arm):
            a, b = (np.nan if t is None else float(getattr(t, p.name)) for t in (was, now))
            # Relative difference of two values that counts as none
            if not np.isclose(a, b, rtol=1e-9, atol=0.0):
                values.append((p.name, p.unit, a, b))
        found.append(ModelChange(name, term.where, kind, tuple(values), tip_mm))
    return sorted(found, key=lambda change: -change.tip_mm)


@dataclass(frozen=True)
class Applied:
    """The result of `apply`.

    Attributes:
        model, version: file of the model in use, and its version.
        changes: changes of the model, the largest displacement of the tip first.
        predictor: file of the new predictor; None if there is none, so that physics is used alone.
        refused: why a trained network is not used; empty if it is used or none was trained.
        set_aside: copy of the predictor that was in use before; None if there was none.
        commanded_mm, seen_mm: mean held-out error before and after, as commanded and as seen
            (docs/report.md); None if it was not recorded.
    """

    model: Path
    version: int
    changes: tuple[ModelChange, ...]
    predictor: Path | None
    refused: str
    set_aside: Path | None
    commanded_mm: tuple[float, float] | None
    seen_mm: tuple[float, float] | None

    @property
    def undo(self) -> str:
        """The shell command that restores the version before."""
        return f"longarm undo {self.model}"


def apply(
    diagnosis: Path,
    arm: Arm,
    model: Path,
    predictor: Path | None = None,
    *,
    session: Path | None = None,
    network: bool = True,
    seed: int = 0,
    note: inputs.Note = inputs.log_note,
    progress: inputs.Telling = False,
) -> Applied:
    """Apply a diagnosis: put its model, and a predictor trained for it, to use.

    Args:
        diagnosis: folder of the diagnosis.
        model: file of the model in use. If it does not exist yet, the declared arm is in use.
        predictor: file of the predictor in use; by default ``predictor.npz`` beside the model.
        session: session that was diagnosed; by default the one that the diagnosis names.
        network: whether to train a predictor on the residual of the model in the session.
        seed, note, progress: as in `train`.

    Raises:
        InputError: the diagnosis is missing or incomplete; it is of another arm, or was not made
            with the model in use; the session is missing or another one; a predictor is to be
            trained, and the one in use comes from outside the package; another process changes the
            model.
        JobError: the diagnosis adds nothing.
    """
    with alone_in(follow_link(model).parent):  # also while a network is trained
        report, made = read_addition(diagnosis), diagnosis / inputs.MODEL
        stored = read_stored(made)
        diagnosed = str(stored.provenance.get("session_hash"))
        if report.provenance.data_sha256 != diagnosed:
            found = f"sessions {report.provenance.data_sha256[:12]} and {diagnosed[:12]}"
            allowed = (
                "files of one diagnosis: one was broken off, or two wrote here; diagnose again"
            )
            raise InputError(diagnosis, "report.json and model.yaml", found, allowed)
        after = restore(stored, arm, str(made))
        target = follow_link(predictor or model.parent / inputs.PREDICTOR)
        if network:
            predictor_file.check_ending(target, of_others=False)
        finish_change(model, target)
        before = _read_before(stored, made, model, arm)
        rows = _read_rows(stored, diagnosis, session, arm, before, note)
        trained, refused = None, ""
        if network:
            trained = train(arm, rows, model=made, seed=seed, note=note, progress=progress)
            if not trained.gain.helps:
                refused, trained = str(trained.gain), None
                note(f"physics only: {refused}")
        seen = rows.take(rows.seen)
        changed = list_changes(before, after, seen.q, seen.context())
        if not model.is_file():
            save_model(model, store(declared_model(arm), version=AS_DECLARED))
        aside = put_to_work(model, made.read_bytes(), target, trained)
        at_work, errors = None if trained is None else target, report.mean_errors
        return Applied(model, stored.version, tuple(changed), at_work, refused, aside, *errors)


def take_back(diagnosis: Path, model: Path, predictor: Path | None = None) -> None:
    """Undo a diagnosis if its model is in use: a job that applied it was interrupted."""
    made = diagnosis / inputs.MODEL
    if model.is_file() and made.is_file() and model.read_bytes() == made.read_bytes():
        undo(model, predictor)


def read_addition(diagnosis: Path) -> DiagnosisReport:
    """Read the report of a diagnosis that adds something to the model in use.

    Raises:
        InputError: the folder holds no report.
        JobError: the diagnosis adds nothing, or its data were refused.
    """
    report = read_report(diagnosis)
    if nothing := nothing_to_apply(report):
        raise JobError(f"{diagnosis}: nothing to apply: {nothing}", verdict=report.verdict)
    return report


def nothing_to_apply(report: DiagnosisReport) -> str:
    """Say why a diagnosis adds nothing to the model in use; empty if it adds something."""
    if report.verdict == "bad_data":
        return report.summary
    return f"{report.summary} {said}" if (said := report.nothing_gained) else ""


def _read_before(made: StoredModel, file: Path, model: Path, arm: Arm) -> Model:
    """Return the model in use.

    Raises:
        InputError: it is not the model that was diagnosed, or the diagnosis is in use already.
    """
    field = f"provenance.{inputs.MODEL_BEFORE}"
    diagnosed = made.provenance.get(inputs.MODEL_BEFORE)
    if diagnosed is None:
        raise InputError(file, field, "missing", "diagnose again")
    at_work, now = declared_model(arm), ""
    if model.is_file():
        stored = read_stored(model)
        at_work = restore(stored, arm, str(model))
        now = inputs.file_hash(model)
        if now == inputs.file_hash(file):
            raise InputError(file, "model", "in use already", "another diagnosis")
        if stored.version == AS_DECLARED and not diagnosed:
            return at_work
    if diagnosed != now:
        declared = "the declared arm"
        allowed = f"the model in use, {now[:12] or declared}: diagnose with --model {model}"
        raise InputError(file, field, str(diagnosed)[:12] or declared, allowed)
    return at_work


def _read_rows(
    made: StoredModel,
    diagnosis: Path,
    session: Path | None,
    arm: Arm,
    before: Model,
    note: inputs.Note,
) -> Session:
    """Return the admitted rows that were diagnosed; InputError if the session has others."""
    named, diagnosed = (str(made.provenance.get(k, "")) for k in (inputs.SESSION, "session_hash"))
    path = session or Path(os.path.normpath(diagnosis / named))
    if (session is None and not named) or not path.exists():
        allowed = "--session, the session diagnosed"
        raise InputError(diagnosis, "session", named or "none named", allowed)
    known = before if made.provenance[inputs.MODEL_BEFORE] else None
    rows = inputs.admit_session(path, arm, known, note=note)
    if rows.hash != diagnosed:
        wanted = f"the session diagnosed, {diagnosed[:12]}"
        raise InputError(path, "sha256 of the rows", rows.hash[:12], wanted)
    return rows
