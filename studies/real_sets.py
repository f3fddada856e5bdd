"""Every set of real arms: what calibration and diagnosis leave, as commanded, and what they state.

Every figure is of rows that were held out: by the stated split of a set, else each row once, and of
touches each place in turn, with the distance from the mean of the held-out touches of a point.  A
rigid fit that shares no code with the package stands beside it (`studies/own_rigid.py`).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.commanded import as_commanded, own_way
from longarm_comp.core.data.measurement import compute_touch_errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.proof import CALIBRATED
from longarm_comp.sessions.read import read_session
from longarm_comp.workflows.diagnose import diagnose
from studies import coverage
from studies.interval import mean_ci95
from studies.loop_cases import NAMES, Case
from studies.loop_setting import set_up
from studies.own_rigid import OwnRigid
from studies.real_sessions import Measured, every_robot
from studies.touch import EXAMPLE
from studies.touch import read as read_touches

CERTAIN = 0.95
"""Probability from which on a name is stated, and must be in what the other half finds."""
FILES = {
    "iiwa7": ("iiwa7/arm.yaml", "iiwa7/train.csv", "iiwa7/test.csv"),
    "iiwa14_touch": ("iiwa14_touch/arm.yaml", "iiwa14_touch/touches.csv", None),
    "gen3_touch": ("gen3_touch/arm.yaml", "gen3_touch/touches.csv", None),
    "ur10": ("ur10/arm.yaml", "ur10/train.csv", "ur10/test.csv"),
    "palletiser": ("palletiser/arm_coupled.yaml", "palletiser/rows.csv", None),
}
"""Sets in the files of the package: arm, rows, and the rows held out where they are stated."""
PANDAS = "touch_pandas"

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors (N,) at rows held out, m.

    Attributes:
        own: of the rigid fit by scipy.
        calibrated, written: as seen.
        calibrated_commanded, written_commanded: as a command would have them.
        inside: which of them the written model's 90 % radius holds, as commanded.
        found: the diagnosis; None where it refused, and what was calibrated stays.
        refused: why.
    """

    own: np.ndarray
    calibrated: np.ndarray
    written: np.ndarray
    calibrated_commanded: np.ndarray
    written_commanded: np.ndarray
    inside: np.ndarray
    found: Diagnosis | None = None
    refused: str = ""


def real_sets(folder: Path) -> Iterator[tuple[str, list[Measured]]]:
    """Yield the sets that a folder holds, by name.

    Raises:
        InputError: it holds none.
    """
    found: dict[str, list[Measured]] = {}
    if any((folder / name).exists() for name in ("dlr_justin", "wam_ur5")):
        found |= every_robot(folder)
    for name, (arm_file, rows, test) in FILES.items():
        if (folder / arm_file).exists():
            arm = Arm.load(folder / arm_file)
            held = None if test is None else read_session(folder / test, arm)
            found[name] = [Measured(arm, read_session(folder / rows, arm), held)]
    if (folder / PANDAS).exists():
        arm, files = Arm.load(EXAMPLE / "arm.yaml"), sorted((folder / PANDAS).glob("*.csv"))
        found[PANDAS] = [Measured(arm, read_touches(file, arm), None) for file in files]
    if not found:
        allowed = "one that holds " + ", ".join(("dlr_justin", "wam_ur5", PANDAS, *FILES))
        raise InputError("--data", "folder", folder, allowed)
    yield from found.items()


def judge_splits(part: Measured, say: Say) -> Iterator[HeldOut]:
    """Yield every split of an arm's rows."""
    for train, test in part.splits:
        touched = test is not None and not test.has_position.any()
        say("diagnosis")
        try:
            found = _diagnose(part.arm, train, test)
        except LongarmError as error:
            yield _keep_rigid(part.arm, train, test, str(error))
            continue
        say("own rigid fit")
        yield _touches(found) if touched else _rows(found)


def _diagnose(arm: Arm, train: Session, test: Session | None) -> Diagnosis:
    quiet: Say = lambda _: None  # noqa: E731
    made = diagnose(arm, train, test=test, network=False, note=quiet)
    return made.diagnosis


def _rows(found: Diagnosis) -> HeldOut:
    """Return rows that say where the tip is; fold by fold, as the proof has them."""
    own, inside = [], []
    for fold in found.folds:
        rows = fold.rows.take(fold.rows.has_position)
        own.append(OwnRigid.fit(found.arm, fold.fits[CALIBRATED].session).left(rows))
        judged = coverage.judge("", fold.fits[found.written], rows, commanded=True)
        inside.append(judged.error <= judged.radius)
    seen, told = (
        {name: np.linalg.norm(each, axis=1) for name, each in of.items()}
        for of in (found.proof.errors, found.proof.commanded)
    )
    written = found.written
    return HeldOut(
        np.concatenate(own), seen[CALIBRATED], seen[written], told[CALIBRATED], told[written],
        np.concatenate(inside), found,
    )  # fmt: skip


