"""The live table of a sweep: min, now, max of every joint, until Enter or until all is covered."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from longarm_comp.cli.dialogue import attended, enter_pressed

if TYPE_CHECKING:
    from rich.table import Table

    from longarm_comp.devices.servo_joint import JointConfig
    from longarm_comp.devices.servo_setup import ServoSetup, Sweep

_STILL_S = 1.0
"""Rest after which a hand has let go, and no joint is on its way to a stop."""
_COVERED = 0.98
"""Share of the declared range that counts as all of it."""


def swept(setup: ServoSetup, seconds: float | None) -> Sweep:
    """Sweep by hand.

    Args:
        seconds: at most so long, and until every joint has covered its declared range and the arm
            rests; None: until Enter.
    """
    from rich.console import Console
    from rich.live import Live

    end = None if seconds is None else time.monotonic() + seconds
    drawn = 0.0

    def done(sweep: Sweep, still_s: float) -> bool:
        if end is None:
            return enter_pressed()
        all_covered = all(share >= _COVERED for share in _shares(setup.joints, sweep).values())
        return time.monotonic() > end or (all_covered and still_s > _STILL_S)

    if not (attended() or sys.stderr.isatty()):
        return setup.sweep(done, lambda sweep: None)
    with Live(console=Console(stderr=True), auto_refresh=False) as live:

        def show(sweep: Sweep) -> None:
            nonlocal drawn
            if time.monotonic() - drawn > 0.1:
                drawn = time.monotonic()
                live.update(_table(setup.joints, sweep), refresh=True)

        return setup.sweep(done, show)


def _shares(joints: Mapping[str, JointConfig], sweep: Sweep) -> dict[str, float]:
    """Travel of each joint so far over its declared range."""
    return {
        name: sweep[joint.servo_id].span * joint.si_per_tick / (joint.upper - joint.lower)
        for name, joint in joints.items()
        if joint.servo_id in sweep
    }


def _table(joints: Mapping[str, JointConfig], sweep: Sweep) -> Table:
    from rich.table import Table

    from longarm_comp.devices.servo_setup import shown

    table = Table(title="Move every joint through its travel, then press Enter")
    for head in ("joint", "id", "min", "now", "max", "travel", "declared", "covered"):
        table.add_column(head, justify="left" if head == "joint" else "right")
    shares = _shares(joints, sweep)
    for name, joint in joints.items():
        travel = sweep.get(joint.servo_id)
        if travel is None:
            table.add_row(name, str(joint.servo_id), *["silent"] * 3)
            continue
        table.add_row(
            name, str(joint.servo_id), *map(str, (travel.low, travel.now, travel.high)),
            shown(joint, travel.span * joint.si_per_tick), shown(joint, joint.upper - joint.lower),
            f"{min(shares[name], 9.99):.0%}" + (" ✓" if shares[name] >= _COVERED else ""),
        )  # fmt: skip
    return table
