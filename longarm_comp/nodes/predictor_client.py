"""The learned error: computed from the file of `error_predictor`, or requested from this node."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from std_msgs.msg import String

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.expansion import Expansion, Nearby
from longarm_comp.core.compensation.result import Method
from longarm_comp.core.errors import InputError, JobError, LongarmError
from longarm_comp.core.files import file_hash
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.learn.predictor_file import load
from longarm_comp.nodes.clock import sleepless_s
from longarm_comp.nodes.messages import joints_message
from longarm_comp.nodes.worker import ServiceCaller
from longarm_interfaces.srv import PredictError

BEAT_S = 0.2
"""Interval at which `error_predictor` publishes which file it uses, s."""


@dataclass(frozen=True)
class ServedPredictor:
    """A predictor of an arm, and the SHA-256 of its file."""

    predictor: Predictor
    file_hash: str

    @classmethod
    def read(cls, path: str, arm: Arm, model_hash: str | None = None) -> ServedPredictor:
        """Read a predictor file; read it again if it changes meanwhile.

        Raises:
            InputError: the file cannot be read, or belongs to another arm or model.
        """
        digest, model = "", f"the model in use: {(model_hash or 'none')[:12]}"
        load_of_arm = partial(load, path, arm_hash=arm.hash, joint_names=arm.joint_names)
        try:
            while digest != (digest := file_hash(path)):
                predictor = load_of_arm(model_hash=model_hash, model=model)
        except OSError as error:
            allowed = "a readable file"
            raise InputError(path, "predictor file", error.strerror, allowed) from error
        return cls(predictor, digest)

    @classmethod
    def find(cls, told: str, arm: Arm) -> ServedPredictor | None:
        """Read the file that ``told``, a result of `describe`, names.

        None if the file cannot be read here, has another hash, or needs torch (no ``.npz``).
        """
        digest, _, path = told.partition(" ")
        if Path(path).suffix != ".npz":
            return None
        try:
            found = cls.read(path, arm)
        except LongarmError:
            return None
        return found if found.file_hash == digest else None

    def describe(self, path: str) -> str:
        """Return hash and absolute path of the predictor's file, for other nodes (`find`)."""
        return f"{self.file_hash} {Path(path).absolute()}"

    @property
    def beside_deflection(self) -> bool:
        return self.predictor.provenance.beside_deflection

    def expand(
        self, q: np.ndarray, sides: tuple[float, ...], temperature_c: float, payload_kg: float
    ) -> Expansion:
        """Predict the error at joints (n,), rad and m, that arrive from sides (n,): -1, 0 or +1.

        Unknown circumstances are NaN. All three axes get the largest sigma.
        """
        columns = {"temperature_c": temperature_c, "payload_kg": payload_kg}
        found = self.predictor.expand(q, Context(sides, columns))
        return replace(found, sigma=np.full(3, found.sigma.max()))


Found = TypeVar("Found")


class NoAnswer(JobError):  # noqa: N818
    """No predictor answered in time, it has no file, or it was trained for another method."""


_SERVED_S = 5.0 * BEAT_S
"""Age, s, up to which the last message about the served file counts; then `predict_error` is
called."""
_PROBE_S = 0.5, 4.0
"""First and longest wait for the answer to a probe, s. It doubles: a busy machine answers late."""


