"""Schema, validation and text of report.json."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import ConfigDict, Field

from longarm_comp.core.effects.units import in_names
from longarm_comp.core.errors import InputError
from longarm_comp.core.yaml_file import Closed, parse_declared

SCHEMA = "longarm/diagnosis/1"
DIGITS = 12
"""Significant digits of every number in report.json, as the last bits differ by machine."""

Verdict = Literal["noise", "named", "set", "partly", "unknown", "bad_data"]
CandidateState = Literal["accepted", "rejected", "not_testable", "invisible"]
Stage = Literal[
    "nominal", "frames_only", "calibrated", "with_effects", "with_functions", "with_network"
]
Interval = tuple[float, float]
T = TypeVar("T")


class _Record(Closed):
    # What is written has every key, so the schema requires each
    model_config = ConfigDict(json_schema_serialization_defaults_required=True)


class FindingParameter(_Record):
    """A value of an accepted effect, in `unit`."""

    name: str
    where: str
    value: float
    unit: str
    ci95: Interval | None
    prior_scale: float | None = Field(gt=0)


class RunnerUp(_Record):
    """The next best candidate beside the one accepted."""

    effect: str
    log_bayes_factor: float


class TipSize(_Record):
    """What an effect moves the seen tip by, over the fitted rows."""

    median: float = Field(ge=0)
    max: float = Field(ge=0)


class ReportFinding(_Record):
    """An effect that was added, or the set of effects that it cannot be distinguished from.

    `probability` is that it is there; `set_probability` that each name of the set is its cause;
    `unnamed` is why a cause without a name may be there instead. `seen_mm` and `commanded_mm` are
    mean held-out errors without it, the rest fitted again, and with it: as measured, and as a
    command would have it.
    """

    effect: str
    title: str = ""
    reading: str = ""
    set: list[str]
    probability: float = Field(ge=0, le=1)
    set_probability: dict[str, float]
    unnamed: str = ""
    where: list[str]
    log_bayes_factor: float
    parameters: list[FindingParameter]
    runner_up: RunnerUp | None
    compensated: bool
    tip_mm: TipSize | None = None
    seen_mm: Interval | None = None
    commanded_mm: Interval | None = None
    doubts: list[str] = Field(default=[])
    action: str = ""

    @property
    def others(self) -> list[str]:
        """What these data do not tell it from."""
        return [name for name in self.set if name != self.effect]

    @property
    def open(self) -> bool:
        """Whether it may as well be something else."""
        return len(self.set) > 1 or bool(self.unnamed)


class ReportCandidate(_Record):
    """One candidate that was tried, or could not be."""

    effect: str
    where: str
    log_bayes_factor: float | None
    state: CandidateState
    why: str


class StructureLeft(_Record):
    """Dependence on the inputs that no accepted effect explains, also as a sentence."""

    flag: bool
    text: str = ""
    p_value: float | None = Field(default=None, ge=0, le=1)
    share_explained: float | None = None
    inputs: list[str]
    size_mm: float | None = Field(default=None, ge=0)


class ReportNoise(_Record):
    """Standard deviation per axis, and correlation from one row to the next."""

    sigma_mm: tuple[float, float, float] | None = None
    source: Literal["repeats", "residual"] | None = None
    rho: float | None = Field(default=None, ge=-1, le=1)


class ErrorRow(_Record):
    """Errors of one model on the hold-out."""

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


class HeldOut(_Record):
    """Errors on the held-out rows, which were never fitted.

    The intervals are of what the mean error falls by from `before` to `after`, the stages that
    the verdict compares: as seen, and as a command would have it. `not_commanded` says what the
    latter leaves out.
    """

    n: int = Field(ge=0)
    rows: list[ErrorRow]
    before: Stage | None = None
    after: Stage | None = None
    before_after_ci95_mm: Interval | None = None
    commanded_ci95_mm: Interval | None = None
    not_commanded: list[str] = Field(default=[])


class Outlier(_Record):
    """A row that was left out, and why; the user's own number of it where there is one."""

    index: int
    why: str
    point: str = ""


class DiscoveredTerm(_Record):
    """A coefficient of a cause without a name: value x function, at a place."""

    where: str
    function: str
    value: float
    ci95: Interval
    unit: str


class TipShift(_Record):
    """Shift of the tip over the fitted rows."""

    rms: float = Field(ge=0)
    max: float = Field(ge=0)


