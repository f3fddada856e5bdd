"""Arguments and options that several commands share, so that they look the same everywhere."""

from __future__ import annotations

from pathlib import Path

import click

_PATH = click.Path(path_type=Path)  # type: ignore[type-var]

arm = click.argument("arm", type=_PATH, metavar="ARM")
session = click.argument("session", type=_PATH, metavar="SESSION")
model = click.option("--model", type=_PATH, help="Calibrated model.yaml.")
predictor = click.option("--predictor", type=_PATH, help="Trained predictor file.")
seed = click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Random seed."
)
as_json = click.option("--json", "as_json", is_flag=True, help="Print results as JSON.")


def output(default: str | None, what: str):  # type: ignore[no-untyped-def]
    """``-o PATH``."""
    return click.option(
        *("-o", "--output"), type=_PATH, default=default, required=default is None,
        show_default=default is not None, help=what,
    )  # fmt: skip


def path_option(name: str, what: str, required: bool = False):  # type: ignore[no-untyped-def]
    """An option that takes a path."""
    return click.option(name, type=_PATH, required=required, help=what)
