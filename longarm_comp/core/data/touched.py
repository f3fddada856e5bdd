"""Points and planes that the tip touched.  A fit solves their positions with all other parameters.

Some points may be at known distances from each other.  Each such group has one point that may be
anywhere (`touch_place`).  Every other point of the group is placed relative to one that is placed
before it (`touch_beside`).
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.measuring import KnownDistance, known_distances
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.lifted_base import EXACT
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias
from longarm_comp.core.effects.touched_places import PlanePlace, TouchBeside, TouchPlace
from longarm_comp.core.effects.typical_loads import reach
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.tip_motion import stack

_Misfit = Callable[[np.ndarray], np.ndarray]  # points (N, 3) -> distances from a solution (N,), m
_OFF_SHARE = 0.1
"""Largest plausible error of a known distance, as the declared arm measures it, over the reach."""


def touched_terms(arm: Arm, session: Session) -> tuple[Bias, ...]:
    """Return the terms whose parameters are the places of the points and planes touched.

    Raises:
        InputError: the known distances between the points form a loop.
    """
    names = session.names_of(KINDS["touch"])
    distances = (*known_distances(arm.touch_distances), *session.touch_distances)
    edges = [d for d in distances if d[0] in names and d[1] in names]
    unplaced = list(names)
    points: list[tuple[str, KnownDistance | None, list[str]]] = []
    """Each point, the known distance that places it, and all points that are placed after it."""

    def place(name: str, by: KnownDistance | None) -> list[str]:
        unplaced.remove(name)
        after: list[str] = []
        points.append((name, by, after))
        for edge in edges:
            if edge is by or name not in edge[:2]:
                continue
            further = edge[1] if edge[0] == name else edge[0]
            if further not in unplaced:
                allowed = "one way of known distances from a point to another"
                raise session.error("touch_distances", f"a loop at {further}", allowed)
            after += place(further, edge)
        return [name, *after]

    while unplaced:
        place(unplaced[0], None)
    terms: list[Bias] = [
        TouchPlace(name, "\n".join(after))
        if known is None
        else TouchBeside(name, known[2], known[3], "\n".join(after))
        for name, known, after in points
    ]
    return (*terms, *(PlanePlace(name) for name in session.names_of(KINDS["plane"])))


def check_touches(session: Session, arm: Arm) -> Iterator[tuple[str, str]]:
    """Yield the field and the message of each finding about touches that determine nothing.

    Raises:
        InputError: no row determines anything; the rows are all touches but of several bases; the
            known distances form a loop; or one is far from the distance that the arm touched.
    """
    for kind in (k for k in KINDS.values() if not k.cells and k.label in session.labels):
        texts = session.labels[kind.label]
        lost = (texts != "") & np.isnan(session.reading(kind)[:, 0])
        few = [str(name) for name in np.unique(texts[lost])]
        if few:
            rows = f"{kind.takes + 1} rows or more"
            if not session.seen.any():
                allowed = f"{rows} of one name"
                raise session.error(kind.label, "each in too few rows", allowed)
            yield kind.label, f"{', '.join(few)}: in fewer than {rows}, which is too few"
    kinds = [kind for kind in session.kinds if not kind.cells]
    if not kinds:
        return
    touched_terms(arm, session)
    if len(np.unique(session.texts("group"))) > 1 and not session.has_own_frame(arm):
        why = "touches do not show where the bases stand"
        raise session.error(
            "group", "several", f"one base placement if all rows are touches: {why}"
        )
    tips = Model(arm).tip(session.q, session.context())
    touched = session.texts("touch")
    for one, other, length, _ in (*known_distances(arm.touch_distances), *session.touch_distances):
        ends = [tips[touched == name] for name in (one, other)]
        if not all(map(len, ends)):
            continue
        apart = float(np.linalg.norm(np.subtract(*(np.median(end, axis=0) for end in ends))))
        if abs(length - apart) > _OFF_SHARE * reach(arm):
            hint = " (this looks like millimetres)" if 500 < length / (apart or 1) < 2000 else ""
            allowed = f"metres, about {apart:.3g}, as the arm touched them{hint}"
            raise session.error(f"touch_distances: {one}, {other}", length, allowed)

    points = {name for kind in kinds for name in session.names_of(kind)}
    for one, other, *_ in session.touch_distances:
        if (one in points) != (other in points):
            yield "touch_distances", f"{other if one in points else one} was not touched"


def place_touched(terms: Sequence[Bias], tips: np.ndarray, session: Session) -> tuple[Bias, ...]:
    """Return a model's biases with each touched point and plane placed at the tips (N, 3), m."""
    places: dict[str, np.ndarray] = {}
    made: list[Bias] = []
    for term in terms:
        if isinstance(term, TouchPlace | TouchBeside):
            there = tips[session.labels["touch"] == term.touch]
            if len(there):
                term, place = _place_point(term, there, places.get(term.touch))
                places.update(dict.fromkeys(term.carries.splitlines(), place))
        elif isinstance(term, PlanePlace):
            there = tips[session.labels["plane"] == term.plane]
            term = _place_plane(term, there) if len(there) else term
        made.append(term)
    return tuple(made)


