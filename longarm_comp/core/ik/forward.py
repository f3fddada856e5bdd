"""Tip poses and postures of many joints at once, by the programs of the inverse kinematics."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.ik.engines import Engine, filled_blocks, is_compiled, rows_of
from longarm_comp.core.ik.kernel import Kernel
from longarm_comp.core.model.model import Model, unstack


def tip_poses(model: Model, q: np.ndarray, context: Context | None = None) -> np.ndarray:
    """True tip poses as by `Model.pose`, in machine code if the model is compiled.

    Args:
        q: joints (M, n), rad or m. context: of the M postures, scalars or (M,) arrays.

    Returns:
        (M, 4, 4), base frame.
    """
    context = context or Context()
    kernel = _compiled(model, context)
    if kernel is None or not len(q):
        return model.pose(q, context)
    out = _evaluated(kernel, q, context, "out")
    poses = np.zeros((len(q), 4, 4))
    poses[:, :3, 3] = out[:, :3]
    poses[:, :3, :3] = out[:, 3:12].reshape(-1, 3, 3).swapaxes(1, 2)
    poses[:, 3, 3] = 1.0
    return poses


def posture_at(model: Model, q: np.ndarray, context: Context) -> Posture:
    """`Model.posture` at joints (n,) or (M, n), without load passes if the model is compiled."""
    rows, kernel = np.atleast_2d(q), _compiled(model, context)
    if kernel is None or not len(rows):
        return model.posture(unstack(q), context)
    x = _evaluated(kernel, rows, context, "x")
    carried = np.ascontiguousarray(x.T) if q.ndim == 2 else x[0].tolist()
    return model.loaded(unstack(q), context, kernel.row.twists(carried))


def _compiled(model: Model, context: Context) -> Kernel | None:
    """The model's kernel, if it is compiled."""
    layout = context.layout
    kernel = model.__dict__.get("_kernels", {}).get(layout) if layout.traceable else None
    return kernel if kernel is not None and is_compiled(kernel, Engine.AUTO) else None


def _evaluated(kernel: Kernel, q: np.ndarray, context: Context, name: str) -> np.ndarray:
    """(M, k) rows of the state of that name after an evaluation at joints and contexts."""
    c = kernel.layout.pack(context, len(q))
    blocks = filled_blocks(kernel, {"trial": q, "c": c}, len(q))
    kernel.code.function("many_evaluate")(blocks.ctypes.data, len(blocks))
    return rows_of(blocks, kernel, name, len(q))
