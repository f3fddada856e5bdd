"""Tables of the loop study: shares with Wilson intervals, by group, plan and sample size."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from studies.interval import wilson

Line = Mapping[str, Any]
Row = dict[str, Any]

_STATED = (0.001, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0)
WORSE = 1.1
"""Largest allowed error of a found model, relative to the fit of the true model."""


def share(of: str, measure: str, answers: Iterable[bool | None]) -> Row | None:
    """Return one row from the answers that are not None; None without any."""
    counted = [bool(a) for a in answers if a is not None]
    if not counted:
        return None
    hits, n = sum(counted), len(counted)
    low, high = wilson(hits / n, n)
    return {
        "of": of,
        "measure": measure,
        "share": hits / n,
        "low": low,
        "high": high,
        "hits": hits,
        "n": n,
    }


def _visible(line: Line) -> bool:
    return min(line["result"]["visible"], default=1.0) >= 1.0


def _ratio(line: Line, which: str = "") -> float | None:
    errors = line["result"]["errors_mm"]
    true = errors.get(f"true_effects{which}")
    return None if true is None else errors[f"with_effects{which}"] / true


def _within(line: Line, which: str = "") -> bool | None:
    ratio = _ratio(line, which)
    return None if ratio is None else ratio <= WORSE


Measure = tuple[str, Callable[[Line], "bool | None"]]

_ADDED: Measure = ("adds an effect", lambda x: bool(x["result"]["found"]))
_STRUCTURE: Measure = ("claims structure", lambda x: x["result"]["flag"])
_DANGEROUS: Measure = ("dangerous verdict", lambda x: x["result"]["dangerous"])
_WRONG: Measure = ("wrong single name", lambda x: x["result"]["wrong_single"])
_TOLD: Measure = (
    "wrong single name, told by the rows",
    lambda x: x["result"]["wrong_single"] and x["result"]["told_apart"],
)
_NAMING: tuple[Measure, ...] = (
    ("right name, or a set with it", lambda x: x["result"]["covered"]),
    ("exact name", lambda x: x["result"]["exact"]),
    ("exact name or minimal set", lambda x: x["result"]["minimal"]),
    _WRONG,
    ("any wrong name beside", lambda x: bool(x["result"]["wrong_name"])),
    ("an effect too many", lambda x: x["result"]["extra"] > 0),
    ("says noise", lambda x: x["result"]["verdict"] == "noise"),
    ("claims structure beside", lambda x: x["result"]["flag"]),
    ("place found", lambda x: x["result"]["located"]),
    ("held-out error <= 1.1 of the true model's", _within),
    ("the same on the fitted poses", lambda x: _within(x, "_train")),
    _DANGEROUS,
)
_OTHER: tuple[Measure, ...] = (
    (
        "flagged: set, partly, unknown or rolled back",
        lambda x: x["result"]["flag"] or x["result"]["verdict"] in ("unknown", "partly", "set"),
    ),
    _WRONG,
    _TOLD,
    _DANGEROUS,
)
_MEASURES: dict[str, tuple[Measure, ...]] = {
    "none": (_ADDED, _STRUCTURE, _DANGEROUS),
    "single": _NAMING,
    "pair": _NAMING,
    "removed": _OTHER,
    "outside": _OTHER,
}


def summary(lines: Sequence[Line]) -> list[Row]:
    """Return all shares, and the medians of the error ratios, of the cases that ran."""
    rows: list[Row | None] = []
    kinds: dict[tuple[str, str, int, bool], list[Line]] = {}
    for line in _ran(lines):
        case = line["case"]
        kind = case["group"], case["plan"], case["rows"], _visible(line)
        kinds.setdefault(kind, []).append(line)
    for (group, plan, count, seen), mine in sorted(kinds.items(), key=_order):
        of = f"{group}, {plan} {count}" + ("" if seen else ", not visible")
        rows += [share(of, name, map(ask, mine)) for name, ask in _MEASURES[group]]
        intervals = [i for line in mine for i in line["result"]["intervals"]]
        inside = (i["low"] <= i["true"] <= i["high"] for i in intervals)
        rows.append(share(of, "95 % interval holds the true value", inside))
    return [row for row in rows if row is not None]


def by_effect(lines: Sequence[Line]) -> list[Row]:
    """Return visible single effects: one row per effect, plan and sample size."""
    kinds: dict[tuple[str, str, int], list[Line]] = {}
    for line in _ran(lines):
        case = line["case"]
        if case["group"] == "single" and _visible(line):
            kinds.setdefault((case["effects"][0], case["plan"], case["rows"]), []).append(line)
    rows = []
    for (name, plan, count), mine in sorted(kinds.items(), key=lambda k: (k[0][1:], k[0][0])):
        results = [x["result"] for x in mine]
        ratios = [r for r in map(_ratio, mine) if r is not None]
        rows.append(
            {
                "effect": name,
                "data": f"{plan} {count}",
                "n": len(mine),
                "in set": sum(r["covered"] for r in results),
                "exact": sum(r["exact"] for r in results),
                "minimal": sum(r["minimal"] for r in results),
                "wrong": sum(r["wrong_single"] for r in results),
                "extra": sum(r["extra"] > 0 for r in results),
                "flag": sum(r["flag"] for r in results),
                "off-grid ratio": float(np.median(ratios)),
            }
        )
    return rows


def reliability(lines: Sequence[Line]) -> list[Row]:
    """Return names as probable as they were called, against how many of them were hidden.

    Of sessions whose causes are all in the library. Every name of every finding counts, at its
    probability there; between 0.95 and 1 it is a single name.
    """
    stated: list[tuple[float, bool]] = []
    for line in _ran(lines):
        if line["case"]["group"] in ("none", "single", "pair"):
            true = line["case"]["effects"]
            for _, _, names in line["result"]["probabilities"]:
                stated += [(p, name in true) for name, p in names.items()]
    rows = []
    for low, high in pairwise(_STATED):
        mine = [(p, right) for p, right in stated if low < p <= high]
        row = share(f"{low:g} to {high:g}", "of these names were hidden", [r for _, r in mine])
        if row is not None:
            rows.append(row | {"stated": float(np.mean([p for p, _ in mine]))})
    return rows


def failures(lines: Sequence[Line]) -> list[str]:
    """Return one line per case that ended with an error."""
    return [f"{x['case']['id']}: {x['error']}" for x in lines if "error" in x]


def _ran(lines: Sequence[Line]) -> list[Line]:
    return [x for x in lines if "result" in x]


_GROUPS = list(_MEASURES)


def _order(item: tuple[tuple[str, str, int, bool], list[Line]]) -> tuple[int, str, int, bool]:
    group, plan, count, seen = item[0]
    return _GROUPS.index(group), plan, -count, not seen
