"""Diagnosis: finds missing effects; writes report, model, predictor and poses to measure."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import Errors
from longarm_comp.core.calibration.uncertainty import measure_uncertainty
from longarm_comp.core.data.admission import FEW_POSES
from longarm_comp.core.data.holdout import mark_copies
from longarm_comp.core.data.plan import Plan
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import origin
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import alone_in, check_writable, write_bytes
from longarm_comp.core.html_table import html_table
from longarm_comp.core.identify import diagnose as core
from longarm_comp.core.identify.alternatives import weigh_alternatives
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.findings import Finding
from longarm_comp.core.learn import ensemble as networks
from longarm_comp.core.learn import predictor_file
from longarm_comp.core.learn.predictor import Predictor, Provenance
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import StoredModel, read_stored, save_model, store
from longarm_comp.report.assemble import build_report, refused_report
from longarm_comp.report.detail import Detail, detail
from longarm_comp.report.pages import write_report
from longarm_comp.report.record import DiagnosisReport, read_report
from longarm_comp.sessions.poses import FILE, write_poses
from longarm_comp.version import __version__
from longarm_comp.workflows import inputs
from longarm_comp.workflows.calibrate import kind_from
from longarm_comp.workflows.evaluate import ErrorTable
from longarm_comp.workflows.train import training_rows

POSES = 20
"""Smallest number of poses of a diagnosis without `kind_of`: fewer could hardly contradict any
explanation."""


@dataclass(frozen=True, eq=False, repr=False)
class DiagnosisResult:
    """The result of a diagnosis; `save` writes all files of the command.

    Attributes:
        diagnosis: results of all steps.
        session_hash: hash of the diagnosed rows.
        facts: further provenance for the page.
        model_before, session_file: files of the model before and of the session; None if they were
            given in memory.
    """

    diagnosis: Diagnosis
    session_hash: str
    facts: Mapping[str, str]
    model_before: Path | None = None
    session_file: Path | None = None

    @property
    def verdict(self) -> str:
        """``noise``, ``named``, ``set``, ``partly`` or ``unknown``."""
        return self.diagnosis.verdict

    @property
    def summary(self) -> str:
        """The result in one sentence."""
        return self.diagnosis.summary

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Effects that were added, strongest first, each with its `name` and `where`."""
        return self.diagnosis.findings

    @cached_property
    def model(self) -> Model:
        """The model to use from now on, with its uncertainty."""
        found = self.diagnosis
        of_it = [r for r in (found.train, found.held_out) if r.source == found.train.source]
        ends = [ended for rows in of_it if (ended := rows.ended_s) is not None]
        others = weigh_alternatives(found.fit, found.explained.found, found.explained.doubtful)
        known = replace(measure_uncertainty(found.fit, found.errors_anew), alternatives=others)
        return replace(found.model, uncertainty=known, ended_s=max(ends, default=None))

    @property
    def predictor(self) -> Predictor | None:
        """The network of the remaining error, if it lowered the error on the held-out rows."""
        return self.diagnosis.network

    @property
    def held_out(self) -> ErrorTable:
        """Errors of every model on the held-out rows."""
        commanded = {name: Errors.of(e) for name, e in self.diagnosis.proof.commanded.items()}
        return ErrorTable(self.diagnosis.proof.rows, commanded)

    def _repr_html_(self) -> str:
        return html_table(self.summary, self.held_out.rows)

    def __repr__(self) -> str:
        return f"DiagnosisResult({self.verdict}: {self.summary})"

    @cached_property
    def report(self) -> DiagnosisReport:
        """The content of report.json."""
        return build_report(self.diagnosis, self.session_hash)

    def save(self, folder: inputs.FilePath) -> Path:
        """Write all files of the diagnosis to a folder, and return the folder.

        They are report.json, report.html, plots and model.yaml; predictor.npz if a network helped;
        and next_poses.csv if more poses would tell effects apart or settle a doubt. `undo` restores
        the earlier model, if its file was given. Files of an earlier diagnosis are replaced or
        removed.
        """
        target = Path(folder)
        others = partial(self._write_others, target, (target / "report.json").is_file())
        write_report(self.report, detail(self.diagnosis, self.facts), target, others)
        return target

    def _write_others(self, target: Path, earlier: bool) -> None:
        before, path = self.model_before, target / inputs.MODEL
        stored = self._model_file(target)
        if before is not None and before.resolve() != path.resolve():
            write_bytes(path, before.read_bytes())
        save_model(path, stored)
        for name, write in ((inputs.PREDICTOR, self._write_predictor), (FILE, self._write_next)):
            if not write(target / name) and earlier:
                (target / name).unlink(missing_ok=True)

    def _model_file(self, folder: Path) -> StoredModel:
        found, model, at = self.diagnosis, self.model, self.session_file
        origin = self.model_before
        before = None if origin is None else read_stored(origin)
        intervals = {
            (slot.term, slot.parameter.name): (found.intervals[k].low, found.intervals[k].high)
            for k, slot in enumerate(model.slots)
        }
        added = {t.key for t in found.explained.chosen_terms}
        known = () if before is None else (*before.geometry, *before.effects, *before.camera)
        held = {(t.effect, t.where): t.origin for t in known}
        new = f"{found.verdict}, session {self.session_hash[:16]}, seed {found.seed}"
        origins = {
            number: new if term.key in added else held.get(term.key, "")
            for number, term in enumerate(model.terms)
        }
        provenance: dict[str, str | int | float] = {
            "session_hash": self.session_hash,
            "rows": len(found.train),
            "verdict": found.verdict,
            "seed": found.seed,
            "longarm_comp": __version__,
            inputs.MODEL_BEFORE: "" if origin is None else inputs.file_hash(origin),
            inputs.SESSION: "" if at is None else os.path.relpath(at, folder),
        }
        return store(
            model,
            None,
            version=1 if before is None else before.version + 1,
            provenance=provenance,
            origins=origins,
            intervals=intervals,
        )

    def _write_predictor(self, path: Path) -> bool:
        """Write the network for use with the model beside it; return False if it did not help."""
        if self.predictor is None:
            return False
        origin = self.predictor.provenance
        mark = {"model_hash": inputs.file_hash(path.with_name(inputs.MODEL)), "deflection": True}
        settings = {**origin.settings, **mark}
        bound = replace(origin, session_hash=self.session_hash, settings=settings)
        predictor_file.save(replace(self.predictor, provenance=bound), path)
        return True

    def _write_next(self, path: Path) -> bool:
        """Write the poses that separate effects or settle a doubt; tell whether there are any."""
        splits, more = self.diagnosis.splits, self.diagnosis.next_q
        if not splits and not len(more):
            return False
        q = np.concatenate([*(s.q for s in splits), more])
        sides = np.where(np.arange(len(more)) % 2, -1, 1)
        side = np.concatenate([*(s.approach[:, 0] for s in splits), sides])
        loads = [s.payload_kg for s in splits if s.payload_kg is not None]
        if loads and len(more):
            loads.append(np.full(len(more), np.max(np.concatenate(loads))))
        write_poses(Plan(q, side.astype(int), np.concatenate(loads) if loads else None), path)
        return True


