"""arm.yaml as a person would write it: a comment over every section, a row a line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from longarm_comp.arm_folder.parameter_file import one_line

_COMMENTS = {
    "convention": "Modified DH (Craig): Rx(alpha) Tx(a) Rz(theta_offset + q) Tz(d), or Tz(d + q).",
    "tip": "The point that is commanded and measured, in the frame of a row.",
    "gravity_mps2": "In the base frame: z is up.",
    "payload": "What the arm carries; a session's column payload_kg overrides the mass.",
    "joints": "Rows of the chain, base to tip. limits: what plans and commands may use.",
    "links": "Elastic beams along d (z of the row) or a (x of the row before).\n"
    "E_pa and masses are usual values of the material: weigh the parts.",
    "point_masses": "Servos, grippers, links without a beam: kg, and the place in a row's frame.",
    "camera": "Left camera of the stereo head, in the base frame: as in stereo_bridge.yaml.",
}  # fmt: skip
_NO_LINKS = """No beam is declared: the arm is taken as rigid. For each piece that bends:
links:
  - {name: boom, row: 2, role: a, length_m: 0.4, section: {type: tube, od_m: 0.03, id_m: 0.026},
     E_pa: 6.9e+10, poisson: 0.33, mass_kg: 0.19, body_length_m: 0.4}"""
_NO_PAYLOAD = """Nothing is carried. Otherwise:
payload: {mass_kg: 0.25, frame: 6, position_m: [0, 0, 0.05]}"""


def arm_text(data: Mapping[str, Any], head: str, of_rows: Mapping[int, str]) -> str:
    """The file.

    Args:
        of_rows: a comment beside a row of `joints`, by id.
    """
    lines = _commented(head)
    for key, value in data.items():
        if value in ([], {}, None):
            continue
        lines += _commented(_COMMENTS.get(key, ""))
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            lines.append(f"{key}:")
            for row in value:
                beside = of_rows.get(row.get("id", 0), "") if key == "joints" else ""
                lines.append(f"  - {one_line(dict(row))}" + (f"  # {beside}" if beside else ""))
        else:
            lines.append(f"{key}: {one_line(value)}")
    for key, text in (("links", _NO_LINKS), ("payload", _NO_PAYLOAD)):
        if not data.get(key):
            lines += _commented(text)
    return "\n".join(lines) + "\n"


def _commented(text: str) -> list[str]:
    return [f"# {line}" for line in text.splitlines()]
