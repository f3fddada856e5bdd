"""Real arms that touched sockets: what calibration and diagnosis leave at places held out in turn.

Every figure is the mean distance of the tips from the socket that they touched, solved from the
rows of the place that was held out.  Nothing else is known of these arms.  That place is the
hold-out of the diagnosis, too, which is opened once and selects nothing.
"""

import csv
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.cli import options
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.measuring import PRINTED
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.data.measurement import compute_touch_errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.workflows.diagnose import diagnose
from studies.commands import Figures, Show, study_command
from studies.interval import mean_ci95

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "panda_touch"
GAP = 0.05
"""Distance of the two sockets of a tool, m, as published."""
MODELS = ("nominal", "rigid", "diagnosed")

_STEPS = 25  # places of the six arms: for the bar only


@dataclass(frozen=True)
class Left:
    """Errors of the models at one place of one arm: (N,) distances by model, m; names found."""

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
        """Return the mean distance over all rows, mm."""
        return 1e3 * float(np.concatenate([p.spread[model] for p in self.places]).mean())

    @property
    def names(self) -> list[str]:
        """The names that the diagnoses found, the most frequent first."""
        return [name for name, _ in Counter(n for p in self.places for n in p.names).most_common()]


def read(path: Path, arm: Arm) -> Session:
    """Return the touches of one file."""
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


def _judge_places(name: str, arm: Arm, session: Session, say: Callable[[str], None]) -> Touched:
    location, made = session.labels["location"], []
    for place in np.unique(location):
        say(f"{name}, {place}")
        train, held = session.take(location != place), session.take(location == place)
        fits = dict(fit_stages(declared_model(arm), train))
        models = {"nominal": fits["frames_only"].model, "rigid": fits["geometry"].model}
        try:
            found = diagnose(arm, train, test=held)
            models["diagnosed"] = fit_model(found.model, train).model
            names = tuple(f"{f.name} {', '.join(f.where)}" for f in found.findings)
        except LongarmError as error:
            say(f"{name}, {place}: {error}")
            models["diagnosed"], names = models["rigid"], ()
        left = {key: compute_touch_errors(model, held) for key, model in models.items()}
        made.append(Left(str(place), left, names))
    return Touched(name, len(session), tuple(made))


def gains_mm(arms: list[Touched], model: str, than: str) -> tuple[float, float, float]:
    """Compute how much less a model leaves than another, mm: mean over places, 95 % interval.

    Places are drawn anew: touches of one place share its point.
    """
    by_place = [
        1e3 * float(p.spread[than].mean() - p.spread[model].mean()) for a in arms for p in a.places
    ]
    return mean_ci95(np.array(by_place))


def lines(arms: list[Touched]) -> list[dict[str, Any]]:
    """Return one row an arm, then all arms together, every row counted once."""
    made = []
    groups = [(a.arm, [a]) for a in arms] + [("all", arms)]
    for name, held in groups:
        together = Touched(name, sum(a.rows for a in held), sum((a.places for a in held), ()))
        row: dict[str, Any] = {"arm": name, "rows": together.rows, "places": len(together.places)}
        row |= {f"{model}_mm": round(together.mean_mm(model), 4) for model in MODELS}
        for model in MODELS:
            means = np.array([1e3 * p.spread[model].mean() for p in together.places])
            row[f"{model}_ci95_mm"] = [round(v, 4) for v in mean_ci95(means)[1:]]
        gain = gains_mm(held, "diagnosed", "rigid")
        row["gain_mm"], row["gain_ci95_mm"] = round(gain[0], 4), [round(g, 4) for g in gain[1:]]
        row["names"] = together.names
        made.append(row)
    return made


@study_command(
    options.path_option("--data", "Folder with a CSV an arm: location, socket, q1..q7.", True)
)
def command(data: Path, show: Show) -> Figures:
    """Errors of calibration and diagnosis at sockets held out in turn, on real arms.

    nominal: the data sheet, with the place of the ball; rigid: its geometry calibrated;
    diagnosed: with what a diagnosis of the same rows added.

    \b
    Example:
      longarm study touch --data touch_pandas --json
    """
    files = sorted(data.glob("*.csv"))
    if not files:
        raise InputError(str(data), "data", "no CSV", "a file an arm: location, socket, q1..q7")
    arm, steps = Arm.load(EXAMPLE / "arm.yaml"), iter(range(_STEPS))

    def say(text: str) -> None:
        show(text, next(steps, _STEPS) / _STEPS)

    found = lines([_judge_places(path.stem, arm, read(path, arm), say) for path in files])
    *arms, together = found
    shown = [{k: v for k, v in row.items() if k != "names" and "ci95" not in k} for row in found]
    gain = f"{together['gain_mm']} {together['gain_ci95_mm']} mm"
    means = (f"{k} {together[f'{k}_ci95_mm']}" for k in MODELS)
    names = (", ".join(row["names"]) or "nothing named" for row in arms)
    return Figures(
        {"arms": arms, "all": together},
        {"Mean distance from the touched point, each place held out in turn": shown},
        [
            f"diagnosed leaves less than rigid, over places: {gain}",
            "95 % of the means, over places, mm: " + ", ".join(means),
            *(f"{row['arm']}: {said}" for row, said in zip(arms, names, strict=True)),
        ],
    )
