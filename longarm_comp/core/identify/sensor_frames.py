"""What the sensors of a session leave open: axes of tracked bodies, places of anchors and points.

Each is a measuring-side term with a prior that leaves it free, so its start must be close: it is
computed in closed form from the rows that it is in.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data import touched
from longarm_comp.core.data.kinds import KINDS, matrices
from longarm_comp.core.data.lifted_base import multilaterated
from longarm_comp.core.data.measurement import posture
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.anchor_place import AnchorPlace
from longarm_comp.core.effects.effect import Bias
from longarm_comp.core.effects.encoder import Encoder
from longarm_comp.core.effects.sensor_place import SensorPlace
from longarm_comp.core.effects.tip_orientation import TipOrientation
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.linear import MAD, OUTLIER
from longarm_comp.core.identify.placement import twist_of
from longarm_comp.core.model.model import Model
from longarm_comp.math.points import kabsch

_ROUNDS = 4


def sensor_frames(arm: Arm, session: Session) -> tuple[Bias, ...]:
    """The terms that a session's measurements need besides base and tip."""
    made: list[Bias] = []
    made += [TipOrientation(marker=m, sensor=s) for m, s in _bodies(arm, session)]
    for name in session.named(KINDS["distance"]):
        held = arm.anchors.get(name)
        if held is None or held.xyz_m is None:
            made.append(AnchorPlace(anchor=name))
    made += [SensorPlace(sensor=name) for name in _sensors(session)[1:]]
    made += [Encoder(joint=arm.commanded[k]) for k in session.read_joints]
    return (*made, *touched.unknowns(arm, session))


def _bodies(arm: Arm, session: Session) -> list[tuple[str, str]]:
    """Marker and sensor of every tracked body; empty where there is one."""
    nothing = np.full(len(session), "")
    several = len({b.sensor for b in session.blocks if b.kind == "orientation"}) > 1
    marker = session.labels.get("marker", nothing) if arm.markers else nothing
    sensor = session.labels["sensor"] if several else nothing
    seen = session.turned
    return sorted({(str(m), str(s)) for m, s in zip(marker[seen], sensor[seen], strict=True)})


def reference(session: Session) -> Session:
    """The rows in whose frame the base is placed: those of the first sensor of positions."""
    names = _sensors(session)
    return session if len(names) < 2 else session.where("sensor", names[0])


def _sensors(session: Session) -> list[str]:
    """Sensors of positions and poses, the one of most whole positions first."""
    framed = {b.sensor for b in session.blocks if b.kind in ("position", "orientation")}
    names = sorted(name for name in framed if name is not None)
    labels = session.labels.get("sensor", np.array([]))
    return sorted(names, key=lambda name: -int((session.located & (labels == name)).sum()))


def framed(arm: Arm, session: Session) -> bool:
    """Whether the rows measure in a frame of their own, in which the base is to be placed.

    Touches do not, nor distances to anchors that are all to be solved: their frame is the base.
    """
    return any(kind.framed(arm) for kind in session.kinds)


def started(model: Model, session: Session) -> Model:
    """The model with its sensor frames put where the rows say; others are left as they are.

    Raises:
        InputError: fewer rows than an anchor's place has unknowns.
    """

    def put(term: Bias) -> Bias:
        if isinstance(term, AnchorPlace):
            return _placed(term, model, session)
        return _moved(term, model, session) if isinstance(term, SensorPlace) else term

    model = dataclasses.replace(model, biases=tuple(put(term) for term in model.biases))
    bodies = (
        _turned(t, model, session) if isinstance(t, TipOrientation) else t for t in model.biases
    )
    model = dataclasses.replace(model, biases=tuple(bodies))
    if not any(term.passing for term in model.biases):
        return model
    tips = model.tip(session.q, session.context())
    return dataclasses.replace(model, biases=touched.started(model.biases, tips, session))


def _moved(term: SensorPlace, model: Model, session: Session) -> SensorPlace:
    """Rigid registration of the predicted tips to what the sensor sees."""
    rows = session.take(session.located & (session.labels["sensor"] == term.sensor))
    if len(rows) < 4:
        return term
    tips = model.tip(rows.q, rows.context())

    def solved(kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        motion = np.eye(4)
        turn, shift = kabsch(tips[kept], rows.xyz[kept], np.ones(int(kept.sum())))
        motion[:3, :3], motion[:3, 3] = turn, shift
        left = rows.xyz - tips @ turn.T - shift
        return np.concatenate(twist_of(motion)), np.linalg.norm(left, axis=1)

    names = ("x", "y", "z", "rx", "ry", "rz")
    return term.with_values(dict(zip(names, _robust(len(rows), solved), strict=True)))


def _turned(term: TipOrientation, model: Model, session: Session) -> TipOrientation:
    """Mean rotation from the predicted to the measured axes, in the tip's frame."""
    mine = session.turned.copy()
    for label, value in (("marker", term.marker), ("sensor", term.sensor)):
        if value:
            mine &= session.labels[label] == value
    rows = session.take(mine)
    others = tuple(t for t in model.biases if not isinstance(t, TipOrientation))
    bare = dataclasses.replace(model, biases=others)
    axes = bare.motion(posture(bare, rows), (), turns=True).axes()[0]
    seen = matrices(rows.readings["orientation"])
    between = Rotation.from_matrix(np.swapaxes(axes, 1, 2) @ seen)

    def solved(kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean = between[kept].mean()
        return mean.as_rotvec(), (mean.inv() * between).magnitude()

    rx, ry, rz = _robust(len(rows), solved)
    return dataclasses.replace(term, rx=float(rx), ry=float(ry), rz=float(rz))


def _placed(term: AnchorPlace, model: Model, session: Session) -> AnchorPlace:
    """Multilateration from the predicted tips."""
    measured = np.isfinite(session.readings["distance"][:, 0])
    rows = session.take(measured & (session.labels["anchor"] == term.anchor))
    if len(rows) < 4:
        allowed = "at least 4 where the anchor's place is to be solved"
        raise InputError(session.source, f"anchor {term.anchor}", f"{len(rows)} distances", allowed)
    tips = model.tip(rows.q, rows.context())
    x, y, z = multilaterated(tips, rows.readings["distance"][:, 0])
    return dataclasses.replace(term, x=float(x), y=float(y), z=float(z))


def _robust(rows: int, solved: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """A closed-form solution without the rows that are far from it."""
    kept = np.ones(rows, dtype=bool)
    answer, misfit = solved(kept)
    for _ in range(_ROUNDS):
        kept = misfit <= max(OUTLIER * MAD * float(np.median(misfit)), 1e-9)
        answer, misfit = solved(kept)
    return answer
