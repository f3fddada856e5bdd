"""Refines corners to a hundredth of a pixel: edges of tags, saddle points of a chessboard."""

import cv2
import numpy as np
from numpy.typing import NDArray

from longarm_comp.devices.stereo.camera import Array

_ALONG = np.linspace(0.12, 0.88, 24)  # shares of a side at which the edge is located
_STEP_PX = 0.25  # between samples across an edge: four in a pixel
_REACH = (0.7, 0.5, 0.45, 0.45)  # half window across a side, in cells; one pass each


def refine_quads(grey: NDArray[np.uint8], quads: Array, modules: int) -> Array:
    """Locate the corners (N, 4, 2) of dark squares on light ground to a fraction of a pixel.

    Args:
        grey: (H, W) image.
        quads: (N, 4, 2) px, corners in order around each tag, accurate to about a pixel.
        modules: number of cells along a side, border included. The edge is sought within one cell.
    """
    quads = np.asarray(quads, dtype=float)
    for share in _REACH:
        start, end = quads, np.roll(quads, -1, axis=1)
        along = end - start
        length = np.linalg.norm(along, axis=2)
        normal = np.stack([along[..., 1], -along[..., 0]], axis=-1) / length[..., None]
        reach = float(np.clip(share * length.min() / modules, 1.0, 4.0))
        across = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
        feet = start[:, :, None] + _ALONG[:, None] * along[:, :, None]  # (N, 4, 24, 2)
        at = feet[..., None, :] + across[:, None] * normal[:, :, None, None]
        flat = at.reshape(-1, across.size, 2).astype(np.float32)
        values = cv2.remap(
            grey, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        rise = np.abs(np.diff(values.astype(float), axis=1))
        rise = np.maximum(rise - 0.15 * rise.max(axis=1, keepdims=True), 0.0)  # noise, paper
        middle = (across[1:] + across[:-1]) / 2
        offset = (rise @ middle / np.maximum(rise.sum(axis=1), 1e-9)).reshape(feet.shape[:3])
        edge = feet + offset[..., None] * normal[:, :, None]
        quads = _intersect_sides(edge, quads)
    return quads


def _intersect_sides(edge: Array, fallback: Array) -> Array:
    """Return the corners (N, 4, 2) between sides through the points ``edge`` (N, 4, M, 2).

    ``fallback``: corners to return for parallel sides or a result over 4 px away.
    """
    centre = edge.mean(axis=2)
    x, y = np.moveaxis(edge - centre[:, :, None], -1, 0)
    angle = 0.5 * np.arctan2(2 * np.sum(x * y, axis=2), np.sum(x * x - y * y, axis=2))
    nx, ny = -np.sin(angle), np.cos(angle)  # normal to the direction of the largest spread
    offset = nx * centre[..., 0] + ny * centre[..., 1]
    before = [np.roll(a, 1, axis=1) for a in (nx, ny, offset)]  # the side that ends in a corner
    cross = before[0] * ny - before[1] * nx
    parallel = np.abs(cross) < 1e-3
    cross = np.where(parallel, 1.0, cross)
    u = (before[2] * ny - before[1] * offset) / cross
    v = (before[0] * offset - before[2] * nx) / cross
    corners = np.stack([u, v], axis=-1)
    lost = parallel | (np.linalg.norm(corners - fallback, axis=-1) > 4.0)
    return np.where(lost[..., None], fallback, corners)


def refine_saddles(grey: NDArray[np.uint8], pixels: Array, half: int) -> Array:
    """Locate the corners (N, 2) where four squares meet to a fraction of a pixel.

    Args:
        grey: (H, W) image.
        pixels: (N, 2) px, accurate to about a pixel.
        half: half size of the window, px; the window must not reach the next corner.

    Returns:
        The refined corners (N, 2). A corner is unchanged if its window leaves the image, or if the
        fit moves it by more than 2 px.
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
    state = _guess_state(grey, values, start - middle, middle)
    for _ in range(12):
        jacobian, residual = _linearise_model(state, dx, dy, values)
        weighted = jacobian.transpose(0, 2, 1) * weight
        normal = weighted @ jacobian
        # Damped by a hundredth: parameters that the image hardly determines stay near their start
        damped = normal + (0.01 * np.einsum("nii->ni", normal) + 1e-9)[:, :, None] * np.eye(9)
        state = state + np.linalg.solve(damped, weighted @ residual[..., None])[..., 0]
        state[:, 4] = np.clip(state[:, 4], 0.3, half / 2)
    found = state[:, :2] + middle
    # Beyond 2 px it is another corner
    near = np.linalg.norm(found - start, axis=1) <= 2.0
    out[inside] = np.where(near[:, None], found, start)
    return out


def _guess_state(
    grey: NDArray[np.uint8], values: Array, at: Array, middle: NDArray[np.int64]
) -> Array:
    """Return the initial parameters (N, 9) of the corner model, in the order of `_linearise_model`.

    The principal axes of the smoothed image's curvature bisect the angles between the two edges.
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


def _linearise_model(state: Array, dx: Array, dy: Array, values: Array) -> tuple[Array, Array]:
    """Return the Jacobian (N, M, 9) and the residuals (N, M) of the corner model."""
    from scipy.special import erf  # takes a quarter of a second; tags do not need it

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
    turns = contrast * alongs[0] * edges[1], contrast * alongs[1] * edges[0]
    columns = by[0] - slope_x, by[1] - slope_y, *turns, by[2], product, one, x, y
    return np.stack(columns, axis=-1), values - (
        level + slope_x * x + slope_y * y + contrast * product
    )
