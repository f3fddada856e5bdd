"""``longarm study real``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from longarm_comp.cli import options
from studies.commands import shape

_COLUMNS = (
    "set", "rows", "own_rigid_mm", "calibrated_mm", "written_mm", "calibrated_commanded_mm",
    "written_commanded_mm", "inside_p90",
)  # fmt: skip


@shape.study(
    options.path_option("--data", "Folder that holds sets of real arms.", required=True),
    click.option(
        "--halves", is_flag=True, help="Diagnose two random halves of each set and compare names."
    ),
    shape.number("--sessions", 40, "Simulated sessions whose halves are compared.", least=0),
)
def command(data: Path, halves: bool, sessions: int, show: shape.Show) -> shape.Figures:
    """Held-out errors on real arms: calibrated, diagnosed, as commanded, and what is stated.

    The sets are DLR Agile Justin, Barrett WAM, UR5, UR10, two KUKA iiwas, a Kinova Gen3, a
    palletiser and six Franka Pandas, those of them that the folder holds. A rigid fit by scipy
    that shares no code with the package stands beside each. For the first three, further models
    are fitted in turn; "frames_only" fits only the placement of base and tool.

    \b
    Example:
      longarm study real --data test/data --json
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.share import folder
    from studies import real_sets
    from studies.real import ladder

    record: dict[str, Any] = {"sets": []}
    tables: dict[str, list[dict[str, Any]]] = {"Real sets, rows held out": []}
    notes = []
    sets = dict(real_sets.real_sets(data))
    for number, (name, parts) in enumerate(sets.items()):

        def say(text: str, name: str = name, number: int = number) -> None:
            show(f"{name}: {text}", number / len(sets))

        held = [each for part in parts for each in real_sets.judged(part, say)]
        line = real_sets.line(name, parts, held, say)
        if halves:
            say("halves")
            line |= real_sets.overlap([real_sets.halves(part) for part in parts])
        record["sets"].append(line)
        tables["Real sets, rows held out"].append({c: line[c] for c in _COLUMNS})
        notes += _said(line)
        found = [h.found for h in held if h.found is not None]
        if all(p.test is not None for p in parts) and len(found) == len(parts):
            rungs = ladder(parts, found, say)
            tables[f"{name}: models in turn"] = [rung.row for rung in rungs]
            record[name] = [rung.row | rung.further for rung in rungs]
    if halves and sessions:
        declared = Arm.load(folder("config") / "arm_demo.yaml")
        show(f"halves of {sessions} simulated sessions", 1.0)
        every = [real_sets.halves(part) for part in real_sets.simulated(declared, sessions)]
        line = {"set": "simulated", "sessions": sessions} | real_sets.overlap(every)
        record["sets"].append(line)
        notes += _said(line)
    return shape.Figures(record, tables, notes)


def _said(line: Mapping[str, Any]) -> list[str]:
    """What no column of the table holds."""
    name, said = line["set"], []
    if "commanded_gain_ci95_mm" in line:
        low, high = line["commanded_gain_ci95_mm"]
        said.append(f"{name}: as commanded, 95 % of the gain {low:.3f} to {high:.3f} mm")
    for found in line.get("names", ()):
        names = " or ".join(f"{effect} {share:.2f}" for effect, share in found["set"].items())
        where = ", ".join(found["where"])
        said.append(f"{name}: {names}, there with {found['probability']:.2f} ({where})")
    said += [f"{name}: refused: {why}" for why in line.get("refused", ())]
    if "halves_stated" in line:
        stated, share = line["halves_stated"], line["halves_overlap"]
        kept = "" if share is None else f", {share:.0%} of them in the other half's sets"
        said.append(f"{name}: {stated} names stated by a half{kept}")
    return said
