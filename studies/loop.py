"""`longarm study loop`: how often the diagnosis names hidden effects, and nothing else.

Cases run in parallel on all cores, or on a cluster through joblib's dask backend.  Every finished
case is one line of a JSON-lines file. Cases in the file are not run again.
"""

from __future__ import annotations

import contextlib
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
from studies.extra import extra
from studies.loop_cases import Case
from studies.loop_score import score
from studies.loop_setting import set_up

ANSWER_S = 20.0
"""Time within which a scheduler must answer, s."""


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
    with extra():
        from joblib import Parallel, delayed

    wanted = {case.id for case in cases}
    done = {i: line for i, line in read(out).items() if i in wanted}
    left = [case for case in cases if case.id not in done]
    out.parent.mkdir(parents=True, exist_ok=True)
    with _engine(dask, jobs), out.open("a", encoding="utf-8") as file:
        pool = Parallel(n_jobs=jobs, return_as="generator_unordered", pre_dispatch="2*n_jobs")
        for line in pool(delayed(run_case)(case, arm) for case in left):
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


@contextlib.contextmanager
def _engine(address: str | None, jobs: int) -> Iterator[None]:
    """joblib's own processes, or a dask cluster."""
    if address is None:
        yield
        return
    try:
        from dask.distributed import Client, LocalCluster
        from joblib import parallel_config
    except ImportError:
        wanted = "pip install 'longarm_comp[cluster]'"
        raise InputError("study loop", "--dask", "not installed", wanted) from None
    with contextlib.ExitStack() as stack:
        target: Any = address
        if address == "local":
            workers = os.cpu_count() if jobs < 1 else jobs
            cluster = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None)
            target = stack.enter_context(cluster)
        try:
            client = stack.enter_context(Client(target, timeout=ANSWER_S))
        except (OSError, ValueError) as error:
            raise InputError("study loop", "--dask", address, f"a scheduler ({error})") from error
        client.wait_for_workers(1, timeout=60)
        stack.enter_context(parallel_config(backend="dask", wait_for_workers_timeout=60))
        yield
