"""`longarm effects`: every effect, with every parameter."""

import json

from click.testing import CliRunner

from longarm_comp.cli.diagnose import effects as command
from longarm_comp.core.effects.catalogue import BUILT_IN


def test_the_table_has_a_row_for_every_effect() -> None:
    printed = CliRunner().invoke(command).stdout.splitlines()
    rows = [line.split("│") for line in printed if line.startswith("│")]
    assert [row[1].strip() for row in rows] == list(BUILT_IN)
    assert {len(row) for row in rows} == {6}


def test_json_holds_every_parameter() -> None:
    rows = {
        row["effect"]: row for row in json.loads(CliRunner().invoke(command, ["--json"]).stdout)
    }
    for name, kind in BUILT_IN.items():
        got = [(p["name"], p["unit"], p["prior"]) for p in rows[name]["parameters"]]
        assert got == [(p.name, p.unit, p.prior) for p in kind.declared()]
    assert rows["joint_compliance"]["parameters"][0]["lower"] == 0.0
    assert rows["camera_scale"]["side"] == "camera"
