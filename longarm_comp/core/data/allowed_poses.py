"""Which poses of a plan may be driven and are seen: keep-out boxes, and what the cameras see."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from longarm_comp.core.arm.measuring import CameraSensor
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.data.plan import Plan
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model, unstack

_ALONG = np.linspace(0.0, 1.0, 9)
"""Points along each link that are looked at."""


def outside_boxes(model: Model, plan: Plan, boxes: Sequence[np.ndarray]) -> np.ndarray:
    """(M,) whether the arm stays out of every box, at each pose and where its run-up begins.

    The arm is the line through the origins of its frames to the tip.

    Args:
        model: where the arm stands.
        plan: M poses.
        boxes: (2, 3) opposite corners (m) in the frame of the measurements, each.
    """
    free = np.ones(len(plan), dtype=bool)
    start = plan.q - plan.approach * run_up_lengths(model.arm)
    for q in (plan.q, np.clip(start, model.arm.lower, model.arm.upper)) if boxes else ():
        line = _line(model, q)
        for box in boxes:
            inside = (line >= np.min(box, axis=0)) & (line <= np.max(box, axis=0))
            free &= ~inside.all(axis=2).any(axis=1)
    return free


def in_view(model: Model, plan: Plan, half_angle: float) -> np.ndarray:
    """(M,) whether a camera of arm.yaml has the tip within an angle (rad) of its optical axis.

    Args:
        model: where the tip is.
        plan: M poses.
        half_angle: half of the camera's view.

    Raises:
        InputError: arm.yaml declares no camera.
    """
    arm = model.arm
    eyes = [s.frame() for s in arm.sensors.values() if isinstance(s, CameraSensor)]
    looks = [(np.array(frame.p), np.array(frame.a)) for frame in eyes]
    if arm.camera is not None:
        looks.append((np.array(arm.camera.position_m), np.array(arm.camera.optical_axis)))
    if not looks:
        raise InputError("plan", "view", half_angle, "a camera in arm.yaml that sees the tip")
    tip = model.tip(plan.q)
    seen = np.zeros(len(plan), dtype=bool)
    for place, axis in looks:
        ray = tip - place
        along = ray @ axis / np.linalg.norm(axis)
        seen |= along >= np.cos(half_angle) * np.linalg.norm(ray, axis=1)
    return seen


def _line(model: Model, q: np.ndarray) -> np.ndarray:
    """(M, k, 3) points along the arm."""
    posture = model.posture(unstack(q))
    stations = [posture.frame(row) for row in range(len(model.arm.joints) + 1)]
    frames = [posture.frames[k] for k in stations] + [model.tip_frame(posture)]
    origins = [np.broadcast_to(f.matrix()[..., :3, 3], (len(q), 3)) for f in frames]
    pairs = itertools.pairwise(origins)
    parts = [a[:, None] + _ALONG[:, None] * (b - a)[:, None] for a, b in pairs]
    return np.concatenate(parts, axis=1)
