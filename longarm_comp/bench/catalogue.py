"""Every benchmark by name: a function of that name in the module that it stands beside."""

from __future__ import annotations

import importlib
import platform
from collections.abc import Mapping, Sequence

from longarm_comp.core.errors import InputError

MODULE_OF = {
    "ik_single_vs_rtb_ik_lm_median": "kinematics",
    "ik_warm_vs_rtb_ik_lm_median": "kinematics",
    "ik_batch_vs_rtb_ik_lm_mean": "kinematics",
    "ssa_evals_vs_mealpy_300": "ssa",
    "ssa_evals_vs_mealpy_900": "ssa",
    "ros_target_to_trajectory_vs_echo_p50_ms": "ros",
    "ros_compensate_vs_echo_p50_ms": "ros",
}
"""Names are agreed with whoever compares machines; each returns one row of results."""


def chosen(names: Sequence[str]) -> tuple[str, ...]:
    """Benchmarks that some names mean: their own, or all of a kind (`ros`); none: every one.

    Raises:
        InputError: no such name or kind.
    """
    made: list[str] = []
    for name in names:
        alike = [known for known, kind in MODULE_OF.items() if name in (known, kind)]
        if not alike:
            kinds = dict.fromkeys(MODULE_OF.values())
            raise InputError("bench", "name", name, ", ".join((*MODULE_OF, *kinds)))
        made += [known for known in alike if known not in made]
    return tuple(made) or tuple(MODULE_OF)


def run(name: str) -> Mapping[str, object]:
    """One row: name, value, unit, peer, peer_value, ratio (above 1: faster than the peer), spread.

    Raises:
        InputError: no benchmark of this name.
    """
    if name not in MODULE_OF:
        raise InputError("bench", "name", name, ", ".join(MODULE_OF))
    module = importlib.import_module(f"longarm_comp.bench.{MODULE_OF[name]}")
    row: Mapping[str, object] = getattr(module, name)()
    return row


def machine() -> str:
    """What the figures were measured on."""
    return f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
