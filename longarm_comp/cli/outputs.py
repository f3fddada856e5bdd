"""The rule by which every command may overwrite files.

No input is overwritten. An existing file is replaced only if its first and last bytes show that the
command wrote it. Files that people edit, like arm.yaml, and all other files stay. ``--force``
overrides this. Links are followed. Inputs must be regular files or folders, and numbers finite.
"""

import itertools
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import file_hash

_LOOKED_AT = 4096
"""Bytes at either end of a file in which its marks are looked for."""
Kind = Callable[[Path], bool]
"""A test that tells whether an existing file is one that the command writes, and may replace."""


def never(path: Path) -> bool:
    """Return False: an existing file may hold a person's edits, so it is never replaced."""
    return False


def with_marks(*marks: bytes) -> Kind:
    """Return a test for files that hold all of these marks in their first or last bytes."""

    def ours(path: Path) -> bool:
        ends = _read_ends(path)
        return all(mark in ends for mark in marks)

    return ours


def table(*columns: str, without: str = "") -> Kind:
    """Return a test for tables with the columns ``index`` (first) and these, but not `without`."""

    def ours(path: Path) -> bool:
        header = _read_ends(path).split(b"\n")[0].decode("utf-8", "replace").strip().split(",")
        fits = header[0] == "index" and set(columns) <= set(header)
        return fits and without not in header

    return ours


def folder(*names: str, told_by: str = "", schema: str = "") -> Kind:
    """Return a test for folders that hold none of the files ``names``, or those of an earlier call.

    Args:
        told_by: JSON file by which an earlier call is known.
        schema: its entry ``schema``; empty: any.
    """

    def ours(path: Path) -> bool:
        if not path.is_dir():
            return False
        if not any((path / name).exists() for name in names):
            return True
        try:
            told = json.loads((path / told_by).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return False
        return not schema or (isinstance(told, dict) and told.get("schema") == schema)

    return ours


def begun_folder(told_by: str) -> Kind:
    """Return a test for folders that are empty, or in which an earlier call left this file."""

    def ours(path: Path) -> bool:
        return path.is_dir() and ((path / told_by).is_file() or not any(path.iterdir()))

    return ours


def left_to_the_command(path: Path) -> bool:
    """Return True: the command itself refuses an existing folder or bag, or resumes it."""
    return True


def is_predictor(path: Path) -> bool:
    """Tell whether a file is a predictor, of the paper's network (npz) or another."""
    ends = _read_ends(path)
    return (b"PK\x03\x04" in ends and b"header.npy" in ends) or b"longarm/predictor" in ends


def session(path: Path) -> bool:
    """Tell whether a file is an imported session, unchanged since: by its hash in the mapping."""
    mapping = path.with_suffix(".mapping.yaml")
    if not (mapping.is_file() and path.is_file()):
        return False
    return f"session_sha256: {file_hash(path)}".encode() in mapping.read_bytes()


MODEL = with_marks(b"# Written by longarm")
URDF = with_marks(b"<robot", b"written by longarm export-urdf")
POSES = table("q1", without="repeat_id")
COMMANDS = table("q1", "status", "predicted_error_x")
PICTURE = with_marks(b"longarm")
_DIAGNOSED = "report.json", "report.html", "model.yaml", "predictor.npz", "next_poses.csv"
DIAGNOSIS = folder(*_DIAGNOSED, told_by="report.json", schema="longarm/diagnosis/1")


def json_text(data: object) -> str:
    """Return results as JSON text; NaN becomes null."""
    from pydantic import TypeAdapter

    written = TypeAdapter(Any).dump_json(data, indent=2, fallback=lambda array: array.tolist())
    return written.decode()


def diagnosis_files(path: Path) -> list[Path]:
    return [path / name for name in _DIAGNOSED]


def _read_ends(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            head = file.read(_LOOKED_AT)
            file.seek(max(0, path.stat().st_size - _LOOKED_AT))
            return head + file.read(_LOOKED_AT)
    except OSError:
        return b""


Beside = Callable[[Path], list[Path]]
"""A function that returns further files that are written with a file."""


class Output(click.Option):
    """An option that names a file or folder to write; `kind` tests existing ones."""

    def __init__(self, *words: Any, kind: Kind, beside: Beside | None = None, **named: Any) -> None:
        super().__init__(*words, **named)
        self.kind, self.beside = kind, beside or (lambda path: [])


def guard_outputs(command: click.Command, name: str) -> click.Command:
    """Return the command with ``--force``, and with a check of the rule before it runs.

    The check raises InputError for a file that may not be replaced, and for a number not finite.
    """
    run = command.callback
    assert run is not None
    for option in command.params:
        if isinstance(option, click.Option) and option.default == "":
            option.show_default = False
    outputs = [p for p in command.params if isinstance(p, Output)]
    if any(isinstance(p, click.Option) and "--force" in p.opts for p in command.params):
        return command  # made before
    if outputs:
        what = "Overwrite what exists, also an input."
        command.params.append(click.Option(["--force"], is_flag=True, help=what))

    def run_checked(*, force: bool = False, **given: Any) -> Any:
        from longarm_comp.core.files import check_regular

        read: list[Path] = []
        for param in command.params:
            value = given.get(param.name or "")
            for path in _find_parts(value, Path):
                check_regular(path)
                read += [] if isinstance(param, Output) else [path]
            for number in _find_parts(value, float):
                if not math.isfinite(number):
                    raise InputError(name, param.opts[0], number, "a finite number")
        for option in () if force else outputs:
            word = option.opts[0]
            for path in _find_parts(given.get(option.name or ""), Path):
                for made, other in itertools.product((path, *option.beside(path)), read):
                    if _is_same_file(made, other):
                        said = f"{made} is the input {other}"
                        raise InputError(name, word, said, "another file, or --force")
                if path.exists() and not option.kind(path):
                    said = f"{path} exists and is not a file that {name} writes"
                    raise InputError(name, word, said, "a file that does not exist, or --force")
        return run(**given)

    command.callback = run_checked
    return command


def _find_parts(value: Any, kind: type) -> Iterator[Any]:
    """Yield all objects of a type in a value, or in nested tuples and lists."""
    if isinstance(value, kind):
        yield value
    elif isinstance(value, tuple | list):
        for part in value:
            yield from _find_parts(part, kind)


def _is_same_file(one: Path, other: Path) -> bool:
    """Tell whether two paths are the same file; links are followed, and none need exist."""
    try:
        return one.samefile(other)
    except OSError:  # one does not exist
        return one.resolve() == other.resolve()
