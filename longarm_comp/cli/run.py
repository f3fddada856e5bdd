"""The root command: imports commands when they are run, prints errors, returns exit codes."""

import gc
import os
import sys
from collections.abc import Sequence

import click

from longarm_comp.cli.outputs import guard_outputs
from longarm_comp.cli.registry import COMMANDS, GROUPS, Entry
from longarm_comp.core.errors import JobError, LongarmError
from longarm_comp.version import __version__


class LazyGroup(click.Group):
    """A group that imports a command's module when the command is run."""

    def __init__(
        self, entries: Sequence[Entry], name: str, summary: str, folder: str = "longarm_comp.cli"
    ) -> None:
        super().__init__(name=name, help=summary, context_settings=_SETTINGS)
        self._folder = folder
        self._entries = {entry.name: entry for entry in entries if " " not in entry.name}
        for first, summary in GROUPS.items():
            mine = [e for e in entries if e.name.startswith(f"{first} ")]
            within = [e._replace(name=e.name[len(first) + 1 :]) for e in mine]
            if within:
                self.add_command(LazyGroup(within, first, summary))

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*self._entries, *self.commands]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        entry = self._entries.get(cmd_name)
        if entry is None:
            return super().get_command(ctx, cmd_name)
        command = entry.load(self._folder)
        return command if isinstance(command, click.Group) else guard_outputs(command, cmd_name)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Print the list of commands without importing any."""
        rows = [(name, entry.summary) for name, entry in self._entries.items()]
        rows += [(name, group.help or "") for name, group in self.commands.items()]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


_SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True}


_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""BLAS runs on one thread.

The matrices are small, and a second thread makes training three times slower.  numpy reads these
variables when it is first imported, so they are set before any command is."""


def root() -> click.Group:
    group = LazyGroup(
        COMMANDS,
        "longarm",
        "Calibration, diagnosis and error compensation of long, compliant robot arms.\n\n"
        "Exit codes: 0 done, 2 bad input, 3 the job could not be done.",
    )
    return click.version_option(__version__, prog_name="longarm")(group)


def run(arguments: Sequence[str] | None = None) -> int:
    return run_command(root(), arguments, "longarm")


def run_command(
    command: click.Command, arguments: Sequence[str] | None = None, name: str = ""
) -> int:
    """Run a command and return the exit code.

    Errors of the package are printed as one line. So are errors of the machine: a file that cannot
    be opened, a full disk, too little memory. Any other exception is a bug and is raised.
    """
    for pool in _POOLS:
        os.environ.setdefault(pool, "1")
    # Number of new objects after which Python looks for reference cycles. Libraries and figures
    # make many objects and few cycles. Python's default of 700 cost a short diagnosis 6 % of its
    # time
    gc.set_threshold(100_000, *gc.get_threshold()[1:])
    try:
        code = command.main(
            args=None if arguments is None else list(arguments),
            prog_name=name,
            standalone_mode=False,
        )
    except LongarmError as error:
        click.echo(f"longarm: {error}", err=True)
        return error.exit_code
    except BrokenPipeError:  # `longarm ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return JobError.exit_code
    except ModuleNotFoundError as error:
        name = (error.name or "").split(".")[0]
        built_for_ros = name.endswith(("_interfaces", "_msgs", "_srvs"))
        if not built_for_ros and name not in ("rclpy", "rpyutils"):
            raise
        way = "source ROS 2 Jazzy and its workspace, or run `make setup` in a checkout"
        click.echo(f"longarm: this command needs ROS 2 ({error.name} is missing): {way}", err=True)
        return JobError.exit_code
    except (OSError, MemoryError, RecursionError) as error:
        said = "the input is nested too deeply"
        if isinstance(error, OSError):
            named = [str(name) for name in (error.filename, error.filename2) if name is not None]
            said = ": ".join([*named, error.strerror or str(error)])
        elif isinstance(error, MemoryError):
            said = "not enough memory for this input"
        click.echo(f"longarm: {said}", err=True)
        return JobError.exit_code
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        click.echo("longarm: interrupted", err=True)
        return 130
    return code if isinstance(code, int) else 0
