"""Trained in one condition, commanded in another: payload, temperature, wear.

The paper concludes that error model and network together need no retraining "under relatively
loose conditions", so that they adapt to working conditions more strongly than either alone (its
claim S14).  The arms of Table I, which also grow when warm, are trained as it says; then 40 targets
are commanded as trained, with more payload, warmer, and with the play of one joint grown.  Payload
and temperature are told; nobody knows of the wear.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from longarm_comp.cli import options
from longarm_comp.core.arm.arm import Arm
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.drives import FrictionHysteresis
from studies import table1
from studies.commands import (
    Figures,
    Show,
    arm_option,
    arms_option,
    each_arm,
    split_interval,
    study_command,
)
from studies.day_work import levers
from studies.table1_bench import SETTINGS, Bench, Outcome, RowSetting, fitted_once

ALSO = ("thermal_growth",)
"""What the arms of Table I hide besides: without it, warmth changes nothing but beams."""
NETWORK, TOGETHER = "SSA-BP only, 300", "Deflection + SSA-BP, 300"
ROWS = (
    "Original error", "Deflection only", NETWORK, TOGETHER, "Calibrated + effects, 300",
    "Best: effects + SSA-BP, 300",
)  # fmt: skip


@dataclass(frozen=True)
class Condition:
    """Other than trained in: payload (kg), temperature (K), play of one joint (rad), by so much."""

    name: str
    payload_kg: float = 0.0
    warmer_k: float = 0.0
    play_rad: float = 0.0

    def of(self, bench: Bench) -> Bench:
        """Return the bench in it."""
        arm = bench.declared.arm
        more = self.play_rad * np.eye(arm.n)[levers(arm)[0]]
        worn = [
            replace(e, lag=e.lag + more) if isinstance(e, FrictionHysteresis) else e
            for e in bench.true.hidden
        ]
        return replace(
            bench,
            true=TrueArm(arm, worn),
            temperature_c=bench.temperature_c + self.warmer_k,
            payload_kg=bench.payload_kg + self.payload_kg,
        )


CONDITIONS = (
    Condition("as trained"),
    Condition("+0.5 kg", payload_kg=0.5),
    Condition("15 K warmer", warmer_k=15.0),
    Condition("worn, 6 mrad", play_rad=6e-3),
    Condition("all three", 0.5, 15.0, 6e-3),
)

Found = Mapping[str, Sequence[Outcome]]
"""By condition: what every row leaves."""


def one_arm(
    base: Arm, seed: int, number: int, settings: Sequence[RowSetting], poses: int = 300
) -> Found:
    """Return all rows of one arm, each trained once."""
    bench = Bench.draw(base, seed, number, poses, also=ALSO)
    found: dict[str, list[Outcome]] = {condition.name: [] for condition in CONDITIONS}
    for setting in fitted_once(settings):
        trained = bench.train(setting, seed)
        for condition in CONDITIONS:
            found[condition.name].append(condition.of(bench).command(setting, *trained))
    return found


def rows_of(names: Sequence[str] = ROWS) -> tuple[RowSetting, ...]:
    """Return rows of Table I by name."""
    return tuple(setting for setting in SETTINGS if setting.row in names)


def table(arms: Sequence[Found], settings: Sequence[RowSetting]) -> list[dict[str, Any]]:
    """Return one row a setting: mean |z| by condition, mm; then the mean 3-D error likewise."""
    made: list[dict[str, Any]] = [{"row": setting.row} for setting in settings]
    for name in arms[0]:
        for row, of in zip(made, table1.rows([arm[name] for arm in arms], settings), strict=True):
            row[f"{name}, |z| mm"] = of["mean_abs_z_mm"]
            row[f"{name}, mm"] = of["mean_mm"]
    return made


def claims(arms: Sequence[Found], settings: Sequence[RowSetting]) -> list[dict[str, Any]]:
    """Compute by condition how much more the network loses than both together, mm of mean |z|.

    The claim holds where the 95 % interval over arms lies below 0, is contradicted above it, and
    is open in between.
    """
    made = []
    first, *others = arms[0]
    at = [
        {
            row["row"]: np.array(row["arms_mm"])
            for row in table1.rows([a[n] for a in arms], settings)
        }
        for n in (first, *others)
    ]
    for name, here in zip(others, at[1:], strict=True):
        lost = [{"row": r, "arms_mm": here[r] - at[0][r]} for r in (TOGETHER, NETWORK)]
        (line,) = table1.differences(lost, [(TOGETHER, NETWORK)])
        low, high = line["ci95_mm"]
        made.append(
            {
                "condition": name,
                "together_loses_mm": float(lost[0]["arms_mm"].mean()),
                "network_loses_mm": float(lost[1]["arms_mm"].mean()),
                "difference_mm": line["mean_mm"],
                "ci95_mm": [low, high],
                "claim": "holds" if high < 0 else "contradicted" if low > 0 else "open",
            }
        )
    return made


@study_command(arm_option, arms_option(8, "Simulated arms."), options.seed)
def command(arm: Arm, arms: int, seed: int, show: Show) -> Figures:
    """Train in one condition, command in another: payload, temperature, wear.

    The paper's claim S14: error model and network together lose less than the network alone.
    About a minute an arm.

    \b
    Example:
      longarm study conditions --arms 8
    """
    settings = rows_of()
    found = [one_arm(arm, seed, number, settings) for number in each_arm(arms, show)]
    rows, lost = table(found, settings), claims(found, settings)
    return Figures(
        {"arms": arms, "rows": rows, "claims": lost},
        {
            f"Mean errors of the true tip, trained as in the first column: {arms} arms": rows,
            "S14: what another condition costs": [split_interval(line) for line in lost],
        },
    )
