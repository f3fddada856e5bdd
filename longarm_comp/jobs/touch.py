"""Records touches: the joint values of a running graph while somebody holds the tip still."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import INCLINATION
from longarm_comp.core.arm.measuring import KnownDistance
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.measurement import compute_touch_errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError, JobError, LongarmError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.attend import Attendant
from longarm_comp.jobs.client import ArmClient
from longarm_comp.jobs.graph_client import GraphClient
from longarm_comp.nodes.interfaces import CONTACT, JOINT_STATES
from longarm_comp.sessions.csv import merge_distances

READINGS = 10
"""Number of joint readings that are averaged for a row."""
PATIENCE_S = 30.0
"""Longest wait (s) for an arm that a hand brings to rest."""
ENOUGH = 8
"""Smallest number of touches whose distances from their points mean something."""


@dataclass
class TouchLog:
    """The touches of one arm, in the order in which they were taken."""

    arm: Arm
    distances: tuple[KnownDistance, ...] = ()
    before: Session | None = None  # the touches are added to it
    rows: list[tuple[np.ndarray, str, str]] = field(default_factory=list)
    """The joints (n,), the column (``touch`` or ``plane``) and the name in it, for each."""

    def __len__(self) -> int:
        return len(self.rows) + (0 if self.before is None else len(self.before))

    def begin_with(self, before: Session) -> None:
        """Add to the rows and known distances of an earlier session, which must be of touches."""
        for k in range(len(before)):
            named = [c for c in ("touch", "plane") if before.labels.get(c, [""] * (k + 1))[k]]
            if len(named) != 1 or np.isfinite(before.xyz[k]).any():
                raise InputError(before.source, f"row {k + 1}", "no touch", "rows of touches alone")
        for name in before.columns:
            if not INCLINATION.match(name):
                allowed = "a new file: a touch does not record it, and every row needs it"
                raise InputError(before.source, f"column {name}", "given", allowed)
        self.distances = merge_distances(before.touch_distances, self.distances, before.source)
        self.before = replace(before, touch_distances=self.distances, blocks=())

    def undo(self) -> None:
        """Forget the last touch, if there is one."""
        if self.rows:
            del self.rows[-1]
        elif self.before is not None:
            self.before = self.before.take(slice(-1)) if len(self.before) > 1 else None

    def take(self, client: ArmClient, name: str, column: str = "touch") -> np.ndarray:
        """Add a row with the joints as they rest now, and return these (n,), rad and m.

        Raises:
            JobError: the arm does not come to rest; or, for a point, `contact` is published and
                says that the ball sits in no socket.
        """
        q = wait_for_rest(client)
        if column == "touch" and not _is_seated(client):
            raise JobError(f"touch {name}: the ball sits in no socket; nothing was recorded")
        self.rows.append((q, column, name))
        return q

    def session(self) -> Session:
        """Return the touches as a session. Raises InputError if there are none."""
        if not len(self):
            raise InputError("touch", "rows", 0, "one touch at least")
        if not self.rows and self.before is not None:
            return self.before
        q, columns, names = zip(*self.rows, strict=True)
        labels = {
            column: np.where(np.array(columns) == column, np.array(names), "")
            for column in dict.fromkeys(columns)
        }
        made = Session.record(
            np.array(q),
            np.full((len(q), 3), np.nan),
            labels=labels,
            source="touch",
            touch_distances=self.distances,
        )
        return made if self.before is None else self.before.followed_by(made)

    def spread_m(self) -> np.ndarray | None:
        """Fit the touches; return the distance (m) of each from its point, None if it fails."""
        whole = self.session()
        if np.isfinite(whole.reading(KINDS["touch"])).sum() < ENOUGH:
            return None
        try:
            *_, (_, fitted) = fit_stages(declared_model(self.arm), whole)
        except LongarmError:
            return None
        return compute_touch_errors(fitted.model, whole)


def _is_seated(client: ArmClient) -> bool:
    """Tell whether the ball sits in a socket, by `contact`; True if nobody publishes it."""
    heard: list[str] = []
    felt = CONTACT.subscription(client.node, lambda message: heard.append(message.data))
    try:
        if client.node.count_publishers(felt.topic_name):
            client.until(lambda: heard, PATIENCE_S, "contact")
    finally:
        client.node.destroy_subscription(felt)
    return not heard or bool(heard[-1])


@contextmanager
def release_servos(client: GraphClient) -> Iterator[str]:
    """Switch the servos' torque off within the block, so that a hand can guide the arm.

    Yields the driver's answer. Raises JobError if the arm is stopped already, or was stopped again
    within the block: such a stop stays in force.
    """
    attendant = Attendant(client)
    said, own = attendant.let_go()
    try:
        yield said
    finally:
        with client.putting_back():
            attendant.take_back(own)


def wait_for_rest(client: ArmClient) -> np.ndarray:
    """Wait until the joints rest, and return the mean (n,) of `READINGS` readings, rad and m.

    Readings that were waiting in the queue are skipped, because they may be from the last move.
    """
    client.joints = None
    client.until(lambda: client.joints is not None, PATIENCE_S, "no joint_states")
    # Share of a joint's range within which it is at rest: a hand is less still than a servo
    room = 2e-3 * (client.arm.upper - client.arm.lower)
    held: list[np.ndarray] = []
    last, waiting = client.joints, JOINT_STATES.depth

    def still() -> bool:
        nonlocal last, waiting
        now = client.joints
        if now is None or now is last:
            return False
        last, waiting = now, waiting - 1
        if waiting > 0:
            return False
        held.append(now)
        if (np.ptp(held, axis=0) > room).any():
            del held[:-1]
        return len(held) >= READINGS

    client.until(still, PATIENCE_S, lambda: f"the arm did not rest within {PATIENCE_S:g} s")
    return np.asarray(np.mean(held, axis=0))
