"""Schema, validation and text of report.json."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, Field, GetPydanticSchema

from longarm_comp.core.data.set_aside import SharedBy
from longarm_comp.core.effects.units import in_names
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.candidate_states import TriedCandidate
from longarm_comp.core.identify.discover.causes import Cause
from longarm_comp.core.identify.findings import Finding, ReportPart
from longarm_comp.core.identify.proof import NETWORK
from longarm_comp.core.yaml_file import parse_declared

DIGITS = 12
"""Significant digits of every number in report.json, as the last bits differ by machine."""


def _read_as(choice: Any) -> GetPydanticSchema:
    """Let a field of type text accept only the values of `choice` when a file is read."""
    return GetPydanticSchema(lambda _, handler: handler(choice))


Verdict = Annotated[
    str, _read_as(Literal["noise", "named", "set", "partly", "unknown", "bad_data"])
]
Stage = Annotated[
    str,
    _read_as(
        Literal[
            "nominal", "frames_only", "calibrated", "with_effects", "with_functions", "with_network"
        ]
    ),
]
Source = Annotated[str, _read_as(Literal["repeats", "residual"])]
Interval = tuple[float, float]
T = TypeVar("T")


class StructureLeft(ReportPart):
    """Dependence on the inputs that no accepted effect explains, also as a sentence."""

    flag: bool
    text: str = ""
    p_value: float | None = Field(default=None, ge=0, le=1)
    share_explained: float | None = None
    inputs: Sequence[str]
    size_mm: float | None = Field(default=None, ge=0)


class ReportNoise(ReportPart):
    """Standard deviation per axis, and correlation from one row to the next."""

    sigma_mm: tuple[float, float, float] | None = None
    source: Source | None = None
    rho: float | None = Field(default=None, ge=-1, le=1)


class ErrorRow(ReportPart):
    """Errors of one model on the held-out rows."""

    model: Stage
    mean_mm: float = Field(ge=0)
    commanded_mean_mm: float | None = Field(default=None, ge=0)
    rms_mm: float = Field(ge=0)
    p95_mm: float = Field(ge=0)
    max_mm: float = Field(ge=0)
    mean_abs_z_mm: float = Field(ge=0)
    variance_mm2: float = Field(ge=0)
    excess_mm: float = Field(ge=0)
    mean_mrad: float | None = Field(ge=0)


class HeldOut(ReportPart):
    """Errors on the held-out rows, which were never fitted.

    `before` and `after` are the stages that the verdict compares. The two intervals are of the fall
    of the mean error between them: as seen, and as a command would have it. `not_commanded` says
    what the latter leaves out.
    """

    n: int = Field(ge=0)
    rows: Sequence[ErrorRow]
    before: Stage | None = None
    after: Stage | None = None
    before_after_ci95_mm: Interval | None = None
    commanded_ci95_mm: Interval | None = None
    not_commanded: Sequence[str] = ()


class Outlier(ReportPart):
    """A row that was left out, and why; `point` is the user's own name of the row, if any."""

    index: int
    why: str
    point: str = ""


class Written(ReportPart):
    """The name of the written model, and the error that a command may expect of each model.

    `believed_mm` are the mean errors as commanded of the model before and of this one, at the
    held-out rows that were not set aside.
    """

    model: Stage
    expected_commanded_mm: dict[str, float]
    believed_mm: Interval | None = None


class Doubtful(ReportPart):
    """An effect that is more likely there than not, but less than 95 %; it was not added."""

    effect: str
    where: Sequence[str]
    probability: float = Field(ge=0, le=1)


class ReportProof(ReportPart):
    """The proof, at rows that were not fitted, that findings lower the error as commanded."""

    folds: int
    rows: int
    passed: bool
    why: str


class ReportSetAside(ReportPart):
    """Rows that the fit set aside, their share of all rows, and properties that they share."""

    rows: int
    share: float
    shared_by: Sequence[SharedBy]


class ReportProvenance(ReportPart):
    """The data needed to repeat the diagnosis byte for byte.

    `holdout_uses` says how often each row was held out; `model_given` whether a model was given,
    which the stage ``nominal`` then is.
    """

    seed: int
    data_sha256: str
    version: str
    holdout_uses: Sequence[str]
    model_given: bool = False


