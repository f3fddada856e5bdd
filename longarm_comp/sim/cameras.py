"""Two rendered cameras that observe a printed marker, for tests and for the simulated arm.

Geometry is exact: every image pixel is a grid of finer ones, each traced back through the lens
onto the marker's plane, so edges fall where they belong to a few thousandths of a pixel. Then come
defocus, motion blur, exposure, shot and read noise, and 8 bits. No geometry here is shared with
the measuring side (`devices/stereo`), so that each checks the other.

Optical frames: x right, y down, z forward. Marker frame: x right, y up, z towards the viewer,
origin in the middle of the plate. ``a_T_b`` takes points of b to a; metres.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from longarm_comp.core.errors import InputError
from longarm_comp.devices.camera_info import CameraInfo

Grey = NDArray[np.uint8]


@dataclass(frozen=True)
class Plate:
    """A printed plate: `texture` (H, W) uint8 stretched over `size_m` (width, height)."""

    texture: Grey
    size_m: tuple[float, float]


def tag_plate(
    tag_m: float,
    gap_m: float = 0.0,
    columns: int = 1,
    rows: int = 1,
    dictionary: str = "DICT_4X4_50",
    first_id: int = 0,
) -> Plate:
    """Return a grid of tags, ids along the rows from the top left, a white margin of 0.2 tags.

    Raises InputError if the gap is not a whole number of the tags' pixels.
    """
    known = _load_dictionary(dictionary)
    tag_px = 30 * known.markerSize
    gap_px, margin_px = round(gap_m / tag_m * tag_px), round(0.2 * tag_px)
    pitch = tag_px + gap_px
    if abs(gap_px / tag_px - gap_m / tag_m) > 1e-9:
        raise InputError("tag plate", "gap_m", gap_m, f"a multiple of tag_m / {tag_px}")
    height = rows * pitch - gap_px + 2 * margin_px
    width = columns * pitch - gap_px + 2 * margin_px
    texture = np.full((height, width), 255, dtype=np.uint8)
    for index in range(rows * columns):
        row, column = divmod(index, columns)
        top, left = margin_px + row * pitch, margin_px + column * pitch
        texture[top : top + tag_px, left : left + tag_px] = cv2.aruco.generateImageMarker(
            known, first_id + index, tag_px
        )
    texel = tag_m / tag_px
    return Plate(texture, (width * texel, height * texel))


def charuco_plate(
    square_m: float, tag_m: float, columns: int, rows: int, dictionary: str = "DICT_4X4_50"
) -> Plate:
    """Return a ChArUco board of `columns` x `rows` squares, drawn by OpenCV, without a margin."""
    board = cv2.aruco.CharucoBoard((columns, rows), square_m, tag_m, _load_dictionary(dictionary))
    texture = board.generateImage((160 * columns, 160 * rows))
    return Plate(np.asarray(texture, dtype=np.uint8), (columns * square_m, rows * square_m))


def _load_dictionary(name: str) -> cv2.aruco.Dictionary:
    known = sorted(key for key in vars(cv2.aruco) if key.startswith("DICT_"))
    if name not in known:
        raise InputError("plate", "dictionary", name, ", ".join(known))
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


Array = NDArray[np.float64]
Light = NDArray[np.float32]
Window = tuple[int, int, int, int]
_FINE = 6  # fine pixels along the side of an image pixel


@dataclass(frozen=True)
class CameraPair:
    """Two equal cameras. The defaults look along +y of the base from 1.7 m beside the arm."""

    position_m: tuple[float, float, float] = (0.75, -1.7, 0.3)
    """Left camera's centre in the base frame."""
    optical_axis: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Viewing direction of the left camera, base frame."""
    baseline_m: float = 0.3  # right camera's centre along the left camera's x
    focal_px: float = 800.0
    """focal_px, size: of both cameras; the principal point is the middle of the image."""
    size: tuple[int, int] = (640, 480)
    d: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Plumb-bob distortion k1 k2 p1 p2 k3 of both."""
    right_turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector (3,) of the right camera against the left."""

    @property
    def k(self) -> Array:
        """Intrinsic matrix (3, 3), px."""
        cx, cy = (self.size[0] - 1) / 2, (self.size[1] - 1) / 2
        return np.array([[self.focal_px, 0.0, cx], [0.0, self.focal_px, cy], [0.0, 0.0, 1.0]])

    @property
    def left_in_base(self) -> Array:
        """Pose (4, 4) of the left camera, level with the horizon."""
        z = np.asarray(self.optical_axis, dtype=float)
        z = z / np.linalg.norm(z)
        x = np.cross(z, [0.0, 0.0, 1.0])
        # Straight down or up every x is level
        x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0.0, 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([x, np.cross(z, x), z])
        pose[:3, 3] = self.position_m
        return pose

    @property
    def right_from_left(self) -> Array:
        """The transform (4, 4) of points from the left camera's frame to the right one's."""
        turn = cv2.Rodrigues(np.asarray(self.right_turn_rad, dtype=float))[0].T
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = turn, turn @ [-self.baseline_m, 0.0, 0.0]
        return out

    @property
    def camera_in_base(self) -> Array:
        """Pose (4, 4) of the rectified left optical frame, to which `camera_infos` refer."""
        out = self.left_in_base
        out[:3, :3] = out[:3, :3] @ self._compute_rectification()[0].T
        return out

    def camera_infos(self) -> tuple[CameraInfo, CameraInfo]:
        """Return the raw images' calibration, left and right, as camera drivers publish it."""
        left, right, p_left, p_right = self._compute_rectification()
        return self._make_info(left, p_left), self._make_info(right, p_right)

    def _make_info(self, r: Array, p: Array) -> CameraInfo:
        k, r_, p_ = (tuple(float(x) for x in a.ravel()) for a in (self.k, r, p))
        return CameraInfo(*self.size, "plumb_bob", self.d, k, r_, p_)

    def _compute_rectification(self) -> tuple[Array, Array, Array, Array]:
        d, move = np.asarray(self.d), self.right_from_left
        if not any(self.right_turn_rad):
            p = np.hstack([self.k, np.zeros((3, 1))])
            p_right = p.copy()
            p_right[0, 3] = -self.focal_px * self.baseline_m
            return np.eye(3), np.eye(3), p, p_right
        out = cv2.stereoRectify(self.k, d, self.k, d, self.size, move[:3, :3], move[:3, 3:])
        return out[0], out[1], out[2], out[3]


