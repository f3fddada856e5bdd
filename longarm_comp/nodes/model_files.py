"""The declared arm and the model in use, loaded from arm.yaml and model.yaml."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import NEVER_TOLD
from longarm_comp.core.compensation.target_frame import Placement, base_of_graph
from longarm_comp.core.effects.effect import Bias
from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.files import file_hash
from longarm_comp.core.model.by_readings import by_readings
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model
from longarm_comp.nodes.health import ERROR, OK, WARN, Report

OLD = "; its file does not say where its rows stood, so any command in their ranges counts as near"


@dataclass(frozen=True)
class _LoadedModel:
    model: Model
    file_hash: str = ""  # SHA-256; empty for the declared arm
    learned: int = 0  # number of learned models that have replaced the loaded one since

    @cached_property
    def stands(self) -> Placement:
        """The graph's base frame as the model places it."""
        return base_of_graph(self.model)


class ModelFiles:
    """The arm, read once from arm.yaml, and its model, read again from model.yaml on demand.

    Effects that depend on circumstances which no topic publishes are left out of the model.

    Args:
        trimmed: whether the driver trims the joints: errors that encoders see are left out too.

    Attributes:
        rigid: the model of the declared arm without effects.
        loaded: the model in use, which may be a learned one.
        given: the model as read from the file, or the declared one.
        loads: number of times that model.yaml was read successfully.
    """

    def __init__(self, arm_path: str, model_path: str, trimmed: bool = False) -> None:
        if not arm_path:
            raise InputError("parameters", "arm", arm_path, "path of arm.yaml")
        self.arm = Arm.load(arm_path)
        self._path = model_path
        self.rigid = Model(self.arm)
        self._of_commands = by_readings if trimmed else (lambda model: model)
        self.loaded = self.given = _LoadedModel(self._of_commands(declared_model(self.arm)))
        self._fault, self._left_out, self._unread = "", list[str](), ""
        self.loads = 0
        self.reload()

    def reload(self) -> tuple[bool, str]:
        """Read model.yaml again; return success and a message. On failure the old model stays."""
        if not self._path:
            return True, "the arm as declared: no model.yaml is configured"
        try:
            model = load_model(self._path, self.arm)
            told = [t for t in model.terms if isinstance(t, Bias) or t.commandable]
            kept = model.with_terms(told)
            self._left_out = sorted({e.name for e in model.effects if e not in kept.effects})
            self.loaded = self.given = _LoadedModel(self._of_commands(kept), file_hash(self._path))
        except LongarmError as error:
            self._fault = str(error)
            return False, self._fault
        self._fault = ""
        self.loads += 1
        return True, f"{self._path} {self.loaded.file_hash[:12]}"

    def replace_model(self, model: Model) -> None:
        """Use a learned model instead of the file's model."""
        if model is not self.loaded.model:
            self.loaded = replace(self.loaded, model=model, learned=self.loaded.learned + 1)

    def follow_learned(self, path: str) -> None:
        """Use the model that another node learned at work and saved in a file; "": the given one.

        If the file cannot be read, the present state of the arm is unknown: `refusal` says so.
        """
        from longarm_comp.core.at_work import file  # imports SciPy: only where it is needed

        self._unread = ""
        if not path:
            self.replace_model(self.given.model)
            return
        try:
            if not Path(path).exists():
                raise InputError(path, "file", "missing", "what kinematics learned at work")
            learned = file.load(path, self.given.model, self.given.file_hash)
            self.replace_model(learned.model)
        except LongarmError as error:
            self._unread = str(error)

    @property
    def refusal(self) -> str:
        """The reason why no target may be computed: an existing model cannot be read; or empty.

        The declared arm is no substitute for it, because the tip would go elsewhere.
        """
        lost = self._fault and not self.loaded.file_hash and Path(self._path).exists()
        return f"the model cannot be used: {self._fault}" if lost else self._unread

    def report(self) -> Report:
        facts = {"file": self._path, "sha256": self.loaded.file_hash, "loads": self.loads}
        if self.loaded.file_hash and self._fault:
            return Report(WARN, f"the last good model is kept: {self._fault}", facts)
        if why := self.refusal:
            return Report(ERROR, why, facts)
        if not self.loaded.file_hash:
            said = "not calibrated yet: plan, collect, diagnose; the arm as declared is used"
            return Report(WARN, said, facts)
        left_out = f"; left out {', '.join(self._left_out)} {NEVER_TOLD}" if self._left_out else ""
        known = self.given.model.uncertainty
        old = OLD if known is not None and known.domain is None else ""
        return Report(OK, f"calibrated model loaded{left_out}{old}", facts)
