"""Questions that are also flags: what is not given is asked, where there is somebody to ask."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import click

from longarm_comp.cli.signals import handled
from longarm_comp.core.errors import InputError, JobError


def agreed(question: str, yes: bool) -> bool:
    """Whether the user says yes; asked on the terminal unless it was said with ``--yes``."""
    if yes:
        return True
    try:
        with handled({signal.SIGINT: signal.default_int_handler}):
            return click.confirm(question, err=True)
    except click.Abort:
        raise JobError("there was no answer yes: answer the question, or use --yes") from None


@dataclass(frozen=True)
class Dialogue:
    """Questions of one command."""

    command: str
    yes: bool = False

    def ask(self, flag: str, text: str, allowed: str, default: str | None = None) -> str:
        """The answer to a question."""
        return str(self._prompted(flag, allowed, text, default=default))

    def choose(self, flag: str, text: str, choices: Sequence[str], default: str) -> str:
        """One of several answers. Raises InputError as `ask`."""
        kind = click.Choice(list(choices))
        return str(self._prompted(flag, ", ".join(choices), text, default=default, type=kind))

    def go_on(self, text: str) -> None:
        """Wait until the user says that it may go on; click.Abort: the user says no."""
        if self.yes:
            return
        answer = self._prompted("--yes", "--yes", f"{text} Go on?", default="y", type=bool)
        if not answer:
            raise click.Abort

    def _prompted(self, flag: str, allowed: str, text: str, **options: Any) -> Any:
        try:
            return click.prompt(text, err=True, **options)
        except click.Abort as abort:
            click.echo(err=True)  # the cursor stands behind the question
            if sys.stdin.isatty() or isinstance(abort.__context__, KeyboardInterrupt):
                raise
            raise InputError(
                self.command, flag, "missing", f"{allowed}; or a terminal that can ask you"
            ) from None


def attended() -> bool:
    """Whether somebody sits at a terminal."""
    return sys.stdin.isatty()


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """SIGTERM and SIGINT raise KeyboardInterrupt, so that what must be put back is."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with handled(dict.fromkeys((signal.SIGINT, signal.SIGTERM), interrupt)):
        yield


def by_name(command: str, flag: str, given: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Values of a flag ``NAME=VALUE`` that may be repeated."""
    values = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not equals or name not in names:
            raise InputError(command, flag, text, f"NAME=VALUE, names {', '.join(names)}")
        values[name] = value
    return values