@dataclass(frozen=True)
class Conditions:
    """Light, lens and obstacles."""

    exposure: float = 0.75  # grey level = exposure * reflected light, then clipped at 255
    read_noise: float = 1.5
    """read_noise, shot_noise: grey levels; variance = read^2 + shot^2 * level / 255."""
    shot_noise: float = 3.0
    blur_px: float = 0.6  # Gaussian sigma of the lens, left and right alike
    motion_px: tuple[float, float] = (0.0, 0.0)
    """(right, down) path of the marker on the sensor during the exposure."""
    covered: tuple[float, float] = (0.0, 0.0)
    """Hidden share of the plate's width in the left and in the right image."""
    background: int = 0  # seed of the background


def render(
    base_T_marker: ArrayLike,
    plate: Plate,
    head: CameraPair,
    rng: np.random.Generator,
    conditions: Conditions | None = None,
) -> tuple[Grey, Grey]:
    """Return the two raw images (H, W) uint8 of a plate at a pose (4, 4) in the base frame."""
    conditions = conditions or Conditions()
    left, right = light(base_T_marker, plate, head, conditions)
    return expose(left, conditions, rng), expose(right, conditions, rng)


def light(
    base_T_marker: ArrayLike, plate: Plate, head: CameraPair, conditions: Conditions
) -> tuple[Light, Light]:
    """Compute the light on each pixel (H, W) of the left and the right camera, without noise."""
    left_T_marker = np.linalg.inv(head.left_in_base) @ np.asarray(base_T_marker, dtype=float)
    right_T_marker = head.right_from_left @ left_T_marker
    return (
        _light_camera(left_T_marker, plate, head, conditions, 0),
        _light_camera(right_T_marker, plate, head, conditions, 1),
    )


def expose(light: Light, conditions: Conditions, rng: np.random.Generator) -> Grey:
    """Make the image (H, W) of a camera from its light: exposure, shot and read noise, 8 bits."""
    level = conditions.exposure * light
    sigma = np.sqrt(conditions.read_noise**2 + conditions.shot_noise**2 * level / 255.0)
    noisy = level + sigma * rng.standard_normal(level.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _light_camera(
    camera_T_marker: Array, plate: Plate, head: CameraPair, conditions: Conditions, eye: int
) -> Light:
    light = _draw_background(conditions.background + eye, head.size, conditions.blur_px).copy()
    window = _find_window(camera_T_marker, plate, head, conditions)
    if window is not None:
        x0, y0, x1, y1 = window
        colour, share = _fine_plate(window, camera_T_marker, plate, head, conditions.covered[eye])
        colour, share = (_blur_plate(a, conditions) for a in (colour, share))
        patch = light[y0:y1, x0:x1]
        patch *= 1.0 - share
        patch += colour
    return light


def _find_window(
    camera_T_marker: Array, plate: Plate, head: CameraPair, conditions: Conditions
) -> Window | None:
    """Return the part of the image (x0, y0, x1, y1) that the blurred plate may touch."""
    half = np.asarray(plate.size_m) / 2
    outline = np.array([[x, y, 0.0] for x in (-half[0], half[0]) for y in (-half[1], half[1])])
    points = outline @ camera_T_marker[:3, :3].T + camera_T_marker[:3, 3]
    if points[:, 2].min() < 0.01:
        return None
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), head.k, np.asarray(head.d))[0]
    pad = 3.0 + 4.0 * conditions.blur_px + float(np.hypot(*conditions.motion_px))
    low = np.floor(pixels.reshape(-1, 2).min(axis=0) - pad)
    high = np.ceil(pixels.reshape(-1, 2).max(axis=0) + pad)
    x0, y0 = (int(v) for v in np.maximum(low, 0))
    x1, y1 = (int(v) for v in np.minimum(high, head.size))
    return (x0, y0, x1, y1) if x1 - x0 > 1 and y1 - y0 > 1 else None


