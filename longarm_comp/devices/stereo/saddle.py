"""Sub-pixel chessboard corners, by fitting a model of a corner's grey values.

Around a corner the image is ``m + g (x - p) + c erf(d1 / s sqrt 2) erf(d2 / s sqrt 2)``: two
blurred edges through p, with d1 and d2 the signed distances from them, s the blur, c the contrast
and g a gradient of the light. Levenberg-Marquardt on all grey values of the window is the maximum
likelihood estimate under white noise; OpenCV's `cornerSubPix` uses only where the gradients point.
Same idea: Mallon & Whelan, Pattern Recognition Letters 28 (2007), which finds it free of the bias
that perspective and blur give to corner operators.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from longarm_comp.devices.stereo.camera import Array

_PASSES = 12
_MOVED_TOO_FAR_PX = 2.0


def refine_saddles(grey: NDArray[np.uint8], pixels: Array, half: int) -> Array:
    """Sub-pixel corners (N, 2) where four squares meet.

    Args:
        pixels: (N, 2) px, good to about a pixel.
        half: half window, px; it must not reach the next corner.

    Returns:
        Refined corners; those whose window leaves the image, or whose fit wanders, unchanged.
    """
    height, width = grey.shape
    middle = np.rint(pixels).astype(int)
    inside = np.all((middle >= half) & (middle < np.array([width, height]) - half), axis=1)
    out = np.array(pixels, dtype=float)
    if not np.any(inside):
        return out
    start, middle = out[inside], middle[inside]
    offset = np.arange(-half, half + 1)
    dx, dy = (a.ravel().astype(float) for a in np.meshgrid(offset, offset))
    window = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2) + middle[:, None]
    values = grey[window[..., 1], window[..., 0]].astype(float)
    weight = np.exp(-(dx**2 + dy**2) / (2 * (0.6 * half) ** 2))
    state = _start(grey, values, start - middle, middle)
    cost, jacobian, residual = _linearised(state, dx, dy, values, weight)
    damping = np.full(len(state), 1e-3)
    for _ in range(_PASSES):
        weighted = jacobian.transpose(0, 2, 1) * weight
        normal = weighted @ jacobian
        gradient = weighted @ residual[..., None]
        diagonal = np.einsum("nii->ni", normal)
        damped = normal + (damping[:, None] * diagonal + 1e-9)[:, :, None] * np.eye(9)
        step = np.linalg.solve(damped, gradient)[..., 0]
        tried = state + step
        tried[:, 4] = np.clip(tried[:, 4], 0.3, half / 2)
        new_cost, new_jacobian, new_residual = _linearised(tried, dx, dy, values, weight)
        better = new_cost < cost
        damping = np.where(better, damping * 0.2, damping * 8.0)
        state = np.where(better[:, None], tried, state)
        cost = np.where(better, new_cost, cost)
        jacobian = np.where(better[:, None, None], new_jacobian, jacobian)
        residual = np.where(better[:, None], new_residual, residual)
    found = state[:, :2] + middle
    strayed = np.linalg.norm(found - start, axis=1) > _MOVED_TOO_FAR_PX
    out[inside] = np.where(strayed[:, None], start, found)
    return out


def _start(grey: NDArray[np.uint8], values: Array, at: Array, middle: NDArray[np.int64]) -> Array:
    """State (N, 9): u, v, angle 1, angle 2, blur, contrast, level, slope x, slope y.

    The curvature of the smoothed image is a saddle whose principal axes halve the angles between
    the two edges; both edges start at 45 degrees to them.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), 2.0).astype(np.float64)
    picked = [
        cv2.Sobel(smooth, cv2.CV_64F, *order, ksize=3)[middle[:, 1], middle[:, 0]]
        for order in ((2, 0), (1, 1), (0, 2))
    ]
    axis = 0.5 * np.arctan2(2 * picked[1], picked[0] - picked[2])  # where it curves upwards most
    low, high = np.percentile(values, [10, 90], axis=1)
    state = np.zeros((len(at), 9))
    state[:, :2] = at
    state[:, 2], state[:, 3] = axis - np.pi / 4, axis + np.pi / 4
    state[:, 4], state[:, 5], state[:, 6] = 1.2, -(high - low) / 2, (high + low) / 2
    return state


def _linearised(
    state: Array, dx: Array, dy: Array, values: Array, weight: Array
) -> tuple[Array, Array, Array]:
    """Cost (N,), Jacobian of the model (N, M, 9) and residuals (N, M)."""
    u, v, angle_1, angle_2, blur, contrast, level, slope_x, slope_y = state.T[..., None]
    x, y = dx - u, dy - v
    edges, rates, alongs = [], [], []
    for angle in (angle_1, angle_2):
        cos, sin = np.cos(angle), np.sin(angle)
        distance = y * cos - x * sin
        edges.append(erf(distance / (np.sqrt(2) * blur)))
        rate = np.sqrt(2 / np.pi) / blur * np.exp(-0.5 * (distance / blur) ** 2)
        rates.append((rate, rate * sin, -rate * cos, -rate * distance / blur))
        alongs.append(-rate * (x * cos + y * sin))
    product = edges[0] * edges[1]
    by = [contrast * (rates[0][i] * edges[1] + rates[1][i] * edges[0]) for i in (1, 2, 3)]
    one = np.ones_like(x)
    jacobian = np.stack(
        [
            by[0] - slope_x,
            by[1] - slope_y,
            contrast * alongs[0] * edges[1],
            contrast * alongs[1] * edges[0],
            by[2],
            product,
            one,
            x,
            y,
        ],
        axis=-1,
    )
    residual = values - (level + slope_x * x + slope_y * y + contrast * product)
    return np.sum(weight * residual**2, axis=1), jacobian, residual
