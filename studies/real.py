"""Errors of each model on held-out rows of public measurements of real arms.

DLR Agile Justin (two arms on one torso, fitted together), Barrett WAM, UR5.  The ladder is rigid
first (beams of these arms are not declared), then torsion of the joints, then lateral elasticity of
their seats on top, as Tenhumberg and Baeuml (HUMANOIDS 2020, 2021) have it; ``diagnosed`` is what
`diagnose` writes of the training rows, each arm by itself (`studies/real_sets.py`).  "Frames only"
is the base and tool placement alone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from longarm_comp.cli import options
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import (
    Errors,
    compute_tip_errors,
    copy_known_values,
    declared_model,
    geometry_terms,
    placement_terms,
)
from longarm_comp.core.calibration.fit import fit_together
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.placement import place_bases
from longarm_comp.core.effects.compliances import BearingTilt, JointCompliance
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.placements import TipOffset
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.model.model import Slot
from longarm_comp.share import folder
from studies import real_sets
from studies.commands import Figures, Show, study_command, whole_number
from studies.interval import mean_ci95
from studies.real_sessions import Measured

Terms = tuple[Effect | Bias, ...]
Say = Callable[[str], None]

LAST_SHARED_ROW = 4
"""Justin's torso; its two shoulders (row 5) and what follows are each arm's own."""


@dataclass(frozen=True)
class Line:
    """One model's errors on the test rows, all arms of the robot pooled.

    Attributes:
        model: name of the rung.
        errors: on the test rows.
        ci95: of their mean, m: the rows drawn anew.
        effects: effects of the model besides geometry; of a diagnosis those found, not what every
            arm gives way by.
    """

    model: str
    errors: Errors
    ci95: tuple[float, float]
    effects: tuple[str, ...] = ()

    @property
    def row(self) -> dict[str, Any]:
        """The row of the table, mm."""
        e = self.errors
        millimetres = {f"{k}_mm": 1e3 * getattr(e, k) for k in ("mean", "rms", "max")}
        return {"model": self.model, **millimetres, "n": e.n}

    @property
    def further(self) -> dict[str, Any]:
        """The further fields of ``--json``."""
        return {"ci95_mm": [1e3 * end for end in self.ci95], "effects": list(self.effects)}


def ladder(parts: Sequence[Measured], found: Sequence[Diagnosis], say: Say) -> list[Line]:
    """Fit one robot's models in turn: frames, joint zeros, rigid, what bends; then as diagnosed.

    Args:
        found: the diagnosis of each arm's rows.
        say: called with the name of the model being fitted.
    """

    def every(make: Callable[[Measured], Terms]) -> list[Terms]:
        return [make(part) for part in parts]

    framed = every(lambda p: placement_terms(p.arm, p.train))
    zeros = every(lambda p: (*placement_terms(p.arm, p.train), *JointZero.for_arm(p.arm)))
    rigid = every(lambda p: geometry_terms(p.arm, p.train))
    torsion = every(lambda p: (*geometry_terms(p.arm, p.train), *JointCompliance.for_arm(p.arm)))
    lateral = [(*t, *BearingTilt.for_arm(p.arm)) for t, p in zip(torsion, parts, strict=True)]
    rungs = {
        "frames_only": framed,
        "joint_zeros": zeros,
        "rigid": rigid,
        "joint_compliance": torsion,
        "lateral_compliance": lateral,
    }
    lines: list[Line] = []
    fits: list[ModelFit] | None = None
    for name, terms in rungs.items():
        say(name)
        fits = _fit_rung(parts, terms, fits)
        lines.append(_line(name, parts, fits))
    diagnosed = _line("diagnosed", parts, [d.fit for d in found])
    named = tuple(dict.fromkeys(f.name for d in found for f in d.explained.found))
    return [*lines, replace(diagnosed, effects=named)]


def _fit_rung(
    parts: Sequence[Measured], terms: Sequence[Terms], start: Sequence[ModelFit] | None
) -> list[ModelFit]:
    models = []
    for k, (part, added) in enumerate(zip(parts, terms, strict=True)):
        model = declared_model(part.arm).plus(*added)
        held = place_bases(model, part.train) if start is None else start[k].model
        models.append(copy_known_values(held, model))
    pairs = [(m, p.train) for m, p in zip(models, parts, strict=True)]
    return fit_together(pairs, _own)


def _own(slot: Slot) -> bool:
    """Return whether a parameter belongs to one arm alone (irrelevant for a robot with one arm)."""
    place = slot.owner.placement
    row = place.get("row", place.get("joint"))
    return isinstance(slot.owner, TipOffset) or (row is not None and row > LAST_SHARED_ROW)


def _line(name: str, parts: Sequence[Measured], fits: Sequence[ModelFit]) -> Line:
    pairs = zip(fits, parts, strict=True)
    left = np.concatenate([compute_tip_errors(f.model, p.held_out) for f, p in pairs])
    effects = dict.fromkeys(t.name for f in fits for t in f.model.terms if not t.geometry)
    _, *ci95 = mean_ci95(np.linalg.norm(left, axis=1))
    return Line(name, Errors.of(left), (ci95[0], ci95[1]), tuple(effects))


_COLUMNS = (
    "set", "rows", "own_rigid_mm", "calibrated_mm", "written_mm", "calibrated_commanded_mm",
    "written_commanded_mm", "inside_p90",
)  # fmt: skip


@study_command(
    options.path_option("--data", "Folder that holds sets of real arms.", required=True),
    click.option(
        "--halves", is_flag=True, help="Diagnose two random halves of each set and compare names."
    ),
    whole_number("--sessions", 40, "Simulated sessions whose halves are compared.", least=0),
)
def command(data: Path, halves: bool, sessions: int, show: Show) -> Figures:
    """Held-out errors on real arms: calibrated, diagnosed, as commanded, and what is stated.

    The sets are DLR Agile Justin, Barrett WAM, UR5, UR10, two KUKA iiwas, a Kinova Gen3, a
    palletiser and six Franka Pandas, those of them that the folder holds. A rigid fit by scipy
    that shares no code with the package stands beside each. For the first three, further models
    are fitted in turn; "frames_only" fits only the placement of base and tool.

    \b
    Example:
      longarm study real --data test/data --json
    """
    record: dict[str, Any] = {"sets": []}
    tables: dict[str, list[dict[str, Any]]] = {"Real sets, rows held out": []}
    notes = []
    sets = dict(real_sets.real_sets(data))
    for place, (name, parts) in enumerate(sets.items()):

        def say(text: str, name: str = name, place: int = place) -> None:
            show(f"{name}: {text}", place / len(sets))

        held = [each for part in parts for each in real_sets.judge_splits(part, say)]
        line = real_sets.line(name, parts, held, say)
        if halves:
            say("halves")
            line |= real_sets.overlap([real_sets.halves(part) for part in parts])
        record["sets"].append(line)
        tables["Real sets, rows held out"].append({c: line[c] for c in _COLUMNS})
        notes += _notes(line)
        found = [h.found for h in held if h.found is not None]
        if all(p.test is not None for p in parts) and len(found) == len(parts):
            rungs = ladder(parts, found, say)
            tables[f"{name}: models in turn"] = [rung.row for rung in rungs]
            record[name] = [rung.row | rung.further for rung in rungs]
    if halves and sessions:
        declared = Arm.load(folder("config") / "arm_demo.yaml")
        show(f"halves of {sessions} simulated sessions", 1.0)
        every = [real_sets.halves(part) for part in real_sets.simulate_sets(declared, sessions)]
        line = {"set": "simulated", "sessions": sessions} | real_sets.overlap(every)
        record["sets"].append(line)
        notes += _notes(line)
    return Figures(record, tables, notes)


def _notes(line: Mapping[str, Any]) -> list[str]:
    """Write lines on what no column of the table holds."""
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
