"""Rigid motions: axioms, and SciPy as the second opinion."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.spatial import IDENTITY, ZERO_TWIST, Frame, Twist

N = 200
EPS = 2e-16


def hat(twist: np.ndarray) -> np.ndarray:
    """Twist [d; delta] as a 4 x 4 matrix."""
    x, y, z, a, b, c = twist
    return np.array([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0]])


def twists(rng: np.random.Generator, angle: float, n: int = N) -> np.ndarray:
    """Random twists whose rotation is at most `angle`."""
    made = rng.normal(size=(n, 6))
    size = np.linalg.norm(made[:, 3:], axis=1)
    made[:, 3:] *= (angle * rng.random(n) / size)[:, None]
    return made


def frames(rng: np.random.Generator, n: int = N) -> np.ndarray:
    """Random poses, (n, 4, 4)."""
    made = np.tile(np.eye(4), (n, 1, 1))
    made[:, :3, :3] = Rotation.random(n, rng=rng).as_matrix()
    made[:, :3, 3] = rng.normal(size=(n, 3))
    return made


def floats(row: np.ndarray) -> Twist:
    return tuple(float(v) for v in row)  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("exp", "angle", "tolerance"),
    [(spatial.exp, 0.3, 1e-12), (spatial.exp, 1e-9, EPS), (spatial.exp_large, 3.1, 3e-13)],
)
def test_exp_is_the_matrix_exponential(
    rng: np.random.Generator, exp: Callable[[Twist], Frame], angle: float, tolerance: float
) -> None:
    for twist in twists(rng, angle, 40):
        want = expm(hat(twist))
        np.testing.assert_allclose(exp(floats(twist)).matrix(), want, atol=tolerance)


def test_log_brings_the_twist_back(rng: np.random.Generator) -> None:
    for twist in twists(rng, 2.5, 20):
        back = logm(spatial.exp_large(floats(twist)).matrix()).real
        np.testing.assert_allclose(back, hat(twist), atol=1e-11)


def frame_of(matrix: np.ndarray) -> Frame:
    """The frame of a matrix (4, 4), or of N."""
    columns = [[matrix[..., i, j] for i in range(3)] for j in range(4)]
    return Frame(*(tuple(float(c) if np.ndim(c) == 0 else c for c in v) for v in columns))  # type: ignore[arg-type]


def test_axioms_of_exp(rng: np.random.Generator) -> None:
    assert spatial.exp(ZERO_TWIST) == IDENTITY
    assert spatial.exp_large(ZERO_TWIST) == IDENTITY
    for exp, angle in ((spatial.exp, 0.15), (spatial.exp_large, 1.5)):
        for twist in twists(rng, angle, 30):
            whole = exp(floats(twist))
            turn = whole.matrix()[:3, :3]
            np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-13)
            assert np.linalg.det(turn) == pytest.approx(1.0, abs=1e-13)
            back = exp(floats(-twist))
            np.testing.assert_allclose(back.matrix(), np.linalg.inv(whole.matrix()), atol=1e-13)
            twice = exp(floats(2 * twist)).matrix()
            np.testing.assert_allclose((whole @ whole).matrix(), twice, atol=1e-13)


def test_small_and_large_meet_where_the_series_ends(rng: np.random.Generator) -> None:
    for angle in (1e-12, 1e-6, 0.0099, 0.0101, 0.1):
        twist = np.array([0.3, -0.2, 0.1, 0.0, 0.6 * angle, -0.8 * angle])
        small, large = spatial.exp(floats(twist)), spatial.exp_large(floats(twist))
        np.testing.assert_allclose(small.matrix(), large.matrix(), atol=2e-13)


def test_the_series_is_as_good_as_it_says(rng: np.random.Generator) -> None:
    """1e-12 up to 0.3 rad; beyond, it is not: the base, which may stand anywhere, is exact."""
    far = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 2.0])
    apart = np.abs(spatial.exp(floats(far)).matrix() - expm(hat(far))).max()
    assert 1e-6 < apart < 1e-2


@pytest.mark.parametrize("large", [False, True])
def test_tangent_is_the_derivative_of_the_matrix_exponential(
    rng: np.random.Generator, large: bool
) -> None:
    """Of small twists, of such beside the change of formulas at 0.1 rad, of large ones, of none."""
    sizes = (0.0, 0.1, 0.25, *((0.0999, 0.1001, 3.0) if large else ()))
    for angle in sizes:
        twist = np.array([0.4, -0.7, 0.2, *(angle * np.array([0.36, -0.48, 0.8]))])
        at = rng.normal(size=3)
        turns, shifts = spatial.tangent(floats(twist), tuple(map(float, at)), large)
        here = np.linalg.inv(expm(hat(twist)))
        for j, step in enumerate(1e-5 * np.eye(6)):
            change = here @ (expm(hat(twist + step)) - expm(hat(twist - step))) / 2e-5
            turn = np.zeros(3) if j < 3 else np.array(turns[j - 3])
            shift = turns[j] if j < 3 else shifts[j - 3]
            np.testing.assert_allclose(change @ (*at, 1.0), (*shift, 0.0), atol=2e-9)
            np.testing.assert_allclose(change[:3, :3], hat(np.append(ZERO_TWIST[:3], turn))[:3, :3],
                                       atol=2e-9)  # fmt: skip


def test_composition_and_turns_are_those_of_matrices(rng: np.random.Generator) -> None:
    for a, b in zip(frames(rng, 30), frames(rng, 30), strict=True):
        one, other = frame_of(a), frame_of(b)
        np.testing.assert_allclose((one @ other).matrix(), a @ b, atol=5e-16 * 8)
        v = tuple(float(x) for x in b[:3, 3])
        np.testing.assert_allclose(one.unrotate(v), a[:3, :3].T @ v, atol=1e-14)
        np.testing.assert_allclose(one.transform(v), (a @ np.array([*v, 1]))[:3], atol=1e-14)
        np.testing.assert_allclose(one.unrotate(one.rotate(v)), v, atol=1e-14)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_moves_along_and_turns_about_own_axes(rng: np.random.Generator, axis: int) -> None:
    matrix = frames(rng, 1)[0]
    frame = frame_of(matrix)
    moved = np.eye(4)
    moved[axis, 3] = 0.7
    np.testing.assert_allclose(frame.along(axis, 0.7).matrix(), matrix @ moved, atol=1e-15)
    for angle in (-2.0, 0.0, math.pi / 2, math.pi, 0.4):
        for name, got in (("x", frame.turned_x(angle)), ("z", frame.turned_z(angle))):
            want = matrix[:3, :3] @ Rotation.from_euler(name, angle).as_matrix()
            np.testing.assert_allclose(got.matrix()[:3, :3], want, atol=1e-15)
            assert got.p == frame.p


def test_right_angles_are_exact() -> None:
    assert IDENTITY.turned_x(math.radians(90)).o == (0.0, 0.0, 1.0)
    assert IDENTITY.turned_z(math.radians(-180)).n == (-1.0, 0.0, 0.0)
    assert IDENTITY.turned_z(math.radians(90)).turned_z(math.radians(270)) == IDENTITY


def test_roll_pitch_yaw_is_fixed_axis(rng: np.random.Generator) -> None:
    for angles in [*rng.uniform(-3, 3, (50, 3)), np.array([0.3, math.pi / 2, 0.2])]:
        got = spatial.rpy_frame((0.1, 0.2, 0.3), floats(angles)).matrix()  # type: ignore[arg-type]
        want = Rotation.from_euler("xyz", angles).as_matrix()  # lower case: fixed axes
        np.testing.assert_allclose(got[:3, :3], want, atol=1e-15)
        np.testing.assert_array_equal(got[:3, 3], [0.1, 0.2, 0.3])
        back = spatial.rpy_frame((0.0, 0.0, 0.0), spatial.roll_pitch_yaw(want)).matrix()
        np.testing.assert_allclose(back[:3, :3], want, atol=1e-14)


def test_floats_and_arrays_give_the_same_numbers(rng: np.random.Generator) -> None:
    """The same lines serve one posture and a session."""
    rows, places = twists(rng, 0.3), frames(rng)
    columns: Twist = tuple(np.ascontiguousarray(c) for c in rows.T)  # type: ignore[assignment]
    batch = frame_of(places)
    made = {
        "exp": batch @ spatial.exp(columns),
        "exp_large": batch @ spatial.exp_large(columns),
        "turned": batch.turned_z(columns[5]).along(2, columns[0]),
    }
    for k in range(N):
        one = frame_of(places[k])
        row = floats(rows[k])
        alone = {
            "exp": one @ spatial.exp(row),
            "exp_large": one @ spatial.exp_large(row),
            "turned": one.turned_z(row[5]).along(2, row[0]),
        }
        for name, frame in alone.items():
            scale = 1 + np.abs(frame.matrix()).max()
            apart = np.abs(made[name].matrix()[k] - frame.matrix()).max()
            assert apart <= 1e-15 * scale, name


@pytest.mark.parametrize("name", ["sin", "cos", "sqrt", "sign", "tanh", "absolute", "floor"])
def test_scalar_functions(rng: np.random.Generator, name: str) -> None:
    values = np.concatenate([rng.normal(size=50), [0.0, -0.0, 2.0]])
    values = np.abs(values) if name == "sqrt" else values
    function = getattr(spatial, name)
    alone = np.array([function(float(v)) for v in values])
    np.testing.assert_allclose(alone, getattr(np, name)(values), atol=EPS)
    np.testing.assert_allclose(function(values), alone, atol=EPS)


def test_choices() -> None:
    a, b = np.array([1.0, -2.0]), np.array([0.5, 3.0])
    np.testing.assert_array_equal(spatial.minimum(a, b), [0.5, -2.0])
    np.testing.assert_array_equal(spatial.maximum(a, 0.0), [1.0, 0.0])
    np.testing.assert_array_equal(spatial.where(a > 0, a, b), [1.0, 3.0])
    assert spatial.minimum(1.0, 2.0) == 1.0
    assert spatial.maximum(1.0, 2.0) == 2.0
    assert spatial.where(True, 1.0, 2.0) == 1.0
    assert spatial.atan2(1.0, -1.0) == math.atan2(1.0, -1.0)
