"""Base of measuring-side biases: splits a point along and across the optical axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from longarm_comp.core.arm.spatial import Scalar, Vec, add, dot, scale, sub
from longarm_comp.core.effects.effect import Arm, Bias, Instrument, Sites


@dataclass(frozen=True)
class CameraView(Bias):
    """A bias that needs to know where the declared camera is."""

    instruments: ClassVar[Mapping[Instrument, str]] = {"camera": ""}

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [{}] if arm.camera is not None else []

    @staticmethod
    def split(point: Vec, arm: Arm) -> tuple[Vec, Scalar, Vec, Vec]:
        """(camera position, depth, optical axis, lateral part) of a point, m, base frame."""
        assert arm.camera is not None
        size = float(np.linalg.norm(arm.camera.optical_axis))
        axis = tuple(float(c) / size for c in arm.camera.optical_axis)
        ray = sub(point, arm.camera.position_m)
        depth = dot(ray, axis)  # type: ignore[arg-type]
        return arm.camera.position_m, depth, axis, sub(ray, scale(depth, axis))  # type: ignore[arg-type, return-value]

    @staticmethod
    def join(position: Vec, depth: Scalar, axis: Vec, lateral: Vec) -> Vec:
        return add(position, add(scale(depth, axis), lateral))
