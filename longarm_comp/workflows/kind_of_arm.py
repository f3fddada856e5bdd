"""Reads the models of other arms of a kind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.identify.kind_of_arm import KindOfArm
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import read_stored, restore
from longarm_comp.workflows.inputs import ModelLike, file_hash


def kind_from(arm: Arm, given: Sequence[ModelLike]) -> tuple[KindOfArm, str]:
    """What arms of a kind say of a further one, and which they are."""
    models, names, origins = [], [], []
    noise: dict[str, list[float]] = {}
    for number, each in enumerate(given, 1):
        if isinstance(each, Model):
            models.append(each.lasting())
            names.append(f"model {number}")
            origins.append(names[-1])
            continue
        path, beside = Path(each), Path(each).parent / "arm.yaml"
        stored = read_stored(path)
        models.append(restore(stored, Arm.load(beside) if beside.is_file() else arm, str(path)))
        names.append(str(path))
        origins.append(f"{path.name} {file_hash(path)[:12]}")
        for kind in KINDS:
            sigma = stored.provenance.get(noise_key(kind))
            if isinstance(sigma, float) and sigma > 0:
                noise.setdefault(kind, []).append(sigma)
    usual = {kind: float(np.median(held)) for kind, held in noise.items()}
    return KindOfArm.of(arm, models, names, usual), ", ".join(origins)


def noise_key(kind: str) -> str:
    """Key of a model.yaml's provenance: the noise of a kind of measurement, m or rad."""
    return f"noise_{kind}"
