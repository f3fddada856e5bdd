"""Rigid registration of an arm to its sightings: the poses of its bases, the places of its markers.

A row's sighting is ``R_g (o + B t_k) + p_g``.  The base of group g has the pose (R_g, p_g).  Marker
k is displaced by t_k in the frame that carries it.  o is its declared position, and B the axes of
that frame, both in the base frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model, unstack
from longarm_comp.math.points import nearest_rotation, robust_kabsch, robust_weights

_STEPS = 20
"""Largest number of Gauss-Newton steps, each with new robust weights."""
_MIN_ROWS = 3
"""Smallest number of rows that determines the rotation of a group's base."""


def median_distance(residual: np.ndarray) -> float:
    """Return the median length of (N, 3) residuals, m."""
    return float(np.median(np.linalg.norm(residual, axis=1)))


def median_spread(points: np.ndarray) -> float:
    """Return the median distance of (N, 3) points from their median, m."""
    return median_distance(points - np.median(points, axis=0))


@dataclass(frozen=True, eq=False)
class Sightings:
    """The measured points of a session's rows, and the declared positions of their markers."""

    point: np.ndarray  # (N, 3) declared place of the row's marker, m, in the base frame
    axes: np.ndarray  # (N, 3, 3) axes of the frame that carries it, in columns, in the base frame
    seen: np.ndarray  # (N, 3) measured point, m, in the frame of the measurements
    group: np.ndarray  # (N,) number of the base placement, 0..G-1
    marker: np.ndarray  # (N,) number of the marker, 0..K-1

    @classmethod
    def of(
        cls,
        model: Model,
        session: Session,
        groups: Sequence[str] | None = None,
        markers: Sequence[str] | None = None,
    ) -> Sightings:
        """Return the rows with a measured position beside where the model puts their markers.

        Args:
            model: a model without base or marker placements, which the registration finds.
            groups: names of the base placements; by default one per frame of the session.
            markers: names of the markers, empty for the tip; by default all of the arm's if the
                session has a column ``marker``, else the tip.
        """
        seen, arm = session.take(session.has_position), model.arm
        marked = "marker" in seen.labels and arm.markers
        markers = markers or (list(arm.markers) if marked else [""])
        group = seen.frames if groups is None else seen.texts("group")
        groups = groups or sorted(set(group)) or [""]
        marker = _numbers(seen.texts("marker"), markers)
        posture = model.posture(unstack(seen.q), seen.context())
        axes, point = np.empty((len(seen), 3, 3)), np.empty((len(seen), 3))
        for k, name in enumerate(markers):
            at = arm.markers[name] if name else arm.tip
            frame = posture.frames[posture.spot(name)].matrix()
            matrix = np.broadcast_to(frame, (len(seen), 4, 4))[marker == k]
            axes[marker == k] = matrix[:, :3, :3]
            point[marker == k] = matrix[:, :3, :3] @ np.array(at.position_m) + matrix[:, :3, 3]
        return cls(point, axes, seen.xyz, _numbers(group, groups), marker)


