"""Writes an arm's folder, whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from longarm_comp.arm_folder.head import head_for
from longarm_comp.arm_folder.parameter_file import one_line, own_text, ros_parameters, with_values
from longarm_comp.arm_folder.servos import DEFAULT_MODEL, servo_section
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.parts import link_places
from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import parse_yaml
from longarm_comp.devices.servo_bus import models
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
}  # fmt: skip
_NO_LINKS = """No beam is declared: the arm is taken as rigid. For what bends (docs/arm.md):
links:
  - {{name: boom, row: {row}, role: {role}, length_m: {length:.4g},
     section: {{type: tube, od_m: 0.03, id_m: 0.026}}, E_pa: 6.9e+10, poisson: 0.33, mass_kg: 0.19,
     body_length_m: {length:.4g}}}"""
_NO_PAYLOAD = """No payload is declared. With one:
payload: {mass_kg: 0.25, frame: 6, position_m: [0, 0, 0.05]}"""
_NO_CAMERA = """What measures: tracker, total_station or touch; if absent, every error is tried.
measuring: tracker"""


def _arm_text(data: Mapping[str, Any], head: str, of_rows: Mapping[int, str], arm: Arm) -> str:
    """The file; ``of_rows``: a comment beside a row of `joints`, by id."""
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
    row, role, size = (link_places(arm.joints) or [(1, "a", 0.4)])[0]
    no_links = _NO_LINKS.format(row=row, role=role, length=abs(size))
    for key, text in (("links", no_links), ("payload", _NO_PAYLOAD), ("camera", _NO_CAMERA)):
        if not data.get(key):
            lines += _commented(text)
    return "\n".join(lines) + "\n"


def _commented(text: str) -> list[str]:
    return [f"# {line}" for line in text.splitlines()]


ARM = "arm.yaml"
NODES = ("servo_driver", "stereo_bridge", "simulated_arm")
"""Nodes whose parameter files depend on the arm; the package's own serve for the others."""

_SERVOS = """The servos of {name}, one a joint. ASSUMED, so set all of it: servo_id, model,
gear_ratio or pinion_radius_m, direction, zero_ticks (reading at joint value 0), max_velocity.
Every key: docs/ros.md and devices/servo_config.py."""
_BRIDGE = """The stereo head beside {name}, and the marker on its tip. ASSUMED: hand_eye (where
the left camera stands), tag_m, gap_m (measure the print), tip_in_marker (0: its middle)."""
_SIMULATED = (
    """The simulated {name}. Cameras and marker stand where stereo_bridge.yaml says they do."""
)


@dataclass(frozen=True)
class Source:
    """What an arm's folder is made from."""

    text: str
    arm: Arm

    @classmethod
    def of_data(
        cls, data: Mapping[str, Any], head: str, of_rows: Mapping[int, str], *, seen: bool
    ) -> Source:
        """From what arm.yaml shall hold; ``seen``: a camera is added."""
        arm, whole = Arm.parse(dict(data), ARM), dict(data)
        if seen:
            stereo = head_for(arm)
            whole["camera"] = {"position_m": list(stereo.position_m),
                               "optical_axis": list(stereo.axis)}  # fmt: skip
        return cls(_arm_text(whole, head, of_rows, arm), Arm.parse(whole, ARM))

    @classmethod
    def of_file(cls, path: Path) -> Source:
        """An arm.yaml that is there already."""
        arm = Arm.load(path)
        return cls(path.read_text("utf-8"), arm)


def parameter_files(arm: Arm, servos: str = DEFAULT_MODEL, direct: bool = False) -> dict[str, str]:
    """Texts of the parameter files that fit an arm, by node."""
    head = head_for(arm)
    carried = arm.payload.mass_kg if arm.payload else 0.0
    node = "servo_driver"
    bus = ros_parameters(parse_yaml(own_text(node), node), node)["bus"]
    values: dict[str, dict[str, Any]] = {
        "servo_driver": {
            "joints": servo_section(arm, servos, direct),
            "bus": bus | {"protocol": models()[servos].protocol},
        },
        "stereo_bridge": head.bridge(),
        "simulated_arm": head.simulated()
        | {"payload_kg": carried, "temperature_c": arm.reference_temperature_c},
    }
    heads = dict(zip(NODES, (_SERVOS, _BRIDGE, _SIMULATED), strict=True))
    return {
        node: with_values(node, values[node], heads[node].format(name=arm.name)) for node in NODES
    }


def demonstration() -> dict[str, str]:
    """Texts of the demonstration's files by name."""
    files = {f"{node}.yaml": own_text(node) for node in NODES}
    return {ARM: (folder("config") / "arm_demo.yaml").read_text("utf-8"), **files}


def files_of(source: Source, servos: str = DEFAULT_MODEL, direct: bool = False) -> dict[str, str]:
    """Texts of all files of an arm's folder by name; ``direct``: as in `servo_section`."""
    made = parameter_files(source.arm, servos, direct)
    return {ARM: source.text, **{f"{node}.yaml": text for node, text in made.items()}}


def check_free(out: Path) -> None:
    """Raise InputError where a folder cannot be made because something is there."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError("init", "DIR", out, "a new or empty folder")


def write_folder(out: Path, files: Mapping[str, str]) -> None:
    """Write a new folder of files in one step."""
    check_free(out)
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
