"""Runs a pose plan over the graph and records it: move, settle, look several times, next.

A visit is written to the bag when it is complete, with a ``session_row`` message that holds its
index. So an interrupted session is readable, and `collect` can continue it.
"""

import json
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from longarm_comp.arm_folder.head import View
from longarm_comp.core.arm.history import SAME_POSE
from longarm_comp.core.data.rest import NO_REST
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import describe_entry
from longarm_comp.jobs.client import ArmClient, DriverStopped, Pace
from longarm_comp.jobs.collect.load import PATIENCE_S, Attach, Load
from longarm_comp.jobs.collect.visits import Visit, in_words
from longarm_comp.jobs.graph_client import Reports
from longarm_comp.jobs.recorder import Recorder
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.health import ERROR, OK, WARN, Report
from longarm_comp.nodes.stereo_bridge import MARKER_LOST
from longarm_comp.sessions.bag import last_part, open_bag, read_visit
from longarm_comp.sessions.bag_segments import SegmentedBag
from longarm_comp.sessions.message_types import message_types

ROW_TOPIC, ROW_TYPE = "session_row", "std_msgs/msg/String"
_COMMAND_TOPIC = "joint_trajectory"
_READ = {ROW_TOPIC: ROW_TYPE, _COMMAND_TOPIC: "trajectory_msgs/msg/JointTrajectory"}


def visits_in_bag(path: Path, todo: Sequence[Visit], n: int) -> set[int]:
    """Return indices of the visits that a bag of an arm with n joints holds.

    Raises:
        InputError: the bag was not made by `longarm collect`, or its visits differ from the plan.
    """
    planned = {visit.index: visit.path for visit in todo}
    done: set[int] = set()
    command, begun = np.zeros((0, n)), "a bag that `longarm collect` began"
    with open_bag(path) as reader:
        kept = [c for c in reader.connections if last_part(c.topic) in _READ]
        for connection, _, raw in reader.messages(connections=kept) if kept else ():
            name = last_part(connection.topic)
            message: Any = message_types().deserialize_cdr(raw, _READ[name])
            try:
                if name == _COMMAND_TOPIC:
                    command = np.array([point.positions for point in message.points], float)
                    continue
                index = int(json.loads(message.data)["index"])
            except (KeyError, TypeError, ValueError) as error:
                raise InputError(path, connection.topic, str(error), begun) from error
            way = planned.get(index)
            if way is None or command.shape != way.shape or np.abs(command - way).max() > SAME_POSE:
                allowed = "the plan, seed and options with which it began"
                raise InputError(path, f"visit {index}", command.tolist(), allowed)
            done.add(index)
        if reader.message_count and not done:
            raise InputError(path, ROW_TOPIC, "none", begun)
    return done


@dataclass(frozen=True, eq=False)
class Progress:
    """The progress of a collection."""

    done: int  # number of visits that are in the bag
    total: int  # number of visits of the plan
    visit: int = -1  # index of the present one, if there is one
    made: Mapping[int, str] = field(default_factory=dict)
    """Why the marker was lost at each visit of this run, or ""; by index, the latest last."""
    seconds_left: float = math.nan  # an estimate, if there is one
    state: str = "running"  # or "waiting", "done", "ended"
    why: str = ""  # the reason why the collection waits or has ended

    @property
    def share(self) -> float:
        """The share of the plan that is done, 0 to 1."""
        return self.done / max(1, self.total)

    @property
    def lost_visits(self) -> dict[int, str]:
        """The visits of this run at which the marker was lost, by index, with the reason."""
        return {index: why for index, why in self.made.items() if why}

    @property
    def seen_count(self) -> int:
        """The number of visits of this run at which the marker was seen."""
        return len(self.made) - len(self.lost_visits)

    @property
    def losses(self) -> str:
        """A count of the poses at which the marker was lost, and why; empty if there is none."""
        if not self.lost_visits:
            return ""
        why = in_words(self.lost_visits.values())
        return f"marker lost at {len(self.lost_visits)} of {len(self.made)} poses: {why}"

    def __str__(self) -> str:
        if self.state != "running":
            return f"{self.state}: {self.why}" if self.why else self.state
        left = f", {self.seconds_left:.0f} s left" if math.isfinite(self.seconds_left) else ""
        poses = f"{self.done} of {self.total} poses driven{left}"
        return "; ".join(filter(None, (poses, self.losses)))


