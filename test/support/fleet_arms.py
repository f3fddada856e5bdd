"""Folders of arms of a fleet: their declaration, and rows with one wrong joint zero."""

import dataclasses
import json
from pathlib import Path

import numpy as np
from small_arm import ARM, measured

from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.model.model import Model


def rows_of(zero: float, seed: int, n: int = 60) -> Session:
    """Rows of an arm whose second joint's zero is off by so much (rad)."""
    session = measured(n, np.random.default_rng(seed))
    tip = Model(ARM, (JointZero(joint=2, offset=zero),)).tip(session.q)
    noise = 1e-4 * np.random.default_rng(seed + 1).standard_normal(tip.shape)
    return dataclasses.replace(session, xyz=tip + noise)


def arm_yaml(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(ARM.model_dump(mode="json", exclude_defaults=True))
    (folder / "arm.yaml").write_text(text, encoding="utf-8")
