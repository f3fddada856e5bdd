"""`longarm study explain`: the posterior over explanations beside the search, on equal sessions."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.catalogue import LIBRARY
from longarm_comp.core.errors import LongarmError
from longarm_comp.core.identify.aliasing import findings
from longarm_comp.core.identify.calibrate import declared_model, stages
from longarm_comp.core.identify.candidates import Library, library
from longarm_comp.core.identify.noise import from_repeats
from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.model.model import Model
from studies.loop_cases import Case
from studies.loop_setting import LoopSetting, set_up

Names = list[set[str]]
"""By finding, the names that it may be."""


def compared(cases: Sequence[Case], declared: Arm, functions: bool) -> Iterator[dict[str, Any]]:
    """A row per case: what both say, how far the tip is off by it, and the processor time."""
    for case in cases:
        try:
            yield _row(set_up(case, declared), functions)
        except LongarmError as error:
            yield {"case": case.id, "posterior": str(error)}


def _row(setting: LoopSetting, functions: bool) -> dict[str, Any]:
    true = set(setting.case.effects)
    kinds = [k for k in LIBRARY if setting.case.group != "removed" or k.name not in true]
    train = setting.train
    start = dict(stages(declared_model(setting.arm), train))["geometry"].model
    offered = library(setting.arm, train.context(), kinds, start.terms)
    row: dict[str, Any] = {"case": setting.case.id}
    ways = {
        "posterior": lambda: _explained(start, setting, offered, functions),
        "search": lambda: _searched(start, setting, offered),
    }
    for name, way in ways.items():
        began = time.process_time()
        names, model = way()
        row[name] = " + ".join("/".join(sorted(n)) for n in names) or "nothing"
        row[f"{name}_is"] = judged(true, names)
        row[f"{name}_mm"] = round(1e3 * _off(setting, model), 3)
        row[f"{name}_s"] = round(time.process_time() - began, 1)
    return row


def judged(true: set[str], names: Names) -> str:
    """``right``, ``more`` beside the right ones, ``missed``, or ``wrong``."""
    covered = all(any(t in n for n in names) for t in true)
    extra = [n for n in names if not n & true]
    if covered:
        return "more" if extra and true else "wrong" if extra else "right"
    return "wrong" if extra else "missed"


def _explained(
    start: Model, setting: LoopSetting, offered: Library, functions: bool
) -> tuple[Names, Model]:
    found = explain_session(
        start,
        setting.train,
        offered.testable,
        known_noise=from_repeats(start, setting.train),
        stepped=offered.stepped,
        functions=functions,
    )
    return [set(f.credible) for f in found.found], found.fit.model


def _searched(start: Model, setting: LoopSetting, offered: Library) -> tuple[Names, Model]:
    found = explain_session(
        start,
        setting.train,
        offered.testable,
        known_noise=from_repeats(start, setting.train),
        stepped=offered.stepped,
    )
    found, named = findings(found, offered.testable)
    return [set(f.names) for f in named], found.fit.model


def _off(setting: LoopSetting, model: Model) -> float:
    """Mean distance (m) from the noise-free truth on fresh poses."""
    held = setting.held_out
    error = setting.clean_held_out - model.measured(held.q, held.context())
    return float(np.linalg.norm(error, axis=1).mean())


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """How often each was right, and its median time."""
    made = []
    for name in ("posterior", "search"):
        mine = [r for r in rows if f"{name}_is" in r]
        said = [r[f"{name}_is"] for r in mine]
        counts = {word: said.count(word) for word in ("right", "more", "missed", "wrong")}
        seconds = float(np.median([r[f"{name}_s"] for r in mine])) if mine else float("nan")
        made.append({"by": name, "cases": len(mine), **counts, "median_s": round(seconds, 1)})
    return made
