"""The linear sag of a whole arm by an independent frame-element library (PyNite)."""

from __future__ import annotations

from typing import Any

import numpy as np
from Pynite import FEModel3D

from longarm_comp.core.arm.arm import Arm


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
    model, gravity = FEModel3D(), -arm.gravity_mps2[2]
    model.add_node("N0", 0, 0, 0)
    model.def_support("N0", *[True] * 6)
    count, at = 0, np.zeros(3)
    frame, frames, nodes = np.eye(4), [np.eye(4)], ["N0"]

    def beam(end: np.ndarray, b: Any, loads: list[tuple[float, float]], length: float) -> None:
        nonlocal count, at
        count += 1
        model.add_node(f"N{count}", *end)
        name = f"M{count}"
        if b is None:
            model.add_material(name, 1e14, 1e14, 0.3, 0.0)
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
                reach = min(max(body - (ends[j] - ends[k]), 0.0), lengths[k])
                if reach > 0:
                    loads.append((beams[j].mass_kg / body, reach))
            beam(start + axis * ends[k], b, loads, lengths[k])
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
    masses = [(m.frame, m.mass_kg, m.position_m) for m in arm.point_masses]
    assert arm.payload is not None
    masses.append((arm.payload.frame, arm.payload.mass_kg, arm.payload.position_m))
    for number, mass, position in masses:
        lever = frames[number][:3, :3] @ np.array(position)
        moment = np.cross(lever, [0, 0, -mass * gravity])
        model.add_node_load(nodes[number], "FZ", -mass * gravity)
        for name, value in zip(("MX", "MY", "MZ"), moment, strict=True):
            model.add_node_load(nodes[number], name, float(value))
    model.analyze_linear()
    tip = model.nodes[f"N{count}"]
    return np.array([tip.DX["Combo 1"], tip.DY["Combo 1"], tip.DZ["Combo 1"]])