class ReportDiscovered(_Record):
    """A cause without a name. `set`: places that explain it alike; `kept`: it is in the model.

    `names` are effects of the library that may be the cause instead, with their probability.
    """

    frame: str
    component: str
    set: list[str]
    names: dict[str, float] = Field(default={})
    probability: float = Field(ge=0, le=1)
    formula: str
    terms: list[DiscoveredTerm]
    ci95: list[Interval]
    domain: list[str]
    reading: str
    title: str = ""
    action: str = ""
    doubts: list[str] = Field(default=[])
    log_evidence: float
    tip_mm: TipShift
    held_out_rms_mm: tuple[float, float]
    compensated: bool
    kept: bool


class Written(_Record):
    """Which model was written, and the error that a command may expect of each."""

    model: Stage
    expected_commanded_mm: dict[str, float]


class Doubtful(_Record):
    """An effect that is more likely there than not, but less than 95 %; it was not added."""

    effect: str
    where: list[str]
    probability: float = Field(ge=0, le=1)


class ReportProof(_Record):
    """Whether what was found errs less, as commanded, at rows that it was fitted without."""

    folds: int
    rows: int
    passed: bool
    why: str


class SharedInput(_Record):
    """What rows set aside have in common: an input, where in it, how many, by what chance."""

    input: str
    value: str
    rows: int
    p_value: float


class ReportSetAside(_Record):
    """Rows that the fit does not believe, their share of all, and what they share."""

    rows: int
    share: float
    shared_by: list[SharedInput]


class ReportProvenance(_Record):
    """What is needed to repeat the diagnosis to the byte.

    `holdout_uses` says how often each row was held out.
    """

    seed: int
    data_sha256: str
    version: str
    holdout_uses: list[str]


class DiagnosisReport(_Record):
    """A diagnosis, as report.json holds it."""

    schema_: Literal["longarm/diagnosis/1"] = Field(alias="schema")
    verdict: Verdict
    summary: str = Field(min_length=1)
    findings: list[ReportFinding]
    candidates: list[ReportCandidate]
    structure_left: StructureLeft
    noise: ReportNoise
    held_out: HeldOut
    proof: ReportProof | None = None
    set_aside: ReportSetAside | None = None
    next_poses: list[list[float]]
    outliers: list[Outlier]
    discovered: list[ReportDiscovered] = Field(default_factory=list)
    none_of_these: float | None = Field(default=None, ge=0, le=1)
    written: Written | None = None
    doubtful: list[Doubtful] = Field(default=[])
    called: dict[str, str] = Field(default={})
    provenance: ReportProvenance

    def for_people(self) -> DiagnosisReport:
        """The same with joints by their names instead of by rows of arm.yaml."""
        plain = self.model_dump(by_alias=True)
        named = mapped(plain, str, lambda text: in_names(text, self.called))
        return type(self).model_validate(named)


def checked(report: dict[str, Any]) -> DiagnosisReport:
    """The dict as a `DiagnosisReport`.

    Raises:
        InputError: a key is missing or unknown, a value of the wrong kind, a number not finite.
    """
    return parse_declared(DiagnosisReport, report, "report.json")


def read_report(folder: str | Path) -> DiagnosisReport:
    """The report.json in the folder of a diagnosis.

    Raises:
        InputError: the folder has no report, or the file is not a report.
    """
    path = Path(folder) / "report.json"
    try:
        return checked(json.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        why = error.strerror or str(error)
        raise InputError(path, "file", why, "a folder that longarm diagnose wrote") from error
    except (ValueError, RecursionError) as error:
        raise InputError(path, "json", str(error), "a report that longarm wrote") from error


def text(report: DiagnosisReport) -> str:
    """report.json: keys in the order of the schema, numbers to `DIGITS` digits."""
    plain = report.model_dump(mode="json", by_alias=True)
    # + 0.0: no negative zero
    short = mapped(plain, float, lambda v: float(f"{v:.{DIGITS}g}") + 0.0)
    return json.dumps(short, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def mapped(value: Any, kind: type[T], to: Callable[[T], T]) -> Any:
    """Lists and mappings with `to` of every value of a kind, float or str."""
    if isinstance(value, kind):
        return to(value)
    if isinstance(value, list | tuple):
        return [mapped(entry, kind, to) for entry in value]
    if isinstance(value, dict):
        return {key: mapped(entry, kind, to) for key, entry in value.items()}
    return value