def progress_message(now: Progress, namespace: str) -> DiagnosticStatus:
    """Return the diagnostic status ``collect`` (docs/ros.md), without values not known yet."""
    losing = WARN if now.lost_visits else OK
    values: dict[str, object] = {
        "state": now.state,
        "done": now.done,
        "total": now.total,
        "seen": now.seen_count,
        "lost": len(now.lost_visits),
        "pose": now.visit,
    }
    if math.isfinite(now.seconds_left):
        values["eta_s"] = f"{now.seconds_left:.3f}"
    level = {"ended": ERROR, "waiting": WARN}.get(now.state, losing)
    return Report(level, str(now), values).status("collect", namespace)


@dataclass(frozen=True)
class Collected:
    """The result of `collect`."""

    made: int  # number of visits made in this run, before it, and planned
    before: int
    planned: int
    unseen: dict[int, str]  # why the marker was lost, by index of the visit
    blocked: dict[int, str]
    """Which box the way there enters, or which payload is missing, by index of a visit not made."""


def collect(
    client: ArmClient,
    todo: Sequence[Visit],
    path: Path,
    *,
    pace: Pace | None = None,
    resume: bool = False,
    give_up: int = 6,
    view: View | None = None,
    payload_kg: float | None = None,
    attach: Attach = lambda kg, visits: False,
    progress: Callable[[Progress], None] = lambda now: None,
) -> Collected:
    """Visit every pose of a plan that the bag does not hold yet.

    If the way to a visit enters a keep-out box, the visit is postponed until the arm stands
    elsewhere. While the driver is held, the collection waits; then the visit is made again. Visits
    whose payload nobody attaches are not made.

    Args:
        give_up: end if the marker was lost at all of this many first visits of a new bag; 0: never.
        view: the cameras' view by their files, to say why a marker is lost.
        payload_kg: mass that the arm carries at the start; None: as another node publishes it.
        attach: asks for another payload, while the arm stands.

    Raises:
        JobError: the marker is lost too often, the driver stopped or refused a move, or another
            node publishes another payload than the answered one.
    """
    begun = resume and (path / "metadata.yaml").is_file()
    done = visits_in_bag(path, todo, client.arm.n) if begun else set()
    with SegmentedBag(path, resume=resume) as bag:
        recorder, before = Recorder(client.node, bag), len(done)
        run = _Run(client, recorder, attach, pace or Pace(), progress, view, before, len(todo))
        try:
            run.drive([visit for visit in todo if visit.index not in done], give_up, payload_kg)
        except JobError as error:
            if run.now().lost_visits == run.made and not done:
                bag.discard()  # nothing in it is worth going on with
            with client.putting_back():
                run.end("ended", str(error))
            raise
    return Collected(len(run.made), len(done), len(todo), run.now().lost_visits, run.blocked)


