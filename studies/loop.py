"""`longarm study loop`: how often the diagnosis names hidden effects, and nothing else.

Cases run in parallel on all cores, or on a dask cluster.  Every finished case is one line of a
JSON-lines file. Cases in the file are not run again.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.catalogue import LIBRARY
from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.workflows.cluster import spread
from studies.extra import extra
from studies.loop_cases import Case
from studies.loop_score import score
from studies.loop_setting import set_up


def run_case(case: Case, arm: Arm) -> dict[str, Any]:
    """Measure, diagnose and score one case. An error of the package is recorded as its result."""
    started = time.process_time()
    record: dict[str, Any] = {"case": case.as_dict()}
    try:
        setting = set_up(case, arm)
        gone = set(case.effects) if case.group == "removed" else set()
        kinds = [kind for kind in LIBRARY if kind.name not in gone]
        found = diagnose(setting.arm, setting.train, test=setting.held_out, kinds=kinds, seed=1)
        record["cpu_s"] = round(time.process_time() - started, 2)
        record["result"] = score(setting, found)
    except LongarmError as error:
        record["error"] = str(error)
    return record


def run(
    cases: Sequence[Case],
    arm: Arm,
    out: Path,
    *,
    jobs: int = -1,
    dask: str | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> list[dict[str, Any]]:
    """Run the cases that are not in the file yet; return the lines of all cases in their order.

    Args:
        cases: cases to run.
        arm: as declared.
        out: JSON-lines file, one line per case; created or appended to.
        jobs: processes; -1 is one per core.  Not used with dask.
        dask: address of a scheduler (``tcp://host:8786``), or ``local`` for one on this machine.
        progress: called with the last finished case and the share of all.

    Raises:
        InputError: the file holds other data; dask is not installed or its scheduler not found.
        JobError: joblib is not installed.
    """
    wanted = {case.id for case in cases}
    done = {i: line for i, line in read(out).items() if i in wanted}
    left = [case for case in cases if case.id not in done]
    out.parent.mkdir(parents=True, exist_ok=True)
    with out.open("a", encoding="utf-8") as file:
        for line in _worked(left, arm, jobs, dask):
            file.write(json.dumps(line, allow_nan=False) + "\n")
            file.flush()
            done[line["case"]["id"]] = line
            if progress is not None:
                progress(line["case"]["id"], len(done) / len(cases))
    return [done[case.id] for case in cases]


def read(path: Path) -> dict[str, dict[str, Any]]:
    """The lines of a file by case; empty if there is no file.

    An incomplete last line is removed from the file.

    Raises:
        InputError: a line is not one of this study's.
    """
    if not path.is_file():
        return {}
    text = path.read_text(encoding="utf-8")
    whole, _, torn = text.rpartition("\n")
    if torn:
        os.truncate(path, len(whole.encode()) + 1 if whole else 0)
    records = {}
    for number, line in enumerate(whole.splitlines(), 1):
        try:
            parsed = json.loads(line)
            records[str(parsed["case"]["id"])] = parsed
        except (ValueError, TypeError, KeyError):
            raise InputError(path, f"line {number}", line, "a line of this study") from None
    return records


def _worked(
    cases: Sequence[Case], arm: Arm, jobs: int, dask: str | None
) -> Iterator[dict[str, Any]]:
    """The line of each case as it is done."""
    if dask is None:
        with extra():
            from joblib import Parallel, delayed

        pool = Parallel(n_jobs=jobs, return_as="generator_unordered", pre_dispatch="2*n_jobs")
        yield from pool(delayed(run_case)(case, arm) for case in cases)
        return
    workers = jobs if jobs > 0 else os.cpu_count() or 1
    tasks = [(case, arm) for case in cases]
    for (case, _), made in spread(run_case, tasks, dask, workers=workers, asked="study loop"):
        if isinstance(made, LongarmError):
            made = {"case": case.as_dict(), "error": str(made)}
        yield made
