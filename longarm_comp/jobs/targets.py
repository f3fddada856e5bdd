"""Drives targets through the `compensate` service and measures the tip at rest.

To verify a method, the same targets are driven without compensation and with it.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped

from longarm_comp.core.compensation.result import Method, Status
from longarm_comp.core.compensation.target_frame import base_of_graph
from longarm_comp.core.data.plan import random_targets
from longarm_comp.core.errors import JobError
from longarm_comp.core.model.model import Model
from longarm_comp.jobs.client import ArmClient, Pace
from longarm_comp.jobs.graph_client import GraphClient, Reports
from longarm_comp.math.points import robust_kabsch
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.arm_state import NO_JOINTS
from longarm_comp.nodes.frames import prefix_of
from longarm_comp.nodes.messages import joints_of
from longarm_comp.workflows.verification import Verification, compare_runs
from longarm_interfaces.srv import Compensate

Witness = Callable[[int], np.ndarray]
"""A function that returns the tip (3,), m, by another instrument. Its argument is a time (ns) from
which the tip rests."""
Say = Callable[[str, float], None]
Draw = Callable[[int], np.ndarray]
"""A function that returns n further targets (n, 3), m, or fewer if there are no more."""
Refused = tuple[np.ndarray, str]
"""A target (3,), m, that the graph refuses, and why."""

PLACING = 6
"""Smallest number of measured targets with which an unknown frame can be placed and the errors
still judged."""
WITHOUT, COMPENSATED = "without compensation", "with compensation"


@dataclass(frozen=True, eq=False)
class Trial:
    """A run over N targets, and where the tip came to rest."""

    name: str  # what was compensated, in words
    target: np.ndarray  # (N, 3) m
    seen: np.ndarray  # (N, 3) mean sighting of the cameras, m; NaN where the marker was lost
    true: np.ndarray  # (N, 3) tip by another instrument, m; NaN without one
    status: np.ndarray  # (N,) status that the service returned, as a number of `Status`

    @property
    def off(self) -> np.ndarray:
        """(N, 3) measured - target, m; NaN where the marker was lost."""
        return self.seen - self.target

    @property
    def error(self) -> np.ndarray:
        """(M, 3) measured - target where the marker was seen, m."""
        return self.off[np.isfinite(self.off).all(axis=1)]

    @property
    def true_error(self) -> np.ndarray:
        """(M, 3) true - target where another instrument saw the tip, m."""
        off = self.true - self.target
        return off[np.isfinite(off).all(axis=1)]

    @property
    def refused_count(self) -> int:
        return sum(not Status(int(status)).success for status in self.status)

    def against(self, before: Trial, seed: int = 0) -> Verification:
        """Compare this run, target by target, with another run over the same targets."""
        return compare_runs((before.name, self.name), before.off, self.off, seed)


class TargetRunner:
    """Drives targets on a graph; ``witness`` is another instrument that measures the tip."""

    def __init__(self, client: ArmClient, pace: Pace, witness: Witness | None = None) -> None:
        self._client, self._pace, self._witness = client, pace, witness
        self._compensate = {m: graph.compensate_by(m.value).client(client.node) for m in Method}
        self._frame = "base"
        self.placed_in = ""
        """Frame of the sightings, if nobody knows its place, so that each run placed it."""

    def ready(self, target: np.ndarray, within_s: float) -> None:
        """Wait until kinematics knows the joints, so that it can answer for a target (3,), m."""
        client, reports = self._client, Reports(self._client)

        def hears() -> bool:
            return reports.last_message("kinematics", "targets") not in ("", NO_JOINTS)

        def knows() -> bool:
            answer = self.ask(target, Method.NONE, execute=False)
            return bool(answer.status != Compensate.Response.NOT_READY)

        client.until(hears, within_s, "kinematics hears no joint_states")
        reports.close()
        (self._frame,) = client.parameters("kinematics", "base_frame")
        client.until(knows, within_s, "kinematics has no joint_states")

    def refusals(self, targets: np.ndarray, methods: Sequence[Method]) -> list[str]:
        """Say for each target (N, 3), m, why the graph refuses it with a method, or ""."""
        why = [""] * len(targets)
        for method in methods:
            for k, target in enumerate(targets):
                answer = self.ask(target, method, execute=False)
                if not answer.success:
                    why[k] = why[k] or f"{method.value}: {answer.message}"
        return why

    def run(self, name: str, targets: np.ndarray, method: Method, progress: Say) -> Trial:
        """Send every target (N, 3), m, and measure the tip at rest.

        The tip is NaN where a target is refused or the marker is not seen.
        """
        rows = []
        for k, target in enumerate(targets):
            progress(f"{name}: {k} of {len(targets)} targets driven", k / len(targets))
            rows.append(self._drive_target(target, method))
        seen, true, status = (np.array(column) for column in zip(*rows, strict=True))
        return Trial(name, targets, self._in_base(seen, targets), true, status)

    def _in_base(self, seen: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Return sightings (N, 3), m, in the base; in an unknown frame they are laid on targets."""
        frame = self._client.seen_in
        if frame in ("", self._frame, prefix_of(self._client.node) + self._frame):
            return seen
        rows = np.isfinite(seen).all(axis=1)
        if rows.sum() < PLACING:
            why = f"nobody knows where the frame {frame!r} of the sightings lies"
            raise JobError(f"{why}: calibrate first, or drive more targets", needed=PLACING)
        rotation, offset = robust_kabsch(seen[rows], targets[rows])
        self.placed_in = frame
        return np.asarray(seen @ rotation.T + offset)

    def ask(self, target: np.ndarray, method: Method, *, execute: bool) -> Compensate.Response:
        """Return the answer for a target (3,), m, with a method; ask again if it came late."""
        pose = PoseStamped()
        pose.header.frame_id = self._frame
        pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = target.tolist()
        request = Compensate.Request(target=pose, position_only=True, execute=execute)
        service = self._compensate[method]
        client = self._client
        ask = client.call_to_move if execute else partial(client.call, again=True)
        answer = ask(service, request)
        stale = answer.status == Compensate.Response.STALE_TARGET  # nothing was moved
        return ask(service, request) if stale else answer

    def _drive_target(
        self, target: np.ndarray, method: Method
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Drive to one target; return the tip as seen and as it is (NaN if unknown), the status."""
        client = self._client
        start = client.joints
        answer = self.ask(target, method, execute=True)
        seen = true = np.full(3, np.nan)
        if not answer.success:
            return seen, true, int(answer.status)
        stops = (answer.run_up, answer.command) if answer.run_up.name else (answer.command,)
        path = np.array([joints_of(stop, client.arm, "compensate") for stop in stops])
        rest, looks = client.look(path, self._pace, start, answer.id)
        if looks:
            seen = np.mean(looks, axis=0)
        if self._witness is not None:
            true = self._witness(rest)
        return seen, true, int(answer.status)


def choose_targets(
    runner: TargetRunner, draw: Draw, n: int, methods: tuple[Method, ...]
) -> tuple[np.ndarray, list[Refused]]:
    """Return up to n targets (N, 3), m, that the graph accepts with every method, and the others.

    Nothing moves. Raises JobError if fewer than two targets are accepted.
    """
    kept: list[np.ndarray] = []
    refused: list[Refused] = []
    # Random targets are drawn at most so many times as often as they are wanted
    while len(kept) < n and len(kept) + len(refused) < 4 * n:
        drawn = draw(n - len(kept))
        if not len(drawn):
            break
        for xyz, why in zip(drawn, runner.refusals(drawn, methods), strict=True):
            if why:
                refused.append((xyz, why))
            else:
                kept.append(xyz)
    if len(kept) < 2:
        why = f": {refused[0][1]}" if refused else ""
        raise JobError(f"fewer than two targets are reachable{why}", refused=len(refused))
    return np.array(kept), refused


def at_random(model: Model, rng: np.random.Generator) -> Draw:
    """Return a function that draws targets: the tip of a model at random joints, base frame."""
    stands = base_of_graph(model)
    return lambda n: stands.carry_from_model(random_targets(model, n, rng))


def one_by_one(targets: np.ndarray) -> Draw:
    """Return a function that hands out the given targets (N, 3), m, in their order."""
    left = iter(targets)
    return lambda n: np.array(list(itertools.islice(left, n))).reshape(-1, 3)


def method_at_work(client: GraphClient) -> Method:
    """Return the present method of kinematics; `BOTH` if it compensates nothing at present."""
    (name,) = client.parameters("kinematics", "method")
    return Method.BOTH if Method(name) is Method.NONE else Method(name)


def verify(
    runner: TargetRunner,
    xyz: np.ndarray,
    refused: Sequence[Refused],
    method: Method,
    *,
    seed: int = 0,
    progress: Say = lambda text, share: None,
) -> tuple[Verification, dict[str, Any]]:
    """Drive targets (N, 3), m, without compensation, then with a method.

    Returns:
        The comparison, and everything as plain data, for --json and the file.
    """
    without = runner.run(WITHOUT, xyz, Method.NONE, progress)
    compensated = runner.run(COMPENSATED, xyz, method, progress)
    result = compensated.against(without, seed)
    errors = zip(xyz, without.off, compensated.off, strict=True)
    return result, {
        "rows": result.rows,
        "helps": result.helps,
        "summary": result.summary,
        "gain_mm": 1e3 * result.gain_m,
        "gain_ci95_mm": [1e3 * g for g in result.gain_ci95_m],
        "method": method.value,
        "targets": len(xyz),
        "seen_in_both": result.rows[0]["n"],
        "placed_by_each_run": runner.placed_in,
        "status": dict(Counter(str(Status(int(s))) for s in compensated.status)),
        "refused": [{"target": target, "why": why} for target, why in refused],
        "errors": [
            {"target": target, "without_mm": 1e3 * before, "compensated_mm": 1e3 * after}
            for target, before, after in errors
        ],
    }
