"""``longarm sweep``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from longarm_comp.cli import options
from longarm_comp.cli.dialogue import agreed
from longarm_comp.cli.output import kept_if_broken_off, note, progress
from longarm_comp.cli.signals import on_graph
from longarm_comp.core.errors import JobError

if TYPE_CHECKING:
    import numpy as np


@click.command()
@options.arm
@click.option("--seconds", default=20.0, show_default=True,
              help="Least time of a joint for its whole range, s.")  # fmt: skip
@click.option("--margin", default=0.02, show_default=True,
              help="Distance from every limit, as a share of the joint's range.")  # fmt: skip
@click.option("--one-by-one", is_flag=True, help="One joint after another; default: all at once.")
@click.option("--yes", is_flag=True, help="Do not ask before the arm moves.")
@options.namespace
def command(
    arm: Path, seconds: float, margin: float, one_by_one: bool, yes: bool, namespace: str
) -> None:
    """Drive every joint of ARM to both of its limits and back.

    Play and friction depend on earlier moves, which are unknown after power-on. After the sweep
    kinematics knows them. The arm moves through its whole range: keep its surroundings clear. It
    moves only after you answer yes. Ctrl-C stops it where it is.

    \b
    Example:
      longarm sweep arm.yaml --seconds 30
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.jobs.sweep import sweep_joints

    began: list[bool] = []

    def kept() -> str:
        return "the joints stand where it ended; the same command starts again" if began else ""

    def agree(path: np.ndarray, takes: float) -> None:
        ask = f"Drive all {path.shape[1]} joints to both ends of their ranges ({takes:.0f} s)?"
        if not agreed(ask, yes):
            raise JobError("not swept: there was no answer yes")
        began.append(True)

    with (
        kept_if_broken_off(kept),
        on_graph("sweep", namespace, Arm.load(arm)) as client,
        progress("sweep") as show,
    ):
        moves = sweep_joints(
            client, range_s=seconds, margin=margin, together=not one_by_one, agree=agree,
            progress=show,
        )  # fmt: skip
    note(f"{moves} moves made; the joints are back where they were, and their history is known")
