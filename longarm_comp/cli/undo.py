"""``longarm undo``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli.output import note


@click.command()
@click.argument("model", type=click.Path(path_type=Path), metavar="MODEL")
def command(model: Path) -> None:
    """Restore the version of MODEL before the last change, byte for byte.

    The predictor beside it that belonged to that version comes back too. One that belongs to the
    version taken back is set aside. Nodes that run with these files notice.

    \b
    Example:
      longarm undo model.yaml
    """
    from longarm_comp.workflows.at_work import undo

    back = undo(model)
    note(f"{model} is the previous version again")
    if back is not None:
        note(f"{back} is the predictor that belongs to it")
