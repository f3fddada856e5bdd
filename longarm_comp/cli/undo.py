"""``longarm undo``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli.output import note


@click.command()
@click.argument("model", type=click.Path(path_type=Path), metavar="MODEL")
def command(model: Path) -> None:
    """Put the version of MODEL before the last change back, byte for byte.

    \b
    Example:
      longarm undo model.yaml
    """
    from longarm_comp.core.model.model_file import undo

    undo(model)
    note(f"{model} is the version before")
