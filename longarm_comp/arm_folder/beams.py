"""The declared beams as they stand: section, which side is up, stiffness, and the arm's sag."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from longarm_comp.arm_folder.findings import FolderFinding, declared
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.beam import Beam, Rect, Tube
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model, unstack
from longarm_comp.core.vibration.modes import modes

_LINES = 4
"""Height of a drawing of a section's longer side; a character is twice as high as wide."""


def of_beams(arm: Arm, q: np.ndarray) -> Iterator[FolderFinding]:
    """A finding a beam, and one on the sag, at the pose of q (N, n) that reaches out farthest."""
    model, rigid = declared_model(arm), declared_model(arm, deflection=False)
    tips = rigid.tip(q)
    level = np.array(arm.gravity_mps2) / (np.linalg.norm(arm.gravity_mps2) or 1.0)
    out = tips - arm.base.xyz_m
    out = np.linalg.norm(out - (out @ level)[:, None] * level, axis=1)
    at = q[int(out.argmax())]
    posture = rigid.posture(unstack(at))
    for beam in arm.links:
        row = posture.chain.rows[beam.row - 1]
        element = (row.elements_a if beam.role == "a" else row.elements_d)[0]
        fell = np.array([float(v) for v in posture.gravity_in(element.station)])
        across = [(element.axis + 1) % 3, (element.axis + 2) % 3]
        text = f"{_section(beam)}; {_stiffness(beam)}; {1e3 * beam.mass_kg:.4g} g"
        if isinstance(beam.section, Rect):
            text += _standing(beam.section, fell[across], float(np.linalg.norm(fell)))
        yield declared(f"arm.yaml: links.{beam.name}", text)
    sag = 1e3 * float(np.linalg.norm(model.tip(at) - rigid.tip(at)))
    joints = ", ".join(
        f"{name} {_shown(arm, k, v)}"
        for k, (name, v) in enumerate(zip(arm.joint_names, at, strict=True))
    )
    said = f"held out to {out.max():.2f} m ({joints}) the tip sags by {sag:.3g} mm. Measure it: "
    yield declared("arm.yaml: links", said + "twice as much or half is a wrong section or side")
    yield from _ringing(model, at)


def _ringing(model: Model, at: np.ndarray) -> Iterator[FolderFinding]:
    """How it rings there."""
    hz = modes(model, at).hz
    if len(hz):
        known = model.arm.damping
        more = f"damping {known:g}" if known else "how long: longarm modes, and `damping`"
        yield declared("arm.yaml: damping", f"there it rings at {hz[0]:.3g} Hz; {more}")


def _shown(arm: Arm, k: int, value: float) -> str:
    turns = arm.joints[arm.commanded[k] - 1].type == "revolute"
    return f"{math.degrees(value):.0f} deg" if turns else f"{1e3 * value:.0f} mm"


def _section(beam: Beam) -> str:
    section = beam.section
    if section is None:
        return "EI and GJ as declared"
    if isinstance(section, Tube):
        inner = f"/{1e3 * section.id_m:.4g}" if section.id_m else ", solid"
        return f"tube {1e3 * section.od_m:.4g}{inner} mm"
    wall = f"wall {1e3 * section.wall_m:.4g}" if section.wall_m else "solid"
    return f"{1e3 * section.width_m:.4g} wide x {1e3 * section.height_m:.4g} high mm, {wall}"


def _stiffness(beam: Beam) -> str:
    first, second, torsion = beam.stiffness
    bending = f"{first:.3g}" if first == second else f"{first:.3g} and {second:.3g}"
    return f"EI {bending}, GJ {torsion:.3g} N m^2"


def _standing(section: Rect, fell: np.ndarray, gravity: float) -> str:
    """Which side is up, and the section drawn so; `fell`: gravity along width and height."""
    if np.linalg.norm(fell) < 0.1 * (gravity or 1.0):
        return "; the beam hangs or stands: neither side is up"
    lean = math.degrees(math.atan2(abs(fell[0]), abs(fell[1])))
    upright = lean <= 45.0
    wide, high = section.width_m, section.height_m
    if not upright:
        wide, high, lean = high, wide, 90.0 - lean
    per_line = max(wide, high) / _LINES
    lines, columns = max(1, round(high / per_line)), max(2, round(2 * wide / per_line))
    edge = f"    +{'-' * columns}+"
    drawn = [edge, *[f"    |{' ' * columns}|"] * lines, edge]
    side = "height_m" if upright else "width_m"
    return "\n".join([f"; {side} is upright there, to {lean:.0f} deg:", *drawn])
