"""A running collection on the terminal: a table that follows it, or a line where it loses sight."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from longarm_comp.cli.output import note

if TYPE_CHECKING:
    from rich.console import RenderableType

    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.jobs.collect.progress import Progress


@contextmanager
def shown(arm: Arm, quiet: bool) -> Iterator[Callable[[Progress], None]]:
    """Called with every `Progress`: a live table on a terminal, notes elsewhere."""
    if not sys.stderr.isatty() or quiet:
        yield _Notes()
        return
    from rich.console import Console
    from rich.live import Live

    with Live(console=Console(stderr=True), refresh_per_second=4, transient=True) as live:
        yield lambda now: live.update(table(arm, now), refresh=True)


class _Notes:
    """A line when the marker was lost once more, and when the state changes."""

    def __init__(self) -> None:
        self._lost, self._state = 0, "running"

    def __call__(self, now: Progress) -> None:
        if len(now.lost) > self._lost:
            note(f"pose {now.visit}: marker lost: {now.lost[-1]}; {now.losses}")
        if now.state != self._state and now.state not in ("done", "ended"):
            note(str(now))
        self._lost, self._state = len(now.lost), now.state


def table(arm: Arm, now: Progress) -> RenderableType:
    """Where the collection is: bar, joints, seen and lost, error, time left."""
    from rich.console import Group
    from rich.markup import escape
    from rich.progress_bar import ProgressBar
    from rich.table import Table

    rows = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    rows.add_row("poses", f"{now.done} of {now.total}", ProgressBar(now.total, now.done, width=40))
    rows.add_row("state", escape(str(now) if now.state != "running" else f"pose {now.visit}"), "")
    if now.q is not None:
        rows.add_row("joints", _joints(arm, now.q), "")
    rows.add_row("marker seen", f"{now.seen} of {len(now.made)}", "")
    if now.losses:
        rows.add_row("", escape(now.losses), "")
    if math.isfinite(now.error_mm):
        rows.add_row("off the declared arm", f"{now.error_mm:.1f} mm", "")
    if math.isfinite(now.seconds_left):
        rows.add_row("time left", _minutes(now.seconds_left), "")
    return Group(rows, "Ctrl-Z pauses and goes on, Ctrl-C ends")


def _joints(arm: Arm, q: np.ndarray) -> str:
    """Joints in deg and mm."""
    sliding = [arm.joints[row - 1].type == "prismatic" for row in arm.commanded]
    values = (
        f"{1e3 * v:.0f} mm" if slides else f"{math.degrees(v):.1f}°"
        for v, slides in zip(q.tolist(), sliding, strict=True)
    )
    return "  ".join(values)


def _minutes(seconds: float) -> str:
    return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"