def diagnose(
    arm: Arm,
    session: inputs.SessionLike,
    *,
    test: inputs.SessionLike | None = None,
    model: inputs.ModelLike | None = None,
    kind_of: Sequence[inputs.ModelLike] = (),
    network: bool = True,
    seed: int = 0,
    note: inputs.Note = inputs.log_note,
    progress: inputs.Telling = False,
) -> DiagnosisResult:
    """Find in a session the effects that a model lacks, add them, and prove them on held-out rows.

    Args:
        session: measurements, or their CSV or bag.
        test: held-out rows. Without them, blocks of the session are held out.
        model: known model, or its file. Its effects are not added again.
        kind_of: as in `calibrate`. Compliance that these arms have is expected of this arm too, and
            is no finding.
        network: whether to train a network on the remaining error.
        note: called with each finding of the admission.
        progress: True: print each step; or a function that is called with it.

    Raises:
        InputError: the data were refused, or a file cannot be used.
        JobError: a fit diverged.
    """
    known = None if model is None else inputs.choose_physics(arm, model)
    poses = FEW_POSES if kind_of else POSES
    whole = inputs.admit_session(session, arm, known, poses, note)
    held_out = None if test is None else inputs.admit_session(test, arm, known, 1, note)
    for rows in (whole, held_out):
        if rows is not None and not rows.placed.any():
            allowed = "rows that say where the tip is (longarm calibrate takes orientations alone)"
            raise InputError(rows.source, "x, y, z", "blank in all rows", allowed)
    if held_out is not None:
        held_out = _leave_out_copies(held_out, whole, note)
    kind, origin_of_kind = kind_from(arm, kind_of) if kind_of else (None, "")

    def train_on(fitted: Model, rows: Session) -> Predictor:
        origin = Provenance(arm.hash, rows.hash, arm.joint_names, {"deflection": True})
        return networks.train(*training_rows(fitted, rows), seed=seed, provenance=origin)

    found = core.diagnose(
        arm,
        whole,
        test=held_out,
        model=known,
        kind=kind,
        seed=seed,
        progress=inputs.make_teller(progress),
        train_network=train_on if network else None,
    )
    facts = {"session": _path_of(session).name, "arm": arm.hash, "rows": str(len(whole))}
    if test is not None and held_out is not None:
        facts |= {"hold-out": _path_of(test).name, "hold-out sha256": held_out.hash}
    facts |= {"kind of": origin_of_kind} if kind_of else {}
    before = None if model is None or isinstance(model, Model) else Path(model)
    if before is not None:
        facts["model before"] = inputs.file_hash(before)
    kinds = {type(term) for term in found.model.terms}
    facts |= {f"effect {k.name}": origin(k) for k in kinds if origin(k)}
    recorded = _path_of(session) if _path_of(session).exists() else None
    return DiagnosisResult(found, whole.hash, facts, before, recorded)


