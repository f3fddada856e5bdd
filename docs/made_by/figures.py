"""`make figures`: prints the tables of figures of the documentation anew, on the code as it is.

A command that has printed its figures on this code is not run again, so a second call goes on where
the first was broken off. A table stands in its page below ``<!-- figures: NAME -->``; one whose
command has not run on this code stays as it is, and is named at the end.
"""

import argparse
import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

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
    "real": "study real --data {data}",
    "table1": "study table1 --arms 4",
    "paper": "study table1 --paper-setting --arms 10",
    "coverage": "study coverage --data {data} --arms 8",
    "day": "study day --arms 12",
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


TABLE1_HEADER = ("row", "mean abs. z", "sd over arms", "mean 3-D", "variance")
TABLE1 = ("row", "mean_abs_z_mm", "sd_over_arms_mm", "mean_mm", "variance_mm2")
SHARES = ("measure", "share", "95 % interval")
BENCH = ("row", "here", "beside", "its figure", "ratio (lowest .. highest)")
TABLES: dict[str, tuple[str, tuple[str, ...], Callable[[Any], Cells]]] = {
    "real": (
        "studies.md", ("rows held out, mean error, mm", "rows", "rigid, by scipy", "calibrated",
                       "diagnosed", "as commanded", "inside the 90 % radius"), real,
    ),
    "table1": ("studies.md", TABLE1_HEADER, of(*TABLE1)),
    "paper": (
        "studies.md", (*TABLE1_HEADER, "paper: mean abs. z", "variance"),
        of(*TABLE1, "paper_mean_abs_z_mm", "paper_variance_mm2"),
    ),
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
    left = []
    for name in given.names or COMMANDS:
        if "{data}" in COMMANDS[name] and not given.data:
            left.append(name)
            continue
        words = COMMANDS[name].format(data=given.data, out=given.out)
        found = result(name, words, given.out, code, longarm)
        if found is None:
            left.append(name)
            continue
        if name in TABLES:
            file, header, rows = TABLES[name]
            page = ROOT / "docs" / file
            write_text(page, placed(page.read_text("utf-8"), name, table(header, rows(found))))
    if left:
        print(f"not printed on this code: {', '.join(left)}", file=sys.stderr)
    return 3 if left else 0


if __name__ == "__main__":
    sys.exit(main())