@dataclass(eq=False)
class _Run:
    """The visits of one call of `collect`; `made` and `blocked` as in `Progress`, `Collected`."""

    _client: ArmClient
    _recorder: Recorder
    _attach: Attach
    _pace: Pace
    _show: Callable[[Progress], None]
    _view: View | None
    _before: int
    _total: int
    _visit: Visit | None = None
    _driving_s: float = 0.0
    made: dict[int, str] = field(default_factory=dict)
    blocked: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        client = self._client
        self._reports, self._load = Reports(client), Load(client, self._ask_for_load)
        self._publisher = graph.COLLECT_PROGRESS.publisher(client.node)
        self._model = declared_model(client.arm)

    def drive(self, left: list[Visit], give_up: int, payload_kg: float | None) -> None:
        self._client.ready()
        recorder, load = self._recorder, self._load
        self._client.wait(lambda: not (recorder.waits_for() or load.waits()), PATIENCE_S)
        if payload_kg is not None:
            load.confirm(payload_kg)
        half = max(5, len(left) // 2)
        while left:
            visit = self._choose_next(left)
            if visit is None:
                break
            left.remove(visit)
            self._visit = visit
            self._tell_progress()
            self._make_visit(visit)
            now = self.now()
            if now.lost_visits == self.made and not self._before and 0 < give_up <= len(self.made):
                hint = "longarm plan --seen leaves such poses out; --give-up 0 never ends early"
                raise JobError(f"{now.losses}. {hint}")
            if len(now.lost_visits) > half:
                raise JobError(f"the marker is not seen at most poses. {now.losses}")
        self._visit = None
        self.end("done")

    def end(self, state: str, why: str = "") -> None:
        """Publish the final state, and why the collection ended."""
        self._tell_progress(state, why)
        self._client.spin(0.2)  # s for it to be heard before the node ends

    def _ask_for_load(self, kg: float, visits: int) -> bool:
        self._visit = None
        self._tell_progress("waiting", f"{visits} poses need {kg:g} kg at the tool")
        return self._attach(kg, visits)

    def _make_visit(self, visit: Visit) -> None:
        """Drive to one pose, measure it and keep the row; repeat it if the driver was held."""
        begun_s = time.monotonic()
        while True:
            self._recorder.drop()
            self._load.publish()
            try:
                row = self._visit_row(visit)
                break
            except DriverStopped as stopped:
                if not stopped.held:
                    raise
                self._tell_progress("waiting", str(stopped))
                takes = partial(self._client.driver_takes, held=True)
                self._client.until(takes, math.inf, "driver")
                begun_s = time.monotonic()
        why = ""
        if not row.has_position[0]:
            why = self._describe_cause(visit.q, row.lost.get(visit.index, ""))
        self.made[visit.index] = why
        self._driving_s += time.monotonic() - begun_s
        self._tell_progress()

    def _describe_cause(self, q: np.ndarray, recorded: str) -> str:
        """Say why the marker is probably lost at joints q (n,).

        It is what was recorded if the arm did not rest, else by the cameras' geometry, else by the
        last message of `stereo_bridge`.
        """
        if recorded == NO_REST:
            return recorded
        why = "" if self._view is None else self._view.unseen(self._model.pose(q[None]))[0]
        if why:
            return why
        near = "in view, but " if self._view is not None else ""
        said = self._reports.last_message("stereo_bridge", "stereo")
        why = said.removeprefix(MARKER_LOST)
        return near + (why.partition(" (")[0] if why != said else "not seen")

    def _visit_row(self, visit: Visit) -> Session:
        """Drive to one pose, measure it, keep it, and return the row as the bag holds it.

        It waits until the recorder has received as much as the client.
        """
        client, pace, recorder = self._client, self._pace, self._recorder
        client.ready_to_move()
        start = client.joints
        begun = client.send(visit.path, pace.move_s, pace.arm_speed)
        _, tips = client.look(visit.path, pace, start)
        # Into the bag alone: what no topic of the robot says
        told = json.dumps({"index": visit.index, "repeat_id": visit.repeat_id})
        topic = client.node.resolve_topic_name(ROW_TOPIC)
        recorder.put(topic, ROW_TYPE, serialize_message(String(data=told)))
        topics = "joint_trajectory", "tip_measured", "joint_states"
        names = [client.node.resolve_topic_name(topic) for topic in topics]
        last = client.sightings[-1][0] if tips else 0
        end, read_at = time.monotonic() + pace.look_s, 0

        def complete() -> Session | None:
            nonlocal read_at
            command, tip, joints = (recorder.newest.get(name, 0) for name in names)
            late = not tips or time.monotonic() > end
            if command < begun or (not late and (min(tip, joints) < last or tip == read_at)):
                return None
            read_at = tip
            rows = read_visit(recorder.about(begun), client.arm)
            row = rows.take(np.flatnonzero(rows.index == visit.index)[-1:])
            return row if late or row.has_position[0] else None

        row: Session = client.until(complete, pace.look_s + 60.0, "recording")
        recorder.keep(since_ns=begun)
        return row

    def _choose_next(self, left: list[Visit]) -> Visit | None:
        """Return the first visit to which the way is free; None if there is none (`blocked`).

        Those with the payload at the tool come first; then another payload is asked for.
        """
        here, why = self._client.joints, {}
        loads = Counter(visit.payload_kg for visit in left)
        carried = {kg for kg in loads if self._load.is_carried(kg)}
        for visit in sorted(left, key=lambda visit: visit.payload_kg not in carried):
            kg = visit.payload_kg
            way = visit.path if here is None else np.vstack([here, visit.path])
            found = describe_entry(self._model, way)
            if not found and kg is not None and kg not in carried:
                found = self._load.change(kg, loads[kg])
            if not found:
                return visit
            why[visit.index] = found
        self.blocked = why
        return None

    def now(self, state: str = "running", why: str = "") -> Progress:
        made = len(self.made)
        done, each = self._before + made, self._driving_s / made if made else math.nan
        at, left_s = -1 if self._visit is None else self._visit.index, each * (self._total - done)
        return Progress(done, self._total, at, dict(self.made), left_s, state, why)

    def _tell_progress(self, state: str = "running", why: str = "") -> None:
        now = self.now(state, why)
        self._show(now)
        self._publisher.publish(progress_message(now, self._client.node.get_namespace()))
