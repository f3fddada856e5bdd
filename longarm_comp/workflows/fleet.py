"""Diagnoses the newest session of each of many arms, and compares the arms."""

import csv
import gc
import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from pydantic import TypeAdapter

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.kind_of_arm import describe_table
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.errors import InputError, JobError, LongarmError
from longarm_comp.core.files import check_regular, write_text
from longarm_comp.core.processes import starting_workers
from longarm_comp.sessions.csv import TOUCHES
from longarm_comp.version import __version__
from longarm_comp.workflows.cluster import run_tasks
from longarm_comp.workflows.diagnose import diagnose_files
from longarm_comp.workflows.evaluate import evaluate
from longarm_comp.workflows.inputs import file_hash

SCHEMA = "longarm/fleet/1"
WRITTEN, PAGE = "fleet.json", "fleet.html"

ARM, MODEL = "arm.yaml", "model.yaml"
_LONGEST_HEADER = 100_000
"""Bytes of a header that are read; `csv` accepts no longer cell."""
_MEASURED = {(*kind.cells, kind.label)[0] for kind in KINDS.values()}


@dataclass(frozen=True)
class _Member:
    """An arm of a fleet: its name, its arm.yaml, its newest session, and any model in use."""

    name: str
    arm: Path
    session: Path
    model: Path | None


@dataclass(frozen=True)
class FleetFinding:
    """An effect that was found at a place of an arm.

    Attributes:
        effect: its name; or the names that no row tells apart, joined by "or"; or the title of a
            cause without a name.
        tip_mm: displacement of the tip by the effect at all of its places; median, or RMS for a
            cause without a name.
        of_kind: whether half of the arms of the kind, at least two, have it at that place.
    """

    effect: str
    where: str
    tip_mm: float
    of_kind: bool = False


@dataclass(frozen=True)
class Diagnosed:
    """The result of one arm's diagnosis.

    Attributes:
        kind: number of the arm's kind; arms with the same table of DH rows share it.
        verdict: as in report.json; ``failed`` if there is none, with the reason in `summary`.
        in_use_mm: mean error of the model in use on the session; None if no model is in use.
        calibrated_mm, diagnosed_mm: mean held-out error of a new calibration of the geometry, and
            of the model that the diagnosis wrote.
        made_of: hash of the files and options from which the result was made.
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
    findings: tuple[FleetFinding, ...] = ()
    made_of: str = ""

    @property
    def has_drifted(self) -> bool:
        """True where the model in use errs by more than twice as much as a new calibration."""
        if self.in_use_mm is None or self.calibrated_mm is None:
            return False
        # Above twice the error of a new calibration, the arm counts as changed: three quarters of
        # the squared error arose since the model was made
        return self.in_use_mm > 2.0 * self.calibrated_mm

    @property
    def row(self) -> dict[str, object]:
        """The arm's row in fleet.json."""
        return {**asdict(self), "drifted": self.has_drifted}


_ROWS = TypeAdapter(tuple[Diagnosed, ...])


def list_members(folder: Path) -> list[_Member]:
    """List the arms of a folder, each with a session.

    If the folder has an arm.yaml, each session beside it is one arm. Otherwise each subfolder with
    an arm.yaml is one arm, with its newest session; its model.yaml, if any, is the model in use.

    Raises:
        InputError: there is no arm, a subfolder has no session, or a name is not unique or cannot
            be that of a folder.
    """
    if (folder / ARM).is_file():
        found = [_Member(s.stem, folder / ARM, s, None) for s in list_sessions(folder)]
    else:
        found = []
        for each in sorted(folder.iterdir()) if folder.is_dir() else ():
            if (each / ARM).is_file():
                held = list_sessions(each)
                if not held:
                    raise InputError(str(each), "session", "none", "a CSV or bag that measures")
                newest = max(held, key=lambda path: (path.stat().st_mtime, path.name))
                model = each / MODEL if (each / MODEL).is_file() else None
                found.append(_Member(each.name, each / ARM, newest, model))
    if not found:
        allowed = f"folders with {ARM} and a session each, or one {ARM} and a session an arm"
        raise InputError(str(folder), "fleet", "no arm", allowed)
    taken = {WRITTEN, PAGE}  # and each has a folder of its own in the output
    for member in found:
        if not member.name.strip(".") or member.name in taken:
            allowed = "a name that is no other arm's, and that a folder can have"
            raise InputError(str(member.session), "name of an arm", member.name, allowed)
        taken.add(member.name)
    return found


