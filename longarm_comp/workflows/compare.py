"""Two diagnoses, two models or two sessions side by side: what is the same, what changed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import SAME_POSE
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.units import for_people
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model_file import StoredModel, StoredTerm, read_stored
from longarm_comp.report.record import DiagnosisReport, read_report
from longarm_comp.sessions.read import read_session

FEWEST = 5
"""Common poses of two sessions from which on their tips are compared."""
MOST = 5
"""Number of changes of geometry shown, of each unit."""
Cell = str | float | None


@dataclass(frozen=True)
class _ComparisonTable:
    """Rows side by side."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


@dataclass(frozen=True)
class _Comparison:
    """What came of it.

    Attributes:
        kind: ``diagnoses``, ``models`` or ``sessions``.
    """

    kind: str
    said: tuple[str, ...]
    tables: tuple[_ComparisonTable, ...]


def compare(a: Path, b: Path, arm: Arm | None = None) -> _Comparison:
    """Compare two of a kind: folders of diagnoses, model files, or sessions.

    Args:
        a, b: folder with a report.json, model.yaml, or CSV or bag.
        arm: of the sessions; not needed for the others.
    """
    kinds = tuple(map(_kind, (a, b)))
    if kinds[0] != kinds[1]:
        raise InputError(b, "kind", f"one of {kinds[1]}", f"one of {kinds[0]}, as {a}")
    if kinds[0] == "diagnoses":
        return of_diagnoses(read_report(a), read_report(b))
    if kinds[0] == "models":
        return of_models(read_stored(a), read_stored(b))
    if arm is None:
        raise InputError("compare", "--arm", "missing", "the arm.yaml of the sessions")
    return of_sessions(read_session(a, arm), read_session(b, arm))


def _kind(path: Path) -> str:
    if not path.exists():
        raise InputError(path, "file", "missing", "a diagnosis, a model.yaml or a session")
    if (path / "report.json").is_file():
        return "diagnoses"
    return "models" if path.suffix in (".yaml", ".yml") else "sessions"


# ------------------------------------------------------------------ diagnoses


def of_diagnoses(a: DiagnosisReport, b: DiagnosisReport) -> _Comparison:
    """Verdicts, findings with their values, and held-out errors."""
    values = [_values_of_findings(each) for each in (a, b)]
    means = [{row.model: row for row in each.held_out.rows} for each in (a, b)]
    stages = dict.fromkeys((*means[0], *means[1]))
    errors = tuple(
        (
            stage,
            *(
                None if stage not in mine else getattr(mine[stage], name)
                for name in ("commanded_mean_mm", "mean_mm")
                for mine in means
            ),
        )
        for stage in stages
    )
    same = a.provenance.data_sha256 == b.provenance.data_sha256
    said = [
        f"Verdict {a.verdict} and {b.verdict}, of {'the same' if same else 'different'} data.",
        *_only({f.effect for f in a.findings}, {f.effect for f in b.findings}, "found"),
        *_moved(*values),
    ]
    left = [each.structure_left.text or "none" for each in (a, b)]
    facts: tuple[tuple[Cell, ...], ...] = (
        ("verdict", a.verdict, b.verdict),
        ("findings", *(", ".join(f.effect for f in each.findings) or "none" for each in (a, b))),
        ("structure left", *left),
        ("noise x, y, z, mm", *(_noise(each) for each in (a, b))),
        ("held-out rows", *(str(each.held_out.n) for each in (a, b))),
    )
    return _Comparison(
        "diagnoses",
        tuple(said),
        (
            _ComparisonTable("Outcome", ("", "A", "B"), facts),
            _ComparisonTable(
                "Held-out mean error, mm",
                ("model", "A, commanded", "B, commanded", "A, seen", "B, seen"),
                errors,
            ),
            _value_table(*values),
        ),
    )


@dataclass(frozen=True)
class Value:
    """A parameter in the unit that people read."""

    value: float
    unit: str
    ci95: tuple[float, float] | None

    @classmethod
    def of(cls, value: float, unit: str, ci95: tuple[float, float] | None) -> Value:
        """From SI."""
        times, name = for_people(unit)
        pair = None if ci95 is None else (times * ci95[0], times * ci95[1])
        return cls(times * value, name, pair)

    def __str__(self) -> str:
        """With its interval."""
        said = "" if self.ci95 is None else f" [{self.ci95[0]:.3g}, {self.ci95[1]:.3g}]"
        gap = "" if self.unit == "°" else " "
        return f"{self.value:.3g}{gap}{self.unit}{said}"


Values = Mapping[tuple[str, str, str], Value]


def _values_of_findings(report: DiagnosisReport) -> Values:
    return {
        (f.effect, p.where, p.name): Value.of(p.value, p.unit, p.ci95)
        for f in report.findings
        for p in f.parameters
    }


def _only(a: set[str], b: set[str], verb: str) -> list[str]:
    """Effects of both, and those of one alone."""
    parts = (("Both", a & b), ("Only A", a - b), ("Only B", b - a))
    return [f"{who} {verb} {', '.join(sorted(names))}." for who, names in parts if names]


