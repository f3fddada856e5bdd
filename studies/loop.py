"""`longarm study loop`: how often the diagnosis names hidden effects, and nothing else.

Cases run in parallel on all cores, or on a dask cluster.  Every finished case is one line of a
JSON-lines file. Cases in the file are not run again.
"""

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from longarm_comp.cli import options, outputs
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.catalogue import LIBRARY
from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.workflows.cluster import run_tasks
from studies.commands import Figures, Show, arm_option, arms_option, study_command, whole_number
from studies.extra import extra
from studies.loop_cases import NAMES, Case, Design
from studies.loop_score import score
from studies.loop_setting import set_up
from studies.loop_table import by_effect, failures, reliability, summary


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
    done = {i: line for i, line in read_lines(out).items() if i in wanted}
    left = [case for case in cases if case.id not in done]
    for line in _run_cases(left, arm, jobs, dask):
        append_line(out, line)
        done[line["case"]["id"]] = line
        if progress is not None:
            progress(line["case"]["id"], len(done) / len(cases))
    return [done[case.id] for case in cases]


def append_line(path: Path, line: dict[str, Any]) -> None:
    """Add a line to a JSON-lines file, which is made where there is none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line, allow_nan=False) + "\n")


def read_lines(path: Path) -> dict[str, dict[str, Any]]:
    """Return the lines of a file by case; empty if there is no file.

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


def _run_cases(
    cases: Sequence[Case], arm: Arm, jobs: int, dask: str | None
) -> Iterator[dict[str, Any]]:
    """Yield the line of each case as it is done."""
    if dask is None:
        with extra():
            from joblib import Parallel, delayed

        pool = Parallel(n_jobs=jobs, return_as="generator_unordered", pre_dispatch="2*n_jobs")
        yield from pool(delayed(run_case)(case, arm) for case in cases)
        return
    workers = jobs if jobs > 0 else os.cpu_count() or 1
    tasks = [(case, arm) for case in cases]
    for (case, _), made in run_tasks(run_case, tasks, dask, workers=workers, asked="study loop"):
        if isinstance(made, LongarmError):
            made = {"case": case.as_dict(), "error": str(made)}
        yield made


@study_command(
    options.output(
        None,
        "JSON-lines file, one line per case. Cases in it are not run again.",
        outputs.with_marks(b"{"),
    ),
    arm_option,
    click.option("--groups", default="none,single,pair,removed,outside", show_default=True),
    click.option("--effects", help="Canonical names, separated by commas; all by default."),
    click.option("--plans", default="grid", show_default=True, help="grid, sobol, or both."),
    click.option(
        "--rows", default="300,60", show_default=True, help="Sample sizes, separated by commas."
    ),
    click.option(
        "--noises", default="1", show_default=True, help="Factors on the usual camera noise."
    ),
    arms_option(3, "Arms like the declared one."),
    whole_number("--repeats", 2, "Repetitions per arm."),
    whole_number("--pairs", 20, "Pairs per arm and size.", least=0),
    click.option(
        "--jobs", type=int, default=-1, show_default=True, help="Processes; -1: all cores."
    ),
    options.dask,
)
def command(
    output: Path, arm: Arm, groups: str, effects: str | None, plans: str, rows: str, noises: str,
    arms: int, repeats: int, pairs: int, jobs: int, dask: str | None, show: Show,
) -> Figures:  # fmt: skip
    """Benchmark the diagnosis on simulated arms with hidden effects.

    Cases run on all cores, or on a Dask cluster. After an interruption the same command continues.
    It ends with a table of shares with 95 % Wilson intervals.

    \b
    Examples:
      longarm study loop -o loop.jsonl
      longarm study loop -o loop.jsonl --groups none --rows 300 --repeats 12
      longarm study loop -o loop.jsonl --dask tcp://head:8786
    """
    design = Design(
        groups=groups.split(","),
        effects=NAMES if effects is None else effects.split(","),
        plans=plans.split(","),
        rows=_numbers("--rows", rows, int),
        noises=_numbers("--noises", noises, float),
        arms=arms,
        repeats=repeats,
        pairs=pairs,
    )
    lines = run(design.cases(), arm, output, jobs=jobs, dask=dask, progress=show)
    tables = {
        "summary": (f"{len(lines)} cases", summary(lines)),
        "by_effect": ("Visible single effects", by_effect(lines)),
        "reliability": ("Names by their stated probability", reliability(lines)),
    }
    broken = failures(lines)
    return Figures(
        {name: rows for name, (_, rows) in tables.items()} | {"failures": broken},
        dict(tables.values()),
        broken,
    )


def _numbers(name: str, text: str, kind: type) -> list:
    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        raise InputError("study loop", name, text, "numbers with commas between") from None