def with_touched(model: Model, session: Session, at: Posture) -> Model:
    """Return the model with a term for each touched point and plane of the session that it lacks.

    It may have been fitted to other rows.  `at` is the posture of the arm at these.
    """
    if all(kind.cells for kind in session.kinds):
        return model
    points = {t.touch for t in model.biases if isinstance(t, TouchPlace | TouchBeside)}
    planes = {t.plane for t in model.biases if isinstance(t, PlanePlace)}
    lacking = (
        *(TouchPlace(n) for n in session.names_of(KINDS["touch"]) if n not in points),
        *(PlanePlace(n) for n in session.names_of(KINDS["plane"]) if n not in planes),
    )
    if not lacking:
        return model
    tips = np.broadcast_to(stack(model.tip_frame(at).p), (len(session), 3))
    return model.plus(*place_touched(lacking, tips, session))


def _place_point(
    term: TouchPlace | TouchBeside, tips: np.ndarray, beside: np.ndarray | None
) -> tuple[TouchPlace | TouchBeside, np.ndarray]:
    """Place a touched point at the middle of the tips (k, 3), m; return its position too.

    `beside` is the position of the point that it is placed by, if there is one.
    """

    def solve(kept: np.ndarray) -> tuple[np.ndarray, _Misfit]:
        mean = kept.mean(axis=0)
        return mean, lambda points: np.linalg.norm(points - mean, axis=1)

    middle = _solve_robustly(tips, solve)
    if isinstance(term, TouchPlace) or beside is None:
        return term.with_values(dict(zip("xyz", middle, strict=True))), middle
    way = middle - beside
    length = float(np.linalg.norm(way))
    along = way / length if length > EXACT else np.array([1.0, 0.0, 0.0])
    turn = Rotation.align_vectors(along[None], np.array([[1.0, 0.0, 0.0]]))[0].as_rotvec()
    values = dict(zip(("rx", "ry", "rz"), turn, strict=True))
    return term.with_values({**values, "stretch": 0.0}), beside + term.distance * along


def _place_plane(term: PlanePlace, tips: np.ndarray) -> PlanePlace:
    def solve(kept: np.ndarray) -> tuple[np.ndarray, _Misfit]:
        middle = kept.mean(axis=0)
        normal = np.linalg.svd(kept - middle, full_matrices=True)[2][-1]
        normal = normal * (1.0 if normal[2] >= 0 else -1.0)
        return np.append(normal, normal @ middle), lambda points: np.abs((points - middle) @ normal)

    *normal, height = _solve_robustly(tips, solve)
    turn = np.cross(normal, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(turn))
    angle = np.arctan2(sine, normal[2]) / sine if sine > EXACT else 1.0
    return term.with_values({"z": height, "rx": angle * turn[0], "ry": angle * turn[1]})


def _solve_robustly(
    tips: np.ndarray, solve: Callable[[np.ndarray], tuple[np.ndarray, _Misfit]]
) -> np.ndarray:
    """Return the closed-form solution of tips (k, 3), m, that leaves out the tips far from it."""
    answer, misfit = solve(tips)
    for _ in range(4):
        away = misfit(tips)  # four standard deviations are six medians
        answer, misfit = solve(tips[away <= max(6.0 * float(np.median(away)), EXACT)])
    return answer
