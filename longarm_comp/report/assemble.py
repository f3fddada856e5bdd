"""Builds the contents of report.json from a diagnosis, deterministically."""

from collections import Counter

import numpy as np

from longarm_comp.core.data.commanded import not_commanded
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.findings import describe_structure
from longarm_comp.report import record
from longarm_comp.report.noise_floor import FIGURES, excess, floor_of
from longarm_comp.version import __version__


def build_report(diagnosis: Diagnosis, data_sha256: str) -> record.DiagnosisReport:
    """Return the contents of report.json for a diagnosis.

    Args:
        data_sha256: hash of the diagnosed rows.
    """
    structure, noise = diagnosis.structure, diagnosis.explained.noise
    # Noise of the first sensor, m, where it tells all of a place
    sigma = noise.sigma[:3]
    whole = diagnosis.train.blocks[0].kind in ("position", "touch") and np.isfinite(sigma).all()
    x, y, z = (1e3 * float(s) for s in sigma) if whole else (0.0, 0.0, 0.0)
    splitting = [q for by in diagnosis.splits for q in by.q]
    folds, rows = len(diagnosis.folds), len(diagnosis.held_out)
    uses = f"{rows} rows once, {f'{folds} folds' if folds > 1 else 'none of them fitted'}"
    report = record.DiagnosisReport(
        schema="longarm/diagnosis/1",
        verdict=diagnosis.verdict,
        summary=diagnosis.summary,
        findings=diagnosis.findings,
        candidates=diagnosis.candidates,
        structure_left=record.StructureLeft(
            flag=structure.flag,
            text=describe_structure(structure),
            p_value=None if structure.sign else structure.p_value,
            share_explained=structure.share_explained,
            inputs=structure.inputs,
            size_mm=1e3 * structure.size_m,
        ),
        noise=record.ReportNoise(
            sigma_mm=(x, y, z) if whole else None, source=noise.source, rho=float(noise.rho)
        ),
        held_out=_held_out(diagnosis),
        proof=record.ReportProof(
            folds=folds, rows=rows, passed=not diagnosis.failed, why=diagnosis.failed
        ),
        set_aside=record.ReportSetAside.model_validate(diagnosis.set_aside.record),
        next_poses=[q.tolist() for q in (*splitting, *diagnosis.next_q)],
        outliers=_list_outliers(diagnosis),
        discovered=diagnosis.causes,
        none_of_these=diagnosis.none_of_these,
        written=record.Written(
            model=diagnosis.written,
            expected_commanded_mm={k: 1e3 * v for k, v in diagnosis.expected.items()},
            believed_mm=_believed_errors(diagnosis),
        ),
        doubtful=[
            record.Doubtful(
                effect=f.name,
                where=list(dict.fromkeys(t.where for t in f.terms)),
                probability=f.presence,
            )
            for f in diagnosis.explained.doubtful
        ],
        called=diagnosis.arm.names_for_people,
        provenance=_provenance_of(diagnosis.seed, data_sha256, [uses], diagnosis.model_given),
    )
    held, floor = report.held_out, floor_of(report)
    beyond = [row.model_copy(update={"excess_mm": excess(row.rms_mm, floor)}) for row in held.rows]
    return report.model_copy(update={"held_out": held.model_copy(update={"rows": beyond})})


def refused_report(
    error: InputError, seed: int, data_sha256: str, model_given: bool
) -> record.DiagnosisReport:
    """Return the contents of report.json for data that were refused with an error."""
    return record.DiagnosisReport(
        schema="longarm/diagnosis/1",
        verdict="bad_data",
        summary=str(error),
        findings=[],
        candidates=[],
        structure_left=record.StructureLeft(flag=False, inputs=[]),
        noise=record.ReportNoise(),
        held_out=record.HeldOut(n=0, rows=[]),
        next_poses=[],
        outliers=[],
        provenance=_provenance_of(seed, data_sha256, [], model_given),
    )


def _provenance_of(
    seed: int, data_sha256: str, uses: list[str], model_given: bool
) -> record.ReportProvenance:
    return record.ReportProvenance(
        seed=seed,
        data_sha256=data_sha256,
        version=__version__,
        holdout_uses=uses,
        model_given=model_given,
    )


def _held_out(diagnosis: Diagnosis) -> record.HeldOut:
    """Return the errors on the held-out rows; what is beyond the noise floor is not known yet."""
    proof = diagnosis.proof
    rows = [
        record.ErrorRow(
            model=name,
            commanded_mean_mm=1e3 * float(np.linalg.norm(proof.commanded[name], axis=1).mean()),
            excess_mm=0.0,
            mean_mrad=None if e.angle is None else 1e3 * e.angle,
            **{key: e.mm[key] for key in FIGURES},
        )
        for name, e in proof.rows.items()
    ]
    before, after = diagnosis.compared_stages
    intervals = (diagnosis.seen_gain.ci95, diagnosis.commanded_gain.ci95)
    seen, commanded = (
        (1e3 * low, 1e3 * high) if after != "calibrated" else None for low, high in intervals
    )
    # What commands leave out: of the model to use, and of those that the proof is by
    left_out = not_commanded(diagnosis.model, diagnosis.held_out)
    folds = [not_commanded(f.fits[diagnosis.written].model, f.rows) for f in diagnosis.folds]
    other = Counter(said for fold in folds for said in fold if said not in left_out)
    left_out = [*left_out, *(f"{said} in {k} of {len(folds)} folds" for said, k in other.items())]
    return record.HeldOut(
        n=len(diagnosis.held_out),
        rows=rows,
        before=before,
        after=after,
        before_after_ci95_mm=seen,
        commanded_ci95_mm=commanded,
        not_commanded=left_out,
    )


def _believed_errors(diagnosis: Diagnosis) -> tuple[float, float] | None:
    kept = diagnosis.believed
    if not len(kept):
        return None
    commanded = diagnosis.proof.commanded
    names = "nominal", diagnosis.written
    before, after = (np.linalg.norm(commanded[name][kept], axis=1) for name in names)
    return 1e3 * float(before.mean()), 1e3 * float(after.mean())


def _list_outliers(diagnosis: Diagnosis) -> list[record.Outlier]:
    fit, rows = diagnosis.fit, list[record.Outlier]()
    points = fit.session.labels.get("point", np.full(len(fit.session), ""))
    noise = fit.stated_noise_ratio(fit.session)[:, None] * fit.sigma
    for row in fit.outliers:
        length = float(np.linalg.norm(fit.residual[row] * fit.metres))
        ratio = float(np.max(np.abs(fit.residual[row]) / noise[row]))
        why = f"{1e3 * length:.1f} mm off, {ratio:.0f} standard deviations on its worst axis"
        index = int(fit.session.index[row])
        rows.append(record.Outlier(index=index, why=why, point=str(points[row])))
    lost = fit.session.lost.items()
    return rows + [record.Outlier(index=k, why=f"not measured: {why}") for k, why in lost]
