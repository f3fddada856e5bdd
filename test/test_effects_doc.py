"""The table of effects in the documentation is the one that the effects print."""

from __future__ import annotations

import json
from pathlib import Path

from click.testing import CliRunner

from longarm_comp.cli.effects import command
from longarm_comp.core.effects.catalogue import BUILT_IN

PHYSICS = Path(__file__).parents[1] / "docs" / "physics.md"


def test_documented_table_is_the_printed_one() -> None:
    printed = CliRunner().invoke(command).stdout
    assert len(printed.splitlines()) == 2 + len(BUILT_IN)
    assert printed in PHYSICS.read_text(encoding="utf-8"), "paste the output of longarm effects"


def test_json_holds_every_parameter() -> None:
    rows = {
        row["effect"]: row for row in json.loads(CliRunner().invoke(command, ["--json"]).stdout)
    }
    for name, kind in BUILT_IN.items():
        got = [(p["name"], p["unit"], p["prior"]) for p in rows[name]["parameters"]]
        assert got == [(p.name, p.unit, p.prior) for p in kind.declared()]
    assert rows["joint_compliance"]["parameters"][0]["lower"] == 0.0
    assert rows["camera_scale"]["side"] == "camera"
