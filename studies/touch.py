"""Real arms that touched sockets: what calibration and diagnosis leave at places held out in turn.

Every figure is the mean distance of the tips from the socket that they touched, solved from the
rows of the place that was held out.  Nothing else is known of these arms.  That place is the
hold-out of the diagnosis, too, which is opened once and selects nothing.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.measuring import PRINTED
from longarm_comp.core.calibration.calibrate import stages
from longarm_comp.core.calibration.fit import fit
from longarm_comp.core.data.measurement import spreads
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.workflows.diagnose import diagnose
from studies.interval import mean_ci95

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "panda_touch"
GAP = 0.05
"""Distance of the two sockets of a tool, m, as published."""
MODELS = ("nominal", "rigid", "diagnosed")

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Left:
    """What the models leave at one place of one arm: (N,) distances by model, m; names found."""

    place: str
    spread: dict[str, np.ndarray]
    names: tuple[str, ...]


@dataclass(frozen=True)
class Touched:
    """One arm, each place held out in turn."""

    arm: str
    rows: int
    places: tuple[Left, ...]

    def mean_mm(self, model: str) -> float:
        """Mean distance over all rows, mm."""
        return 1e3 * float(np.concatenate([p.spread[model] for p in self.places]).mean())

    @property
    def names(self) -> list[str]:
        """What the diagnoses found, the most frequent first."""
        return [name for name, _ in Counter(n for p in self.places for n in p.names).most_common()]


def study(folder: Path, progress: Progress | None = None) -> list[Touched]:
    """Every arm of a folder.

    Args:
        folder: one CSV an arm, with ``q1..q7``, ``location`` and ``socket``.
        progress: called with the arm and the place that is held out.

    Raises:
        InputError: there is no such file, or a column is missing.
    """
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise InputError(str(folder), "data", "no CSV", "a file an arm: location, socket, q1..q7")
    arm = Arm.load(EXAMPLE / "arm.yaml")
    return [
        _judged(path.stem, arm, read(path, arm), progress or (lambda _: None)) for path in files
    ]


def read(path: Path, arm: Arm) -> Session:
    """The touches of one file."""
    with path.open(newline="", encoding="utf-8") as handle:
        rows = list(csv.DictReader(handle))
    wanted = ("location", "socket", *(f"q{j}" for j in range(1, arm.n + 1)))
    for name in wanted:
        if not rows or name not in rows[0]:
            raise InputError(str(path), f"column {name}", "missing", ", ".join(wanted))
    location = np.array([row["location"] for row in rows])
    touch = np.array([f"{row['location']}_{row['socket']}" for row in rows])
    return Session.record(
        np.array([[float(row[name]) for name in wanted[2:]] for row in rows]),
        np.full((len(rows), 3), np.nan),
        labels={"touch": touch, "location": location},
        source=str(path),
        touch_distances=[(f"{p}_0", f"{p}_1", GAP, PRINTED) for p in np.unique(location)],
    )


def _judged(name: str, arm: Arm, session: Session, say: Progress) -> Touched:
    location, made = session.labels["location"], []
    for place in np.unique(location):
        say(f"{name}, {place}")
        train, held = session.take(location != place), session.take(location == place)
        fits = dict(stages(declared_model(arm), train))
        models = {"nominal": fits["frames_only"].model, "rigid": fits["geometry"].model}
        try:
            found = diagnose(arm, train, test=held)
            models["diagnosed"], names = fit(found.model, train).model, _named(found.findings)
        except LongarmError as error:
            say(f"{name}, {place}: {error}")
            models["diagnosed"], names = models["rigid"], ()
        left = {key: spreads(model, held) for key, model in models.items()}
        made.append(Left(str(place), left, names))
    return Touched(name, len(session), tuple(made))


def _named(findings: object) -> tuple[str, ...]:
    return tuple(f"{f.name} {', '.join(f.where)}" for f in findings)  # type: ignore[attr-defined]


def gains_mm(arms: list[Touched], model: str, than: str) -> tuple[float, float, float]:
    """By how much a model leaves less than another, mm: mean over places, and its 95 % interval.

    Places are drawn anew: touches of one place share its point.
    """
    by_place = [
        1e3 * float(p.spread[than].mean() - p.spread[model].mean()) for a in arms for p in a.places
    ]
    return mean_ci95(np.array(by_place))


def lines(arms: list[Touched]) -> list[dict[str, object]]:
    """One row an arm, then all arms together, every row counted once."""
    made = []
    groups = [(a.arm, [a]) for a in arms] + [("all", arms)]
    for name, held in groups:
        together = Touched(name, sum(a.rows for a in held), sum((a.places for a in held), ()))
        row: dict[str, object] = {
            "arm": name,
            "rows": together.rows,
            "places": len(together.places),
        }
        row |= {f"{model}_mm": round(together.mean_mm(model), 4) for model in MODELS}
        for model in MODELS:
            means = np.array([1e3 * p.spread[model].mean() for p in together.places])
            row[f"{model}_ci95_mm"] = [round(v, 4) for v in mean_ci95(means)[1:]]
        gain = gains_mm(held, "diagnosed", "rigid")
        row["gain_mm"], row["gain_ci95_mm"] = round(gain[0], 4), [round(g, 4) for g in gain[1:]]
        row["names"] = together.names
        made.append(row)
    return made
