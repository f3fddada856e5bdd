"""Writes an arm's folder, whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.arm_folder.head import head_for
from longarm_comp.arm_folder.parameter_file import one_line, own_text, with_values
from longarm_comp.arm_folder.servos import DEFAULT_MODEL, servo_section
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.parts import link_places
from longarm_comp.core.effects.typical_loads import reach
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.devices.servo_bus.registry import models
from longarm_comp.share import folder

_COMMENTS = {
    "convention": "Modified DH (Craig): Rx(alpha) Tx(a) Rz(theta_offset + q) Tz(d), or Tz(d + q).",
    "tip": "The point that is commanded and measured, in the frame of a row.",
    "gravity_mps2": "In the base frame: z is up.",
    "payload": "What the arm carries; a session's column payload_kg overrules the mass.",
    "joints": "Rows of the chain, base to tip. limits: what plans and commands may use.",
    "links": "Elastic beams along d (z of the row) or a (x of the row before).\n"
    "E_pa and masses are usual values of the material: weigh the parts.",
    "point_masses": "Servos, grippers, links without a beam: kg, and the place in a row's frame.",
    "camera": "Left camera of the stereo head, in the base frame: as in stereo_bridge.yaml.",
}
_NO_LINKS = """No beam is declared: the arm is taken as rigid. What bends (docs/arm.md)
can lie along {places}:
links:
  - {{name: boom, row: {row}, role: {role}, length_m: {length:.4g},
     section: {{type: tube, od_m: 0.03, id_m: 0.026}}, E_pa: 6.9e+10, poisson: 0.33, mass_kg: 0.19,
     body_length_m: {length:.4g}}}"""
_NO_PAYLOAD = """No payload is declared. With one:
payload: {{mass_kg: 0.25, frame: {frame}, position_m: [0, 0, 0.05]}}"""
_NO_CAMERA = """What measures: tracker, total_station or touch; if absent, every error is tried.
measuring: tracker"""


def _comment_lines(text: str) -> list[str]:
    return [f"# {line}" for line in text.splitlines()]


ARM = "arm.yaml"
NODES = ("servo_driver", "stereo_bridge", "simulated_arm")
"""Nodes whose parameter files depend on the arm; the package's own serve for the others."""

_SERVOS = """The servos of {name}, one a joint. ASSUMED, so set all of it: servo_id, model,
gear_ratio or pinion_radius_m, direction, zero_ticks (reading at joint value 0), max_velocity.
Every key: docs/ros.md and devices/servo_config.py."""
_BRIDGE = """The stereo head beside {name}, and the marker on its tip. ASSUMED: hand_eye (where
the left camera stands), tag_m, gap_m (measure the print), tip_in_marker (0: its middle)."""
_SIMULATED = "The simulated {name}. Cameras and marker stand where stereo_bridge.yaml says they do."


def arm_file(
    data: Mapping[str, Any], head: str, of_rows: Mapping[int, str], *, seen: bool
) -> tuple[str, Arm]:
    """Return the text of an arm.yaml with the content `data`, and the arm.

    Args:
        head: comment on top.
        of_rows: comments beside rows of `joints`, by their id.
        seen: whether to add a camera that sees the tip.
    """
    whole = dict(data)
    if seen:
        stereo = head_for(Arm.parse(whole, ARM))["simulated_arm"]
        place, axis = stereo["camera.position"], stereo["camera.axis"]
        whole["camera"] = {"position_m": place, "optical_axis": axis}
    arm, lines = Arm.parse(whole, ARM), _comment_lines(head)
    for key, value in whole.items():
        if value in ([], {}, None):
            continue
        lines += _comment_lines(_COMMENTS.get(key, ""))
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            lines.append(f"{key}:")
            for row in value:
                beside = of_rows.get(row.get("id", 0), "") if key == "joints" else ""
                lines.append(f"  - {one_line(dict(row))}" + (f"  # {beside}" if beside else ""))
        else:
            lines.append(f"{key}: {one_line(value)}")
    places = link_places(arm.joints) or [(1, "a", 0.4)]
    named = ", ".join(f"row {row} {role} {size:.4g} m" for row, role, size in places)
    row, role, size = places[0]
    no_links = _NO_LINKS.format(places=named, row=row, role=role, length=abs(size))
    no_payload = _NO_PAYLOAD.format(frame=arm.tip.frame)
    for key, text in (("links", no_links), ("payload", no_payload), ("camera", _NO_CAMERA)):
        if not whole.get(key):
            lines += _comment_lines(text)
    return "\n".join(lines) + "\n", arm


