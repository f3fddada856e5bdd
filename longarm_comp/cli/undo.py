"""``longarm undo``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli.output import note


@click.command()
@click.argument("model", type=click.Path(path_type=Path), metavar="MODEL")
def command(model: Path) -> None:
    """Restore the version of MODEL before the last change, byte for byte.

    \b
    Example:
      longarm undo model.yaml
    """
    from longarm_comp.core.model.model_file import undo

    undo(model)
    note(f"{model} is the previous version again")
