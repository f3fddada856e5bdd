"""The frame of targets: the arm's own base, or the frame in which the rows were measured.

A calibrated model computes in the frame of the measurements, and a target in the base frame is
transformed into it.  A shift of all rows by a bias counts as part of that frame, as in the errors
as commanded (`core/data/commanded.py`).  If the frame of a target is not stated, both frames must
agree to within a usual error of setup everywhere in reach; else the target is refused.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.frame_tree import carry_place
from longarm_comp.core.arm.spatial import roll_pitch_yaw
from longarm_comp.core.compensation.expected import geometry_of
from longarm_comp.core.compensation.result import Compensation
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model, slots_of, unstack
from longarm_comp.core.model.uncertainty import sizes

BASE, MEASURED = "base", "measured"
FRAMES = (BASE, MEASURED)


@dataclass(frozen=True, eq=False)
class Placement:
    """The transforms between the frames of targets, of the measurements and of a model."""

    frame: str  # frame of the target, ``base`` or ``measured``
    motion: np.ndarray  # (4, 4) transform from the frame of the target to that of the model
    base: np.ndarray  # (4, 4) pose of the base in the frame of the measurements
    seen: np.ndarray  # (4, 4) transform from the frame of the measurements to that of the model
    solved: bool  # whether `base` comes from a calibration

    @property
    def text(self) -> str:
        """The frame of the targets and the place of the base, in one line."""
        turned = (f"{np.degrees(v):.2f}" for v in roll_pitch_yaw(self.base[:3, :3]))
        at = ", ".join(f"{v:.4f}" for v in self.base[:3, 3])
        how = "by calibration" if self.solved else "as arm.yaml declares"
        return (
            f"targets in the frame {self.frame}; the base stands at {at} m, "
            f"rpy {', '.join(turned)} deg in the frame of the measurements, {how}"
        )

    def promising(self, model: Model) -> Model:
        """Return the model with the uncertainty that applies to targets of this frame.

        Targets in the frame of the measurements need the whole uncertainty: there the errors of the
        base and of the joints' zeros cancel each other. For targets in the base frame the
        uncertainty of the base is left out.
        """
        if self.frame == MEASURED or not self.solved or model.uncertainty is None:
            return model
        if "promising_from_base" not in model.memo:
            bases = [e for e in model.effects if e.base(model.arm) is not None]
            known = model.uncertainty.without({s.identity for s in slots_of(model.arm, bases)})
            model.memo["promising_from_base"] = replace(model, uncertainty=known)
        made: Model = model.memo["promising_from_base"]
        return made

    def carry_to_model(self, target: np.ndarray) -> np.ndarray:
        """Transform targets, (..., 3) m or (..., 4, 4), to the frame of the model."""
        return carry_place(self.motion, target)

    def carry_from_model(self, place: np.ndarray) -> np.ndarray:
        """Transform positions, (..., 3) m, or poses from the model's frame to the target's."""
        return carry_place(self._back, place)

    @cached_property
    def _back(self) -> np.ndarray:
        """The (4, 4) pose of the model's frame in the frame of the target."""
        return np.linalg.inv(self.motion)

    @property
    def measurements(self) -> np.ndarray:
        """The (4, 4) pose of the measurements' frame in the frame of the target."""
        return self.carry_from_model(self.seen)

    def turn_from_model(self, vector: np.ndarray) -> np.ndarray:
        """Rotate a vector (3,) from the model's frame to the frame of the target."""
        return np.asarray(self.motion[:3, :3].T @ vector)

    def carry_back(self, outcome: Compensation) -> Compensation:
        """Return a result with its target, error and pseudo-target in the frame of the target."""
        return replace(
            outcome,
            target=self.carry_from_model(outcome.target),
            predicted_error=self.turn_from_model(outcome.predicted_error),
            pseudo_target=self.carry_from_model(outcome.pseudo_target),
        )


