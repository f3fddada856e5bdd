"""What the model expects of the tip's ring after the last move, on /diagnostics."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.core.errors import InputError
from longarm_comp.core.vibration.after_move import MoveRing, ring_after
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.health import OK, Report
from longarm_comp.nodes.messages import joints_of, path_of, seconds
from longarm_interfaces.msg import Motion


class RingTeller:
    """Computes on the worker, when a move has ended and nothing else waits.

    Args:
        shaped: whether the driver splits moves so that they leave little ring.
    """

    def __init__(self, state: ArmState, shaped: bool) -> None:
        self._state, self._shaped = state, shaped
        self._move: Any = None
        self._last: MoveRing | None = None
        self._said = "not known, because no move has ended"
        if not state.driver.acknowledged:
            self._said = "not known, because the driver does not say when it ends"

    def told(self, motion: Motion) -> None:
        """Take what became of a trajectory."""
        if motion.event == Motion.ACCEPTED:
            self._move = motion
        elif motion.event == Motion.REACHED and self._move is not None:
            move = self._move
            if move.id == motion.id and not self._state.worker.waiting:
                self._state.worker.submit(partial(self._compute, move))
        elif motion.event in (Motion.REPLACED, Motion.BROKEN_OFF):
            self._move, self._last, self._said = (
                None,
                None,
                "not known, because it did not end at rest",
            )

    def _compute(self, move: Any) -> None:
        state, arm = self._state, self._state.arm
        context = state.known()
        if move is not self._move or context is None:
            return
        try:
            start = joints_of(move.start, arm, "start of motion")
            way = JointTrajectory(joint_names=move.start.name, points=move.points)
            points = path_of(way, arm)
        except InputError:
            return  # the link to the driver has said so
        times = np.array([seconds(point.time_from_start) for point in move.points])
        self._last = ring_after(state.files.loaded.model, context, start, points, times)
        if self._last is None:
            self._said = "by this model nothing bends"
        elif self._shaped:
            self._said = f"{self._last.hz:.2g} Hz; moves are shaped, little of the ring is left"
        else:
            self._said = self._last.said()

    def report(self) -> Report:
        """The last one, for diagnostics."""
        ring = None if self._shaped else self._last
        facts: dict[str, object] = {} if ring is None else {
            "frequency [Hz]": ring.hz, "size [m]": ring.size_m, "settles in [s]": ring.settle_s,
            "damping": ring.damping,
        }  # fmt: skip
        return Report(OK, self._said, facts)
