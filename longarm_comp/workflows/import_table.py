"""Tables of other programs as a session in memory; the command is `longarm import-data`."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.sessions.csv import read_csv
from longarm_comp.sessions.foreign import convert
from longarm_comp.workflows.inputs import FilePath


def import_table(
    files: FilePath | Sequence[FilePath],
    arm: Arm,
    *,
    units: Sequence[str] = (),
    names: Mapping[str, str] | None = None,
    like: FilePath | None = None,
    **told: str | None,
) -> Session:
    """Read CSV, TXT or XLSX of another program; several files make one session.

    Args:
        units: units of columns whose names have none, such as ``("mm", "deg")``.
        names: session column by the file's, ``{"A": "q1", "B": "q2:mm"}``.
        like: mapping of an earlier file of the same kind, instead of the other arguments.
        told: ``rotation``, ``sheet``, ``decimal``, ``join`` and ``sort``, as the options of
            `longarm import-data`.
    """
    options = convert.Options(tuple(units), dict(names or {}), arm=arm, **told)
    found = convert.import_table(files, options if like is None else options.like(Path(like)))
    with tempfile.TemporaryDirectory() as folder:
        csv = Path(folder) / "samples.csv"
        found.save(csv)
        session = read_csv(csv, arm)
    return replace(session, source=", ".join(file.name for file in found.files))