def parameter_files(
    arm: Arm,
    servos: str = DEFAULT_MODEL,
    direct: bool = False,
    fastest: Mapping[int, float] | None = None,
) -> dict[str, str]:
    """Return the texts of the parameter files that fit an arm, by node; see `servo_section`."""
    values: dict[str, dict[str, Any]] = {
        "servo_driver": {
            "joints": servo_section(arm, servos, direct, fastest),
            "bus.protocol": models()[servos].protocol,
        }
    } | head_for(arm)
    values["simulated_arm"] |= {
        "payload_kg": arm.payload.mass_kg if arm.payload else 0.0,
        "temperature_c": arm.reference_temperature_c,
    }
    heads = dict(zip(NODES, (_SERVOS, _BRIDGE, _SIMULATED), strict=True))
    return {
        node: with_values(node, values[node], heads[node].format(name=arm.name)) for node in NODES
    }


def demonstration() -> dict[str, str]:
    files = {f"{node}.yaml": own_text(node) for node in NODES}
    return {ARM: (folder("config") / "arm_demo.yaml").read_text("utf-8"), **files}


def write_folder(out: Path, files: Mapping[str, str]) -> None:
    """Write a new folder of files in one step. Raises InputError if it cannot be written."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}."))
        try:
            for name, text in files.items():
                (made / name).write_text(text, encoding="utf-8", newline="\n")
            made.chmod(0o755)
            os.replace(made, out)
        finally:
            shutil.rmtree(made, ignore_errors=True)
    except OSError as error:
        raise InputError(out, "DIR", error.strerror or str(error), "a folder to write") from error


def narrow_limits(
    data: Mapping[str, Any], range_deg: float, home_deg: Mapping[str, float]
) -> tuple[dict[str, Any], dict[int, str]]:
    """Narrow the limits of revolute joints in the content of arm.yaml.

    Args:
        range_deg: largest range of a revolute joint; 0 keeps the limits.
        home_deg: middle of the new range by joint name; by default, that of the old range.

    Returns:
        The new content, and a note on the old range of each changed row, by its id.

    Raises:
        InputError: a joint is not known, or a middle is outside the old range.
    """
    names = [str(row.get("name") or f"joint{row['id']}") for row in data["joints"]]
    for name in home_deg:
        if name not in names:
            raise InputError("init", "--home", name, ", ".join(names))
    rows, notes = [], {}
    for name, row in zip(names, data["joints"], strict=True):
        limits = row.get("limits_deg")
        if limits is None:
            rows.append(row)
            continue
        low, high = map(float, limits)
        home = home_deg.get(name, (low + high) / 2)
        if not low <= home <= high:
            raise InputError("init", f"--home {name}", home, f"{low:g} to {high:g} deg")
        if not range_deg or high - low <= range_deg:
            rows.append(row)
            continue
        start = min(max(home - range_deg / 2, low), high - range_deg)
        made = [round(start, 6) + 0.0, round(start + range_deg, 6) + 0.0]
        rows.append({key: row[key] for key in row if key != "endless"} | {"limits_deg": made})
        notes[row["id"]] = f"whole range {low:g} to {high:g} deg"
    return {**data, "joints": rows}, notes


def find_range_in_sight(data: Mapping[str, Any], home_deg: Mapping[str, float]) -> float:
    """Return the largest range of revolute joints (deg) that two webcams near the arm can see.

    Near means at most 1.5 times the arm's reach from the tip, so that the marker is small. At least
    15 deg are returned.
    """
    for range_deg in (45.0, 40.0, 35.0, 30.0, 25.0, 20.0, 15.0):
        arm = Arm.parse(narrow_limits(data, range_deg, home_deg)[0], "arm.yaml")
        tip = declared_model(arm, deflection=False).tip(arm.mid)
        if np.linalg.norm(tip - head_for(arm)["stereo_bridge"]["hand_eye.xyz"]) <= 1.5 * reach(arm):
            break
    return range_deg