def find_placement(
    model: Model, frame: str = "", group: str = "", where: str = "targets"
) -> Placement:
    """Return the placement of targets of one frame and group.

    Args:
        frame: ``base``, ``measured``, or "" if it is not stated.
        group: group of rows to which the targets belong, if the base was moved between groups.
        where: source of the targets, for error messages.

    Raises:
        InputError: the frame or the group is missing, unknown or not possible.
    """
    if frame not in ("", *FRAMES):
        raise InputError(where, "frame", frame, " or ".join(FRAMES))
    declared, found = model.arm.base.frame().matrix(), _bases(model)
    if len(found) > 1 and group not in found:
        names = ", ".join(str(name) for name in found)
        raise InputError(where, "group", group or "missing", f"{names}: the base stood in several")
    base = found.get(group, declared) if len(found) > 1 else next(iter(found.values()), declared)
    motion, seen = base @ np.linalg.inv(declared), _motion_of_all_rows(model)
    if frame == MEASURED:
        if not found and model.arm.tolerance.base is None:
            allowed = f"{BASE}, or a calibrated model, which says where the base stands"
            raise InputError(where, "frame", frame, allowed)
        return Placement(MEASURED, seen, base, seen, bool(found))
    if frame == BASE:
        return Placement(BASE, motion, base, seen, bool(found))
    away, usual = _farthest_apart(motion, model.arm)
    if away > usual:
        allowed = (
            f"{BASE} (the arm's own) or {MEASURED} (that of the measurements), by a column frame, "
            "--frame or frame=: the calibration found the base elsewhere, "
            f"{1e3 * away:.4g} mm apart at a tip that the arm reaches; up to {1e3 * usual:.3g} mm "
            "would count as an error of setup"
        )
        raise InputError(where, "frame", "not said", allowed)
    return Placement(MEASURED if found else BASE, seen, base, seen, bool(found))


def base_of_graph(model: Model) -> Placement:
    """Return the placement of the targets of the graph, which are in the frame ``base``.

    If the calibration found the base farther from where arm.yaml declares it than a usual error of
    setup, this is the arm's own base. Else both frames count as one, that of the measurements.
    """
    arm, seen = model.arm, _motion_of_all_rows(model)
    declared = arm.base.frame().matrix()
    base = _bases(model).get("", declared)
    motion = base @ np.linalg.inv(declared)
    away, usual = _farthest_apart(motion, arm)
    if away > usual:
        return Placement(BASE, motion, base, seen, True)
    return Placement(MEASURED, seen, base, seen, base is not declared)


def _motion_of_all_rows(model: Model) -> np.ndarray:
    """Return the transform (4, 4) from the measurements' frame to the model's: `frame_shift`."""
    made = np.eye(4)
    made[:3, 3] = np.negative(model.frame_shift)
    return made


def _bases(model: Model) -> dict[str, np.ndarray]:
    """Return the calibrated poses (4, 4) of the base in the measurements' frame, by group."""
    found: dict[str, np.ndarray] = {}
    for effect in model.effects:
        stands = effect.base(model.arm)
        if stands is not None:
            found[str(effect.placement.get("group", ""))] = stands.matrix()
    return found


def _farthest_apart(motion: np.ndarray, arm: Arm) -> tuple[float, float]:
    """Compute how far a motion (4, 4) moves a tip, and how far a usual error of setup does, m.

    90 of 100 errors of setup are below the second value. A motion hardly moves some points, so both
    are returned for the tip at which their ratio is largest. Tips are tried with all joints
    mid-range, all at one end of their ranges, and each alone at one end.
    """
    if arm.hash not in _in_reach:
        ends = np.clip(arm.bounds, -2 * np.pi, 2 * np.pi)
        each = np.where(np.eye(arm.n, dtype=bool), ends[:, None], arm.mid)
        q = np.vstack([arm.mid, *ends, *each])
        model, slots = Model(arm), slots_of(arm, geometry_of(arm))
        tips, columns = model.columns(model.posture(unstack(q)), slots)
        moved = columns * [slot.parameter.prior for slot in slots]
        _in_reach[arm.hash] = tips, sizes(moved @ np.swapaxes(moved, 1, 2))[1]
    tips, usual = _in_reach[arm.hash]
    away = np.linalg.norm(carry_place(motion, tips) - tips, axis=1)
    most = int(np.argmax(away / usual))
    return float(away[most]), float(usual[most])


_in_reach: dict[str, tuple[np.ndarray, np.ndarray]] = {}