class DiagnosisReport(ReportPart):
    """A diagnosis, as report.json holds it."""

    schema_: Literal["longarm/diagnosis/1"] = Field(alias="schema")
    verdict: Verdict
    summary: str = Field(min_length=1)
    findings: Sequence[Finding]
    candidates: Sequence[TriedCandidate]
    structure_left: StructureLeft
    noise: ReportNoise
    held_out: HeldOut
    proof: ReportProof | None = None
    set_aside: ReportSetAside | None = None
    next_poses: Sequence[Sequence[float]]
    outliers: Sequence[Outlier]
    discovered: Sequence[Cause] = ()
    none_of_these: float | None = Field(default=None, ge=0, le=1)
    written: Written | None = None
    doubtful: Sequence[Doubtful] = ()
    called: dict[str, str] = Field(default={})
    provenance: ReportProvenance

    @property
    def mean_errors(self) -> tuple[Interval | None, Interval | None]:
        """Mean held-out errors of the model before and the written one, mm, each None if unknown.

        The first pair is as commanded, the second as seen.
        """
        rows = {row.model: row for row in self.held_out.rows}
        before, after = rows.get("nominal"), rows.get(self.written.model if self.written else "")
        if before is None or after is None:
            return None, None
        seen = (before.mean_mm, after.mean_mm)
        if before.commanded_mean_mm is None or after.commanded_mean_mm is None:
            return None, seen
        return (before.commanded_mean_mm, after.commanded_mean_mm), seen

    @property
    def nothing_gained(self) -> str:
        """Say why the written model is not worth applying; empty if it is.

        It is if anything was found, if a network helps, or if the calibration alone lowers the mean
        held-out error by a tenth.
        """
        found = self.findings or any(cause.kept for cause in self.discovered)
        if found or self.held_out.after == NETWORK:
            return ""
        believed = self.written.believed_mm if self.written else None
        commanded, seen = self.mean_errors
        pair = believed or commanded or seen  # gross errors would hide what is gained
        if pair is None:
            return "No held-out error is known"
        before, after = pair
        said = f"Held-out mean error of the model in use {before:.3f} -> {after:.3f} mm"
        return "" if after < 0.9 * before else said

    def for_people(self) -> DiagnosisReport:
        """Return the same report with joints by their names instead of by rows of arm.yaml."""
        named: DiagnosisReport = map_values(self, str, lambda text: in_names(text, self.called))
        return named


def parse_report(report: dict[str, Any]) -> DiagnosisReport:
    """Check the contents of a report.json.

    Raises:
        InputError: a key is missing or unknown, a value of the wrong kind, a number not finite.
    """
    return parse_declared(DiagnosisReport, report, "report.json")


def read_report(folder: str | Path) -> DiagnosisReport:
    """Read the report.json in the folder of a diagnosis.

    Raises:
        InputError: the folder has no report, or the file is not a report.
    """
    path = Path(folder) / "report.json"
    try:
        return parse_report(json.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        why = error.strerror or str(error)
        raise InputError(path, "file", why, "a folder that longarm diagnose wrote") from error
    except (ValueError, RecursionError) as error:
        raise InputError(path, "json", str(error), "a report that longarm wrote") from error


def text(report: DiagnosisReport) -> str:
    """Return the text of report.json: keys in the schema's order, numbers to `DIGITS` digits."""
    plain = report.model_dump(mode="json", by_alias=True)
    # + 0.0: no negative zero
    short = map_values(plain, float, lambda v: float(f"{v:.{DIGITS}g}") + 0.0)
    return json.dumps(short, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def map_values(value: Any, kind: type[T], to: Callable[[T], T]) -> Any:
    """Return a copy with `to` applied to every float or str in records, lists and mappings.

    Args:
        kind: the type of the values, float or str.
    """
    if isinstance(value, kind):
        return to(value)
    if isinstance(value, BaseModel):
        return value.model_copy(update={name: map_values(v, kind, to) for name, v in value})
    if isinstance(value, list | tuple):
        return type(value)(map_values(entry, kind, to) for entry in value)
    if isinstance(value, dict):
        return {key: map_values(entry, kind, to) for key, entry in value.items()}
    return value
