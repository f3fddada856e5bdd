"""Ledger of targets: each one is answered once, and each executed command is sent once."""

import re
from collections import Counter, OrderedDict
from dataclasses import dataclass, field

from longarm_comp.core.compensation.result import Status

Joints = tuple[float, ...]
_REMEMBERED = 20_000  # answered targets, to notice a second answer


@dataclass
class Ledger:
    """Record of sent targets, their answers and trajectories. Times are in s.

    Targets are identified by their stamp (ns).

    Attributes:
        answered: number of answers by status.
        wrong: number of violations by kind; empty after a good soak.
        reasons: number of refusals by their reason up to its first number.
    """

    sent: int = 0
    answered: Counter[int] = field(default_factory=Counter)
    wrong: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    trajectories: int = 0
    _open: dict[int, tuple[float, bool]] = field(default_factory=dict)
    _closed: OrderedDict[int, None] = field(default_factory=OrderedDict)
    _unmatched: Counter[Joints] = field(default_factory=Counter)

    @property
    def waiting(self) -> int:
        """Targets without an answer yet."""
        return len(self._open)

    def target(self, stamp: int, now: float, *, good: bool) -> None:
        """Enter a target that is sent. One that is not good must be refused."""
        self.sent += 1
        self._open[stamp] = now, good

    def answer(self, stamp: int, status: int, refused: bool, message: str, joints: Joints) -> None:
        """Enter the answer on `compensation`; ``joints`` were sent to the driver, if any."""
        if stamp not in self._open:
            self.wrong["answered twice" if stamp in self._closed else "answer to no target"] += 1
            return
        _, good = self._open.pop(stamp)
        self._closed[stamp] = None
        while len(self._closed) > _REMEMBERED:
            self._closed.popitem(last=False)
        self.answered[status] += 1
        if refused:
            self.reasons[re.split(r"-?[\[\d]", message)[0].strip()] += 1
        if refused and not message:
            self.wrong["refused without a reason"] += 1
        if refused and joints and status != Status.NOT_ACCEPTED:
            self.wrong["refused but executed"] += 1
        if not refused and not good:
            self.wrong["a bad target was accepted"] += 1
        if not refused and not joints:
            self.wrong["accepted but not executed"] += 1
        if joints:
            self._match(joints, 1)

    def trajectory(self, joints: Joints) -> None:
        """Enter the joints of a message on `joint_trajectory`."""
        self.trajectories += 1
        self._match(joints, -1)

    def _match(self, joints: Joints, step: int) -> None:
        self._unmatched[joints] += step
        if not self._unmatched[joints]:
            del self._unmatched[joints]

    def late(self, now: float, patience_s: float) -> int:
        """Number of targets without an answer for longer than ``patience_s``."""
        return sum(now - sent > patience_s for sent, _ in self._open.values())

    def give_up(self) -> None:
        """Count targets without an answer as lost."""
        if self._open:
            self.wrong["target without an answer"] += len(self._open)
        self._open.clear()

    def close(self) -> None:
        """Count all open entries as lost, when everything is at rest."""
        self.give_up()
        lost = sum(n for n in self._unmatched.values() if n > 0)
        doubled = -sum(n for n in self._unmatched.values() if n < 0)
        for kind, n in (
            ("executed but no trajectory", lost),
            ("trajectory that no target asked for", doubled),
        ):
            if n:
                self.wrong[kind] += n
        self._unmatched.clear()
