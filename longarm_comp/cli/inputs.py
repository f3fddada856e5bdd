"""What commands read: an admitted session, the physics, the predictor that goes with it."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

from longarm_comp.cli.output import note
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.compensate import rigid
from longarm_comp.core.data.admission import FEW_POSES, admit
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.calibrate import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model
from longarm_comp.sessions.read import read_session

if TYPE_CHECKING:
    from longarm_comp.core.learn.predictor import Predictor


def admitted(
    path: Path, arm: Arm, model: Model | None = None, min_poses: int = FEW_POSES
) -> Session:
    """A session that passed admission; its findings are noted.

    Raises:
        InputError: it cannot be read, or cannot be what it claims to be.
    """
    admission = admit(read_session(path, arm), arm, model, min_poses)
    for finding in admission.findings:
        note(f"{path}: {finding}")
    return admission.session


def physics(arm: Arm, path: Path | None, deflection: bool = True) -> Model:
    """The calibrated model of a file, or the arm as declared; without its sag where asked."""
    if path is None:
        return declared_model(arm, deflection=deflection)
    model = load_model(path, arm)
    return model if deflection else rigid(model)


def physics_mark(path: Path | None, deflection: bool = True) -> dict[str, object]:
    """What a predictor was trained on top of; a different physics has a different residual."""
    digest = "" if path is None else hashlib.sha256(path.read_bytes()).hexdigest()
    return {"model_hash": digest, "deflection": deflection}


def trained(path: Path, arm: Arm, model_path: Path | None) -> tuple[Predictor, bool]:
    """A predictor that belongs to the arm and the model, and whether its physics has deflection.

    Raises:
        InputError: corrupt, or trained for another arm or on top of another model.
    """
    from longarm_comp.core.learn.predictor_file import belongs, load

    predictor = load(path, arm_hash=arm.hash, joint_names=arm.joint_names)
    deflection = predictor.provenance.beside_deflection
    wanted = str(physics_mark(model_path, deflection)["model_hash"])
    to = f"the --model that it was trained with, not {model_path or 'none'}"
    belongs(predictor, path, wanted, to)
    return predictor, deflection