class PredictorClient:
    """Computes the learned error here, or calls the service `predict_error`.

    While `error_predictor` publishes which file it uses, and this file can be read here, the error
    is computed in this process. Otherwise the service is called in the thread of the caller. The
    predictor then counts as answering from its first answer until it is late once or leaves the
    graph. While it does not answer, `probe` sends requests in the background, so that the first
    target after its return is compensated with it.

    Args:
        timeout_s: longest wait for an answer, s.
        tell: called with every error (3,), m, that is computed here inside the domain.

    Attributes:
        file_hash: SHA-256 of the file of the predictor that answered last; "" if it did not tell.
    """

    def __init__(
        self,
        caller: ServiceCaller,
        arm: Arm,
        timeout_s: float,
        tell: Callable[[np.ndarray], None] = lambda error: None,
    ) -> None:
        self._caller, self._arm, self._timeout_s, self._tell = caller, arm, timeout_s, tell
        self._told, self._told_s = "", -math.inf
        self._read: ServedPredictor | None = None
        self._silent = False  # a question was not answered in time
        self._probe: int | None = None
        self._probed_s, self._patience_s = 0.0, _PROBE_S[0]
        self._answers = False
        self.file_hash = ""

    def on_served(self, message: String, sent: float | None) -> None:
        """Process a message about the served file: read the file if it is another than before."""
        if message.data != self._told:
            self._told, self._read = message.data, ServedPredictor.find(message.data, self._arm)
        self._told_s = sleepless_s() if sent is None else sent

    @property
    def _served_now(self) -> ServedPredictor | None:
        """The served predictor, if its file was read here and the last message is recent."""
        return self._read if sleepless_s() - self._told_s <= _SERVED_S else None

    @property
    def answers(self) -> bool:
        """True if an answer to the next request is to be expected."""
        return self._answers or self._served_now is not None

    def compensate_with(
        self, method: Method, compensate: Callable[[Nearby | None], Found]
    ) -> tuple[Found, str, str]:
        """Compensate with the predictor, or without if none answers or the method needs none.

        Returns:
            The compensation; the `file_hash` of the predictor used, or ""; and the reason why no
            predictor was used though the method needs one, or "".
        """
        why = ""
        if method.uses_predictor and (self._served_now or self._caller.present):
            try:  # mostly one call a target
                found = compensate(Nearby(partial(self.ask, deflection=method.uses_physics)))
                return found, self.file_hash, ""
            except NoAnswer as absent:
                why = absent.reason
        elif method.uses_predictor:
            why = "no error_predictor is running"
        return compensate(None), "", why

    def ask(self, q: np.ndarray, context: Context, *, deflection: bool = True) -> Expansion:
        """Return the expected error at joints (n,), rad and m, and its expansion around them.

        ``deflection``: whether the physics to which the error is added includes link deflection.

        Raises:
            NoAnswer: no predictor runs, it has no file, it does not answer in time, or it was
                trained with other physics.
        """
        known = [float(context.column(k, math.nan)) for k in ("temperature_c", "payload_kg")]
        if (served := self._served_now) is not None:
            found = served.expand(q, context.of_all("approach", self._arm.n), *known)
            self.file_hash = served.file_hash
            if found.in_domain:
                _check_physics(served.beside_deflection, deflection)
                self._tell(found.error)
            return found
        if not self._look_for_answer():
            raise NoAnswer("no error_predictor is running")
        if self._silent:  # only the first target waits for the timeout
            self.probe()
            raise NoAnswer("error_predictor does not answer, physics only until it answers")
        request = PredictError.Request(
            joints=joints_message(self._arm, q),
            approach=np.array(context.approach, np.int8),
            temperature_c=known[0],
            payload_kg=known[1],
        )
        answer = self._caller.answer(self._caller.send(request), self._timeout_s)
        self._note_state(answers=answer is not None, silent=answer is None)
        if answer is None:
            raise NoAnswer(f"error_predictor did not answer within {self._timeout_s:g} s")
        if not answer.success and math.isnan(answer.sigma):
            raise NoAnswer(answer.message)
        if answer.success:
            _check_physics(answer.beside_deflection, deflection)
        # Out of its domain it says why instead; its last message about the served file names it
        self.file_hash = answer.message if answer.success else self._told.partition(" ")[0]
        n, e = self._arm.n, answer.error
        expanded = len(answer.jacobian) == 3 * n and len(answer.reach) == n
        return Expansion(
            error=np.array([e.x, e.y, e.z]),
            sigma=np.full(3, answer.sigma),
            in_domain=bool(answer.success and answer.in_domain),
            reason="" if answer.success else answer.message,
            jacobian=np.reshape(answer.jacobian, (3, n)) if expanded else np.zeros((3, n)),
            reach=np.array(answer.reach) if expanded else np.zeros(n),
        )

    def probe(self) -> None:
        """Send a request to a predictor that did not answer so far; do not wait for the answer."""
        if not self._look_for_answer() or self.answers:
            return
        now = sleepless_s()
        if self._probe is None or now - self._probed_s > self._patience_s:
            if self._probe is not None:
                self._patience_s = min(2.0 * self._patience_s, _PROBE_S[1])
            self._probed_s = now
            anywhere = PredictError.Request(joints=joints_message(self._arm, self._arm.mid))
            self._probe = self._caller.send(anywhere)

    def _look_for_answer(self) -> bool:
        """Take the answer to a probe, if it has come; tell whether a predictor is on the graph."""
        if not self._caller.present:
            self._note_state(answers=False, silent=False)
            return False
        if self._probe is not None and self._caller.answer(self._probe, 0.0) is not None:
            self._note_state(answers=True, silent=False)
        return True

    def _note_state(self, *, answers: bool, silent: bool) -> None:
        self._answers, self._silent = answers, silent
        self._probe, self._patience_s = None, _PROBE_S[0]


def _check_physics(beside_deflection: bool, deflection: bool) -> None:
    """Raise `NoAnswer` unless the physics is as in training, with or without link deflection."""
    if beside_deflection != deflection:
        fits = Method.BOTH if beside_deflection else Method.NETWORK
        raise NoAnswer(f"its predictor was trained for method {fits.value!r}")