def _touches(found: Diagnosis) -> HeldOut:
    """Return touches of the place that was held out."""
    (fold,) = found.folds
    rows, before, after = fold.rows, fold.fits[CALIBRATED], fold.fits[found.written]
    own = OwnRigid.fit(found.arm, before.session).left(rows)
    told = [compute_touch_errors(as_commanded(f.model), own_way(rows)) for f in (before, after)]
    judged = coverage.judge_touches("", after, rows)
    seen = (compute_touch_errors(before.model, rows), compute_touch_errors(after.model, rows))
    return HeldOut(own, *seen, told[0], told[1], judged.error <= judged.radius, found)


def _keep_rigid(arm: Arm, train: Session, test: Session | None, why: str) -> HeldOut:
    """Return what stays where nothing is written: the rigid fit, at the rows held out if stated."""
    rows = train if test is None else test
    own = OwnRigid.fit(arm, train).left(rows)
    none = np.full(len(own), np.nan)
    return HeldOut(own, none, none, none, none, np.zeros(0, bool), refused=why)


def line(name: str, parts: Sequence[Measured], held: Sequence[HeldOut], say: Say) -> dict[str, Any]:
    """Return one set's figures, as ``--json`` has them."""

    def mean(field: str) -> float | None:
        values = np.concatenate([getattr(h, field) for h in held])
        values = values[np.isfinite(values)]
        return 1e3 * float(values.mean()) if len(values) else None

    fields = ("own", "calibrated", "written", "calibrated_commanded", "written_commanded")
    row: dict[str, Any] = {"set": name, "rows": sum(len(h.own) for h in held)}
    row |= {f"{field.replace('own', 'own_rigid')}_mm": mean(field) for field in fields}
    told = [h for h in held if h.found is not None]
    if told:
        before, after = (
            1e3 * np.concatenate([getattr(h, field) for h in told]) for field in fields[3:]
        )
        row["written_commanded_ci95_mm"] = list(mean_ci95(after)[1:])
        row["commanded_gain_ci95_mm"] = list(mean_ci95(before - after)[1:])
    inside = np.concatenate([h.inside for h in held])
    row["inside_p90"] = float(inside.mean()) if len(inside) else None
    say("names")
    row["names"], row["refused"] = _names(parts, held)
    return row


def _names(
    parts: Sequence[Measured], held: Sequence[HeldOut]
) -> tuple[list[dict[str, Any]], list[str]]:
    """List the names by a diagnosis of all rows to fit, and why any refused."""
    names, refused = [], [h.refused for h in held if h.refused]
    whole = [h.found for h in held] if len(held) == len(parts) else []
    for k, part in enumerate(parts):
        found = whole[k] if whole else None
        if not whole:
            try:
                found = _diagnose(part.arm, part.train, None)
            except LongarmError as error:
                refused.append(str(error))
        if found is not None:
            names += _list_names(found)
    return names, refused


def _list_names(found: Diagnosis) -> list[dict[str, Any]]:
    return [
        {
            "effect": f.name,
            "where": list(f.where),
            "probability": f.probability,
            "set": {name: share for name, share in f.chances if share > 0.0},
        }
        for f in found.findings
    ]


def halves(part: Measured, seed: int = 1) -> tuple[int, int]:
    """Count names that half of the poses states, and those that the other half's sets hold."""
    poses = np.unique(part.train.pose_id)
    drawn = np.random.default_rng(seed).permutation(poses)[: len(poses) // 2]
    mine = np.isin(part.train.pose_id, drawn)
    both = []
    for half in (part.train.take(mine), part.train.take(~mine)):
        try:
            both.append(_diagnose(part.arm, half, None).findings)
        except LongarmError:
            return 0, 0
    stated = kept = 0
    for these, others in (both, both[::-1]):
        names = [f.name for f in these
                 if len(f.names) == 1 and f.probability * f.chances[0][1] >= CERTAIN]  # fmt: skip
        stated += len(names)
        kept += sum(any(name in other.names for other in others) for name in names)
    return stated, kept


def overlap(counted: Sequence[tuple[int, int]]) -> dict[str, Any]:
    """Return names stated at 0.95 or more by the halves, and the share that the other half has."""
    stated, kept = (sum(each) for each in zip(*counted, strict=True))
    return {"halves_stated": stated, "halves_overlap": kept / stated if stated else None}


def simulate_sets(declared: Arm, count: int) -> Iterator[Measured]:
    """Yield sessions of simulated arms with one hidden effect each, in turn."""
    for k in range(count):
        name = NAMES[k % len(NAMES)]
        case = Case("single", (name,), False, "usual", "sobol", coverage.ROWS, 1.0, k, 0)
        setting = set_up(case, declared)
        yield Measured(setting.arm, setting.train, None)