def _moved(a: Values, b: Values) -> list[str]:
    """Values whose intervals do not meet."""
    said = []
    for key in a:
        one, two = a[key], b.get(key)
        if two is None or one.ci95 is None or two.ci95 is None:
            continue
        if one.ci95[1] < two.ci95[0] or two.ci95[1] < one.ci95[0]:
            grew = "grew" if abs(two.value) > abs(one.value) else "fell"
            said.append(f"{' '.join(key)} {grew} from {one} to {two}.")
    return said


def _value_table(a: Values, b: Values) -> _ComparisonTable:
    rows = tuple(
        (*key, *("–" if key not in each else str(each[key]) for each in (a, b)))
        for key in dict.fromkeys((*a, *b))
    )
    return _ComparisonTable("Values", ("effect", "where", "parameter", "A", "B"), rows)


def _noise(report: DiagnosisReport) -> str:
    sigma = report.noise.sigma_mm
    return "not known" if sigma is None else ", ".join(f"{s:.3f}" for s in sigma)


# ------------------------------------------------------------------ models


def of_models(a: StoredModel, b: StoredModel) -> _Comparison:
    """Effects and values; geometry by its largest changes."""
    if a.arm.hash != b.arm.hash:
        first, second = (f"{m.arm.name} {m.arm.hash[:12]}" for m in (a, b))
        raise InputError("compare", "arm", second, f"{first}, as the first model")
    effects = [_stored((*each.effects, *each.camera)) for each in (a, b)]
    geometry = [_stored(each.geometry) for each in (a, b)]
    names = [{key[0] for key in each} for each in effects]
    versions = f"Versions {a.version} and {b.version} of a model of {a.arm.name}."
    header = ("where", "parameter", "A", "B", "change")
    moved = _ComparisonTable("Geometry, largest changes", header, _largest_changes(*geometry))
    said = (versions, *_only(names[0], names[1], "had"), *_moved(*effects))
    return _Comparison("models", said, (_value_table(*effects), moved))


def _stored(terms: Iterable[StoredTerm]) -> Values:
    return {
        (t.effect, t.where, name): Value.of(p.value, p.unit, p.ci95)
        for t in terms
        for name, p in t.parameters.items()
    }


def _largest_changes(a: Values, b: Values) -> tuple[tuple[Cell, ...], ...]:
    """Of the geometry in both, the `MOST` largest of each unit."""
    both = [key for key in a if key in b and a[key].unit == b[key].unit]
    both.sort(key=lambda key: (a[key].unit, -abs(b[key].value - a[key].value)))
    rows = []
    for unit in dict.fromkeys(a[key].unit for key in both):
        mine = [key for key in both if a[key].unit == unit and a[key].value != b[key].value]
        rows += [
            (
                *key[1:],
                f"{a[key].value:.4g} {unit}",
                f"{b[key].value:.4g} {unit}",
                f"{b[key].value - a[key].value:+.3g} {unit}",
            )
            for key in mine[:MOST]
        ]
    return tuple(rows)


# ------------------------------------------------------------------ sessions


def of_sessions(a: Session, b: Session) -> _Comparison:
    """Rows and circumstances, and where the same commands put the tip."""
    facts: list[tuple[Cell, ...]] = [
        ("rows", *(str(len(each)) for each in (a, b))),
        ("marker seen", *(str(int(each.seen.sum())) for each in (a, b))),
    ]
    for name in dict.fromkeys((*a.columns, *b.columns)):
        facts.append((name, *(_range(each.columns.get(name)) for each in (a, b))))
    for k, joint in enumerate(f"q{j + 1}" for j in range(a.n)):
        facts.append((joint, *(_range(each.q[:, k]) for each in (a, b))))
    pairs = _common(a, b)
    said = [f"{len(pairs)} common poses."]
    tables = [_ComparisonTable("Sessions", ("", "A", "B"), tuple(facts))]
    if len(pairs) >= FEWEST:
        moved = 1e3 * np.array([b.xyz[k] - a.xyz[j] for j, k in pairs])
        length, mean = np.linalg.norm(moved, axis=1), moved.mean(axis=0)
        said.append(
            f"At these the tip moved by {length.mean():.2f} mm in the mean, {length.max():.2f} mm "
            f"at most; by ({mean[0]:+.2f}, {mean[1]:+.2f}, {mean[2]:+.2f}) mm all together."
        )
    return _Comparison("sessions", tuple(said), tuple(tables))


def _range(values: np.ndarray | None) -> str:
    held = values[np.isfinite(values)] if values is not None else np.zeros(0)
    return f"{held.min():.4g} .. {held.max():.4g}" if len(held) else "–"


def _common(a: Session, b: Session) -> list[tuple[int, int]]:
    """Rows of A and B at one pose, reached from the same sides."""
    rows = [np.flatnonzero(each.located) for each in (a, b)]
    if not (len(rows[0]) and len(rows[1])):
        return []
    one, two = (
        np.concatenate([each.q[held], each.approach[held]], axis=1)
        for each, held in zip((a, b), rows, strict=True)
    )
    _, found = cKDTree(two).query(one, p=np.inf, distance_upper_bound=SAME_POSE)
    return [(int(rows[0][j]), int(rows[1][k])) for j, k in enumerate(found) if k < len(two)]
