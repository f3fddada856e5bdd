"""The ring of the tip after a move, and what shaping by an identified model saves.

The arms are made so soft that they sag by `SAG_M` on average, and hide soft joints and beams.  A
calibration at rest identifies the stiffness; of it the modes are computed at the end of each move.
The true arm rings by its own physics (`sim/ringing.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from longarm_comp.cli import options
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.measuring import VISIBLE_M
from longarm_comp.core.data.plan import random_joints
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.vibration.modes import find_modes
from longarm_comp.core.vibration.ring import move_straight
from longarm_comp.core.vibration.seen import correct_modes, fit_waves
from longarm_comp.core.vibration.shaper import find_shaper, find_way_modes
from longarm_comp.math.shaper import Way
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.ringing import Ringing
from studies.commands import (
    Figures,
    Show,
    arm_option,
    arms_option,
    each_arm,
    study_command,
    whole_number,
)
from studies.path import ELASTIC, StudiedArm

SAG_M = 0.02
DAMPING = 0.01
SPEED, RANGE_S = 0.5, 1.5
"""Mean speed of the tip at most, m/s, and time for a joint's whole range at least, s."""
CAMERA_HZ, SEEN_S, NOISE_M = 30.0, 4.0, 2e-4
"""Of the one ring that is watched."""
_STEP_S = 4e-3
_LOOK_S, _LONGEST_S = 5e-3, 120.0


@dataclass(frozen=True)
class Shaping:
    """A way to shape moves.

    Attributes:
        model: by which one's modes; not at all where empty.
        seen: whether its frequencies are corrected by one ring that the cameras saw.
        factor: its frequencies are wrong by.
    """

    name: str
    model: str = ""
    seen: bool = False
    factor: float = 1.0


SHAPINGS = (
    Shaping("not shaped"),
    Shaping("by the declared model", "declared"),
    Shaping("by the identified model", "identified"),
    Shaping("identified, one ring seen", "identified", seen=True),
    Shaping("the same, frequency 10 % high", "identified", True, 1.1),
    Shaping("the same, frequency 10 % low", "identified", True, 0.9),
)


def soften(arm: Arm, sag_m: float) -> Arm:
    """Return the arm with its beams so soft that it sags so much on average over its postures."""
    q = random_joints(arm, 64, np.random.default_rng(0))
    for _ in range(3):
        sag = np.linalg.norm(declared_model(arm).tip(q) - Model(arm).tip(q), axis=1).mean()
        data = arm.model_dump(mode="json", exclude_none=True)
        for beam in data["links"]:
            for key in ("E_pa", "G_pa", "EI_nm2", "GJ_nm2"):
                if key in beam:
                    beam[key] *= float(sag / sag_m)
        arm = Arm.parse(data, "softened")
    return arm


def after(true: TrueArm, way: Way, seconds: float) -> Ringing:
    """Return the true arm at the end of a motion."""
    ring = Ringing(true, DAMPING)
    times = np.append(np.arange(0.0, seconds, _STEP_S), seconds)
    for t, q in zip(times.tolist(), way(times), strict=True):
        ring.move_joints(t, q)
    ring.move_joints(seconds + 1e-9, way(times[-1:])[0])  # it stops
    return ring


def settle_s(ring: Ringing) -> float:
    """Time until the true tip stays within `VISIBLE_M` of its rest."""
    later = np.arange(0.0, _LONGEST_S, _LOOK_S)
    away = np.flatnonzero(np.linalg.norm(ring.tip_ring(later), axis=1) > VISIBLE_M)
    return float(later[away[-1]]) if len(away) else 0.0


def one_arm(declared: Arm, number: int, seed: int, moves: int) -> list[dict[str, Any]]:
    """Make random moves of one arm, each in every way."""
    studied = StudiedArm.draw(soften(declared, SAG_M), number, seed, ELASTIC)
    known = {"identified": studied.model, "declared": declared_model(studied.arm)}
    rng = np.random.default_rng([seed, number, 1])
    lines, heard = [], None
    for _ in range(moves + 1):
        start, end = random_joints(studied.arm, 2, rng)
        far = np.linalg.norm(np.diff(studied.model.tip(np.stack([start, end])), axis=0))
        share = np.abs(end - start) / (studied.arm.upper - studied.arm.lower)
        seconds = float(max(far / SPEED, RANGE_S * share.max()))
        way = move_straight(start, end, seconds)
        if heard is None:  # the first move is watched
            times = np.arange(0.0, SEEN_S, 1.0 / CAMERA_HZ)
            seen = after(studied.true, way, seconds).tip_ring(times)
            found = fit_waves(times, seen + NOISE_M * rng.standard_normal(seen.shape))
            heard = find_modes(studied.model, end), found
            continue
        for shaping in SHAPINGS:
            made, longer = way, 0.0
            if shaping.model:
                way_by = find_way_modes(known[shaping.model], way, seconds)
                if shaping.seen:
                    way_by = [correct_modes(each, *heard) for each in way_by]
                wrong = [replace(each, omega=shaping.factor * each.omega) for each in way_by]
                shaper = find_shaper(wrong, way, seconds, DAMPING)
                assert shaper is not None
                made, longer = shaper.shape_motion(way, seconds), shaper.duration
            lines.append({
                "moves": shaping.name, "move_s": seconds, "longer_s": longer,
                "settle_s": settle_s(after(studied.true, made, seconds + longer)),
            })  # fmt: skip
    return lines


def table(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row a way: mean times, s, and the mean settling over that of unshaped moves."""
    rows: list[dict[str, Any]] = []
    for shaping in SHAPINGS:
        mine = [line for line in lines if line["moves"] == shaping.name]
        row = {
            key: float(np.mean([line[key] for line in mine]))
            for key in ("move_s", "longer_s", "settle_s")
        }
        whole = row["longer_s"] + row["settle_s"]
        first = rows[0]["settle_s"] if rows else row["settle_s"]
        rows.append({
            "moves": shaping.name, **row,
            "p95_settle_s": float(np.percentile([line["settle_s"] for line in mine], 95)),
            "settle_ratio": row["settle_s"] / first, "ratio_with_longer": whole / first,
        })  # fmt: skip
    return rows


@study_command(
    arm_option,
    arms_option(8, "Simulated arms, each made to sag by 20 mm."),
    whole_number("--moves", 10, "Moves of each arm."),
    options.seed,
)
def command(arm: Arm, arms: int, moves: int, seed: int, show: Show) -> Figures:
    """Time the ring of the tip after a move, unshaped and shaped, to 0.1 mm.

    The moves are shaped with the modes of the declared model, of a model calibrated at rest, and of
    the same model with the frequencies of one ring that was seen, also with these 10 % wrong.

    \b
    Example:
      longarm study ringing --arms 8
    """
    rows = table([line for k in each_arm(arms, show) for line in one_arm(arm, k, seed, moves)])
    title = f"Until the tip is within 0.1 mm, {arms} arms, {moves} moves each"
    return Figures({"rows": rows}, {title: rows})
