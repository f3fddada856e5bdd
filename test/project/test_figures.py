"""`make figures`: what it runs, when it runs it again, and where it writes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

DOCS = ROOT / "docs"
sys.path.append(str(DOCS / "made_by"))

import figures

from bench.catalogue import BENCHMARKS
from studies.commands import STUDIES


def test_every_table_has_its_place_and_every_command_is_there() -> None:
    for name, (page, *_) in figures.TABLES.items():
        assert f"<!-- figures: {name} -->\n" in (DOCS / page).read_text("utf-8"), name
    assert set(figures.BENCHES) <= set(BENCHMARKS)
    words = [command.split() for command in figures.COMMANDS.values()]
    assert {w[1] for w in words if w[0] == "study"} <= {entry.name for entry in STUDIES}


def test_a_table_is_written_below_its_mark_and_nowhere_else() -> None:
    page = "a\n\n<!-- figures: day -->\n\n| old |\n|---|\n| 1 |\n\nb\n\n| other |\n"
    found = {"rows": [{"commanded": "once", "poses": 1234.5, "minutes": 0.12345}]}
    _, header, rows = figures.TABLES["day"]
    made = figures.placed(page, "day", figures.table(header[:3], rows(found)))
    told = "| commanded | poses | minutes |\n| --- | --- | --- |\n| once | 1,234 | 0.123 |\n"
    assert made == f"a\n\n<!-- figures: day -->\n\n{told}\nb\n\n| other |\n"
    with pytest.raises(ValueError, match="no mark"):
        figures.placed(page, "real", told)
    with pytest.raises(ValueError, match="other columns"):
        figures.table(header[:2], rows(found))


def test_a_command_runs_once_on_one_state_of_the_code(tmp_path: Path) -> None:
    """The command appends to a file: how often it ran."""
    script = tmp_path / "longarm.py"
    script.write_text(
        "import json, sys\nopen(sys.argv[1], 'a').write('x')\nprint(json.dumps({'rows': [1]}))\n"
    )
    longarm, count = [sys.executable, str(script)], tmp_path / "count"

    def run(code: str, words: str = str(count)) -> object:
        return figures.result("some study", words, tmp_path / "out", code, longarm)

    assert [run("a"), run("a")] == [{"rows": [1]}] * 2 and count.read_text() == "x"
    assert run("b") == {"rows": [1]} and count.read_text() == "xx"
    kept = json.loads((tmp_path / "out" / "some_study.json").read_text())
    assert (kept["code"], kept["command"]) == ("b", str(count))
    assert run("b", str(tmp_path / "no" / "folder")) is None
    assert run("b") == {"rows": [1]} and count.read_text() == "xx"  # a failure loses nothing


def test_the_code_is_every_tracked_file_as_it_stands(tmp_path: Path) -> None:
    (tmp_path / "studies").mkdir()
    file, other = tmp_path / "studies" / "a.py", tmp_path / "notes.txt"
    file.write_text("1\n")
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    subprocess.run(["git", "add", "studies"], cwd=tmp_path, check=True)
    before = figures.code_hash(tmp_path)
    other.write_text("no code\n")
    assert figures.code_hash(tmp_path) == before
    file.write_text("2\n")
    assert figures.code_hash(tmp_path) != before
