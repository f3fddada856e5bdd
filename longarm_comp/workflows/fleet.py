"""Many arms at once: the newest session of each is diagnosed, and the arms are compared."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.identify.kind_of_arm import table
from longarm_comp.workflows.diagnose import diagnose_files
from longarm_comp.workflows.evaluate import evaluate

ARM, MODEL = "arm.yaml", "model.yaml"
_MEASURED = {(*kind.cells, kind.label)[0] for kind in KINDS.values()}


@dataclass(frozen=True)
class _Member:
    """One arm of a fleet: its name, its arm.yaml, its newest session, the model in use if any."""

    name: str
    arm: Path
    session: Path
    model: Path | None


@dataclass(frozen=True)
class Finding:
    """An effect that was found at an arm.

    Attributes:
        effect, where: name and places.
        of_kind: whether half of the arms of the kind, two at least, have it at that place.
    """

    effect: str
    where: str
    of_kind: bool = False


@dataclass(frozen=True)
class Diagnosed:
    """What the diagnosis of one arm said.

    Attributes:
        kind: number of its kind: arms of one table of rows share it.
        verdict: as in report.json; ``failed`` where there is none, and why in `summary`.
        in_use_mm: mean error of the model in use on the session; None where there is none.
        calibrated_mm, diagnosed_mm: mean held-out error of the geometry calibrated anew, and with
            what was found.
        findings: effects that were found.
    """

    name: str
    kind: int
    session: str
    rows: int
    verdict: str
    summary: str
    in_use_mm: float | None = None
    calibrated_mm: float | None = None
    diagnosed_mm: float | None = None
    findings: tuple[Finding, ...] = ()

    @property
    def drifted(self) -> bool:
        """Whether the model in use errs by much more than what a calibration of today leaves."""
        if self.in_use_mm is None or self.calibrated_mm is None:
            return False
        # Error of a model in use, in that of a calibration of today, from which the arm is another:
        # three quarters of the squared error came since
        return self.in_use_mm > 2.0 * self.calibrated_mm

    @property
    def row(self) -> dict[str, object]:
        """As one row of fleet.json."""
        return {**asdict(self), "drifted": self.drifted}


def members(folder: Path) -> list[_Member]:
    """The arms of a folder: a subfolder each with arm.yaml, or one arm.yaml and a session each."""
    if (folder / ARM).is_file():
        found = [_Member(s.stem, folder / ARM, s, None) for s in sessions(folder)]
    else:
        found = []
        for each in sorted(folder.iterdir()) if folder.is_dir() else ():
            if (each / ARM).is_file():
                held = sessions(each)
                if not held:
                    raise InputError(str(each), "session", "none", "a CSV or bag that measures")
                newest = max(held, key=lambda path: (path.stat().st_mtime, path.name))
                model = each / MODEL if (each / MODEL).is_file() else None
                found.append(_Member(each.name, each / ARM, newest, model))
    if not found:
        allowed = f"folders with {ARM} and a session each, or one {ARM} and a session an arm"
        raise InputError(str(folder), "fleet", "no arm", allowed)
    return found


def sessions(folder: Path) -> list[Path]:
    """Bags, and tables with joints and something measured."""
    bags = [path.parent for path in folder.glob("*/metadata.yaml")]
    return sorted([*bags, *filter(_measures, folder.glob("*.csv"))])


def _measures(path: Path) -> bool:
    with path.open(newline="", encoding="utf-8", errors="replace") as handle:
        header = {cell.strip() for cell in next(csv.reader(handle), [])}
    return "q1" in header and bool(header & _MEASURED) and "status" not in header


def fleet(
    folder: Path,
    output: Path,
    *,
    jobs: int = 1,
    network: bool = True,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> list[Diagnosed]:
    """Diagnose every arm of a folder, each into a folder of its own in `output`.

    Args:
        folder: as for `members`.
        jobs: processes.
        network: whether to train networks on what remains.
        progress: called with each finished arm and the share of all.
    """
    found = members(folder)
    tables = [table(Arm.load(member.arm)) for member in found]
    kinds = [tables.index(each) for each in tables]
    look = partial(_diagnosed, output=output, network=network, seed=seed)
    made: list[Diagnosed] = []
    if jobs == 1:
        results: Iterator[Diagnosed] = map(look, found, kinds)
    else:
        pool = ProcessPoolExecutor(jobs, mp_context=get_context("spawn"))
        results = pool.map(look, found, kinds)
    for one in results:
        made.append(one)
        progress(one.name, len(made) / len(found))
    if jobs != 1:
        pool.shutdown()
    return compared(made)


def _diagnosed(member: _Member, kind: int, *, output: Path, network: bool, seed: int) -> Diagnosed:
    arm, where = Arm.load(member.arm), str(member.session)
    try:
        found = diagnose_files(
            arm, member.session, output / member.name, network=network, seed=seed
        )
        in_use = None
        if member.model is not None:
            in_use = 1e3 * evaluate(arm, member.session, model=member.model)["calibrated"].mean
    except LongarmError as error:
        return Diagnosed(member.name, kind, where, 0, "failed", str(error))
    left = found.held_out
    return Diagnosed(
        member.name,
        kind,
        where,
        len(found.diagnosis.train) + len(found.diagnosis.held_out),
        found.verdict,
        found.summary,
        in_use,
        1e3 * left["calibrated"].mean,
        1e3 * left[list(left)[-1]].mean,
        tuple(Finding(f.name, ", ".join(f.where)) for f in found.findings),
    )


def compared(arms: Sequence[Diagnosed]) -> list[Diagnosed]:
    """The same, with what is found at arms of a kind told from what is one arm's own."""
    counts: Mapping[tuple[int, str, str], int] = Counter(
        (arm.kind, f.effect, f.where) for arm in arms for f in arm.findings
    )
    sizes = Counter(arm.kind for arm in arms)

    def told(arm: Diagnosed, f: Finding) -> Finding:
        count = counts[arm.kind, f.effect, f.where]
        return replace(f, of_kind=count >= 2 and 2 * count >= sizes[arm.kind])

    return [replace(arm, findings=tuple(told(arm, f) for f in arm.findings)) for arm in arms]
