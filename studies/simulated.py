"""Sessions of the true arm: driven through poses, measured by its cameras and encoders."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from longarm_comp.core.data.session import Session
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import State, TrueContext
from studies.true_camera import Noise, TrueCamera

Array = np.ndarray
_Approach = Literal["both", "random", "mixed", "previous", "below"]


@dataclass(frozen=True)
class TrueEncoders:
    """Encoders of the motors: zero (n,) and scale (n,) off, noise and resolution, rad and m."""

    step: Array | float = 2 * np.pi / 4096 / 20
    zero: Array | float = 0.0
    scale: Array | float = 0.0
    sigma: Array | float = 0.0

    def read(self, shafts: Array, rng: np.random.Generator) -> Array:
        """Return (N, n) readings of where the motors stand."""
        seen = (1.0 + self.scale) * shafts + self.zero
        seen = seen + self.sigma * rng.standard_normal(shafts.shape)
        return np.asarray(np.round(seen / self.step) * self.step)


@dataclass(frozen=True)
class SimulatedSession:
    """A measured session and its truth.

    Attributes:
        session: as a diagnosis reads it.
        truth: noise-free: `tip` (N, 3) m, `seen` (N, 3) m with measuring-side effects, `side`
            (N, n) true approach, `written` (N,) side that was recorded, NaN where it was not,
            `outlier` (N,) bool.
    """

    session: Session
    truth: dict[str, Array] = field(repr=False)


def measure_session(
    true_arm: TrueArm,
    camera: TrueCamera,
    poses: Array,
    *,
    rng: np.random.Generator,
    approach: _Approach = "random",
    repeats: int = 0,
    lost: float = 0.0,
    outliers: float = 0.0,
    noise: Noise | None = None,
    start_s: float = 0.0,
    warming_k: float = 10.0,
    payload_kg: float | Array | None = None,
    encoders: TrueEncoders | None = None,
) -> SimulatedSession:
    """Drive the true arm through poses and measure its tip.

    Args:
        approach: `both`: every pose twice, from below and from above; `random`: one side at
            random; `mixed`: a third of these left blank; `previous`: all blank; `below`:
            every pose from below. A blank row arrives joint by joint from the row before.
        repeats: number of random poses that are visited two more times during the session.
        outliers: share of rows with a gross error of 4-15 mm.
        start_s: time of the first row.
        warming_k: rise of the room temperature over hours.
        encoders: of the motors; none are read by default.
    """
    arm = true_arm.arm
    poses = State.of(arm, poses, None).q
    order, repeat_id = _with_repeats(len(poses), repeats, approach == "both", rng)
    q = poses[order]
    rows = len(q)
    written = _written_side(approach, order, rng)
    side = arrival(q, written)
    t = np.round(start_s + np.cumsum(rng.uniform(13.0, 19.0, rows)), 1)
    temperature = np.round(_warming(t, arm.reference_temperature_c, warming_k, rng), 2)
    declared = arm.payload.mass_kg if arm.payload else 0.0
    mass = np.broadcast_to(declared if payload_kg is None else payload_kg, len(poses))[order]
    context = TrueContext(side, temperature, mass, t)
    tip = true_arm.tip(q, context)
    seen = camera.seen(tip, t)
    sight = camera.sight(seen)
    xyz = seen + (noise or Noise()).draw(sight, rng)
    gross = rng.random(rows) < outliers
    jump = rng.standard_normal((rows, 3)) * 0.4 + rng.choice([-1.0, 1.0], (rows, 1)) * sight
    jump *= rng.uniform(4e-3, 15e-3, (rows, 1)) / np.linalg.norm(jump, axis=1, keepdims=True)
    xyz = xyz + gross[:, None] * jump
    xyz[rng.random(rows) < lost] = np.nan
    columns = {"t_s": t, "temperature_c": temperature, "payload_kg": mass.astype(float)}
    for effect in true_arm.hidden:
        for name, clean in effect.readings(State.of(arm, q, context)).items():
            columns[name] = clean + 5e-5 * rng.standard_normal(rows)
    readings = {}
    if encoders is not None:
        read = encoders.read(true_arm.shafts(q, context), rng)
        readings = {f"read_q{k + 1}": read[:, k, None] for k in range(arm.n)}
    session = Session.record(
        q, xyz, approach=written, repeat_id=repeat_id, columns=columns, readings=readings,
        source="study",
    )  # fmt: skip
    truth = {"tip": tip, "seen": seen, "side": side, "written": written, "outlier": gross}
    return SimulatedSession(session, truth)


def arrival(q: Array, written: Array) -> Array:
    """Return the side (N, n) of -1, 0, +1 that each joint arrived from: below is +1.

    A row's written side (N,) holds for all joints. If it is blank (NaN), it follows from the motion
    of each joint; a joint that did not move keeps its side.
    """
    side = np.zeros_like(q)
    for k in range(len(q)):
        if np.isfinite(written[k]):
            side[k] = written[k]
        elif k > 0:
            moved = np.sign(np.round(q[k] - q[k - 1], 9))
            side[k] = np.where(moved != 0, moved, side[k - 1])
    return side


def _with_repeats(
    poses: int, repeats: int, both: bool, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Number the pose of every row; repeat id: the first row of that pose, -1 if it is single."""
    order = np.arange(poses)
    again = rng.choice(poses, min(repeats, poses), replace=False)
    for pose in np.repeat(again, 2):
        order = np.insert(order, rng.integers(0, len(order) + 1), pose)
    if both:
        order = np.repeat(order, 2)
    first = {pose: int(np.argmax(order == pose)) for pose in again}
    return order, np.array([first.get(pose, -1) for pose in order])


def _written_side(approach: _Approach, order: Array, rng: np.random.Generator) -> Array:
    side = rng.choice([-1.0, 1.0], len(order))
    if approach == "both":
        side[1::2] = -side[::2]
    if approach == "mixed":
        side[rng.random(len(order)) < 1 / 3] = np.nan
    if approach == "previous":
        side[:] = np.nan
    if approach == "below":
        side[:] = 1.0
    return side


def _warming(t: Array, start_c: float, rise: float, rng: np.random.Generator) -> Array:
    """Draw temperatures of room and motors: a rise over hours, fluctuations, read to 0.03 K."""
    slow = rise * -np.expm1(-t / 5000) + 0.15 * rise * np.sin(2 * np.pi * t / 2500)
    return start_c + slow + 0.03 * rng.standard_normal(len(t))
