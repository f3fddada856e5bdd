"""The visits of a plan of poses, in driving order, and the checks of them before the arm moves."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from longarm_comp.arm_folder.head import View
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import SAME_POSE
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.data.plan import FLOOR, Plan, with_room
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import boxes_entered, describe_entry
from longarm_comp.devices.servo_config import ServoConfig


@dataclass(frozen=True, eq=False)
class Visit:
    """One measurement to make."""

    index: int
    path: np.ndarray  # (2, n) start of the run-up and pose, or (1, n) pose alone; rad and m
    repeat_id: int = -1  # number of the pose if it is visited more than once
    payload_kg: float | None = None  # mass to carry; None: as it is

    @property
    def q(self) -> np.ndarray:
        """(n,) joints of the pose to measure, rad and m."""
        return self.path[-1]


def list_visits(
    plan: Plan, arm: Arm, *, repeats: int = 0, shuffle: bool = True, seed: int = 0
) -> list[Visit]:
    """Return the visits of a plan, always the same ones for the same arguments.

    A joint that has no room for its run-up on the planned side arrives from the other side. The
    visits with one payload follow one another, so that it is changed as rarely as possible.

    Args:
        repeats: number of poses, drawn at random, that are visited two more times.
        shuffle: drive in random order, so that effects of time and pose can be told apart.

    Raises:
        InputError: there are more repeats than poses.
    """
    if not 0 <= repeats <= len(plan):
        raise InputError("collect", "--repeats", repeats, f"0 to {len(plan)} (poses of the plan)")
    rng = np.random.default_rng(seed)
    again = rng.permutation(len(plan))[:repeats]
    rows = np.concatenate([np.arange(len(plan)), np.repeat(again, 2)])
    order = rng.permutation(len(rows)) if shuffle else np.arange(len(rows))
    if plan.payload_kg is not None:
        order = order[np.argsort(plan.payload_kg[rows[order]], kind="stable")]
    first, pose, count = np.unique(
        plan.q[rows], axis=0, return_index=True, return_inverse=True, return_counts=True
    )[1:]
    pose = pose.reshape(-1)
    repeat_id = np.where(count > 1, first, -1)[pose]
    sides = with_room(arm, plan.q, plan.approach)
    start = plan.q - sides * run_up_lengths(arm)
    made = []
    for k, i in enumerate(order):
        row = rows[i]
        path = np.stack([start[row], plan.q[row]] if sides[row].any() else [plan.q[row]])
        payload = None if plan.payload_kg is None else float(plan.payload_kg[row])
        made.append(Visit(k, path, int(repeat_id[i]), payload))
    return made


@dataclass(frozen=True)
class PlanCheck:
    """The result of one check on every visit of a plan."""

    question: str  # the condition that is checked
    faults: tuple[str, ...]  # for each visit why it fails, or ""
    blocks: bool  # a visit that fails is not driven

    @property
    def passed_count(self) -> int:
        return sum(not fault for fault in self.faults)

    @property
    def common_faults(self) -> str:
        """The faults in words, the most frequent kinds first."""
        return in_words(fault for fault in self.faults if fault)


def plan_checks(
    arm: Arm,
    visits: Sequence[Visit],
    *,
    view: View | None = None,
    servos: ServoConfig | None = None,
) -> list[PlanCheck]:
    """Check the visits of a plan; checks that need missing data or cameras are left out."""

    def why_outside(path: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> str:
        off = (path < lower - SAME_POSE) | (path > upper + SAME_POSE)
        if not off.any():
            return ""
        row, j = np.argwhere(off)[0]
        allowed = f"allowed {lower[j]:.4g} to {upper[j]:.4g}"
        return f"{arm.joint_names[j]} outside: {path[row, j]:.4g}, {allowed}"

    model = declared_model(arm)
    q = np.array([visit.q for visit in visits])
    outside = tuple(why_outside(visit.path, *arm.bounds) for visit in visits)
    checks = [PlanCheck("inside the limits of arm.yaml", outside, True)]
    if servos is not None:
        joints = [servos.joints[name] for name in arm.joint_names]
        slack = np.array([0.5 * joint.si_per_tick for joint in joints])  # as the driver allows
        lower = np.array([joint.lower for joint in joints]) - slack
        upper = np.array([joint.upper for joint in joints]) + slack
        faults = tuple(why_outside(visit.path, lower, upper) for visit in visits)
        checks.append(PlanCheck("inside the servos' limits", faults, True))
    if arm.keep_out:
        # A fault of the floor and one of other boxes, at the pose and where its run-up begins
        owner = np.repeat(np.arange(len(visits)), [len(visit.path) for visit in visits])
        found = {True: [""] * len(visits), False: [""] * len(visits)}
        stops = np.concatenate([visit.path for visit in visits])
        for k, text in zip(owner, boxes_entered(model, stops), strict=True):
            side = found[text.startswith(f"{FLOOR}:")]
            side[k] = side[k] or text
        if FLOOR in arm.keep_out:
            checks.append(PlanCheck("over the floor", tuple(found[True]), True))
        if set(arm.keep_out) - {FLOOR}:
            checks.append(PlanCheck("outside the keep-out boxes", tuple(found[False]), True))
        # The way from the visit before, and the run-up
        starts = [visits[0].path[0], *q[:-1]]
        ways = (np.vstack([start, v.path]) for start, v in zip(starts, visits, strict=True))
        free = tuple(describe_entry(model, way) for way in ways)
        checks.append(PlanCheck("way there is free", free, False))
    if view is not None:
        checks.append(PlanCheck("seen by both cameras", tuple(view.unseen(model.pose(q))), False))
    return checks


def blocked_visits(checks: Sequence[PlanCheck], visits: Sequence[Visit]) -> dict[int, str]:
    """Return the first reason against each visit that must not be driven, by index of the visit."""
    found: dict[int, str] = {}
    for check in checks:
        for visit, fault in zip(visits, check.faults, strict=True):
            if fault and check.blocks:
                found.setdefault(visit.index, fault)
    return dict(sorted(found.items()))


def servos_beside(arm: Path, names: Sequence[str]) -> ServoConfig | None:
    """Return the servos in the folder of an arm.yaml; None without a file or for other joints."""
    file = arm.absolute().parent / "servo_driver.yaml"
    if not file.is_file():
        return None
    servos = ServoConfig.load(file)
    return servos if sorted(servos.joints) == sorted(names) else None


def refuse_blocked(checks: Sequence[PlanCheck], visits: Sequence[Visit], where: object) -> None:
    """Raise InputError if a visit must not be driven."""
    found = blocked_visits(checks, visits)
    for index, why in found.items():
        others = f" (and {len(found) - 1} more poses)" if len(found) > 1 else ""
        allowed = "poses that `longarm plan` makes for this arm and floor"
        raise InputError(where, f"pose of visit {index}", why + others, allowed)


def in_words(faults: Iterable[str]) -> str:
    """Say in words how many faults of each kind there are, the most frequent first."""
    kinds = Counter(fault.partition(": ")[0] for fault in faults)  # without their figures
    return ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
