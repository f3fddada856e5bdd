"""Updates the model in use from rest poses during ordinary work, and saves it in a file."""

from __future__ import annotations

import time
from datetime import datetime
from pathlib import Path
from typing import IO, TYPE_CHECKING

from std_msgs.msg import String

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.expansion import Expansion
from longarm_comp.core.data.rest import RestPose
from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.files import lock_beside
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.clock import steady_timer
from longarm_comp.nodes.health import OK, WARN, Report
from longarm_comp.nodes.params import Param

if TYPE_CHECKING:
    from longarm_comp.core.at_work.learner import Learner, PoseRequest

PARAMS = (
    Param("learning", False, "the model learns from ordinary moves (docs/at_work.md)"),
    Param("learning_step_m", 2e-3, "largest correction of the tip where it was seen", 1e-6, 0.1),
    Param("learned_file", "", "what was learned; by default *.at_work.json beside the model"),
)


class Learning:
    """Replaces the model in use by the learned one, on the worker, and saves this in a file."""

    def __init__(self, state: ArmState) -> None:
        self._state, self._files = state, state.files
        self.learner: Learner | None = None
        self._update_ms, self._fault = 0.0, ""
        self._asked: PoseRequest | None = None
        self._continued = 0
        self._path = Path(
            state.p["learned_file"]
            or Path(state.p["model"] or "model.yaml").with_suffix(".at_work.json")
        )
        self._lock: IO[bytes] | None = None
        self._told = graph.LEARNED.publisher(state.node)
        # A frozen learner has no next change that would save
        again_s = 5.0  # between two attempts to save after a failure
        steady_timer(state.node, again_s, lambda: state.worker.submit_once(self._keep_again))
        self.begin()

    def begin(self) -> None:
        """Continue from what was learned with the loaded model; keep that of another one.

        Raises:
            InputError: nothing can be learned with this model, or the file is damaged or used by
                another process. The model is then used as it was loaded.
        """
        if not self._state.p["learning"]:
            self._told.publish(String())
            return
        from longarm_comp.core.at_work import file  # imports SciPy: only where it is needed

        loaded, step_m = self._files.given, self._state.p["learning_step_m"]
        try:
            self._lock = self._lock or lock_beside(self._path)
            file.take_up(self._path, loaded.file_hash)
            learner = file.load(self._path, loaded.model, loaded.file_hash, step_m)
        except InputError as error:
            self._fault, self.learner = f"nothing is learned: {error}", None
            self._told.publish(String())
            raise
        self.learner, self._asked = learner, None
        self._continued = self.learner.sightings
        self._files.replace_model(self.learner.model)
        self._tell(self.learner)

    def learn_from(self, rest: RestPose, context: Context, learned: Expansion | None) -> bool:
        """Learn from the tip at a rest pose, without the error that a predictor expects.

        Return whether another version of the model began, because a change is now certain.
        """
        before = self.learner
        if before is None or before.frozen:
            return False
        error, sigma = (0.0, None) if learned is None else (learned.error, learned.sigma)
        begun, now_s = time.perf_counter(), self._state.now_s
        after = before.learn(rest.q, context, rest.tip - error, rest.variance, now_s, sigma)
        self._update_ms = 1e3 * (time.perf_counter() - begun)
        self._take_over(after)
        self._asked = after.request_pose(context)
        return after.versions[-1] is not before.versions[-1]

    def freeze(self, frozen: bool) -> tuple[bool, str]:
        if self.learner is None:
            return False, _OFF
        self._take_over(self.learner.freeze() if frozen else self.learner.thaw())
        return True, self._with_fault("frozen" if frozen else "learning")

    def undo(self) -> tuple[bool, str]:
        """Use the version before the last change, and stop learning; return success and message."""
        if self.learner is None:
            return False, _OFF
        self._take_over(self.learner.undo())
        done = f"version {len(self.learner.versions)} is in use, and nothing is learned"
        return True, self._with_fault(done)

    def _with_fault(self, done: str) -> str:
        """Return ``done``; if the file was not written, add that this ends with the process."""
        return f"{done}; until this node ends: {self._fault}" if self._fault else done

    def _take_over(self, after: Learner) -> None:
        before, self.learner, self._asked = self.learner, after, None
        if before is None or after.model is not before.model:
            self._files.replace_model(after.model)
        self._tell(after)

    def _tell(self, learner: Learner) -> None:
        """Save what was learned in the file, and publish the file's path."""
        from longarm_comp.core.at_work import file

        try:
            file.save(self._path, learner, self._files.given.file_hash)
            self._fault = ""
        except LongarmError as error:
            self._fault = f"not kept: {error}"
        self._told.publish(String(data=str(self._path.absolute())))

    def _keep_again(self) -> None:
        if self.learner is not None and self._fault:
            self._tell(self.learner)

    def report(self) -> Report:
        learner = self.learner
        if learner is None:
            return Report(WARN, self._fault)
        facts = {
            "sightings": learner.sightings,
            "doubtful": learner.doubtful,
            "version": len(learner.versions),
            "update, ms": round(self._update_ms, 1),
            "of these before the start": self._continued,
        }
        if self._fault:
            return Report(WARN, self._fault, facts)
        if learner.unexplained:
            said = "something changed that no known effect explains: run longarm diagnose"
            return Report(WARN, said, facts)
        if learner.disagreeing >= _MANY:
            seem = "of the last sightings seem wrong: look at marker and camera"
            return Report(WARN, f"{learner.disagreeing} {seem}", facts)
        if learner.knocked:
            moved = "; ".join(n.text for n in learner.now)
            said = f"base or camera, tip or marker was moved: calibrate again ({moved})"
            return Report(WARN, said, facts)
        since = (f"{n.text}, since {datetime.fromtimestamp(n.since_s):%H:%M}" for n in learner.now)
        found = "; ".join(since)
        state = "frozen" if learner.frozen else "learning"
        if self._asked is not None:
            found += f"; {self._asked.text}"
        return Report(OK, f"{state}: {found or 'nothing changed'}", facts)


_MANY = 5
"""Number of wrong sightings among the last twenty from which on a warning is given.

By chance it happens once in 700,000 times (`DOUBT`).
"""
_OFF = "nothing is learned at work: its parameter `learning` is false"
