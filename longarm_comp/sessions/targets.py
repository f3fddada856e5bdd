"""Targets (targets.csv) and the joint commands computed for them (commands.csv)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.target_frame import FRAMES
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.csv import UNITS, XYZ, joint_names, recorded_besides
from longarm_comp.sessions.names import check_header, check_unknown
from longarm_comp.sessions.table import FARTHEST, Table, WriteTable, read_table, write_table

QUATERNION = ("qx", "qy", "qz", "qw")
_UNIT_LENGTH = 1e-3  # a quaternion printed with few digits is this far from length 1


@dataclass(frozen=True, eq=False)
class Targets:
    """N points or poses to reach.

    Attributes:
        index: (N,) number of each target.
        xyz: (N, 3), m.
        quaternion: (N, 4) x, y, z, w of unit length; NaN rows leave the orientation free.
        approach: (N,) side that all joints are to arrive from, 0 for any.
        columns: further numbers by name, (N,) each, as in `Session.columns`.
        labels: text by name, (N,) each.
        frame: (N,) ``base`` or ``measured``; blank where it is not said.
    """

    index: np.ndarray
    xyz: np.ndarray
    quaternion: np.ndarray
    approach: np.ndarray
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)
    labels: Mapping[str, np.ndarray] = field(default_factory=dict)
    source: str = "targets"
    frame: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Number of targets."""
        return len(self.xyz)

    def context(self, n: int) -> Context:
        """Circumstances of the targets for an arm of n joints: scalars are (N,) arrays."""
        return Context(
            approach=(self.approach,) * n if self.approach.any() else (),
            columns=self.columns,
            labels=self.labels,
        )

    @classmethod
    def one(cls, numbers: Sequence[float]) -> Targets:
        """One target from the command line: x y z, or x y z qx qy qz qw."""
        values = np.asarray(numbers, dtype=float)
        if values.shape not in ((3,), (7,)) or not (np.abs(values) <= FARTHEST).all():
            allowed = f"x y z or x y z qx qy qz qw, up to {FARTHEST:g}"
            raise InputError("target", "numbers", list(numbers), allowed)
        free = np.full((1, 4), np.nan)
        single = cls(np.zeros(1, int), values[None, :3], free, np.zeros(1), source="target")
        if len(values) == 3:
            return single
        length = np.linalg.norm(values[3:])
        if abs(length - 1) > _UNIT_LENGTH:
            raise InputError("target", "qx qy qz qw", f"length {length:.4g}", "length 1")
        return dataclasses.replace(single, quaternion=values[None, 3:] / length)


@dataclass(frozen=True)
class Command:
    """One line of commands.csv.

    Attributes:
        status: ``success``, or the kind of failure in one word.
        reason: the failure in one sentence; empty on success.
        q: commanded joints (n,), rad and m; None without success.
        target: (3,) requested position, m, in its `frame`, as `predicted_error` is.
        predicted_error: expected error (3,), m; None where none was predicted.
        sigma_m: standard deviation of what the command leaves, the largest of the axes, m.
        passes: pseudo-target passes used.
        approach: (n,) side that each joint must arrive from for the prediction to hold; 0 any.
        run_up: (n,) via point from which the last approach begins; None: none needed.
        ideal: (n,) joints from the physics alone, or the joints before the command was chosen
            among the servos' steps.
        frame: ``base`` or ``measured``.
        expected_m, p90_m: expected distance of the tip from the target, and the one that 90 of
            100 such commands stay below, m; None where nothing says it.
    """

    index: int
    status: str
    reason: str
    q: np.ndarray | None
    target: np.ndarray
    predicted_error: np.ndarray | None = None
    sigma_m: float | None = None
    passes: int = 0
    approach: np.ndarray | None = None
    run_up: np.ndarray | None = None
    ideal: np.ndarray | None = None
    frame: str = ""
    expected_m: float | None = None
    p90_m: float | None = None


def read_targets(path: str | Path, read: Callable[[str | Path], Table] = read_table) -> Targets:
    """Read ``x,y,z[,qx,qy,qz,qw][,frame][,temperature_c,payload_kg,t_s,approach][,index]``.

    A row with a blank quaternion leaves the orientation free; other columns are kept as
    context, as in a session. ``read`` may know another form of the table.

    Raises:
        InputError: names file, line and column, what was found and what is allowed.
    """
    table = read(path)
    required = XYZ + (QUATERNION if any(name in table.header for name in QUATERNION) else ())
    known = (*XYZ, *QUATERNION, *UNITS, "approach", "index", "frame")
    check_header(table.where, table.header, required)
    check_unknown(table.where, table.header, known)
    xyz = np.stack([table.lengths(name) for name in XYZ], axis=-1)
    quaternion = np.full((len(table), 4), np.nan)
    if len(required) > len(XYZ):
        turns = [table.lengths(name, "unit quaternion", blanks=True) for name in QUATERNION]
        quaternion = np.stack(turns, axis=-1)
        length = np.linalg.norm(quaternion, axis=1)
        for row in range(len(table)):
            blanks = np.isnan(quaternion[row]).sum()
            if blanks not in (0, 4) or abs(length[row] - 1) > _UNIT_LENGTH:
                raise table.error(row, "qx", "a quaternion of length 1, or four blanks")
        quaternion = quaternion / length[:, None]
    approach = np.zeros(len(table))
    if "approach" in table.cells:
        sides = table.numbers("approach", "+1 or -1", True, lambda v: v in (-1.0, 0.0, 1.0))
        approach = np.nan_to_num(sides)
    columns, labels = recorded_besides(table, set(known))
    index = table.integers("index") if "index" in table.cells else np.arange(len(table))
    frame = tuple(cell.strip() for cell in table.cells.get("frame", ()))
    for row, name in enumerate(frame):
        if name not in ("", *FRAMES):
            raise table.error(row, "frame", " or ".join(FRAMES))
    return Targets(index, xyz, quaternion, approach, columns, labels, table.where, frame)


_OF_THE_MOVE = ("approach", "run_up", "ideal")


def _cells(values: np.ndarray | None, n: int) -> list[float | None]:
    return [None] * n if values is None else list(values)


def write_commands(
    path: str | Path,
    n: int,
    commands: Sequence[Command],
    write: WriteTable = write_table,
    further: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write commands.csv for an arm of n joints, whole or not at all; ``further`` columns last."""
    more = further or {}
    header = [
        *("index", "status", "reason", *joint_names(n)),
        *("target_x", "target_y", "target_z"),
        *("predicted_error_x", "predicted_error_y", "predicted_error_z", "sigma_mm", "passes"),
        *("expected_mm", "p90_mm", "frame"),
        *(f"{kind}_{name}" for kind in _OF_THE_MOVE for name in joint_names(n)),
        *more,
    ]
    rows = []
    for k, c in enumerate(commands):
        q = [None] * n if c.q is None else list(c.q)
        lengths = (c.sigma_m, c.expected_m, c.p90_m)
        error = [None] * 3 if c.predicted_error is None else list(c.predicted_error)
        sigma_mm, *expected = (None if v is None else 1e3 * v for v in lengths)
        move = [value for kind in _OF_THE_MOVE for value in _cells(getattr(c, kind), n)]
        said = [c.index, c.status, c.reason, *q, *c.target, *error, sigma_mm, c.passes]
        rows.append([*said, *expected, c.frame, *move, *(float(x[k]) for x in more.values())])
    write(path, header, rows)
