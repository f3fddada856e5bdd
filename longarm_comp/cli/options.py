"""Arguments and options that several commands share."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli.output import JSON
from longarm_comp.cli.outputs import Beside, Kind, Output

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm as Arm
    from longarm_comp.jobs.client import Pace

    Paced = Callable[..., Pace]

_Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

_PATH = click.Path(path_type=Path)  # type: ignore[type-var]


def path_argument(name: str, metavar: str, **more: Any) -> _Decorator:
    return click.argument(name, type=_PATH, metavar=metavar, **more)


arm_file = path_argument("arm", "ARM")
session = path_argument("session", "SESSION")
folder = path_argument("folder", "DIR")
bag = path_argument("bag", "BAG")


def arm(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the argument ``ARM``, a file; the command gets `arm`, the arm declared in it."""

    @functools.wraps(function)
    def command(arm: Path, **rest: Any) -> Any:
        from longarm_comp.core.arm.arm import Arm

        return function(arm=Arm.load(arm), **rest)

    return arm_file(command)


def flag(name: str, what: str) -> _Decorator:
    return click.option(*name.split(), is_flag=True, help=what)


def choice(name: str, choices: Sequence[str], what: str, **more: Any) -> _Decorator:
    return click.option(*name.split(), type=click.Choice(choices), help=what, **more)


def path_option(name: str, what: str, required: bool = False) -> _Decorator:
    return click.option(name, type=_PATH, required=required, help=what)


model = path_option("--model", "Calibrated model.yaml.")
predictor = path_option("--predictor", "Trained predictor file.")
seed = click.option("--seed", type=click.IntRange(min=0), default=0, help="Random seed.")
dask = click.option(
    "--dask", metavar="ADDRESS", help="Dask scheduler, or 'local': one with --jobs workers."
)
as_json = click.option(
    "--json",
    is_flag=True,
    expose_value=False,
    callback=lambda context, _, given: context.meta.update({JSON: given}),
    help="Print results as JSON.",
)


def several(*added: _Decorator) -> _Decorator:
    """Return several options as one decorator, in the order in which the help lists them."""
    return lambda function: functools.reduce(lambda made, add: add(made), added[::-1], function)


