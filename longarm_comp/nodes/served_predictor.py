"""The predictor of `error_predictor`: other nodes that read the same file compute the same."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.expansion import Expansion
from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.files import file_hash
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.learn.predictor_file import load

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