def _fine_plate(
    window: Window, camera_T_marker: Array, plate: Plate, head: CameraPair, covered: float
) -> tuple[Light, Light]:
    """Return, for every fine pixel of a window, the light from the plate and the plate's share."""
    x0, y0, x1, y1 = window
    u = x0 - 0.5 + (np.arange((x1 - x0) * _FINE) + 0.5) / _FINE
    v = y0 - 0.5 + (np.arange((y1 - y0) * _FINE) + 0.5) / _FINE
    ray_x = (u - head.k[0, 2])[None] / head.focal_px
    ray_y = (v - head.k[1, 2])[:, None] / head.focal_px
    if any(head.d):
        ray_x, ray_y = _undistort_rays(window, head)
    to_plane = np.linalg.inv(camera_T_marker[:3, [0, 1, 3]])  # ray -> (X, Y, 1) of the plane
    to_plane[0] /= plate.size_m[0]
    to_plane[1] /= plate.size_m[1]
    to_plane, ray_x, ray_y = (a.astype(np.float32) for a in (to_plane, ray_x, ray_y))
    x, y, w = (row[0] * ray_x + (row[1] * ray_y + row[2]) for row in to_plane)
    across, down = x / w + np.float32(0.5), np.float32(0.5) - y / w
    height, width = plate.texture.shape
    colour = cv2.remap(
        plate.texture,
        across * np.float32(width) - np.float32(0.5),
        down * np.float32(height) - np.float32(0.5),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float32)
    from_behind = camera_T_marker[:3, 2] @ camera_T_marker[:3, 3] > 0.0
    # the plate's unprinted side, and what covers it
    colour[(across < covered) | from_behind] = 90.0
    share = ((np.abs(across - 0.5) <= 0.5) & (np.abs(down - 0.5) <= 0.5)).astype(np.float32)
    return colour * share, share


def _undistort_rays(window: Window, head: CameraPair) -> tuple[Array, Array]:
    """Compute rays x/z, y/z of fine pixels: exact at pixel centres, linear between them."""
    x0, y0, x1, y1 = window
    u, v = np.arange(x0 - 1.0, x1 + 1.0), np.arange(y0 - 1.0, y1 + 1.0)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-10)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(grid, head.k, np.asarray(head.d), criteria=stop)
    coarse = rays.reshape(v.size, u.size, 2)
    fine = cv2.resize(coarse, None, fx=_FINE, fy=_FINE, interpolation=cv2.INTER_LINEAR)
    inner = fine[_FINE:-_FINE, _FINE:-_FINE]
    return inner[..., 0], inner[..., 1]


def _blur_plate(fine: Light, conditions: Conditions) -> Light:
    """Apply lens blur, motion and the pixel's own area: fine pixels to image pixels."""
    if conditions.blur_px > 0.0:
        fine = cv2.GaussianBlur(fine, (0, 0), conditions.blur_px * _FINE)
    if any(conditions.motion_px):
        path = np.linspace(-0.5, 0.5, 201)[:, None] * np.asarray(conditions.motion_px) * _FINE
        half = int(np.ceil(np.abs(path).max())) + 1
        kernel = np.zeros((2 * half + 1, 2 * half + 1), dtype=np.float32)
        at = np.rint(path).astype(int) + half
        np.add.at(kernel, (at[:, 1], at[:, 0]), 1.0)
        fine = cv2.filter2D(fine, -1, kernel / kernel.sum())
    size = (fine.shape[1] // _FINE, fine.shape[0] // _FINE)
    return cv2.resize(fine, size, interpolation=cv2.INTER_AREA)


@lru_cache(maxsize=8)
def _draw_background(seed: int, size: tuple[int, int], blur_px: float) -> Light:
    """Draw a cluttered background: soft patches, sharp boxes, fine grain, lens blur."""
    rng = np.random.default_rng(seed)
    soft = rng.uniform(60.0, 150.0, (size[1] // 80 + 2, size[0] // 80 + 2)).astype(np.float32)
    wall = cv2.resize(soft, size, interpolation=cv2.INTER_CUBIC)
    for _ in range(25):
        x, y = rng.integers(0, size[0]), rng.integers(0, size[1])
        w, h = rng.integers(4, 90, 2)
        wall[y : y + h, x : x + w] = rng.uniform(30.0, 220.0)
    wall += rng.normal(0.0, 4.0, wall.shape).astype(np.float32)
    wall = np.clip(wall, 0.0, 255.0)
    return cv2.GaussianBlur(wall, (0, 0), blur_px) if blur_px > 0.0 else wall