def kind_of(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--kind-of MODEL...``, to be last on the line; the command gets all in `kind_of`."""

    @functools.wraps(function)
    def command(kind_of: Path | None, more: tuple[Path, ...], **rest: Any) -> Any:
        if more and kind_of is None:
            raise click.UsageError(f"unexpected: {' '.join(map(str, more))}")
        return function(kind_of=() if kind_of is None else (kind_of, *more), **rest)

    option = click.option(
        "--kind-of",
        type=_PATH,
        metavar="MODEL...",
        help="Calibrated models (model.yaml) of other arms of the same type: ARM is expected to "
        "differ from its drawing as they do. Put it after ARM and SESSION.",
    )
    return option(click.argument("more", type=_PATH, nargs=-1, metavar="")(command))


floor = click.option(
    "--floor", type=float, metavar="Z", help="Height that the arm must stay above, m, base frame."
)


def _check_namespace(_: click.Context, __: click.Parameter, given: str | None) -> str | None:
    """Return a namespace without slashes at its ends; refuse one that ROS does not allow."""
    if given is None:
        return None
    parts = given.strip("/").split("/")
    if parts != [""] and not all(re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", part) for part in parts):
        raise click.BadParameter(
            f"{given!r}; allowed: words of letters, digits and _, with / between, as left_arm"
        )
    return "/".join(parts)


def namespace_of(default: str | None, what: str) -> _Decorator:
    """Return the option ``--namespace`` with another default or another meaning."""
    return click.option("--namespace", default=default, callback=_check_namespace, help=what)


namespace = namespace_of("", "Namespace of the arm.")


def pace(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options ``--sightings``, ``--within``, ``--dwell``, ``--move``, ``--arm-speed``.

    The command gets `pace`, a function of a model and postures (N, n), rad and m. It returns the
    `Pace`, whose rest is long enough for the arm's vibration at these postures.
    """

    @functools.wraps(function)
    def command(**given: Any) -> Any:
        names = ("sightings", "within", "dwell", "move", "arm_speed")
        sightings, within, dwell, move, arm_speed = map(given.pop, names)

        def pace(model: Any, q: Any) -> Any:
            from longarm_comp.core.vibration.ring import rest_s
            from longarm_comp.jobs.client import Pace

            near = {} if within is None else {"tolerance": within}
            return Pace(sightings, rest_s(model, q, move, dwell), move, arm_speed, **near)

        return function(pace=pace, **given)

    return several(
        click.option("--sightings", default=5, help="Sightings averaged at each pose."),
        click.option(
            "--within",
            type=click.FloatRange(1e-6, 0.1),
            help="So near to its command a joint is there, rad or m; default: 0.002.",
        ),
        click.option(
            "--dwell",
            type=float,
            help="Rest before the first sighting, s; default: computed if arm.yaml has damping, "
            "at least 0.3.",
        ),
        click.option("--move", default=0.5, help="Least time of a move, s."),
        click.option(
            "--arm-speed",
            type=click.FloatRange(1e-3, 100.0),
            default=0.25,
            help="Highest speed of any part of the arm where another program drives it, m/s.",
        ),
    )(command)


def _effects_option(expose: bool) -> _Decorator:
    def load(_: click.Context, __: click.Parameter, files: tuple[Path, ...]) -> tuple[Path, ...]:
        for file in files:
            from longarm_comp.core.effects.catalogue import load_file

            load_file(file)
        return files

    return click.option(
        "--effects",
        "effect_files",
        type=_PATH,
        multiple=True,
        callback=load,
        expose_value=expose,
        metavar="FILE",
        help="Python file that defines further effects; it is executed. Repeat for more.",
    )


def _execute_network(_: click.Context, __: click.Parameter, given: str | Path | None) -> Any:
    if given is not None:
        from longarm_comp.core.learn.others import choose_network

        return choose_network(given)
    return None


_NETWORK_FILE = "Python file of the predictor's network, if not the paper's; it is executed."
network = click.option(
    "--network",
    metavar="FILE|NAME",
    callback=_execute_network,
    help="Another network to train (docs/your_own_network.md): a Python file, which is executed, "
    "or the name of an installed one.",
)
known_network = click.option(
    "--network",
    type=_PATH,
    metavar="FILE",
    callback=_execute_network,
    expose_value=False,
    help=_NETWORK_FILE,
)
network_file = click.option("--network", type=_PATH, metavar="FILE", help=_NETWORK_FILE)
"""The same option for a command that gets the path and passes it on."""
effects = _effects_option(expose=False)
"""Option ``--effects``: executes the files before the command, which does not get them."""
effect_files = _effects_option(expose=True)
"""The same option for a command that passes the files on; its parameter is `effect_files`."""


def output(default: str | None, what: str, kind: Kind, beside: Beside | None = None) -> _Decorator:
    """Return the option ``-o/--output PATH``, which is required if `default` is None."""
    # To click a default of None is a value, with which nothing is missing
    given: dict[str, Any] = {"required": True} if default is None else {"default": default}
    return written_option("-o/--output", what, kind, beside=beside, **given)


def without(name: str, what: str) -> _Decorator:
    """Return the option ``--no-NAME``; the parameter `name` is True unless it is given."""
    flag = f"--no-{name.replace('_', '-')}"
    return click.option(flag, name, is_flag=True, callback=lambda c, p, given: not given, help=what)


def written_option(name: str, what: str, kind: Kind, **more: Any) -> _Decorator:
    """Return an option that names a further file or folder to write."""
    return click.option(*name.split("/"), type=_PATH, help=what, cls=Output, kind=kind, **more)


like = path_option(
    "--like",
    "Mapping that `import-data` wrote: write with the names, units and file type of its table.",
)
"""Option ``--like``; its value is a path, which `form_of` reads."""


def form_of(like: Path | None, output: Path) -> tuple[Any, Path]:
    """Return the table format to write in (None: CSV in SI), and the path to write.

    A path that the user did not give gets the ending of the format.
    """
    if like is None:
        return None, output
    from click.core import ParameterSource

    from longarm_comp.sessions.foreign.written import Like

    form = Like(like)
    given = click.get_current_context().get_parameter_source("output")
    return form, form.output(output) if given is ParameterSource.DEFAULT else output


servo_line = several(
    click.option("--port", help="Serial port of the servo bus, for instance /dev/ttyUSB0."),
    click.option(
        "--protocol", help="Protocol of the servos; default: the one that a servo answers."
    ),
    click.option("--baud", type=click.IntRange(min=1), help="bit/s; default: what answers."),
    click.option("--ids", default="0-252", help="Ids to ask: 1-20 or 1,2."),
    click.option(
        "--timeout",
        default=0.02,
        type=click.FloatRange(0.001, 1.0),
        help="Patience with one id, s.",
    ),
)
"""Options ``--port``, ``--protocol``, ``--baud``, ``--ids``, ``--timeout`` of a servo bus."""