def _leave_out_copies(held_out: Session, fitted: Session, note: inputs.Note) -> Session:
    """Return the rows to hold out without those that are fitted, which would prove nothing."""
    copies = mark_copies(held_out, fitted)
    if copies.all():
        allowed = "rows that are not fitted; or none: then blocks of the session are held out"
        raise held_out.error("rows", f"all {len(copies)} are rows of {fitted.source}", allowed)
    if copies.any():
        note(f"{held_out.source}: {copies.sum()} of {len(copies)} rows left out: they are fitted")
    return held_out.take(~copies)


def diagnose_files(
    arm: Arm,
    session: Path,
    folder: Path,
    *,
    test: Path | None = None,
    model: Path | None = None,
    kind_of: Sequence[Path] = (),
    note: inputs.Note = inputs.log_note,
    progress: inputs.Telling = False,
    **how: Any,
) -> DiagnosisResult:
    """Diagnose files and write everything to a folder; arguments as in `diagnose`.

    Of refused data the report says why, unless the folder holds an earlier diagnosis.

    Raises:
        InputError: as `diagnose`; another process writes to the folder.
    """
    for path in (session, test, model, *kind_of):
        if path is not None and not path.exists():
            raise InputError(path, "file", "missing", "a file or a bag that exists")
    check_writable(folder)  # before the work
    with alone_in(folder):  # two would leave the report of one beside the model of the other
        if model is not None:
            inputs.choose_physics(arm, model)
        try:
            found = diagnose(
                arm,
                session,
                test=test,
                model=model,
                kind_of=kind_of,
                note=note,
                progress=progress,
                **how,
            )
        except InputError as error:
            if _holds_diagnosis(folder):
                note(f"{folder} keeps the diagnosis of before")
            else:
                of = inputs.file_hash(session)
                report = refused_report(error, how.get("seed", 0), of, model is not None)
                write_report(report, Detail(title=session.name), folder)
            raise
        inputs.make_teller(progress)("report")
        found.save(folder)
        return found


def _holds_diagnosis(folder: Path) -> bool:
    """Tell whether a folder has a report that says more than that data were refused."""
    try:
        return read_report(folder).verdict != "bad_data"
    except InputError:
        return (folder / "report.json").exists()


def _path_of(given: inputs.SessionLike) -> Path:
    """Return the path of a session; for a session in memory, its source as a path."""
    return Path(given.source if isinstance(given, Session) else given)