def _numbers(labels: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Return the index (N,) of each label in the names; 0 for a label that is not among them."""
    known = {name: k for k, name in enumerate(names)}
    return np.array([known.get(str(label), 0) for label in labels], dtype=int)


@dataclass(frozen=True, eq=False)
class Registration:
    """The poses of G bases, the places of K markers, and the residuals of N sightings."""

    rotation: np.ndarray  # (G, 3, 3) of each base in the frame of the measurements
    offset: np.ndarray  # (G, 3) m
    tip: np.ndarray  # (K, 3) m beyond each marker's declared place, in the frame that carries it
    residual: np.ndarray  # (N, 3) seen - registered, m

    @property
    def distance(self) -> np.ndarray:
        """(N,) distance of each sighting from the registered arm, m."""
        return np.linalg.norm(self.residual, axis=1)

    @property
    def misfit(self) -> float:
        """Median distance between the sightings and where the registered arm puts them, m."""
        return median_distance(self.residual)

    @classmethod
    def at(
        cls, rows: Sightings, rotation: np.ndarray, offset: np.ndarray, tip: np.ndarray
    ) -> Registration:
        """Return the registration with a known placement, and the residuals that it leaves."""
        local = rows.point + np.einsum("nij,nj->ni", rows.axes, tip[rows.marker])
        predicted = np.einsum("nij,nj->ni", rotation[rows.group], local) + offset[rows.group]
        return cls(rotation, offset, tip, rows.seen - predicted)


def register(rows: Sightings, tips: bool = True) -> Registration:
    """Find the bases and markers that bring the arm's points closest to the sightings, robustly.

    Without `tips` only the bases are found.  With it the markers are free too: two starts are
    refined, the declared markers and the linear solution, and the better result is kept.
    Directions that the rows do not determine stay as declared.
    """
    still = np.zeros((int(rows.marker.max()) + 1, 3))
    best = _refine(rows, still, tips)
    if tips:
        linear = _linear_tips(rows, robust_weights(best.distance))
        other = best if linear is None else _refine(rows, linear, tips)
        best = min(best, other, key=lambda r: r.misfit)
    return best


def _refine(rows: Sightings, tip: np.ndarray, tips: bool) -> Registration:
    """Fit the bases with fixed markers `tip`; then, with `tips`, both by Gauss-Newton."""
    groups = int(rows.group.max()) + 1
    point = rows.point + np.einsum("nij,nj->ni", rows.axes, tip[rows.marker])
    rotation, offset = np.zeros((groups, 3, 3)), np.zeros((groups, 3))
    counts = np.bincount(rows.group, minlength=groups)
    for g in sorted(range(groups), key=lambda g: -counts[g]):
        at, seen = point[rows.group == g], rows.seen[rows.group == g]
        if counts[g] < _MIN_ROWS:  # turned like the base of most rows
            rotation[g] = rotation[np.argmax(counts)]
            offset[g] = np.median(seen - at @ rotation[g].T, axis=0)
        else:
            rotation[g], offset[g] = robust_kabsch(at, seen)
    made = Registration.at(rows, rotation, offset, tip)
    for _ in range(_STEPS if tips else 0):
        following = _take_step(rows, made)
        if following.misfit > made.misfit:
            break
        before, made = made.misfit, following
        if made.misfit > (1.0 - 1e-3) * before:  # too little for another step
            break
    return made


def _take_step(rows: Sightings, now: Registration) -> Registration:
    """Take one weighted Gauss-Newton step of all base poses and marker positions."""
    n, groups, kinds = len(rows.seen), len(now.offset), len(now.tip)
    turned = rows.seen - now.residual
    centre = np.stack([turned[rows.group == g].mean(0) for g in range(groups)])
    arm = turned - centre[rows.group]
    design = np.zeros((n, 3, 6 * groups + 3 * kinds))
    every = np.arange(n)
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        design[every, j, 6 * rows.group + k] = arm[:, i]
        design[every, i, 6 * rows.group + k] = -arm[:, j]
        design[every, k, 6 * rows.group + 3 + k] = 1.0
    moved = np.einsum("nij,njk->nik", now.rotation[rows.group], rows.axes)
    for k in range(3):
        design[every, :, 6 * groups + 3 * rows.marker + k] = moved[:, :, k]
    root = np.sqrt(robust_weights(now.distance))[:, None]
    a = (design * root[..., None]).reshape(3 * n, -1)
    x = np.linalg.lstsq(a, (now.residual * root).reshape(-1), rcond=1e-7)[0]
    change = x[: 6 * groups].reshape(groups, 6)
    turn = Rotation.from_rotvec(change[:, :3]).as_matrix()
    rotation = turn @ now.rotation
    offset = np.einsum("gij,gj->gi", turn, now.offset - centre) + centre + change[:, 3:]
    return Registration.at(rows, rotation, offset, now.tip + x[6 * groups :].reshape(kinds, 3))


def _linear_tips(rows: Sightings, weights: np.ndarray) -> np.ndarray | None:
    """Return the marker displacements (K, 3), m, from a linear problem; None if undetermined.

    A sighting is linear, ``X o + sum_j Y_j B_j + p``, if X = R and the products Y_j of R and t are
    independent numbers.  Only the largest group is used, and only its markers are displaced.
    """
    g = int(np.argmax(np.bincount(rows.group)))
    tip = np.zeros((rows.marker.max() + 1, 3))
    for marker in range(len(tip)):
        mine = (rows.group == g) & (rows.marker == marker)
        count = int(mine.sum())
        if count < 4 * 13:
            continue
        point, axes = rows.point[mine], rows.axes[mine].reshape(count, 9)
        known = np.column_stack([point, axes, np.ones(count)])
        root = np.sqrt(weights[mine])[:, None]
        x, _, rank, _ = np.linalg.lstsq(known * root, rows.seen[mine] * root, rcond=1e-6)
        if rank < 13:
            continue
        rotation = nearest_rotation(x[:3].T)
        products = x[3:12].reshape(3, 3, 3)  # row i of B, column j of B, axis of the sighting
        local = np.einsum("ijk,kl->ijl", products, rotation)
        tip[marker] = np.einsum("iji->j", local) / 3
    return tip if tip.any() else None
