"""`make figures`: prints the tables of figures of the documentation anew, on the code as it is.

A command that has printed its figures on this code is not run again, so a second call goes on where
the first was broken off. A table stands in its page below ``<!-- figures: NAME -->``; one whose
command has not run on this code stays as it is, and is named at the end.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from longarm_comp.core.files import write_text

ROOT = Path(__file__).resolve().parents[2]
CODE = ("longarm_comp", "longarm_interfaces", "studies", "bench", "config", "setup.py")
BENCHES = ("kinematics", "ssa", "calibration", "diagnosis", "bags", "startup", "ros")

LOOPS = {
    "none": "--groups none --rows 300 --arms 3 --repeats 4",
    "single": "--groups single --rows 300 --arms 2 --repeats 1",
    "sobol": "--groups single --plans sobol --rows 300 --arms 1 --repeats 1",
    "removed": "--groups removed,outside --rows 300 --arms 1 --repeats 1",
    "few": "--groups single --rows 60 --arms 2 --repeats 1",
    "pair": "--groups pair --rows 300 --arms 1 --repeats 1",
}
"""Groups of `docs/loop_study.md`; each case is a line of a file that is gone on with."""

COMMANDS = {
    "demo": "demo --out {out}/demo",
    "real": "study real --data {data}",
    "table1": "study table1 --arms 4",
    "paper": "study table1 --paper-setting --arms 10",
    "coverage": "study coverage --data {data} --arms 8",
    "day": "study day --arms 12 --fast",
    "poses": "study poses --arms 6",
    "measurements": "study measurements --arms 4",
    "realisable": "study realisable",
    "discover": "study discover --no-network",
    **{f"loop {name}": f"study loop -o {{out}}/{name}.jsonl {w}" for name, w in LOOPS.items()},
    **{f"bench {kind}": f"bench {kind}" for kind in BENCHES},
}

Cells = list[list[Any]]


def code_hash(root: Path = ROOT) -> str:
    """Of every tracked file that a figure may depend on, as it stands."""
    names = subprocess.run(
        ["git", "ls-files", "-z", *CODE], cwd=root, check=True, capture_output=True, text=True
    ).stdout.split("\0")
    digest = hashlib.sha256()
    for name in sorted(filter(None, names)):
        file = root / name
        digest.update(name.encode() + (file.read_bytes() if file.is_file() else b"gone"))
    return digest.hexdigest()


def result(name: str, words: str, out: Path, code: str, longarm: list[str]) -> Any:
    """What a command prints, from its file where it ran on this code; None where it failed."""
    file = out / f"{name.replace(' ', '_')}.json"
    if file.is_file():
        kept = json.loads(file.read_text("utf-8"))
        if (kept["code"], kept["command"]) == (code, words):
            return kept["result"]
    print(f"longarm {words}", flush=True)
    ran = subprocess.run([*longarm, *words.split(), "--json"], stdout=subprocess.PIPE, text=True)
    try:
        found = json.loads(ran.stdout)
    except ValueError:  # it said why on stderr
        return None
    write_text(file, json.dumps({"code": code, "command": words, "result": found}))
    return found


# ------------------------------------------------------------------ tables


def of(*keys: str, among: str = "rows") -> Callable[[Any], Cells]:
    """Cells of some keys of the rows that a command prints."""
    return lambda found: [[row.get(key) for key in keys] for row in found[among]]


def real(found: Any) -> Cells:
    """A row a set: rows held out, errors, promise."""
    fields = ("own_rigid_mm", "calibrated_mm", "written_mm", "written_commanded_mm", "inside_p90")
    return [[row["set"], row["rows"], *(row[f] for f in fields)] for row in found["sets"]]


def bench(found: Any) -> Cells:
    """A row a benchmark: here, beside, ahead by."""
    made = []
    for row in found["results"]:
        low, high = row["spread"] or (None, None)
        ahead = f"**{cell(row['ratio'])}** ({cell(low)} .. {cell(high)})"
        here = "" if row["value"] is None else f"{cell(row['value'])} {row['unit']}"
        peer = re.sub(r" \(.*\)", "", row["peer"] or "")  # what it was asked to do is in the page
        made.append([f"`{row['name']}`", here, peer, row["peer_value"],
                     "" if row["ratio"] is None else ahead])  # fmt: skip
    return made


BESIDE = ("exact name", "says noise", "any wrong name beside", "the same on the fitted poses")
"""What other rows of the same table say as well."""


def shares(found: Any) -> Cells:
    """How often, of the visible cases of a group."""
    return [
        [
            row["of"],
            row["measure"],
            f"{row['hits']}/{row['n']}",
            f"{row['low']:.2f} .. {row['high']:.2f}",
        ]
        for row in found["summary"]
        if not row["of"].endswith("not visible") and row["measure"] not in BESIDE
    ]


SHARES = ("measure", "share", "95 % interval")
BENCH = ("row", "here", "beside", "its figure", "ratio (lowest .. highest)")
TABLES: dict[str, tuple[str, tuple[str, ...], Callable[[Any], Cells]]] = {
    "real": (
        "studies.md", ("rows held out, mean error, mm", "rows", "rigid, by scipy", "calibrated",
                       "diagnosed", "as commanded", "inside the 90 % radius"), real,
    ),
    **{
        name: (
            "studies.md",
            ("row", "mean abs. z", "sd over arms", "mean 3-D", "variance", "paper: mean abs. z",
             "variance"),
            of("row", "mean_abs_z_mm", "sd_over_arms_mm", "mean_mm", "variance_mm2",
               "paper_mean_abs_z_mm", "paper_variance_mm2"),
        )
        for name in ("table1", "paper")
    },
    "coverage": (
        "studies.md", ("rows left out", "rows", "inside", "kept", "mean, mm", "expected, mm"),
        of("set", "rows", "inside_90", "kept", "mean_mm", "expected_mm"),
    ),
    "day": (
        "studies.md", ("commanded", "poses", "minutes", "not served", "day", "p95",
                       "0-2 h", "2-4 h", "4-6 h", "6-8 h"),
        lambda found: [list(row.values()) for row in found["rows"]],
    ),
    "poses": (
        "studies.md", ("effect", "poses", "grid", "Sobol", "I-optimal"),
        of("effect", "poses", "grid_mm", "sobol_mm", "i-optimal_mm"),
    ),
    "measurements": (
        "studies.md", ("rows", "pose", "position", "distance", "touch"),
        lambda found: [list(row.values()) for row in found["errors"]]
        + [[f"rows for {row.pop('error_mm'):g} mm", *row.values()] for row in found["needed"]],
    ),
    **{
        f"loop {group}": ("loop_study.md", SHARES, lambda found: [row[1:] for row in shares(found)])
        for group in LOOPS if group != "removed"
    },
    "loop removed": ("loop_study.md", ("cases", *SHARES), shares),
    **{f"bench {kind}": ("performance.md", BENCH, bench) for kind in BENCHES},
}  # fmt: skip
"""By name of the command: page, header, and the cells of what it prints."""


def cell(value: Any) -> str:
    """Three digits of a number; text as it is."""
    if isinstance(value, list):
        return " .. ".join(map(cell, value))
    if not isinstance(value, float):
        return "" if value is None else str(value)
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def table(header: Iterable[str], rows: Cells) -> str:
    """A table in Markdown."""
    names = list(header)
    if any(len(row) != len(names) for row in rows):
        raise ValueError(f"a row has other columns than {names}")
    lines = [names, ["---"] * len(names), *rows]
    return "".join(f"| {' | '.join(map(cell, line))} |\n" for line in lines)


def placed(page: str, name: str, made: str) -> str:
    """The page with a table below its mark, in place of the one that stands there."""
    mark = f"<!-- figures: {name} -->\n"
    found = re.search(re.escape(mark) + r"\n?(\|[^\n]*\n)*", page)
    if found is None:
        raise ValueError(f"no mark {mark.strip()} in the page")
    return page[: found.start()] + mark + "\n" + made + page[found.end() :]


class Figure(NamedTuple):
    """One figure of what a command prints: a key of the row whose ``name`` is a value."""

    name: str
    key: str
    value: str
    among: str = "rows"

    def of(self, found: Any) -> float:
        """The figure. Raises ValueError where there is no such row."""
        for row in found[self.among]:
            if row[self.name] == self.value:
                return float(row[self.key])
        raise ValueError(f"no row whose {self.name} is {self.value!r}")


SUMMARY: dict[str, tuple[str, Figure]] = {
    "**Demonstration**: true mean error over the ROS graph, uncompensated, mm": (
        "demo", Figure("model", "true_mean_mm", "original")),
    "Demonstration, with the declared deflection, mm": (
        "demo", Figure("model", "true_mean_mm", "declared")),
    "Demonstration, with the effects that the diagnosis found, mm": (
        "demo", Figure("model", "true_mean_mm", "effect found")),
    **{
        f"**{title}**, held-out mean error, {model.replace('_', ' ')} (published {known}), mm": (
            "real", Figure("model", "mean_mm", model, robot))
        for title, robot, model, known in (
            ("DLR Justin", "dlr_justin", "rigid", 10.5),
            ("DLR Justin", "dlr_justin", "joint_compliance", 5.64),
            ("DLR Justin", "dlr_justin", "diagnosed", 3.12),
            ("Barrett WAM", "wam", "diagnosed", 2.92),
            ("UR5", "ur5", "rigid", 0.155),
        )
    },
    "**Table I**, 4 simulated arms really commanded, mean abs. z: original (paper 17.7), mm": (
        "table1", Figure("row", "mean_abs_z_mm", "Original error")),
    "Table I, calibrated + effects, 300 samples (the paper's best: 5.3, with 900), mm": (
        "table1", Figure("row", "mean_abs_z_mm", "Calibrated + effects, 300")),
    "**A day of work**, wear, warmth and payloads, mean 3-D error: calibrated once, mm": (
        "day", Figure("commanded", "mean_mm", "calibrated once")),
    "A day of work, learning at work, mm": (
        "day", Figure("commanded", "mean_mm", "learning at work")),
    "**Single hidden effects**: right name, or a set with it": (
        "loop single", Figure("measure", "share", "right name, or a set with it", "summary")),
    "Nothing hidden: an effect added": (
        "loop none", Figure("measure", "share", "adds an effect", "summary")),
}  # fmt: skip
"""Rows of `docs/figures.md`: the command that prints each, and which of its figures."""


def summed_up(page: str, results: dict[str, Any]) -> str:
    """The page with the figures of these results; rows of other commands stay as they are."""
    for what, (name, figure) in SUMMARY.items():
        row = re.compile(rf"^\| {re.escape(what)} \| [^|]* \|", re.M)
        if row.search(page) is None:
            raise ValueError(f"docs/figures.md has no row {what!r}")
        if name in results:
            page = row.sub(f"| {what} | {cell(figure.of(results[name]))} |", page)
    return page


def main() -> int:
    """Run what has not run on this code, and write the pages after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(COMMANDS)}; default: all")
    parser.add_argument("--data", default="", help="folder with dlr_justin and wam_ur5")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "figures")
    given = parser.parse_args()
    if given.data and not all(
        (Path(given.data) / name).is_dir() for name in ("dlr_justin", "wam_ur5")
    ):
        parser.error(f"--data: {given.data} does not hold both dlr_justin and wam_ur5")
    code, longarm = code_hash(), [sys.executable, "-m", "longarm_comp"]
    left, results = [], {}
    for name in given.names or COMMANDS:
        if "{data}" in COMMANDS[name] and not given.data:
            left.append(name)
            continue
        words = COMMANDS[name].format(data=given.data, out=given.out)
        found = result(name, words, given.out, code, longarm)
        if found is None:
            left.append(name)
            continue
        results[name] = found
        summary = ROOT / "docs" / "figures.md"
        write_text(summary, summed_up(summary.read_text("utf-8"), results))
        if name in TABLES:
            file, header, rows = TABLES[name]
            page = ROOT / "docs" / file
            write_text(page, placed(page.read_text("utf-8"), name, table(header, rows(found))))
    if left:
        print(f"not printed on this code: {', '.join(left)}", file=sys.stderr)
    return 3 if left else 0


if __name__ == "__main__":
    sys.exit(main())