def list_sessions(folder: Path) -> list[Path]:
    """List the bags in a folder, and its CSV tables with joints and something measured."""
    found = [path.parent for path in folder.glob("*/metadata.yaml")]
    for path in folder.glob("*.csv"):
        check_regular(path)
        with path.open("rb") as file:
            first = file.readline(_LONGEST_HEADER).decode("utf-8-sig", "replace")
        header = {cell.strip() for cell in next(csv.reader([first]), [])}
        if "q1" in header and header & _MEASURED and "status" not in header:
            found.append(path)
    return sorted(found)


def fleet(
    folder: Path,
    output: Path,
    *,
    jobs: int = 1,
    dask: str | None = None,
    network: bool = True,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> list[Diagnosed]:
    """Diagnose every arm of a folder (`list_members`), each into a folder of its own in `output`.

    fleet.json is written after each arm. An arm whose result is in it already, from the same files
    and options, is not diagnosed again, unless it failed. An arm that cannot be diagnosed has the
    verdict ``failed``.

    Args:
        jobs: number of processes.
        dask: address of a scheduler whose workers see the same files, or ``local`` for one with
            `jobs` processes.
        network: whether to train networks on the remaining errors.
        progress: called with each finished arm and the share of all.

    Raises:
        InputError: as `list_members`; or an arm's output folder holds an arm.yaml or model.yaml
            without a report.json.
    """
    if dask is not None:  # workers may be in another folder
        folder, output = folder.resolve(), output.resolve()
    found = list_members(folder)
    tables = [_read_table(member.arm) for member in found]
    options = (__version__, network, seed)
    made: dict[str, Diagnosed] = {}
    for member in found:
        mine = output / member.name
        own = next((name for name in (ARM, MODEL) if (mine / name).exists()), "")
        if own and not (mine / "report.json").is_file():
            raise InputError(mine, "output", f"has {own}", "a new folder, or that of a diagnosis")
    known, left = _read_known(output / WRITTEN), []
    for member, rows in zip(found, tables, strict=True):
        beside = member.session.parent / TOUCHES
        more = [p for p in (member.model, beside) if p is not None and p.is_file()]
        files = [member.arm, member.session, *more]
        made_of = repr((*options, *map(file_hash, files)))
        kind, key = tables.index(rows), hashlib.sha256(made_of.encode()).hexdigest()
        before = known.get(member.name)
        there = (output / member.name / "report.json").is_file()
        if before is not None and before.made_of == key and before.verdict != "failed" and there:
            made[member.name] = replace(before, kind=kind)
        else:
            left.append((member, kind, key))
    look = partial(_diagnose_arm, output=output, network=network, seed=seed)
    for one in _diagnose_each(look, left, jobs, dask):
        made[one.name] = one
        _write_fleet(made.values(), output)
        progress(one.name, len(made) / len(found))
    told = compare_arms([made[member.name] for member in found])
    _write_fleet(told, output)
    return told


def _read_table(path: Path) -> object:
    """Return the DH table, which arms of one kind share; the path itself if it cannot be read."""
    try:
        return describe_table(Arm.load(path))
    except LongarmError:
        return path


def _read_known(path: Path) -> dict[str, Diagnosed]:
    """Read the arms of a fleet.json by name; none if it is missing or of another version."""
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["arms"]
        return {arm.name: arm for arm in _ROWS.validate_python(rows)}
    except (OSError, ValueError, TypeError, KeyError):
        return {}


def _write_fleet(arms: Iterable[Diagnosed], output: Path) -> None:
    text = json.dumps({"schema": SCHEMA, "arms": [arm.row for arm in arms]}, indent=1)
    write_text(output / WRITTEN, text + "\n")


def _diagnose_each(
    look: Callable[..., Diagnosed],
    left: Sequence[tuple[_Member, int, str]],
    jobs: int,
    dask: str | None,
) -> Iterator[Diagnosed]:
    """Diagnose the arms, in several processes if asked for; yield each result when it is done."""
    if dask is None and jobs == 1:
        yield from (look(*one) for one in left)
        return
    try:
        if dask is not None:
            for one, made in run_tasks(look, left, dask, workers=jobs, asked="fleet"):
                yield _failed_arm(*one, made) if isinstance(made, LongarmError) else made
            return
        with ExitStack() as stack:
            with starting_workers():
                pool = ProcessPoolExecutor(jobs, mp_context=get_context("spawn"))
                stack.enter_context(pool)
                begun = {pool.submit(look, *one) for one in left}
            for done in as_completed(begun):
                yield done.result()
    except BrokenProcessPool as error:
        why = "fleet: a process was killed, perhaps for want of memory"
        raise JobError(f"{why}: call again, with fewer --jobs") from error


def _failed_arm(member: _Member, kind: int, made_of: str, error: Exception) -> Diagnosed:
    why = str(error) if isinstance(error, LongarmError) else f"a fault of longarm: {error!r}"
    return Diagnosed(member.name, kind, str(member.session), 0, "failed", why, made_of=made_of)


def _diagnose_arm(
    member: _Member, kind: int, made_of: str, *, output: Path, network: bool, seed: int
) -> Diagnosed:
    try:
        arm = Arm.load(member.arm)
        found = diagnose_files(
            arm, member.session, output / member.name, network=network, seed=seed
        )
        in_use = None
        if member.model is not None:
            in_use = 1e3 * evaluate(arm, member.session, model=member.model)["calibrated"].mean
    except Exception as error:  # of this arm alone: the others are still diagnosed
        return _failed_arm(member, kind, made_of, error)
    left = found.held_out
    findings = [
        FleetFinding(" or ".join(sorted(f.names)), place, f.tip_mm.median if f.tip_mm else 0.0)
        for f in found.findings
        for place in f.where
    ] + [FleetFinding(c.title, c.where[0], c.tip_mm.rms) for c in found.report.discovered if c.kept]
    rows = len(found.diagnosis.train) + len(found.diagnosis.held_out)
    written = found.diagnosis.compared_stages[1]  # with the network, if there is one
    calibrated, diagnosed = (1e3 * left[name].mean for name in ("calibrated", written))
    made = Diagnosed(
        member.name,
        kind,
        str(member.session),
        rows,
        found.verdict,
        found.summary,
        in_use,
        calibrated,
        diagnosed,
        tuple(findings),
        made_of,
    )
    del found
    gc.collect()  # fits and postures refer to each other: a fleet would hold those of many arms
    return made


def compare_arms(arms: Sequence[Diagnosed]) -> list[Diagnosed]:
    """Set `FleetFinding.of_kind` in copies of the arms.

    It is True for a finding that at least half of the arms of a kind share, and at least two arms.
    """
    counts: Mapping[tuple[int, str, str], int] = Counter(
        (arm.kind, f.effect, f.where) for arm in arms for f in arm.findings
    )
    sizes = Counter(arm.kind for arm in arms)
    made = []
    for arm in arms:
        found = []
        for f in arm.findings:
            count = counts[arm.kind, f.effect, f.where]
            found.append(replace(f, of_kind=count >= 2 and 2 * count >= sizes[arm.kind]))
        made.append(replace(arm, findings=tuple(found)))
    return made
