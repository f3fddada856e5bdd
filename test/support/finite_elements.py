"""Linear sag and modes of a whole arm by an independent frame-element library (PyNite)."""

from typing import Any

import numpy as np
from Pynite import FEModel3D

from longarm_comp.core.arm.arm import Arm

Weight = tuple[str, float, np.ndarray]


def stiffened(arm: Arm, factor: float) -> Arm:
    """The arm with all moduli times `factor`."""
    data = arm.model_dump(mode="json", exclude_none=True)
    for beam in data["links"]:
        beam["E_pa"] *= factor
    return Arm.parse(data, "test")


def mdh(alpha: float, a: float, theta: float, d: float) -> np.ndarray:
    """One Craig row, written out."""
    ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
    return np.array(
        [
            [ct, -st, 0, a],
            [st * ca, ct * ca, -sa, -d * sa],
            [st * sa, ct * sa, ca, d * ca],
            [0, 0, 0, 1],
        ]
    )


def fe_sag(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Linear sag of the tip by frame elements in the undeformed posture, (3,) m."""
    model, last, weights, _ = frame_model(arm, q)
    for node, mass, lever in weights:
        weight = np.array([0, 0, mass * arm.gravity_mps2[2]])
        model.add_node_load(node, "FZ", float(weight[2]))
        for name, value in zip(("MX", "MY", "MZ"), np.cross(lever, weight), strict=True):
            model.add_node_load(node, name, float(value))
    model.analyze_linear()
    tip = model.nodes[last]
    return np.array([tip.DX["Combo 1"], tip.DY["Combo 1"], tip.DZ["Combo 1"]])


def fe_frequencies(arm: Arm, q: np.ndarray) -> np.ndarray:
    """The slowest frequencies by frame elements in the undeformed posture, (4,) Hz."""
    model, _, weights, lumps = frame_model(arm, q, pieces=12, rigid=1e11)
    model.analyze_linear()
    names = list(model.nodes)
    stiff = np.asarray(model.Ke("Combo 1", sparse=False))
    heavy = np.zeros_like(stiff)
    for node, mass, (x, y, z) in (*weights, *lumps):  # eccentric: a node's turn moves it too
        at = 6 * names.index(node) + np.arange(6)
        motion = np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])
        heavy[np.ix_(at, at)] += mass * motion.T @ motion
    free = np.delete(np.arange(len(stiff)), 6 * names.index("N0") + np.arange(6))
    stiff, heavy = stiff[np.ix_(free, free)], heavy[np.ix_(free, free)]
    slow = np.sort(np.linalg.eigvals(np.linalg.solve(stiff, heavy)).real)[::-1][:4]
    return np.asarray(1.0 / (2.0 * np.pi * np.sqrt(slow)))


def frame_model(
    arm: Arm, q: np.ndarray, pieces: int = 1, rigid: float = 1e14
) -> tuple[FEModel3D, str, list[Weight], list[Weight]]:
    """The arm as frame elements, its beams' weight as loads along z.

    Args:
        pieces: members that each beam is cut in. rigid: modulus of what joins the beams, Pa.

    Returns:
        The model, the name of its last node, the other masses (node, kg, lever (3,) m), and
        those of the beams, halves at both ends of every member.
    """
    model, gravity = FEModel3D(), -arm.gravity_mps2[2]
    model.add_node("N0", 0, 0, 0)
    model.def_support("N0", *[True] * 6)
    lumps: list[Weight] = []
    count, at = 0, np.zeros(3)
    frame, frames, nodes = np.eye(4), [np.eye(4)], ["N0"]

    def beam(end: np.ndarray, b: Any, loads: list[tuple[float, float]], length: float) -> None:
        nonlocal count, at
        count += 1
        model.add_node(f"N{count}", *end)
        name = f"M{count}"
        if b is None:
            model.add_material(name, rigid, rigid, 0.3, 0.0)
            model.add_section(name, 1e-3, 1e-5, 1e-5, 2e-5)
        else:
            first, second, torsion = b.stiffness
            model.add_material(name, b.E_pa, b.E_pa / (2 * (1 + b.poisson)), b.poisson, 0.0)
            shear = b.E_pa / (2 * (1 + b.poisson))
            model.add_section(name, 1e-2, first / b.E_pa, second / b.E_pa, torsion / shear)
        model.add_member(name, f"N{count - 1}", f"N{count}", name, name)
        for density, reach in loads:
            w = -density * gravity
            model.add_member_dist_load(name, "FZ", w, w, length - reach, length)
            for node in (f"N{count - 1}", f"N{count}"):
                lumps.append((node, 0.5 * density * reach, np.zeros(3)))
        at = end

    def run(start: np.ndarray, axis: np.ndarray, size: float, row: int, role: str) -> None:
        beams = [b for b in arm.links if b.row == row and b.role == role]
        fixed = sum(b.length_m for b in beams if b.length_m != "rest")
        lengths = [size - fixed if b.length_m == "rest" else b.length_m for b in beams]
        ends = np.cumsum(lengths)
        for k, b in enumerate(beams):
            loads = []
            for j in range(k, len(beams)):
                body = beams[j].body_length_m
                assert body is not None
                reach = min(max(body - (ends[j] - ends[k]), 0.0), lengths[k])
                if reach > 0:
                    loads.append((beams[j].mass_kg / body, reach))
            begun = ends[k] - lengths[k]
            for far in np.linspace(0.0, lengths[k], pieces + 1)[1:]:
                piece, back = lengths[k] / pieces, lengths[k] - far
                mine = [(w, min(max(reach - back, 0.0), piece)) for w, reach in loads]
                held = [(w, reach) for w, reach in mine if reach > 0]
                beam(start + axis * (begun + far), b, held, piece)
        if not beams and abs(size) > 0:
            beam(start + axis * size, None, [], abs(size))

    for k, joint in enumerate(arm.joints):
        theta, d = np.radians(joint.theta_offset_deg), joint.d_m
        theta, d = (theta + q[k], d) if joint.type == "revolute" else (theta, d + q[k])
        alpha = np.radians(joint.alpha_deg)
        run(at, frame[:3, 0], joint.a_m, k + 1, "a")
        frame = frame @ mdh(alpha, joint.a_m, theta, d)
        run(at, frame[:3, 2], d, k + 1, "d")
        assert np.allclose(at, frame[:3, 3])
        frames.append(frame)
        nodes.append(f"N{count}")
    held = [(m.frame, m.mass_kg, m.position_m) for m in arm.point_masses]
    assert arm.payload is not None
    held.append((arm.payload.frame, arm.payload.mass_kg, arm.payload.position_m))
    weights = [(nodes[k], mass, frames[k][:3, :3] @ np.array(at)) for k, mass, at in held]
    return model, f"N{count}", weights, lumps
